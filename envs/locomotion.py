"""Velocity tracking on flat ground, blind: anymal_loco, go1_loco, g1_loco (paper Sec. V-A; Isaac Lab's flat tasks).

A command is a forward velocity, a sideways velocity and a heading. The heading error sets the turning rate.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp

from envs import rewards
from envs.base import Env, FootClocks, joint_indices, select, soft_limits, uniform
from envs.config import Config, Range
from envs.rotations import axis_angle, inverse, rotate, wrap


@dataclass(frozen=True)
class LocomotionConfig(Config):
    """Numbers of a velocity-tracking task."""

    lin_vel_x: Range = (-1.0, 1.0)  # [m/s] forward command
    lin_vel_y: Range = (-1.0, 1.0)  # [m/s] sideways command
    yaw_rate: float = 1.0  # [rad/s] half-width of the turning command
    command_seconds: float = 10.0  # time between commands
    standing: float = 0.02  # share of commands to stand still
    fixed_velocity: tuple[float, float] | None = None  # [m/s] forward, sideways with heading 0, in place of commands
    air_time_threshold: float = 0.5  # [s]
    effort_joints: tuple[str, ...] = ("",)  # parts of the names of joints with torque and acceleration penalties


@flax.struct.dataclass
class Task(FootClocks):
    """State of velocity tracking."""

    command: jax.Array  # (3,) forward [m/s], sideways [m/s], turning [rad/s], base frame
    heading: jax.Array  # () commanded yaw [rad]
    moves: jax.Array  # () bool: not a command to stand still


class Locomotion(Env):
    # Deviation (input scaling): as in legged_gym. Isaac Lab feeds inputs raw.
    OBS = {
        "lin_vel": ("polar", 2.0),
        "ang_vel": ("axial", 0.25),
        "gravity": ("polar", 1.0),
        "command": ("planar", (2.0, 2.0, 0.25)),
        "joint_pos": ("joint", 1.0),
        "joint_vel": ("joint", 0.05),
        "action": ("joint", 0.5),
    }
    SHOWCASE_FIELDS = {"fixed_velocity": (0.8, 0.0), "spawn_yaw": 0.0, "spawn_xy": 0.0}
    COMMAND_RANGES = {"forward [m/s]": (-1.0, 1.0), "sideways [m/s]": (-1.0, 1.0), "turning [rad/s]": (-1.0, 1.0)}

    def __init__(self, config, engine="auto"):
        super().__init__(config, engine)
        self.effort = joint_indices(self.robot, *config.effort_joints)
        self.command_steps = round(config.command_seconds / self.dt)

    def init_task(self, key, physics, course):
        feet = jnp.zeros(len(self.robot.feet))
        command, heading, moves = self.draw_command(key)
        task = Task(feet, feet, feet, command=command, heading=heading, moves=moves)
        return self.steer(task, self.motion(physics).yaw)

    def draw_command(self, key):
        """A new command: velocity (3,), heading () and `moves` ()."""
        c = self.config
        if c.fixed_velocity is not None:
            return jnp.array([*c.fixed_velocity, 0.0]), jnp.zeros(()), jnp.ones((), bool)
        k_x, k_y, k_heading, k_stand = jax.random.split(key, 4)
        command = jnp.stack([uniform(k_x, *c.lin_vel_x), uniform(k_y, *c.lin_vel_y), 0.0])
        return command, uniform(k_heading, -jnp.pi, jnp.pi), uniform(k_stand, 0.0, 1.0) >= c.standing

    def steer(self, task, yaw):
        """Set the turning rate from the heading error, and all velocities to 0 for a command to stand still."""
        turn = jnp.clip(0.5 * wrap(task.heading - yaw), -self.config.yaw_rate, self.config.yaw_rate)
        return task.replace(command=jnp.where(task.moves, task.command.at[2].set(turn), 0.0))

    def set_command(self, task, command):
        return task.replace(command=command)

    def before_rewards(self, task, motion):
        return task.tick(motion.foot_contact, self.dt)

    def after_rewards(self, key, task, motion, clock):
        command, heading, moves = self.draw_command(key)
        due = clock % self.command_steps == 0
        task = select(due, task.replace(command=command, heading=heading, moves=moves), task)
        return self.steer(task, motion.yaw)

    def task_inputs(self, task, motion, clock):
        return {"command": task.command}

    def rewards(self, task, motion, action, last_action, clock):
        m, c = motion, self.config
        return {
            "track_lin_vel": rewards.track_lin_vel(task.command[:2], m.lin_vel[:2]),
            "track_yaw_rate": rewards.track_yaw_rate(task.command[2], m.ang_vel[2]),
            "vertical_vel": rewards.square(m.lin_vel[2]),
            "roll_pitch_rate": rewards.square(m.ang_vel[:2]),
            "orientation": rewards.square(m.gravity[:2]),
            "torque": rewards.square(m.torque[self.effort]),
            "joint_acc": rewards.square(m.joint_acc[self.effort]),
            "action_rate": rewards.square(action - last_action),
            "air_time": rewards.air_time(task.landed_after, c.air_time_threshold, task.command),
            "slip": rewards.slip(m.foot_vel, m.foot_contact),
            "pose": rewards.square(m.joint_pos),
            "alive": jnp.ones(()),
        }

    def task_metrics(self, task, motion, truncated):
        return {
            "lin_vel_error": jnp.linalg.norm(task.command[:2] - motion.lin_vel[:2]),  # [m/s]
            "yaw_rate_error": jnp.abs(task.command[2] - motion.ang_vel[2]),  # [rad/s]
        }


class AnymalLocomotion(Locomotion):
    """ANYmal D, with a penalty for thighs that touch the ground."""

    def __init__(self, config, engine="auto"):
        super().__init__(config, engine)
        self.thighs = self.engine.sensor(*(f"{foot.replace('foot', 'thigh')}_force" for foot in self.robot.feet))

    def rewards(self, task, motion, action, last_action, clock):
        thighs = motion.sensors[self.thighs]
        return super().rewards(task, motion, action, last_action, clock) | {"thigh_contact": rewards.touching(thighs)}


class G1Locomotion(Locomotion):
    """G1, with terms for a biped's gait and for joints that should stay near the default pose."""

    def __init__(self, config, engine="auto"):
        super().__init__(config, engine)
        self.ankles = joint_indices(self.robot, "ankle")
        self.hips = joint_indices(self.robot, "hip_roll", "hip_yaw")
        self.arms = joint_indices(self.robot, "shoulder", "elbow", "wrist")
        self.waist = joint_indices(self.robot, "waist")
        self.soft_limits = soft_limits(self.model, 0.9)

    def rewards(self, task, motion, action, last_action, clock):
        m = motion
        low, high = self.soft_limits
        # Velocities are tracked in the heading frame: a trunk that leans or pitches loses no reward.
        upright = axis_angle(jnp.array([0.0, 0, 1]), m.yaw)
        lin_vel, ang_vel = (rotate(inverse(upright), rotate(m.quat, v)) for v in (m.lin_vel, m.ang_vel))
        ankles = (m.joint_pos + self.default_pose)[self.ankles]
        return super().rewards(task, motion, action, last_action, clock) | {
            "track_lin_vel": rewards.track_lin_vel(task.command[:2], lin_vel[:2]),
            "track_yaw_rate": rewards.track_yaw_rate(task.command[2], ang_vel[2]),
            "flight": rewards.flight(m.foot_contact, task.command),
            "one_foot": rewards.one_foot(m.foot_contact, task.command),
            "single_stance": rewards.single_stance(task.air_time, task.contact_time, task.command),
            "ankle_limits": rewards.beyond(ankles, low[self.ankles], high[self.ankles]),
            "hip_deviation": jnp.sum(jnp.abs(m.joint_pos[self.hips])),
            "arm_deviation": jnp.sum(jnp.abs(m.joint_pos[self.arms])),
            "waist_deviation": jnp.sum(jnp.abs(m.joint_pos[self.waist])),
        }


# Deviation (reward weights): Isaac Lab's make every early return negative at CPU batch sizes: robots learn to fall.
# So roll_pitch_rate, torque and joint_acc weigh a quarter, being alive is rewarded, and the total has a floor. air_time
# counts from 0.1 s. slip and pose keep quadrupeds from dragging their feet.
# Deviation (entropy bonus): none (Isaac Lab: 0.005 to 0.01). With it the policy comes to depend on its own noise.
BLIND_QUADRUPED = {
    "hidden": (128, 128, 128),
    "entropy": 0.0,
    "init_std": 1.0,
    "cpu": {"num_envs": 256, "total_steps": 4_000_000},
    "gpu": {"total_steps": 29_500_000},
}

ANYMAL_LOCO = LocomotionConfig(
    robot="anymal_d",
    weights={
        "track_lin_vel": 1.0,
        "track_yaw_rate": 0.5,
        "vertical_vel": -2.0,
        "roll_pitch_rate": -0.0125,
        "torque": -6.25e-6,
        "joint_acc": -6.25e-8,
        "action_rate": -0.01,
        "air_time": 0.5,
        "slip": -0.1,
        "pose": -0.1,
        "thigh_contact": -1.0,
        "orientation": -5.0,
        "alive": 0.25,
    },
    ppo=BLIND_QUADRUPED | {"cpu": {"num_envs": 256, "total_steps": 6_000_000}},
    air_time_threshold=0.1,
    spawn_joints=(0.5, 1.5),
    spawn_velocity=0.5,
    added_mass=(-5.0, 5.0),
    push_velocity=0.5,
)

GO1_LOCO = LocomotionConfig(
    robot="go1",
    weights={
        "track_lin_vel": 1.5,
        "track_yaw_rate": 0.75,
        "vertical_vel": -2.0,
        "roll_pitch_rate": -0.0125,
        "torque": -5e-5,
        "joint_acc": -6.25e-8,
        "action_rate": -0.01,
        "air_time": 1.0,
        "slip": -0.1,
        "pose": -0.1,
        "orientation": -2.5,
        "alive": 0.25,
    },
    ppo=BLIND_QUADRUPED,
    air_time_threshold=0.1,
    added_mass=(-1.0, 3.0),
)

G1_PARTS = ("thigh", "shin", "upperarm", "forearm", "hand")

G1_LOCO = LocomotionConfig(
    robot="g1",
    weights={
        "track_lin_vel": 1.0,
        "track_yaw_rate": 1.0,
        # Deviation (G1 gait): With Isaac Lab's 0.75 and no flight term it hops on both feet. Without one_foot and
        # air_time it shuffles on both at once. waist_deviation is -0.1 there, but their G1 cannot bow.
        "single_stance": 2.0,
        "one_foot": 0.5,
        "air_time": 1.0,
        "flight": -1.0,
        "slip": -0.1,
        "ankle_limits": -1.0,
        "hip_deviation": -0.1,
        "arm_deviation": -0.05,
        "waist_deviation": -0.5,
        "vertical_vel": -0.2,
        "roll_pitch_rate": -0.0125,
        "orientation": -1.0,
        "action_rate": -0.0025,
        "joint_acc": -1e-7,
        "torque": -2e-6,
        "alive": 0.5,
    },
    ppo={
        "hidden": (256, 128, 128),
        "entropy": 0.0,
        "init_std": 0.74,
        "cpu": {"num_envs": 256, "total_steps": 8_000_000},
        "gpu": {"total_steps": 147_000_000},
    },
    air_time_threshold=0.1,
    termination_reward=-2.0,
    lin_vel_x=(0.0, 1.0),
    lin_vel_y=(-0.5, 0.5),
    effort_joints=("hip", "knee"),
    # Deviation (G1 contacts): Any part but the feet ends the episode, not the torso alone. Else it learns to sit.
    contact_ends=("torso", "pelvis", *(f"{side}_{part}" for side in ("left", "right") for part in G1_PARTS)),
    max_tilt=70.0,
)
