"""Tasks of a robot from a file: exploration, and velocity tracking (`loco`). Numbers follow from its body.

Quadrupeds and the like have Go1's task, bipeds one with a gait's clock, like G1's without its named joints. Sums over
joints weigh as over Go1's twelve, torques as a share of the motors' limits.
"""

import dataclasses

from envs.explore import EXPLORE, ExploreConfig
from envs.locomotion import G1_LOCO, GO1_LOCO, ROBUST, ROBUST_QUADRUPED, STEP_WEIGHTS

GO1_EFFORT = 4 * (2 * 23.7**2 + 35.55**2)  # [N^2 m^2] sum of its squared torque limits
PER_JOINT = ("joint_acc", "joint_vel", "action", "action_rate", "pose", "stand_still")
BIPED_TERMS = (
    "in_step",
    "foot_path",
    "slip",
    "impact",
    "stand_still",
    "stand_on_feet",
    "vertical_vel",
    "power",
    "alive",
)


def scaled(weights, body):
    """Weights of Go1's terms for another body."""
    shares = dict.fromkeys(PER_JOINT, 12 / len(body["joints"])) | {"torque": GO1_EFFORT / body["effort"]}
    return {name: weight * shares.get(name, 1.0) for name, weight in weights.items()}


def shared(body):
    """Fields of every config for a body."""
    fields = {name: tuple(body[name]) for name in ("added_mass", "contact_ends")}
    return fields | {"robot": body["name"], "body": body, "max_tilt": body["max_tilt"]}


def loco(body):
    """Config of velocity tracking for a body."""
    weights, steps = scaled(GO1_LOCO.weights, body), scaled(STEP_WEIGHTS, body)
    friction = min(0.01 * max(body["torque_limit"]), 0.05 * min(body["torque_limit"]))  # one number for all joints
    robust = {"added_mass": tuple(body["added_mass"]), "joint_friction": (0.0, friction)}
    if len(body["feet"]) > 2:
        robust |= ROBUST_QUADRUPED | {"weights": weights | steps, "gait_hz": 2.8, "stance": 0.5}
        return dataclasses.replace(GO1_LOCO, **shared(body), weights=weights, robust=robust)
    terms = {name: G1_LOCO.weights[name] for name in BIPED_TERMS}
    weights |= scaled(terms, body) | {"track_yaw_rate": 1.5, "orientation": -1.0, "air_time": 0.0, "pose": -0.2}
    same = ("ppo", "termination_reward", "lin_vel_x", "lin_vel_y", "command_seconds", "standing", "turning")
    same += ("on_the_spot", "tracking_seconds", "gait_hz", "swing_height")
    fields = {name: getattr(G1_LOCO, name) for name in same}
    fields["march"] = True  # H1, told to stand, fell once it had put both feet down
    robust |= ROBUST | {"tracking_seconds": 0.2, "lin_vel_x": (-0.8, 1.2)}
    return dataclasses.replace(GO1_LOCO, **shared(body), **fields, weights=weights, robust=robust)


def explore(body):
    """Config of exploration for a body."""
    like = EXPLORE["go1" if len(body["feet"]) > 2 else "g1"]
    fields = {name: getattr(like, name) for name in ("ppo", "noise", "reward_floor", "friction", "link_mass")}
    fields |= {name: getattr(like, name) for name in ("spawn_joints", "spawn_velocity", "push_seconds")}
    fields |= {name: body[name] for name in ("perturb_force", "push_velocity")}
    return ExploreConfig(**shared(body), **fields, weights=scaled(EXPLORE["go1"].weights, body))
