"""Velocity tracking on flat ground, blind: anymal_loco, go1_loco, g1_loco (paper Sec. V-A; Isaac Lab's flat tasks).

A command is a forward velocity, a sideways velocity and a heading, whose error sets the turning rate; or, where the
config asks for it, a turning rate of its own.
"""

from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp

from envs import rewards
from envs.base import BODY, Env, FootClocks, joint_indices, select, soft_limits, uniform
from envs.config import Config, Range
from envs.rotations import in_heading, rotate, wrap


@dataclass(frozen=True)
class LocomotionConfig(Config):
    """Numbers of a velocity-tracking task."""

    lin_vel_x: Range = (-1.0, 1.0)  # [m/s] forward command
    lin_vel_y: Range = (-1.0, 1.0)  # [m/s] sideways command
    yaw_rate: float = 1.0  # [rad/s] half-width of the turning command
    command_seconds: Range = (10.0, 10.0)  # time between commands
    standing: float = 0.02  # share of commands to stand still
    turning: float = 0.0  # share of commands with a turning rate in place of a heading
    on_the_spot: float = 0.0  # share of commands with a turning rate and no velocity
    fixed_velocity: tuple[float, float] | None = None  # [m/s] forward, sideways with heading 0, in place of commands
    tracking_seconds: float = 0.0  # [s] time constant of the low-pass on the velocities that the rewards see
    air_time_threshold: float = 0.5  # [s]
    gait_hz: float = 0.0  # steps per second of each foot, by a clock that the policy sees; 0: no clock
    stance: float = 0.6  # share of a step for which the clock has a foot stand
    swing_height: float = 0.08  # [m] to which the clock has it swing
    march: bool = False  # the clock runs on while the robot is told to stand
    effort_joints: tuple[str, ...] = ("",)  # parts of the names of joints with torque and acceleration penalties

    def __post_init__(self):
        super().__post_init__()
        if (shares := self.turning + self.on_the_spot) > 1:
            raise ValueError(f"turning and on_the_spot are shares, together at most 1, not {shares:g}")
        if not self.gait_hz and any(self.weights.get(term) for term in ("in_step", "foot_path")):
            raise ValueError("in_step and foot_path need gait_hz above 0; set their weights to 0, too")


@flax.struct.dataclass
class Task(FootClocks):
    """State of velocity tracking."""

    command: jax.Array  # (3,) forward [m/s], sideways [m/s], turning [rad/s], in the frame of `tracked_velocity`
    heading: jax.Array  # () commanded yaw [rad]
    moves: jax.Array  # () bool: not drawn to stand still; it may yet be slower than `rewards.moving`
    steers: jax.Array  # () bool: the heading sets the turning rate
    remaining: jax.Array  # () control steps until the next command
    velocity: jax.Array  # (3,) low-passed forward, sideways [m/s] and turning [rad/s]


SEEN = BODY | {"command": ("planar", (2.0, 2.0, 0.25))}
ORDER = ("lin_vel", "ang_vel", "gravity", "command", "joint_pos", "joint_vel", "action")  # of what is seen


class Locomotion(Env):
    OBS = {name: SEEN[name] for name in ORDER}
    SHOWCASE_FIELDS = {"fixed_velocity": (0.8, 0.0), "spawn_yaw": 0.0, "spawn_xy": 0.0}

    def __init__(self, config, engine="auto"):
        turning = (-config.yaw_rate, config.yaw_rate)  # what a person may ask for is what it was trained with
        ranges = {"forward [m/s]": config.lin_vel_x, "sideways [m/s]": config.lin_vel_y, "turning [rad/s]": turning}
        self.COMMAND_RANGES = ranges
        if config.gait_hz:
            self.OBS = self.OBS | {"phase": ("phase", 1.0)}
        super().__init__(config, engine)
        self.effort = joint_indices(self.robot, *config.effort_joints)
        self.weight = 9.81 * float(self.model.body_mass.sum())  # [N]
        self.soft_limits = soft_limits(self.model, 0.8)
        self.height = self.robot.sole - float(self.feet_in_base(self.default_pose)[:, 2].min())  # [m] of the base

    def init_task(self, key, physics, course):
        motion = self.motion(physics)
        command = self.draw_command(key)
        task = Task.started(len(self.robot.feet), velocity=self.tracked_velocity(motion), **command)
        return self.steer(task, motion.yaw)

    def draw_command(self, key):
        """Fields of Task that hold a new command."""
        c = self.config
        k_x, k_y, k_heading, k_turn, k_kind, k_stand, k_time = jax.random.split(key, 7)
        kind, turn = uniform(k_kind, 0.0, 1.0), uniform(k_turn, -c.yaw_rate, c.yaw_rate)
        on_the_spot, steers = kind < c.on_the_spot, kind >= c.on_the_spot + c.turning
        velocity = jnp.stack([uniform(k_x, *c.lin_vel_x), uniform(k_y, *c.lin_vel_y)])
        fields = {
            "command": jnp.append(jnp.where(on_the_spot, 0.0, velocity), turn),
            "heading": uniform(k_heading, -jnp.pi, jnp.pi),
            "moves": uniform(k_stand, 0.0, 1.0) >= c.standing,
            "steers": steers,
            "remaining": jnp.round(uniform(k_time, *c.command_seconds) / self.dt).astype(int),
        }
        if c.fixed_velocity is not None:
            fixed = {"command": jnp.array([*c.fixed_velocity, 0.0]), "heading": jnp.zeros(())}
            fields |= fixed | {"moves": jnp.ones((), bool), "steers": jnp.ones((), bool)}
        return fields

    def steer(self, task, yaw):
        """Set the turning rate from the heading error, and all velocities to 0 for a command to stand still."""
        turn = jnp.clip(0.5 * wrap(task.heading - yaw), -self.config.yaw_rate, self.config.yaw_rate)
        turn = jnp.where(task.steers, turn, task.command[2])
        return task.replace(command=jnp.where(task.moves, task.command.at[2].set(turn), 0.0))

    def set_command(self, task, command):
        """The command holds from now on; no heading and no other command follows."""
        forever = jnp.full_like(task.remaining, 2**30)
        yes = jnp.ones_like(task.moves)
        return task.replace(command=command, moves=yes, steers=~yes, remaining=forever)

    def tracked_velocity(self, motion):
        """Forward, sideways [m/s] and turning velocity [rad/s] that a command asks for, (3,)."""
        return jnp.append(motion.lin_vel[:2], motion.ang_vel[2])

    def before_rewards(self, task, motion):
        share = min(1.0, self.dt / self.config.tracking_seconds) if self.config.tracking_seconds else 1.0
        velocity = task.velocity + share * (self.tracked_velocity(motion) - task.velocity)
        return task.replace(velocity=velocity).tick(motion.foot_contact, self.dt)

    def after_rewards(self, key, task, motion, clock):
        task = task.replace(remaining=task.remaining - 1)
        task = select(task.remaining <= 0, task.replace(**self.draw_command(key)), task)
        return self.steer(task, motion.yaw)

    def task_inputs(self, task, motion, clock):
        """The command, and sine and cosine of the gait's clock, or zeros while it rests."""
        if not self.config.gait_hz:
            return {"command": task.command}
        angle = 2 * jnp.pi * self.config.gait_hz * clock * self.dt
        phase = jnp.stack([jnp.sin(angle), jnp.cos(angle)]) * self.paced(task.command)
        return {"command": task.command, "phase": phase}

    def paced(self, command):
        """True while the gait's clock runs."""
        return rewards.moving(command) | self.config.march

    def gait(self, command, clock):
        """What the gait's clock asks of the feet: to stand (F,) bool, and their height (F,) [m]."""
        swing = 1 - self.config.stance  # a step begins with it
        share = (self.config.gait_hz * clock * self.dt + jnp.array(self.robot.gait)) % 1.0
        moves = self.paced(command)
        height = self.config.swing_height * jnp.sin(jnp.pi * jnp.minimum(share / swing, 1.0))
        return (share >= swing) | ~moves, height * moves

    def rewards(self, task, motion, action, last_action, clock):
        m, c = motion, self.config
        stance, height = self.gait(task.command, clock)
        return {
            "track_lin_vel": rewards.track_lin_vel(task.command[:2], task.velocity[:2]),
            "track_yaw_rate": rewards.track_yaw_rate(task.command[2], task.velocity[2]),
            "vertical_vel": rewards.square(m.lin_vel[2]),
            "roll_pitch_rate": rewards.square(m.ang_vel[:2]),
            "orientation": rewards.square(m.gravity[:2]),
            "torque": rewards.square(m.torque[self.effort]),
            "joint_acc": rewards.square(m.joint_acc[self.effort]),
            "action_rate": rewards.square(action - last_action),
            "air_time": rewards.air_time(task.landed_after, c.air_time_threshold, task.command),
            "slip": rewards.slip(m.foot_vel, m.foot_contact),
            "in_step": rewards.in_step(m.foot_contact, stance),
            "foot_path": rewards.foot_path(m.foot_pos[:, 2] - self.robot.sole, height),
            "impact": rewards.impact(m.foot_force, self.weight),
            "power": rewards.power(m.torque, m.joint_vel, self.weight),
            "stand_still": jnp.sum(jnp.abs(m.joint_pos)) * ~self.paced(task.command),
            "stand_on_feet": jnp.sum(~m.foot_contact) * ~self.paced(task.command),
            "joint_limits": rewards.beyond(m.joint_pos + self.default_pose, *self.soft_limits),
            "height": rewards.square(m.base_pos[2] / self.height - 1),
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
    """G1, with terms for joints that should stay near the default pose."""

    def __init__(self, config, engine="auto"):
        super().__init__(config, engine)
        self.hips = joint_indices(self.robot, "hip_roll", "hip_yaw")
        self.arms = joint_indices(self.robot, "shoulder", "elbow", "wrist")
        self.waist = joint_indices(self.robot, "waist")

    def rewards(self, task, motion, action, last_action, clock):
        m = motion
        return super().rewards(task, motion, action, last_action, clock) | {
            "hip_deviation": jnp.sum(jnp.abs(m.joint_pos[self.hips])),
            "arm_deviation": jnp.sum(jnp.abs(m.joint_pos[self.arms])),
            "waist_deviation": jnp.sum(jnp.abs(m.joint_pos[self.waist])),
        }

    def tracked_velocity(self, motion):
        """In the heading frame, not the base's: a trunk that leans or pitches loses no reward."""
        lin_vel, ang_vel = (in_heading(motion.yaw, rotate(motion.quat, v)) for v in (motion.lin_vel, motion.ang_vel))
        return jnp.append(lin_vel[:2], ang_vel[2])


# Deviation (entropy bonus): none (Isaac Lab: 0.005 to 0.01). With it the policy comes to depend on its own noise.
BLIND_QUADRUPED = {
    "hidden": (128, 128, 128),
    "entropy": 0.0,
    "init_std": 1.0,
    "cpu": {"num_envs": 256, "total_steps": 4_000_000},
    "gpu": {"total_steps": 29_500_000},
}

# --robust: what a robot meets and a simulation lacks, and commands as a person gives them. Ours.
ROBUST = {
    "spawn_joints": (0.8, 1.2),
    "spawn_velocity": 0.5,
    "friction": (0.3, 1.2),
    "link_mass": (0.9, 1.1),
    "motor_strength": (0.9, 1.1),
    "action_delay": (0.0, 0.04),
    "sensor_lag": (0.0, 0.01),
    "push_velocity": 1.0,
    "push_seconds": (4.0, 8.0),
    "command_seconds": (3.0, 8.0),
    "standing": 0.1,
    "turning": 0.3,
    "on_the_spot": 0.15,
    "tracking_seconds": 0.1,
}
ROBUST_QUADRUPED = ROBUST | {"lin_vel_x": (-1.0, 1.2), "gait_hz": 2.0}
STEP_WEIGHTS = {  # high, even steps with feet that do not slide, and rest where the command is to stand
    "track_lin_vel": 4.0,
    "track_yaw_rate": 2.0,
    "in_step": 0.7,
    "foot_path": 0.7,
    "slip": -0.3,
    "air_time": 0.0,
    "action_rate": -0.02,
    "joint_limits": -5.0,
    "height": -30.0,  # without it quadrupeds crouch, and Go1 walks on its knees
    "pose": -0.3,
    "stand_still": -0.2,
    "stand_on_feet": -1.0,
    "alive": 0.5,
}

# Deviation (reward weights): Isaac Lab's make every early return negative at CPU batch sizes: robots learn to fall.
# So being alive is rewarded and the total has a floor; on quadrupeds roll_pitch_rate, torque and joint_acc weigh a
# quarter, air_time counts from 0.1 s, and slip and pose keep them from dragging their feet.
ANYMAL_WEIGHTS = {
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
}

ANYMAL_LOCO = LocomotionConfig(
    robot="anymal_d",
    weights=ANYMAL_WEIGHTS,
    robust=ROBUST_QUADRUPED
    | {
        "weights": ANYMAL_WEIGHTS | STEP_WEIGHTS | {"torque": -2.5e-5},
        "added_mass": (-5.0, 10.0),
        "joint_friction": (0.0, 0.3),
    },
    ppo=BLIND_QUADRUPED | {"cpu": {"num_envs": 256, "total_steps": 6_000_000}},
    air_time_threshold=0.1,
    spawn_joints=(0.5, 1.5),
    spawn_velocity=0.5,
    added_mass=(-5.0, 5.0),
    push_velocity=0.5,
)

GO1_WEIGHTS = {
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
}

GO1_LOCO = LocomotionConfig(
    robot="go1",
    weights=GO1_WEIGHTS,
    robust=ROBUST_QUADRUPED
    | {
        "weights": GO1_WEIGHTS | STEP_WEIGHTS,
        "added_mass": (-1.0, 4.0),
        "joint_friction": (0.0, 0.3),
        # Its actions are small, a quarter of a radian: at 2 Hz it learns to step on the spot and nothing else.
        "gait_hz": 2.8,
        "stance": 0.5,
    },
    ppo=BLIND_QUADRUPED,
    air_time_threshold=0.1,
    added_mass=(-1.0, 3.0),
)

G1_PARTS = ("thigh", "shin", "upperarm", "forearm", "hand")

G1_WEIGHTS = {
    "track_lin_vel": 3.0,
    "track_yaw_rate": 3.0,
    "in_step": 1.5,
    "foot_path": 1.0,
    "slip": -0.2,
    "impact": -0.2,
    "joint_limits": -1.0,
    "hip_deviation": -0.2,
    "arm_deviation": -0.1,
    "waist_deviation": -0.5,
    "stand_still": -0.05,
    "stand_on_feet": -0.5,
    "vertical_vel": -0.2,
    "roll_pitch_rate": -0.0125,
    "orientation": -1.0,
    "action_rate": -0.0025,
    "joint_acc": -1e-7,
    "torque": -2e-6,
    "power": -0.1,
    "alive": 0.5,
}

# Deviation (G1 gait): Isaac Lab's single_stance made it hop or shuffle. A clock that the policy sees sets the pace;
# in_step and foot_path pay for it. Commands turn and stand more often, and tracking is low-passed: what noise does to
# the turning rate hid the reward for it.
G1_LOCO = LocomotionConfig(
    robot="g1",
    robust=ROBUST
    | {
        "tracking_seconds": 0.3,
        "added_mass": (-1.0, 5.0),
        "joint_friction": (0.0, 0.3),
        "lin_vel_x": (-0.8, 1.2),
        "march": True,  # on two feet at rest it fell slowly, for its actions are late
        "weights": G1_WEIGHTS | {"track_lin_vel": 5.0, "slip": -0.5, "joint_limits": -5.0},
    },
    weights=G1_WEIGHTS,
    ppo={
        "hidden": (256, 128, 128),
        "entropy": 0.0,
        "init_std": 0.74,
        "desired_kl": 0.02,  # rsl_rl 0.01, which has not been tried on the task as it is
        "cpu": {"num_envs": 256, "total_steps": 10_000_000},
        "gpu": {"total_steps": 147_000_000},
    },
    termination_reward=-2.0,
    lin_vel_x=(0.0, 1.0),
    lin_vel_y=(-0.5, 0.5),
    command_seconds=(3.0, 8.0),
    standing=0.1,
    turning=0.4,
    on_the_spot=0.1,
    tracking_seconds=0.3,
    gait_hz=2.0,
    swing_height=0.1,
    effort_joints=("hip", "knee"),
    # Deviation (G1 contacts): Any part but the feet ends the episode, not the torso alone. Else it learns to sit.
    contact_ends=("torso", "pelvis", *(f"{side}_{part}" for side in ("left", "right") for part in G1_PARTS)),
    max_tilt=70.0,
)
