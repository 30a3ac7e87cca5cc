"""Parkour with ANYmal D: five skills that see the ground and have a time to be at a goal (Hoeller et al. 2023).

The robot is told where to be, which way to face and how much time is left; what it does until then is its own affair.
Ten levels move the obstacle (courses.py). An environment that succeeds is promoted, one that fails is demoted; some
episodes are on rough ground without the obstacle, and leave the level as it is.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp
import numpy as np

from envs import rewards, terrain
from envs.base import BODY, Config, Course, Env, axis_angle, inverse, rotate, select, uniform, wrap
from envs.courses import SKILLS, all_slabs, draw_course

LEVELS = 10
HEIGHT_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.5, 0.5, 11), indexing="ij"), -1)  # [m]
CEILING_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 11), np.linspace(-0.5, 0.5, 6), indexing="ij"), -1)
SUCCESS_DISTANCE = 0.5  # [m] from the goal when the time is up


@dataclass(frozen=True)
class ParkourConfig(Config):
    """Numbers of a parkour skill."""

    skill: str = "climb_up"  # a name in courses.SKILLS
    level: int | None = None  # fixed level 0 to 9; None: the curriculum
    rough: float = 0.2  # share of episodes on rough tiles without the obstacle; walking has none
    scan_noise: float = 0.05  # [m] half-width, on every point
    scan_shift: float = 0.075  # [m] half-width of a shift of the whole map, per episode
    random_seconds: float = 2.0  # episodes are shorter by up to this
    base_force: float = 1.0  # [N] on the base is a failure
    foot_force: float = 3000.0  # [N] on a foot is a failure
    velocity_limit: float = 8.5  # [rad/s] of the joints; ANYmal D's URDF
    lowest_base: float = -1e3  # [m] a base below this is a failure (fallen into the pit)


@flax.struct.dataclass
class ParkourCourse(Course):
    goal: jax.Array  # (3,) for the base, world [m]
    rough: jax.Array  # () no obstacle, but rough tiles


@flax.struct.dataclass
class Task:
    """State of a parkour episode."""

    goal: jax.Array  # (3,) [m]
    goal_yaw: jax.Array  # () [rad]
    far: jax.Array  # () [m] horizontal distance of the goal at the start
    shift: jax.Array  # (3,) [m] of the map
    level: jax.Array  # () int
    best: jax.Array  # () highest level solved
    rough: jax.Array  # () whether this episode is without the obstacle
    foot_vel: jax.Array  # (F, 3) of the last step, for the feet's acceleration
    foot_acc: jax.Array  # (F, 3) [m/s^2]


class Parkour(Env):
    OBS = BODY | {
        "goal": ("polar", 0.5),
        "time_left": ("scalar", 1.0),
        "heading": ("heading", 1.0),
        "height": ("height", 2.0),
    }
    LEVELS = LEVELS
    bootstrap_time_outs = False  # the policy sees the time left, and nothing follows
    EVALUATION = {"rough": 0.0}
    SHOWCASE = EVALUATION | {"level": 4, "random_seconds": 0.0}
    FILM = {"start": 0.4, "strip_seconds": 4.0, "gif_seconds": 5.6}

    def __init__(self, config, engine="auto"):
        if config.level is not None and not 0 <= config.level < LEVELS:
            raise ValueError(f"level {config.level} does not exist; choose 0 to {LEVELS - 1}")
        if config.skill not in SKILLS:
            raise ValueError(f"unknown skill {config.skill!r}; choose one of {', '.join(SKILLS)}")
        self.skill = SKILLS[config.skill]
        slabs = all_slabs(self.skill)
        self.half = jnp.array([slab.half for slab in slabs])
        self.overhead = np.array([slab.ceiling for slab in slabs])
        if self.overhead.any():
            self.OBS = self.OBS | {"ceiling": ("ceiling", 1.0)}
        super().__init__(config, engine)
        legs = [foot.removesuffix("_foot") for foot in self.robot.feet]
        self.lower_legs = self.engine.sensor(*(f"{leg}_{part}_force" for leg in legs for part in ("knee", "shank")))
        self.torque_limit = jnp.array(self.model.actuator_forcerange[:, 1])
        self.gain = jnp.array(self.model.actuator_gainprm[:, 0])

    def scene(self, visual=False):
        return terrain.slab_scene(self.robot, all_slabs(self.skill), self.skill.floor, visual)

    # --- course and curriculum ---

    def first_curriculum(self):
        return self.at_level(0 if self.config.level is None else self.config.level)

    def at_level(self, level):
        """A curriculum that starts at a level, with none solved."""
        return {"level": jnp.int32(level), "best": jnp.int32(0)}

    def graduate(self, key, task, motion, terminated, truncated):
        """Up a level after success, down after a failure or where more than half of the way is left."""
        stay = {"level": task.level, "best": task.best}
        if self.config.level is not None:
            return stay
        success = self.succeeded(task, motion, truncated)
        lost = terminated | (self.distance(task, motion) > task.far / 2)
        level = task.level + success - lost
        anywhere = jax.random.randint(key, (), 0, LEVELS)  # who has passed the last level trains on all of them
        moved = {
            "level": jnp.where(level >= LEVELS, anywhere, jnp.maximum(level, 0)),
            "best": jnp.where(success, jnp.maximum(task.best, task.level), task.best),
        }
        return select(task.rough, stay, moved)

    def succeeded(self, task, motion, truncated):
        """Whether the time is up and the robot is where it should be."""
        return truncated & (self.distance(task, motion) < SUCCESS_DISTANCE)

    def first_clock(self, key):
        return jax.random.randint(key, (), 0, round(self.config.random_seconds / self.dt) + 1)

    def course(self, key, curriculum):
        t = curriculum["level"] / (LEVELS - 1)
        poses, goal, rough = draw_course(self.skill, key, t, self.config.rough)
        quat = axis_angle(jnp.array([0.0, 1, 0]), poses[:, 3])
        return ParkourCourse(poses[:, :3], quat, curriculum, goal, rough)

    def place(self, key):
        k_y, k_yaw = jax.random.split(key)
        c = self.config
        xy = jnp.stack([0.0, uniform(k_y, -c.spawn_xy, c.spawn_xy)])
        return xy, uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def ground_height(self, course, xy):
        return self.heights(course.mocap_pos, course.mocap_quat, xy)

    def heights(self, pos, quat, xy):
        """Height of what one can stand on at xy (..., 2) [m]; ceilings do not count."""
        low = ~self.overhead
        return terrain.top_heights(pos[low], quat[low], self.half[low], xy, self.skill.floor)

    def init_task(self, key, physics, course):
        k_yaw, k_shift = jax.random.split(key)
        still = jnp.zeros((len(self.robot.feet), 3))
        way = course.goal[:2] - physics.qpos[:2]
        shift = uniform(k_shift, -self.config.scan_shift, self.config.scan_shift, (3,))
        return Task(
            goal=course.goal,
            goal_yaw=jnp.arctan2(way[1], way[0]) + uniform(k_yaw, -0.3, 0.3),
            far=jnp.linalg.norm(way),
            shift=shift,
            level=course.curriculum["level"],
            best=course.curriculum["best"],
            rough=course.rough,
            foot_vel=still,
            foot_acc=still,
        )

    # --- observation ---

    def sense(self, key, motion, task):
        """Noisy readings as in every task, and scans of the ground (and ceiling) about the base."""
        k_body, k_height, k_ceiling = jax.random.split(key, 3)
        sensed, prop = super().sense(k_body, motion, task)
        where = motion.mocap_pos, motion.mocap_quat
        ground = self.heights(*where, self.grid(HEIGHT_GRID, motion, task))
        noise = task.shift[2] + self.scan_noise(k_height, ground.shape)
        sensed["height"] = jnp.clip(motion.base_pos[2] - ground - 0.5 + noise, -1.0, 1.0)
        if self.overhead.any():
            xy = self.grid(CEILING_GRID, motion, task)
            under = terrain.underside_heights(motion.mocap_pos[self.overhead], self.half[self.overhead], xy)
            noise = task.shift[2] + self.scan_noise(k_ceiling, under.shape)
            sensed["ceiling"] = jnp.clip(under - motion.base_pos[2] + noise, 0.0, 1.0)
        return sensed, prop

    def scan_noise(self, key, shape):
        width = self.config.noise * self.config.scan_noise
        return uniform(key, -width, width, shape)

    def grid(self, points, motion, task):
        """World positions (P, 2) of a grid about the base, turned with its heading and shifted as this map is."""
        c, s = jnp.cos(motion.yaw), jnp.sin(motion.yaw)
        x, y = points.reshape(-1, 2).T
        return motion.base_pos[:2] + task.shift[:2] + jnp.stack([c * x - s * y, s * x + c * y], -1)

    def task_inputs(self, task, motion, clock):
        level = axis_angle(jnp.array([0.0, 0, 1]), motion.yaw)
        goal = rotate(inverse(level), task.goal - motion.base_pos)
        goal *= jnp.minimum(1.0, 5.0 / (jnp.linalg.norm(goal) + 1e-6))
        error = wrap(task.goal_yaw - motion.yaw)
        return {
            "goal": goal,
            "time_left": 1.0 - clock / self.episode_steps,
            "heading": jnp.stack([jnp.sin(error), jnp.cos(error)]),
        }

    def width(self, kind):
        return {"height": HEIGHT_GRID[..., 0].size, "ceiling": CEILING_GRID[..., 0].size}.get(kind) or super().width(
            kind
        )

    def mirror_block(self, mirror, kind):
        grid = {"height": HEIGHT_GRID, "ceiling": CEILING_GRID}.get(kind)
        if grid is None:
            return super().mirror_block(mirror, kind)
        index = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
        return np.flip(index, {"left_right": 1, "front_back": 0}[mirror]).ravel(), np.ones(index.size)

    # --- rewards and terminations ---

    def distance(self, task, motion):
        """Horizontal distance of the base from the goal [m]."""
        return jnp.linalg.norm(task.goal[:2] - motion.base_pos[:2])

    def track(self, task, motion):
        acc = (motion.foot_vel - task.foot_vel) / self.dt
        return task.replace(foot_vel=motion.foot_vel, foot_acc=acc)

    def rewards(self, task, motion, action, last_action, clock):
        m, distance = motion, self.distance(task, motion)
        turn = jnp.abs(wrap(task.goal_yaw - m.yaw))
        ending = (self.episode_steps - clock - 1) * self.dt < 1.0  # the last second
        way = task.goal - m.base_pos
        velocity = rotate(m.quat, m.lin_vel)
        speed = jnp.linalg.norm(velocity)
        towards = jnp.dot(velocity, way) / (jnp.linalg.norm(way) + 0.1)  # [m/s]
        wanted_torque = self.gain * (self.robot.action_scale * action - m.joint_pos)
        force = jnp.linalg.norm(m.foot_force, axis=-1)
        sideways = jnp.linalg.norm(m.foot_force[:, :2], axis=-1)
        return {
            "position": ending * jnp.maximum(1 - 0.5 * distance, -1.0),
            "heading": ending * (distance < 0.5) * (1 - 0.5 * turn),
            "approach": (distance > 0.25) * jnp.clip(towards, -1.0, 1.0),
            "wait": (distance > 0.25) * (speed < 0.2),
            "stand": (distance < 0.25) * (turn < 0.5) * jnp.linalg.norm(m.joint_pos),
            "joint_vel": rewards.square(m.joint_vel),
            "torque": rewards.square(m.torque),
            "joint_vel_limit": jnp.sum(jnp.clip(jnp.abs(m.joint_vel) - self.config.velocity_limit, 0.0, 1.0)),
            "torque_limit": jnp.sum(jnp.maximum(jnp.abs(wanted_torque) - self.torque_limit, 0.0)),
            "base_acc": jnp.minimum(rewards.square(m.base_acc[:3]) + 0.02 * rewards.square(m.base_acc[3:]), 1e3),
            "feet_acc": jnp.sum(jnp.minimum(jnp.linalg.norm(task.foot_acc, axis=-1), 100.0)),
            "action_rate": rewards.square(action - last_action),
            "feet_force": rewards.square(jnp.clip(force - 700.0, 0.0, 700.0)),
            "collision": rewards.touching(m.sensors[self.lower_legs]),
            "stumble": jnp.any(sideways > 2 * jnp.abs(m.foot_force[:, 2])),
        }

    def failed(self, task, motion):
        c = self.config
        base = jnp.linalg.norm(motion.sensors[self.ends], axis=-1)
        feet = jnp.linalg.norm(motion.foot_force, axis=-1)
        fallen = (-motion.gravity[2] < jnp.cos(jnp.deg2rad(c.max_tilt))) | (motion.base_pos[2] < c.lowest_base)
        return jnp.any(base > c.base_force) | jnp.any(feet > c.foot_force) | fallen

    def task_metrics(self, task, motion, truncated):
        return {
            "goal_distance": self.distance(task, motion),  # [m]
            "level": task.level.astype(jnp.float32),
            "progress": task.best / (LEVELS - 1),  # the paper's curriculum progress
            "episode_success": self.succeeded(task, motion, truncated).astype(jnp.float32),
        } | {f"level/{i}": (task.level == i).astype(jnp.float32) for i in range(LEVELS)}


# Deviation: of Hoeller et al.'s weights, torque_limit is a tenth, base_acc and feet_acc are a fifth and bounded, the
# position term and the total are floored, heading counts within 0.5 m, and a fall, which a tilt of 80 degrees is, too,
# costs 4: at CPU batch sizes the full penalties teach the robot to stay where it is. action_rate is theirs, in units
# of actions. In place of the cosine between velocity and way, which pays most per metre to who creeps, `approach` pays
# the metres.
WEIGHTS = {
    "position": 10.0,
    "heading": 5.0,
    "approach": 3.0,
    "wait": -1.0,
    "stand": -0.5,
    "joint_vel": -0.001,
    "torque": -1e-5,
    "joint_vel_limit": -1.0,
    "torque_limit": -0.02,
    "base_acc": -0.0002,
    "feet_acc": -0.0004,
    "action_rate": -0.0025,
    "feet_force": -1e-5,
    "collision": -1.0,
    "stumble": -1.0,
}


def parkour(skill, weights=(), cpu_steps=12_000_000, **changes):
    """The config of a skill: what all skills share, with changes."""
    shared = {
        "robot": "anymal_d",
        "skill": skill,
        "weights": WEIGHTS | dict(weights),
        "ppo": {
            "hidden": (512, 256, 128),
            # Deviation: the PIDM, whose core is the blind tasks', has twice the MLP's parameters (preset gpu 1.4 times)
            # where the paper's has four times as many.
            "intention": (512, 256),  # of the PIDM's intention encoder, before its last layer
            "entropy": 0.005,
            "init_std": 0.6,
            "cpu": {
                "num_envs": 512,
                "num_steps": 48,
                "total_steps": cpu_steps,
                "hidden": (256, 128, 128),
                "intention": (256, 128),
            },
            "gpu": {"num_steps": 48, "total_steps": 393_000_000},
        },
        "episode_seconds": 6.0,
        "reward_floor": -20.0,
        "termination_reward": -4.0,
        "max_tilt": 80.0,
        "spawn_xy": 0.3,
        "spawn_yaw": 0.3,
        "spawn_velocity": 0.3,
        "friction": (0.4, 1.0),
        "added_mass": (-5.0, 5.0),
        "push_velocity": 0.3,
        "push_seconds": (4.0, 6.0),
    }
    return ParkourConfig(**shared | changes)


CLIMB_UP = parkour("climb_up", {"collision": -0.2}, base_force=100.0)
CLIMB_DOWN = parkour("climb_down", foot_force=2000.0)
CROUCH = parkour("crouch", cpu_steps=10_000_000, base_force=100.0)
JUMP = parkour("jump", lowest_base=-0.3)
WALK = parkour("walk", cpu_steps=10_000_000, episode_seconds=8.0)
