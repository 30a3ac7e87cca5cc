"""Exploration without a task, for the data of stage 1 (paper Sec. IV-C). The robot sees x_t and its last action.

ppo_explore.py adds the reward of exploration; the terms here only regularise. Every episode starts on the plane or on
rough ground, with masses and friction of its own, and is disturbed by pushes and forces.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from envs import rewards, terrain
from envs.base import BODY, Env, FootClocks, uniform
from envs.config import Config
from envs.locomotion import G1_LOCO


@dataclass(frozen=True)
class ExploreConfig(Config):
    """Numbers of an exploration environment."""

    rough: float = 0.5  # share of episodes on rough ground
    amplitude: float = 0.05  # [m] of the rough ground, whose heights are 0 to twice this
    spawn_xy: float = 4.0  # [m] half-width around the middle of either ground
    hasty: float = 0.2  # [s] shortest flight of a foot without a penalty
    perturb_force: float = 0.0  # [N] half-width of each component of a force on the base
    perturb_seconds: float = 2.0  # mean time between changes of the force; half of the draws are zero


class Explore(Env):
    OBS = {name: BODY[name] for name in BODY if name != "lin_vel"}

    def __init__(self, config, engine="auto"):
        """Build it. ValueError for noise, which would spoil the data."""
        if config.noise:
            raise ValueError("noise cannot be set here: data have none, and pretrain_pidm.py --noise adds it")
        self.heights = terrain.perlin_heights(config.amplitude) * (config.rough > 0)
        super().__init__(config, engine)

    def scene(self, visual=False):
        if not self.config.rough:  # no robot starts there, and contacts with a height field are slow on mjx
            return terrain.flat_scene(self.robot, visual)
        return terrain.rough_scene(self.robot, self.heights, visual)

    def ground_height(self, course, xy):
        """Height [m] by bilinear interpolation in the rough field, 0 beside it."""
        at = (xy - jnp.array([terrain.ROUGH_CENTRE, 0.0]) + terrain.ROUGH_HALF) / terrain.CELL
        rows_cols = jnp.moveaxis(at[..., ::-1], -1, 0)
        return jax.scipy.ndimage.map_coordinates(jnp.asarray(self.heights), list(rows_cols), order=1, cval=0.0)

    def place(self, key):
        k_xy, k_yaw, k_ground = jax.random.split(key, 3)
        c = self.config
        on_rough = uniform(k_ground, 0.0, 1.0) < c.rough
        xy = uniform(k_xy, -c.spawn_xy, c.spawn_xy, (2,)) + jnp.array([terrain.ROUGH_CENTRE, 0.0]) * on_rough
        return xy, uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def on_rough(self, physics):
        """True (...) if the base is over the rough ground."""
        away = jnp.abs(physics.qpos[..., :2] - jnp.array([terrain.ROUGH_CENTRE, 0.0]))
        return (away < terrain.ROUGH_HALF).all(-1) & (self.config.rough > 0)

    def push(self, key, physics, clock, push_at):
        """Push as in every task, and now and then change the force on the base."""
        k_push, k_when, k_force, k_zero = jax.random.split(key, 4)
        physics, push_at = super().push(k_push, physics, clock, push_at)
        force = uniform(k_force, -self.config.perturb_force, self.config.perturb_force, (3,))
        force *= uniform(k_zero, 0.0, 1.0) < 0.5
        changes = uniform(k_when, 0.0, 1.0) < self.dt / self.config.perturb_seconds
        wrench = physics.wrench.at[1, :3].set(jnp.where(changes, force, physics.wrench[1, :3]))
        return physics.replace(wrench=wrench), push_at

    def init_task(self, key, physics, course):
        return FootClocks.started(len(self.robot.feet))

    def before_rewards(self, task, motion):
        return task.tick(motion.foot_contact, self.dt)

    def rewards(self, task, motion, action, last_action, clock):
        return {
            "action": rewards.square(action),
            "action_rate": rewards.square(action - last_action),
            "torque": rewards.square(motion.torque),
            "joint_vel": rewards.square(motion.joint_vel),
            "hasty_steps": rewards.hasty_steps(task.landed_after, self.config.hasty),
        }


# Data are stored without sensor noise; stage 2 adds it anew to every sample.
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

# Regularisers cost less than exploration pays, 2 per second. Sums over G1's 29 joints weigh about 12 / 29.
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
