"""Parkour with ANYmal D: five skills that see the ground and must be at a goal in time (Hoeller et al. 2023).

The robot sees the goal, the heading to face there and the time left. It is free to choose its way.
Ten levels of difficulty move the obstacle (courses.py). Success promotes an environment by a level, failure demotes it.
Some episodes are on rough ground without the obstacle. They leave the level as it is.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp
import numpy as np

from envs import rewards, terrain
from envs.base import BODY, Course, Env, select, uniform
from envs.config import Config
from envs.courses import SKILLS, all_slabs, draw_course
from envs.rotations import axis_angle, in_heading, rotate, wrap

HEIGHT_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.5, 0.5, 11), indexing="ij"), -1)  # [m]
CEILING_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 11), np.linspace(-0.5, 0.5, 6), indexing="ij"), -1)
GRIDS = {"height": HEIGHT_GRID, "ceiling": CEILING_GRID}  # kind of a block -> its points (rows, columns, 2)
# A robot succeeds if, when the time is up, it is at the goal and stands on its feet.
SUCCESS_DISTANCE = 0.5  # [m] from the goal
UPRIGHT_TILT = 25.0  # [deg] of the trunk, less than this
STANDING_HEIGHT = 0.35  # [m] of the base above the ground under it; in the default pose it is 0.59 m
FEET_ONLY_SECONDS = 0.2  # for which no other body has touched anything


@dataclass(frozen=True)
class ParkourConfig(Config):
    """Numbers of a parkour skill."""

    skill: str = "climb_up"  # a name in courses.SKILLS
    level: int | None = None  # fixed level 0 to 9; None: by the curriculum
    rough: float = 0.2  # share of episodes on rough tiles without the obstacle; walking has none
    scan_noise: float = 0.05  # [m] half-width at every point
    scan_shift: float = 0.075  # [m] half-width of a shift of the whole map, drawn once an episode
    random_seconds: float = 2.0  # episodes are shorter by up to this
    base_force: float = 1.0  # [N] on the base; more is a failure
    foot_force: float = 3000.0  # [N] on a foot; more is a failure
    velocity_limit: float = 8.5  # [rad/s] of the joints, from ANYmal D's URDF
    lowest_base: float = -1e3  # [m] height of the base; less is a failure, a fall into the pit


@flax.struct.dataclass
class ParkourCourse(Course):
    goal: jax.Array  # (3,) for the base, world [m]
    rough: jax.Array  # () bool: rough tiles in place of the obstacle


@flax.struct.dataclass
class Task:
    """State of a parkour episode."""

    goal: jax.Array  # (3,) for the base, world [m]
    goal_yaw: jax.Array  # () heading to face at the goal [rad]
    start_distance: jax.Array  # () horizontal distance of the goal at the start [m]
    shift: jax.Array  # (3,) of the map [m]
    level: jax.Array  # () int
    best: jax.Array  # () highest level solved so far
    reached: jax.Array  # () highest level drawn so far
    rough: jax.Array  # () bool: rough tiles in place of the obstacle
    feet_only: jax.Array  # () control steps since a body other than a foot touched something
    foot_vel: jax.Array  # (F, 3) in the last step [m/s]
    foot_acc: jax.Array  # (F, 3) [m/s^2]


class Parkour(Env):
    OBS = BODY | {
        "goal": ("polar", 0.5),
        "time_left": ("scalar", 1.0),
        "heading": ("heading", 1.0),
        "height": ("height", 2.0),
    }
    LEVELS = 10
    bootstrap_time_outs = False  # the policy sees the time left, and no reward follows it
    EVALUATION_FIELDS = {"rough": 0.0}
    SHOWCASE_FIELDS = EVALUATION_FIELDS | {"level": 4, "random_seconds": 0.0}

    def __init__(self, config, engine="auto"):
        if config.level is not None and not 0 <= config.level < self.LEVELS:
            raise ValueError(f"level {config.level} does not exist; choose 0 to {self.LEVELS - 1}")
        if config.random_seconds > config.episode_seconds:
            raise ValueError(f"random_seconds must be at most episode_seconds, {config.episode_seconds:g}")
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
        self.collision_sensors = self.engine.sensor(
            *(f"{leg}_{part}_force" for leg in legs for part in ("knee", "shank"))
        )
        parts = ("thigh", "knee", "shank")
        self.body_sensors = self.engine.sensor("base_force", *(f"{leg}_{part}_force" for leg in legs for part in parts))
        seconds = config.episode_seconds - 0.4
        self.FILM_WINDOW = {"start": 0.4, "strip_seconds": 1.08 * seconds, "gif_seconds": seconds}  # to the very end
        self.torque_limit = jnp.array(self.model.actuator_forcerange[:, 1])
        self.gain = jnp.array(self.model.actuator_gainprm[:, 0])

    def scene(self, visual=False):
        return terrain.slab_scene(self.robot, all_slabs(self.skill), self.skill.floor, visual)

    # --- course and curriculum ---

    def first_curriculum(self):
        return self.at_level(0 if self.config.level is None else self.config.level)

    def at_level(self, level):
        """Curriculum at a level, with none solved so far."""
        return {"level": jnp.int32(level), "best": jnp.int32(0), "reached": jnp.int32(level)}

    def next_curriculum(self, key, task, motion, terminated, truncated):
        """Up a level after success, down a level after a failure or with more than half of the distance left."""
        stay = {"level": task.level, "best": task.best, "reached": task.reached}
        if self.config.level is not None:
            return stay
        success = self.succeeded(task, motion, truncated)
        failure = terminated | (self.distance(task, motion) > task.start_distance / 2)
        level = task.level + success - failure
        any_level = jax.random.randint(key, (), 0, self.LEVELS)  # after the last level, train on all of them
        moved = {
            "level": jnp.where(level >= self.LEVELS, any_level, jnp.maximum(level, 0)),
            "best": jnp.where(success, jnp.maximum(task.best, task.level), task.best),
            "reached": jnp.clip(level, task.reached, self.LEVELS - 1),
        }
        return select(task.rough, stay, moved)

    def succeeded(self, task, motion, truncated):
        """True () if the time is up and the robot stands on its feet at the goal."""
        upright = self.tilt(motion) < UPRIGHT_TILT
        high = self.base_height(motion) >= STANDING_HEIGHT
        feet_only = task.feet_only >= round(FEET_ONLY_SECONDS / self.dt)
        return truncated & (self.distance(task, motion) < SUCCESS_DISTANCE) & upright & high & feet_only

    def first_clock(self, key):
        return jax.random.randint(key, (), 0, round(self.config.random_seconds / self.dt) + 1)

    def course(self, key, curriculum):
        difficulty = curriculum["level"] / (self.LEVELS - 1)
        poses, goal, rough = draw_course(self.skill, key, difficulty, self.config.rough)
        quat = axis_angle(jnp.array([0.0, 1, 0]), poses[:, 3])
        return ParkourCourse(poses[:, :3], quat, curriculum, goal, rough)

    def place(self, key):
        k_y, k_yaw = jax.random.split(key)
        c = self.config
        xy = jnp.stack([0.0, uniform(k_y, -c.spawn_xy, c.spawn_xy)])
        return xy, uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def ground_height(self, course, xy):
        """Height of the ground [m] at xy (..., 2), without ceilings; a Motion or Physics has the slabs' poses, too."""
        ground = ~self.overhead
        pos, quat = course.mocap_pos[ground], course.mocap_quat[ground]
        return terrain.top_heights(pos, quat, self.half[ground], xy, self.skill.floor)

    def init_task(self, key, physics, course):
        k_yaw, k_shift = jax.random.split(key)
        zero = jnp.zeros((len(self.robot.feet), 3))
        to_goal = course.goal[:2] - physics.qpos[:2]
        width = self.config.noise * self.config.scan_shift
        shift = uniform(k_shift, -width, width, (3,))
        return Task(
            goal=course.goal,
            goal_yaw=jnp.arctan2(to_goal[1], to_goal[0]) + uniform(k_yaw, -0.3, 0.3),
            start_distance=jnp.linalg.norm(to_goal),
            shift=shift,
            level=course.curriculum["level"],
            best=course.curriculum["best"],
            reached=course.curriculum["reached"],
            rough=course.rough,
            feet_only=jnp.int32(0),
            foot_vel=zero,
            foot_acc=zero,
        )

    def markers(self, task):
        """The goal (1, 3)."""
        return task.goal[None]

    # --- observation ---

    def sense(self, key, motion, task):
        """Noisy readings as in every task, and scans of the ground (and a ceiling) around the base."""
        k_body, k_height, k_ceiling = jax.random.split(key, 3)
        sensed, prop = super().sense(k_body, motion, task)
        ground = self.ground_height(motion, self.grid(HEIGHT_GRID, motion, task))
        noise = task.shift[2] + self.scan_noise(k_height, ground.shape)
        sensed["height"] = jnp.clip(motion.base_pos[2] - ground - 0.5 + noise, -1.0, 1.0)
        if self.overhead.any():
            xy = self.grid(CEILING_GRID, motion, task)
            under = terrain.underside_heights(motion.mocap_pos[self.overhead], self.half[self.overhead], xy)
            noise = self.scan_noise(k_ceiling, under.shape) - task.shift[2]  # up where the ground is down
            sensed["ceiling"] = jnp.clip(under - motion.base_pos[2] + noise, 0.0, 1.0)
        return sensed, prop

    def scan_noise(self, key, shape):
        """Noise [m] of every point of a scan."""
        width = self.config.noise * self.config.scan_noise
        return uniform(key, -width, width, shape)

    def grid(self, points, motion, task):
        """World positions (P, 2) of a grid around the base, turned by its heading and shifted with the map."""
        c, s = jnp.cos(motion.yaw), jnp.sin(motion.yaw)
        x, y = points.reshape(-1, 2).T
        return motion.base_pos[:2] + task.shift[:2] + jnp.stack([c * x - s * y, s * x + c * y], -1)

    def task_inputs(self, task, motion, clock):
        """Goal (3,) in the heading frame [m], time left as a share, sine and cosine of the heading error."""
        goal = in_heading(motion.yaw, task.goal - motion.base_pos)
        goal *= jnp.minimum(1.0, 5.0 / (jnp.linalg.norm(goal) + 1e-6))  # at most 5 m
        error = wrap(task.goal_yaw - motion.yaw)
        return {
            "goal": goal,
            "time_left": 1.0 - clock / self.episode_steps,
            "heading": jnp.stack([jnp.sin(error), jnp.cos(error)]),
        }

    def width(self, kind):
        return GRIDS[kind][..., 0].size if kind in GRIDS else super().width(kind)

    def mirror_block(self, mirror, kind):
        if kind not in GRIDS:
            return super().mirror_block(mirror, kind)
        index = np.arange(self.width(kind)).reshape(GRIDS[kind].shape[:2])
        return np.flip(index, {"left_right": 1, "front_back": 0}[mirror]).ravel(), np.ones(index.size)

    # --- rewards and terminations ---

    def distance(self, task, motion):
        """Horizontal distance of the base from the goal [m]."""
        return jnp.linalg.norm(task.goal[:2] - motion.base_pos[:2])

    def tilt(self, motion):
        """Angle of the trunk from level [deg]."""
        return jnp.rad2deg(jnp.arccos(jnp.clip(-motion.gravity[2], -1.0, 1.0)))

    def base_height(self, motion):
        """Height of the base above the ground under it [m]."""
        return motion.base_pos[2] - self.ground_height(motion, motion.base_pos[:2])

    def touching_parts(self, motion):
        """Number of parts other than feet that touch something; a knee and its shank are two."""
        return rewards.touching(motion.sensors[self.body_sensors])

    def before_rewards(self, task, motion):
        feet_only = jnp.where(self.touching_parts(motion) > 0, 0, task.feet_only + 1)
        foot_acc = (motion.foot_vel - task.foot_vel) / self.dt
        return task.replace(feet_only=feet_only, foot_vel=motion.foot_vel, foot_acc=foot_acc)

    def rewards(self, task, motion, action, last_action, clock):
        m, distance = motion, self.distance(task, motion)
        turn = jnp.abs(wrap(task.goal_yaw - m.yaw))
        ending = (self.episode_steps - clock - 1) * self.dt < 1.0  # the last second
        at_goal = ending * (distance < SUCCESS_DISTANCE)
        to_goal = task.goal - m.base_pos
        velocity = rotate(m.quat, m.lin_vel)
        speed = jnp.linalg.norm(velocity)
        towards = jnp.dot(velocity, to_goal) / (jnp.linalg.norm(to_goal) + 0.1)  # [m/s]
        kp_torque = self.gain * (self.action_scale * action - m.joint_pos)
        force = jnp.linalg.norm(m.foot_force, axis=-1)
        sideways = jnp.linalg.norm(m.foot_force[:, :2], axis=-1)
        return {
            "position": ending * jnp.maximum(1 - 0.5 * distance, -1.0),
            "heading": at_goal * (1 - 0.5 * turn),
            "approach": (distance > 0.25) * jnp.clip(towards, -1.0, 1.0),
            "wait": (distance > 0.25) * (speed < 0.2),
            "stand": at_goal * jnp.linalg.norm(m.joint_pos),
            "on_feet": at_goal * self.on_feet(m),
            "joint_vel": rewards.square(m.joint_vel),
            "torque": rewards.square(m.torque),
            "joint_vel_limit": jnp.sum(jnp.clip(jnp.abs(m.joint_vel) - self.config.velocity_limit, 0.0, 1.0)),
            "torque_limit": jnp.sum(jnp.maximum(jnp.abs(kp_torque) - self.torque_limit, 0.0)),
            "base_acc": jnp.minimum(rewards.square(m.base_acc[:3]) + 0.02 * rewards.square(m.base_acc[3:]), 1e3),
            "feet_acc": jnp.sum(jnp.minimum(jnp.linalg.norm(task.foot_acc, axis=-1), 100.0)),
            "action_rate": rewards.square(action - last_action),
            "feet_force": rewards.square(jnp.clip(force - 700.0, 0.0, 700.0)),
            "collision": rewards.touching(m.sensors[self.collision_sensors]),
            "stumble": jnp.any(sideways > 2 * jnp.abs(m.foot_force[:, 2])),
        }

    def on_feet(self, motion):
        """Product () of three shares: 1 on the feet as `succeeded` asks, less with tilt, a low base and contacts.

        Each falls off slowly, so that a robot on its knees or nose gains by every correction.
        """
        upright = jnp.clip(1.5 - self.tilt(motion) / (2 * UPRIGHT_TILT), 0.0, 1.0)  # 0 from 75 degrees
        high = jnp.clip(self.base_height(motion) / STANDING_HEIGHT, 0.0, 1.0)
        return upright * high / (1 + self.touching_parts(motion))

    def failed(self, task, motion):
        c = self.config
        base = jnp.linalg.norm(motion.sensors[self.end_sensors], axis=-1)
        feet = jnp.linalg.norm(motion.foot_force, axis=-1)
        fallen = self.tilted(motion) | (motion.base_pos[2] < c.lowest_base)
        return jnp.any(base > c.base_force) | jnp.any(feet > c.foot_force) | fallen

    def task_metrics(self, task, motion, truncated):
        return {
            "goal_distance": self.distance(task, motion),  # [m]
            "level": task.level.astype(jnp.float32),
            "progress": task.best / (self.LEVELS - 1),
            "progress_reached": task.reached / (self.LEVELS - 1),  # curriculum progress of the paper
            "episode_success": self.succeeded(task, motion, truncated).astype(jnp.float32),
        } | {f"level/{i}": (task.level == i).astype(jnp.float32) for i in range(self.LEVELS)}


# Deviation (parkour rewards): Of Hoeller et al.'s weights, torque_limit is a tenth, and base_acc and feet_acc are a
# fifth and bounded. The position term and the total have floors. heading counts within 0.5 m. A tilt of 80 degrees is a
# failure. At CPU batch sizes the full penalties teach the robot to stay where it is. action_rate is in units of
# actions. `approach` pays for metres towards the goal; their cosine between velocity and goal favours creeping. `stand`
# and `on_feet` count in the last second within 0.5 m, where success is judged. Their `stand` alone, within 0.25 m at
# any time, is avoided by stopping farther away, and asks for no feet: after climbing up robots ended on knees or nose.
WEIGHTS = {
    "position": 10.0,
    "heading": 5.0,
    "approach": 3.0,
    "wait": -1.0,
    "stand": -0.5,
    "on_feet": 5.0,
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
    """Config of a skill: the numbers that all skills share, with changes."""
    shared = {
        "robot": "anymal_d",
        "skill": skill,
        "weights": WEIGHTS | dict(weights),
        "ppo": {
            "hidden": (128, 128, 128),
            "intention": (256, 128),  # hidden widths of the PIDM's intention encoder
            "entropy": 0.005,
            "init_std": 0.6,
            "cpu": {"num_envs": 512, "num_steps": 48, "total_steps": cpu_steps},
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
