"""The three shipped robots: what their MJCF under assets/ cannot say.

Masses, shapes, joints, PD gains and feet are in the file; loader.py derives symmetries and the order of steps from it.
"""

from pathlib import Path

from envs.loader import Robot, shipped

ASSETS = Path(__file__).resolve().parent.parent / "assets"

# Fields of a robot.toml: see docs/your-robot.md. Angles in rad.
WISHES = {
    # Pose: Isaac Lab's ANYMAL_D_CFG.
    "anymal_d": {
        "pose": {"HAA": 0.0, "F_HFE": 0.4, "F_KFE": -0.8, "H_HFE": -0.4, "H_KFE": 0.8},
        "action_scale": 0.5,
    },
    # Pose: MuJoCo Menagerie's "home". Front-back is no symmetry here, since all knees bend the same way.
    # Deviation (Go1 pose): Isaac Lab's (thighs 0.8 and 1.0, calves -1.5) lets the hind feet trail.
    "go1": {"pose": {"hip": 0.0, "thigh": 0.9, "calf": -1.8}, "action_scale": 0.25},
    # Pose: MuJoCo Playground's "knees bent".
    # Deviation (G1 action scale): Isaac Lab's is 0.5 for every joint, which asks arms for 1.5 times their torque limit
    # per unit of action. As in mjlab a unit asks for a quarter of the limit, but never for more than 0.5 rad; loader.py
    # has the rule.
    "g1": {
        "pose": {
            "": 0.0,  # all others
            **{"hip_pitch": -0.312, "knee": 0.669, "ankle_pitch": -0.363, "waist_pitch": 0.073},
            **{"shoulder_pitch": 0.2, "left_shoulder_roll": 0.2, "right_shoulder_roll": -0.2, "elbow": 0.6},
        },
    },
}
ROBOTS = {name: Robot.of(shipped(ASSETS / f"{name}.xml", wishes)) for name, wishes in WISHES.items()}
