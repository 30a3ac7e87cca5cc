"""Obstacle courses of the five parkour skills: the slabs of each, and their places at a difficulty `t` from 0 to 1.

An obstacle is a function (key, t) -> poses, goal. A row of poses (M, 4) is the centre x, y, z [m] of a slab and its
tilt about y [rad]. The goal (3,) is for the base [m]. The robot starts at x = 0 and faces +x.
Sizes and ranges are Hoeller et al.'s (2023) where published, else ours.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from envs.base import uniform
from envs.terrain import PARKED, Slab

BLOCK = Slab("block", (1.5, 2.0, 1.0))
NEAR, FAR = (Slab(name, (1.5, 2.0, 0.5)) for name in ("near_platform", "far_platform"))
TABLE = Slab("table", (0.75, 3.0, 0.25), ceiling=True)
PLANKS = tuple(Slab(f"plank{i}", (0.15, 2.0, 1.2)) for i in range(8))
RAMP = Slab("ramp", (2.0, 2.0, 0.5))
LANDING = Slab("landing", (1.5, 2.0, 1.2))
TILES = tuple(Slab(f"tile{i}", (0.25, 0.25, 0.15)) for i in range(12))

TREAD, STEPS, SLOPE_LENGTH = 0.30, len(PLANKS), 2 * RAMP.half[0]  # [m]


def pose(x, z, tilt=0.0, y=0.0):
    """One row of poses."""
    return jnp.stack([jnp.asarray(v, jnp.float32) for v in (x, y, z, tilt)])


AWAY = (0.0, 0.0, PARKED, 0.0)  # pose of a slab that is not used


def between(t, easy, hard):
    """Interpolate between the easiest level, t = 0, and the hardest, t = 1."""
    return easy + t * (hard - easy)


def rough_ground(key, t):
    """Twelve tiles (12, 4) of random height between the robot and a goal 2 to 4 m ahead."""
    k_x, k_y, k_z, k_gx, k_gy = jax.random.split(key, 5)
    x, y = uniform(k_x, 0.9, 3.5, (12,)), uniform(k_y, -0.8, 0.8, (12,))
    top = uniform(k_z, 0.0, between(t, 0.02, 0.08), (12,))
    goal = jnp.stack([uniform(k_gx, 2.0, 4.0), uniform(k_gy, -0.3, 0.3), jnp.float32(0.5)])
    return jnp.stack([x, y, top - TILES[0].half[2], jnp.zeros(12)], -1), goal


def climb_up(key, t):
    """A box of 0.1 to 1.0 m; the goal is on it."""
    k_x, k_gx, k_gy = jax.random.split(key, 3)
    x, height = uniform(k_x, 1.0, 1.5), between(t, 0.1, 1.0)
    goal = jnp.stack([x + uniform(k_gx, 1.0, 1.5), uniform(k_gy, -0.3, 0.3), height + 0.5])
    return pose(x + 1.5, height - 1.0)[None], goal


def climb_down(key, t):
    """A box of 0.1 to 1.0 m on which the robot starts; the goal is on the floor ahead."""
    k_x, k_gx, k_gy = jax.random.split(key, 3)
    x, height = uniform(k_x, 0.7, 1.0), between(t, 0.1, 1.0)
    goal = jnp.stack([x + uniform(k_gx, 1.2, 1.8), uniform(k_gy, -0.3, 0.3), jnp.float32(0.5)])
    return pose(x - 1.5, height - 1.0)[None], goal


def crouch(key, t):
    """A table whose underside is 0.9 to 0.4 m above the floor; the goal is behind it."""
    k_x, k_gx, k_gy = jax.random.split(key, 3)
    x, clearance = uniform(k_x, 1.0, 1.5), between(t, 0.9, 0.4)
    goal = jnp.stack([x + 1.5 + uniform(k_gx, 0.8, 1.2), uniform(k_gy, -0.3, 0.3), jnp.float32(0.5)])
    return pose(x + 0.75, clearance + 0.25)[None], goal


def jump(key, t):
    """A gap of 0.1 to 1.0 m between platforms over a floor 1 m below; the goal is behind it."""
    k_x, k_gx, k_gy = jax.random.split(key, 3)
    x, width = uniform(k_x, 1.0, 1.5), between(t, 0.1, 1.0)
    goal = jnp.stack([x + width + uniform(k_gx, 1.0, 1.5), uniform(k_gy, -0.3, 0.3), jnp.float32(0.5)])
    return jnp.stack([pose(x - 1.5, -0.5), pose(x + width + 1.5, -0.5)]), goal


def walk(key, t):
    """Stairs (60%) and ramps (20%), up or down, or planks of random height (20%)."""
    k_x, k_kind, k_up, k_top, k_y = jax.random.split(key, 5)
    x, share, up = uniform(k_x, 1.0, 1.5), uniform(k_kind, 0.0, 1.0), uniform(k_up, 0.0, 1.0) < 0.5
    kind = (share >= 0.6).astype(int) + (share >= 0.8)  # stairs, ramp, planks
    number, away = jnp.arange(STEPS), jnp.array([AWAY])
    landing_z, long = LANDING.half[2], LANDING.half[0]

    def planks(tops):
        middle = x + TREAD * number + TREAD / 2
        return jnp.stack([middle, 0 * middle, tops - PLANKS[0].half[2], 0 * middle], -1)

    def landing(top, ahead):
        return pose(jnp.where(up, x + ahead + long, x - long), top - landing_z)[None]

    rise, angle = between(t, 0.05, 0.25), between(t, 0.0, 0.45)
    tops = rise * jnp.where(up, number + 1, STEPS - 1 - number)
    stairs = jnp.concatenate([planks(tops), away, landing(STEPS * rise, STEPS * TREAD)])
    reach, height = SLOPE_LENGTH * jnp.cos(angle), SLOPE_LENGTH * jnp.sin(angle)
    tilt = jnp.where(up, -angle, angle)
    thick = RAMP.half[2]
    slope = pose(x + reach / 2 - thick * jnp.sin(tilt), height / 2 - thick * jnp.cos(angle), tilt)[None]
    ramp = jnp.concatenate([jnp.tile(away, (STEPS, 1)), slope, landing(height, reach)])
    uneven = planks(uniform(k_top, 0.0, 1.0, (STEPS,)) * between(t, 0.05, 0.25))
    uneven = jnp.concatenate([uneven, away, away])

    ahead = jnp.stack([STEPS * TREAD, reach, STEPS * TREAD])[kind]
    top = jnp.where(up, jnp.stack([STEPS * rise, height, 0.0]), 0.0)[kind]
    goal = jnp.stack([x + ahead + 1.0, uniform(k_y, -0.3, 0.3), top + 0.5])
    return jnp.stack([stairs, ramp, uneven])[kind], goal


@dataclass(frozen=True)
class Skill:
    """An obstacle: its slabs, their places, and the height of the floor below."""

    slabs: tuple[Slab, ...]
    obstacle: Callable  # (key, t) -> poses, goal
    floor: float = 0.0  # [m]
    rough_poses: tuple = ()  # poses of the obstacle's slabs in episodes on rough tiles; (): no such episodes


SKILLS = {
    "walk": Skill((*PLANKS, RAMP, LANDING), walk),
    "climb_up": Skill((BLOCK,), climb_up, rough_poses=(AWAY,)),
    "climb_down": Skill((BLOCK,), climb_down, rough_poses=(AWAY,)),
    "crouch": Skill((TABLE,), crouch, rough_poses=(AWAY,)),
    "jump": Skill((NEAR, FAR), jump, floor=-1.0, rough_poses=((0.0, 0.0, -0.5, 0.0), (3.0, 0.0, -0.5, 0.0))),  # no gap
}


def all_slabs(skill):
    """The slabs of the obstacle, then the tiles if the skill has episodes on rough tiles."""
    return (*skill.slabs, *TILES) if skill.rough_poses else skill.slabs


def draw_course(skill, key, t, share):
    """Poses (M, 4) of all_slabs, goal (3,) [m], and () true in the `share` of episodes on rough tiles."""
    if not skill.rough_poses:
        return *skill.obstacle(key, t), jnp.asarray(False)
    k_share, k_obstacle, k_rough = jax.random.split(key, 3)
    poses, goal = skill.obstacle(k_obstacle, t)
    tiles, far_goal = rough_ground(k_rough, t)
    rough = uniform(k_share, 0.0, 1.0) < share
    obstacle = jnp.concatenate([poses, jnp.tile(jnp.array([AWAY]), (len(TILES), 1))])
    ground = jnp.concatenate([jnp.array(skill.rough_poses), tiles])
    return jnp.where(rough, ground, obstacle), jnp.where(rough, far_goal, goal), rough
