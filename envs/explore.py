"""Exploration without a task, for the data of stage 1 (paper Sec. IV-C): the robot sees x_t and its last action.

The reward for what is worth seeing comes from the ensemble in ppo_explore.py; here are the regularisers that any task
has. Every episode starts on the plane or on rough ground, with its own masses and friction, and is pushed about.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp

from envs import rewards, terrain
from envs.base import BODY, Config, Env, FootClocks, uniform
from envs.locomotion import G1_LOCO


@dataclass(frozen=True)
class ExploreConfig(Config):
    """Numbers of an exploration environment."""

    rough: float = 0.5  # share of episodes on rough ground
    amplitude: float = 0.05  # [m] of the rough ground
    spawn_spread: float = 4.0  # [m] half-width around the middle of the ground
    hasty: float = 0.2  # [s] flights shorter than this are punished
    perturb_force: float = 0.0  # [N] half-width of each component of a force on the base
    perturb_seconds: float = 2.0  # mean time between its changes; half the draws are zero
    calm: float = 1.0  # every episode multiplies all actions by a number of its own between this and 1


@flax.struct.dataclass
class Task(FootClocks):
    """State of exploration."""

    vigour: jax.Array  # () what the policy's actions are multiplied by in this episode


class Explore(Env):
    OBS = {name: BODY[name] for name in BODY if name != "lin_vel"}

    def __init__(self, config, engine="auto"):
        self.heights = terrain.perlin_heights(config.amplitude)
        super().__init__(config, engine)

    def scene(self, visual=False):
        return terrain.rough_scene(self.robot, self.heights, visual)

    def ground_height(self, course, xy):
        """Bilinear in the field's grid, 0 beside it."""
        at = (xy - jnp.array([terrain.ROUGH_CENTRE, 0.0]) + terrain.ROUGH_HALF) / terrain.CELL
        rows_cols = jnp.moveaxis(at[..., ::-1], -1, 0)
        return jax.scipy.ndimage.map_coordinates(jnp.asarray(self.heights), list(rows_cols), order=1, cval=0.0)

    def place(self, key):
        k_xy, k_yaw, k_ground = jax.random.split(key, 3)
        c = self.config
        on_rough = uniform(k_ground, 0.0, 1.0) < c.rough
        xy = uniform(k_xy, -c.spawn_spread, c.spawn_spread, (2,)) + jnp.array([terrain.ROUGH_CENTRE, 0.0]) * on_rough
        return xy, uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def on_rough(self, physics):
        """Whether the base is over the rough ground."""
        return jnp.abs(physics.qpos[..., 0] - terrain.ROUGH_CENTRE) < terrain.ROUGH_HALF

    def push(self, key, physics, clock, push_at):
        """Pushes as in the tasks, and a force on the base that changes now and then."""
        k_push, k_when, k_force, k_zero = jax.random.split(key, 4)
        physics, push_at = super().push(k_push, physics, clock, push_at)
        force = uniform(k_force, -self.config.perturb_force, self.config.perturb_force, (3,))
        force *= uniform(k_zero, 0.0, 1.0) < 0.5
        changes = uniform(k_when, 0.0, 1.0) < self.dt / self.config.perturb_seconds
        wrench = physics.wrench.at[1, :3].set(jnp.where(changes, force, physics.wrench[1, :3]))
        return physics.replace(wrench=wrench), push_at

    def executed(self, state, action):
        """What the robot does when the policy says `action` (A,)."""
        return state.task.vigour * action

    def step(self, state, action):
        return super().step(state, self.executed(state, action))

    def init_task(self, key, physics, course):
        feet = jnp.zeros(len(self.robot.feet))
        return Task(feet, feet, feet, vigour=uniform(key, self.config.calm, 1.0))

    def track(self, task, motion):
        return task.tick(motion.foot_contact, self.dt)

    def rewards(self, task, motion, action, last_action, clock):
        return {
            "action": rewards.square(action),
            "action_rate": rewards.square(action - last_action),
            "torque": rewards.square(motion.torque),
            "joint_vel": rewards.square(motion.joint_vel),
            "hasty_steps": rewards.hasty_steps(task.landed_after, self.config.hasty),
        }


# Data are stored without sensor noise: stage 2 adds it anew to every sample.
SHARED = {
    "ppo": {"hidden": (128, 128, 128), "entropy": 0.0, "init_std": 1.0},
    "noise": 0.0,
    "reward_floor": -5.0,
    "max_tilt": 70.0,
    "friction": (0.3, 1.2),
    "link_mass": (0.85, 1.15),
    "spawn_joints": (0.5, 1.5),
    "spawn_velocity": 0.5,
    "push_velocity": 0.5,
    "push_seconds": (3.0, 6.0),
}

# Regularisers of at most the size of what the ensemble pays, 2 per second; sums over G1's 29 joints weigh 12 / 29.
EXPLORE = {
    "anymal_d": ExploreConfig(
        robot="anymal_d",
        weights={"action": -0.02, "action_rate": -0.005, "torque": -1e-5, "joint_vel": -5e-4, "hasty_steps": -0.5},
        added_mass=(-5.0, 5.0),
        perturb_force=100.0,
        **SHARED,
    ),
    "go1": ExploreConfig(
        robot="go1",
        weights={"action": -0.02, "action_rate": -0.005, "torque": -5e-5, "joint_vel": -2.5e-4, "hasty_steps": -0.5},
        added_mass=(-1.0, 3.0),
        perturb_force=25.0,
        **SHARED,
    ),
    "g1": ExploreConfig(
        robot="g1",
        weights={"action": -0.01, "action_rate": -0.002, "torque": -1e-5, "joint_vel": -2e-4, "hasty_steps": -0.5},
        added_mass=(-1.0, 3.0),
        perturb_force=50.0,
        contact_ends=G1_LOCO.contact_ends,
        **SHARED | {"spawn_joints": (0.8, 1.2), "spawn_velocity": 0.3},
    ),
}
