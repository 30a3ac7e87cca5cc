"""Pedipulation with ANYmal D: stand or walk on three legs while the right front foot tracks a point (Arm et al. 2024).

The point is drawn from a box before the robot, which starts at the origin, and stays in the world for 6 s. The robot
has to walk to far points. It is always the same foot, so there is no symmetry and no mirror loss.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp
import numpy as np

from envs import rewards
from envs.base import BODY, Env, uniform
from envs.config import Config, Range
from envs.locomotion import BLIND_QUADRUPED
from envs.rotations import inverse, rotate


@dataclass(frozen=True)
class PedipulationConfig(Config):
    """Numbers of pedipulation."""

    foot: str = "RF_foot"  # the foot that points
    # [m] ranges of the point's x (forward), y (left) and z, from the origin, where every episode starts
    box: tuple[Range, Range, Range] = ((0.0, 1.0), (-0.4, 0.2), (-0.1, 1.3))
    fixed_point: tuple[float, float, float] | None = None  # [m] the one point, for evaluation
    command_seconds: float = 6.0  # time between points
    all_feet_force: float = 0.0  # [N] largest constant force on every shank's centre of mass, per axis
    foot_force: float = 0.0  # [N] half-width of the pointing leg's, which changes at pushes, per axis


@flax.struct.dataclass
class Task:
    """State of pedipulation."""

    point: jax.Array  # (3,) commanded foot position, world [m]


class Pedipulation(Env):
    OBS = BODY | {"target": ("polar", 1.0)}
    SHOWCASE_FIELDS = {"fixed_point": (0.7, -0.2, 0.5)}

    def __init__(self, config, engine="auto"):
        self.COMMAND_RANGES = dict(zip(("x [m]", "y [m]", "z [m]"), config.box, strict=True))
        super().__init__(config, engine)
        if config.spawn_xy or config.spawn_yaw:
            raise ValueError("spawn_xy and spawn_yaw must be 0 here: the point is drawn around the origin")
        if config.foot not in self.robot.feet:
            raise ValueError(f"unknown foot {config.foot!r}; choose one of {', '.join(self.robot.feet)}")
        self.mirrors = {}
        self.foot = self.robot.feet.index(config.foot)
        self.shanks = np.array([self.model.site(foot).bodyid[0] for foot in self.robot.feet])
        legs = [foot.removesuffix("_foot") for foot in self.robot.feet]
        parts = [f"{leg}_{part}_force" for leg in legs for part in ("thigh", "knee", "shank")]
        self.collision_sensors = self.engine.sensor(*parts, f"{config.foot}_force")
        self.command_steps = max(round(config.command_seconds / self.dt), 1)

    def init_task(self, key, physics, course):
        return Task(self.draw_point(key))

    def draw_point(self, key):
        """A point (3,) in the box."""
        if self.config.fixed_point is not None:
            return jnp.array(self.config.fixed_point)
        low, high = jnp.array(self.config.box).T
        return uniform(key, low, high, (3,))

    def set_command(self, task, command):
        return task.replace(point=command)

    def markers(self, task):
        """The commanded point (1, 3)."""
        return task.point[None]

    def after_rewards(self, key, task, motion, clock):
        due = clock % self.command_steps == 0
        return task.replace(point=jnp.where(due, self.draw_point(key), task.point))

    def spawn(self, key, course):
        """Physics as in every task, with a constant force on each foot, at the centre of mass of its shank."""
        k_force, key = jax.random.split(key)
        physics = super().spawn(key, course)
        force = uniform(k_force, 0.0, self.config.all_feet_force, (len(self.shanks), 3))
        return physics.replace(wrench=physics.wrench.at[self.shanks, :3].set(force))

    def push(self, key, physics, clock, push_at):
        """Push as in every task, and change the force on the pointing foot."""
        k_push, k_force = jax.random.split(key)
        force = uniform(k_force, -self.config.foot_force, self.config.foot_force, (3,))
        shank = self.shanks[self.foot]
        force = jnp.where(clock >= push_at, force, physics.wrench[shank, :3])
        physics, push_at = super().push(k_push, physics, clock, push_at)
        return physics.replace(wrench=physics.wrench.at[shank, :3].set(force)), push_at

    def foot_error(self, task, motion):
        """Distance of the pointing foot from its point [m]."""
        return jnp.linalg.norm(motion.foot_pos[self.foot] - task.point)

    def task_inputs(self, task, motion, clock):
        """The point (3,) in the base frame [m]."""
        return {"target": rotate(inverse(motion.quat), task.point - motion.base_pos)}

    def rewards(self, task, motion, action, last_action, clock):
        m = motion
        return {
            "foot_tracking": jnp.exp(-self.foot_error(task, m) / 0.8),
            "torque": rewards.square(m.torque),
            "joint_acc": rewards.square(m.joint_acc),
            "joint_vel": rewards.square(m.joint_vel),
            "action_rate": rewards.square(action - last_action),
            "collision": rewards.touching(m.sensors[self.collision_sensors]),
        }

    def task_metrics(self, task, motion, truncated):
        return {"foot_error": self.foot_error(task, motion)}  # [m]


# Deviation (pedipulation): Disturbances are weaker than Arm et al.'s (pushes 1.5, foot force 50 N, friction 0 to 1.5).
# joint_acc and joint_vel weigh a quarter, and the total has a floor as in locomotion.
ANYMAL_PEDIPULATION = PedipulationConfig(
    robot="anymal_d",
    weights={
        "foot_tracking": 15.0,
        "torque": -2e-5,
        "joint_acc": -1.25e-6,
        "joint_vel": -0.0125,
        "action_rate": -0.01,
        "collision": -2.0,
    },
    ppo=BLIND_QUADRUPED | {"cpu": {"num_envs": 256, "total_steps": 10_000_000}, "gpu": {"total_steps": 393_000_000}},
    episode_seconds=12.0,
    termination_reward=-1.6,
    spawn_xy=0.0,
    spawn_yaw=0.0,
    friction=(0.4, 1.2),
    added_mass=(-5.0, 5.0),
    push_velocity=0.5,
    push_axes=6,
    push_seconds=(2.0, 4.0),
    all_feet_force=12.0,
    foot_force=20.0,
)
