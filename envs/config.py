"""Numbers of a task, and checked changes to them: Python values by name, or text as typed after `--set NAME=`."""

import ast
import dataclasses
import types
import typing
import warnings
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Range = tuple[float, float]  # (low, high)


@dataclass(frozen=True)
class Config:
    """Numbers of a task. Reward weights are per second."""

    robot: str
    weights: dict[str, float]  # reward term -> weight
    ppo: dict  # the task's own PPO settings, which `merge` of stages 1 and 3 reads
    robust: dict = field(default_factory=dict)  # fields that --robust replaces, for use on a robot; {}: none
    body: dict = field(default_factory=dict)  # of a robot from a file, see loader.py; {}: `robot` is a shipped one
    episode_seconds: float = 20.0
    physics_dt: float = 0.005  # [s]
    decimation: int = 4  # physics steps per control step
    history: int = 5  # K
    noise: float = 1.0  # factor on all sensor noise
    reward_floor: float = -0.5  # lower bound per second of the reward, termination_reward aside
    termination_reward: float = 0.0  # added once, when an episode ends in failure
    # end of an episode
    contact_ends: tuple[str, ...] = ("base",)  # a contact of these bodies is a failure; sensors <name>_force
    max_tilt: float = 180.0  # [deg] of the trunk; more is a failure
    # start of an episode
    spawn_xy: float = 0.5  # [m] half-width around the origin
    spawn_yaw: float = np.pi  # [rad] half-width around forward
    spawn_joints: Range = (1.0, 1.0)  # factor on the default pose
    spawn_velocity: float = 0.0  # [m/s, rad/s] half-width of all six base velocities
    # randomisation, drawn once an episode
    friction: Range = (0.7, 0.7)
    added_mass: Range = (0.0, 0.0)  # [kg] on the base
    link_mass: Range = (1.0, 1.0)  # factor on the mass and inertia of each link
    motor_strength: Range = (1.0, 1.0)  # factor on each joint's kp
    joint_friction: Range = (0.0, 0.0)  # [N m] dry friction of all joints
    action_delay: Range = (0.0, 0.0)  # [s] from an action to the joint targets that follow it
    sensor_lag: Range = (0.0, 0.0)  # [s] age of the readings, at most a control step
    # pushes: sudden changes of the base's velocity
    push_velocity: float = 0.0  # [m/s, rad/s] half-width
    push_axes: Literal[2, 6] = 2  # components: the horizontal velocity, or linear and angular velocity
    push_seconds: Range = (10.0, 15.0)  # time between pushes

    def __post_init__(self):
        for name in POSITIVE:
            if np.min(getattr(self, name, 1)) <= 0:
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)}")
        for name, (least, most) in LIMITS.items():
            value = getattr(self, name, least)
            if np.min(value) < least or np.max(value) > most:
                limits = f"at least {least:g}" if most == np.inf else f"from {least:g} to {most:g}"
                limits = f"at most {most:g}" if least == -np.inf else limits
                raise ValueError(f"{name} must be {limits}, not {value}")


POSITIVE = (
    *("episode_seconds", "physics_dt", "decimation", "history", "command_seconds", "perturb_seconds", "amplitude"),
    *("push_seconds", "link_mass", "motor_strength"),
)
AT_LEAST_0 = (
    *("noise", "scan_noise", "scan_shift", "spawn_xy", "spawn_yaw", "spawn_velocity", "friction"),
    *("joint_friction", "push_velocity", "perturb_force", "yaw_rate", "tracking_seconds", "gait_hz", "swing_height"),
    *("base_force", "foot_force", "all_feet_force", "velocity_limit", "random_seconds", "hasty", "air_time_threshold"),
)
LIMITS = dict.fromkeys(AT_LEAST_0, (0, np.inf)) | dict.fromkeys(("standing", "turning", "on_the_spot", "rough"), (0, 1))
LIMITS |= {"stance": (0.05, 0.95), "max_tilt": (1, 180), "reward_floor": (-np.inf, 0)}
FIXED = {
    "robot": "it belongs to the task",
    "body": "it is what --robot FILE loads",
    "ppo": "PPO's settings are flags of their own, like --lr",
    "robust": "--robust turns it on as a whole",
}
UNIONS = (types.UnionType, typing.Union)
WORDS = {  # annotation -> words for it in an error line
    bool: "true or false",
    int: "a whole number like 4",
    float: "a number like 0.5",
    types.NoneType: "none",
    Literal[2, 6]: "2 or 6",
    Range: "two numbers like 0.3,1.2",
    tuple[float, float, float]: "three numbers like 0.7,-0.2,0.5",
    tuple[Range, Range, Range]: "three pairs like (0,1),(-0.4,0.2),(-0.1,1.3)",
    tuple[str, ...]: "names like torso,pelvis",
    dict[str, float]: "one number at a time, as weights.NAME=0.5",
}


def replace_checked(config, overrides):
    """Replace fields of a config by name, and single reward weights by `weights.<term>`.

    ValueError, in one line, for an unknown name or a value that does not fit the field's annotation.
    """
    kinds = {field.name: field.type for field in dataclasses.fields(config) if field.name not in FIXED}
    kinds |= {f"weights.{term}": float for term in config.weights}
    values = {}
    for name, value in overrides.items():
        if name in FIXED:
            raise ValueError(f"{name} cannot be set: {FIXED[name]}")
        if name not in kinds:
            choices = [other for other in kinds if name.startswith("weights.") == other.startswith("weights.")]
            hint = " (only weights that the task's config has can be set)" if name.startswith("weights.") else ""
            raise ValueError(f"unknown option {name!r}; choose one of {', '.join(sorted(choices))}{hint}")
        try:
            values[name] = (parse if isinstance(value, str) else convert)(value, kinds[name])
        except ValueError:
            words = " or ".join(WORDS.get(kind, str(kind)) for kind in alternatives(kinds[name]))
            raise ValueError(f"{name} takes {words}, not {value!r}") from None
        ranges = {Range: [values[name]], tuple[Range, Range, Range]: values[name]}.get(kinds[name], ())
        if any(low > high for low, high in ranges):
            raise ValueError(f"{name} takes its lower end first, not {value!r}")
    weights = values.pop("weights", config.weights)
    weights = {term: values.pop(f"weights.{term}", weight) for term, weight in weights.items()}
    return dataclasses.replace(config, weights=weights, **values)


def parse(text, kind):
    """Read a value of annotation `kind` from text. ValueError if the text is none."""
    if kind is str:
        return text
    if typing.get_origin(kind) is dict:
        raise ValueError("no dict can be typed")
    if kind == tuple[str, ...]:
        return tuple(text.split(","))
    literal = text.capitalize() if text.lower() in ("true", "false", "none") else text
    try:
        with warnings.catch_warnings(action="ignore"):  # Python warns of text that looks like code
            return convert(ast.literal_eval(literal), kind)
    except (SyntaxError, TypeError, MemoryError, RecursionError):
        raise ValueError(f"{text!r} is no value") from None


def convert(value, kind):
    """The value with tuples for lists, and floats for ints where `kind` has them. ValueError if it does not fit."""
    kind = next((one for one in alternatives(kind) if fits(value, one)), None)
    if kind is None:
        raise ValueError(f"{value!r} does not fit")
    if typing.get_origin(kind) is tuple:
        return tuple(map(convert, value, entries(kind, len(value))))
    return float(value) if kind is float else value


def fits(value, kind):
    """True if a value is of an annotation's kind. A list passes for a tuple, an int for a float.

    A number that is not finite, or too large for any use, does not fit.
    """
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in UNIONS:
        return any(fits(value, one) for one in inner)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in inner)
    if origin is tuple:
        kinds = entries(kind, len(value)) if isinstance(value, (list, tuple)) and len(value) < 100 else None
        return kinds is not None and len(kinds) == len(value) and all(map(fits, value, kinds))
    if kind is float:
        return type(value) in (int, float) and abs(value) < 1e12
    return type(value) is (origin or kind) and not (kind is int and abs(value) >= 1e12)


def alternatives(kind):
    """The annotations that a union joins, or the one annotation alone."""
    return typing.get_args(kind) if typing.get_origin(kind) in UNIONS else (kind,)


def entries(kind, count):
    """Annotations of a tuple's entries: `count` of them where it may have any length."""
    inner = typing.get_args(kind)
    return inner[:1] * count if inner[-1] is ... else inner
