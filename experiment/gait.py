"""Numbers of a gait: what a robot did under fixed commands, from recorded motion alone, whatever simulated it.

    by_command = {name: gait.measure(recording, body) for name, recording in recordings.items()}
    summary = gait.summary(by_command, {"push 1.0 m/s": (falls, episodes)})
    print(gait.lines(by_command, summary))

Legend: T control steps, N episodes side by side, A joints and actions, F feet.
"""

import re
from dataclasses import dataclass

import numpy as np

from envs.anatomy import touch

SECONDS, WARM_UP = 10.0, 2.0  # [s] of a recording, and of its start that means leave out
SWITCH_SECONDS = 2.5  # between two commands of "switches"
REVERSE_SECONDS = 4.0  # of "reverse" before its command changes sign
STILL = 0.05  # [m/s] a slower foot is still
CHATTER = 0.04  # [s] a shorter flight or touch is none
HIGH = 8.0  # [Hz] faster changes of an action are no walking
GRAVITY = 9.81  # [m/s^2]

COMMANDS = {  # forward, sideways [m/s], turning [rad/s]
    "stand": (0.0, 0.0, 0.0),
    "forward 0.4": (0.4, 0.0, 0.0),
    "forward 0.8": (0.8, 0.0, 0.0),
    "forward 1.0": (1.0, 0.0, 0.0),
    "backward 0.6": (-0.6, 0.0, 0.0),
    "left": (0.0, 0.5, 0.0),
    "right": (0.0, -0.5, 0.0),
    "turn left": (0.0, 0.0, 0.8),
    "turn right": (0.0, 0.0, -0.8),
    "arc left": (0.6, 0.0, 0.8),
    "arc right": (0.6, 0.0, -0.8),
}
SEQUENCES = ("switches", "reverse")
USUAL = "forward 0.8"  # the command whose gait the summary describes
REVERSED = -0.4  # [m/s] mean forward speed in the last fifth of an episode that counts as reversed


@dataclass
class Body:
    """Facts of a robot."""

    mass: float  # [kg]
    torque_limit: np.ndarray  # (A,) [N m]
    low: np.ndarray  # (A,) [rad] joint limits
    high: np.ndarray  # (A,) [rad]
    feet: tuple[str, ...]  # (F,) names
    sole: float  # [m] height of a foot's position above the ground that it stands on


@dataclass
class Recording:
    """N episodes of one command. Rows follow their control steps; those of an episode that has ended are ignored."""

    dt: float  # [s] control step
    command: np.ndarray  # (T, N, 3) forward, sideways [m/s], turning [rad/s]
    lin_vel: np.ndarray  # (T, N, 3) heading frame [m/s]
    yaw_rate: np.ndarray  # (T, N) z component of the angular velocity in the world [rad/s]
    height: np.ndarray  # (T, N) of the base [m]
    roll: np.ndarray  # (T, N) [rad]
    pitch: np.ndarray  # (T, N) [rad]
    joint_pos: np.ndarray  # (T, N, A) absolute [rad]
    joint_vel: np.ndarray  # (T, N, A) [rad/s]
    torque: np.ndarray  # (T, N, A) whole PD torque, as applied [N m]
    action: np.ndarray  # (T, N, A)
    foot_pos: np.ndarray  # (T, N, F, 3) world [m]
    foot_vel: np.ndarray  # (T, N, F, 3) world [m/s]
    foot_force: np.ndarray  # (T, N, F, 3) [N]
    alive: np.ndarray  # (T, N) bool, False from the step of a fall on


# --- Commands ---


def starts_of(name, starts):
    """Number of episodes of a command or sequence where most commands have `starts`.

    The two arcs share theirs; `reverse` gets a fifth more, since it is harder.
    """
    if name.startswith("arc"):
        return max(1, starts // 2)
    return round(1.2 * starts) if name == "reverse" else starts


def schedule(name, dt, starts, seconds=SECONDS):
    """Commands (T, N, 3) of a command or sequence. Times of sequences shrink with `seconds`; switches are drawn once.

    Every episode of "switches" has an order of its own, always the same.
    """
    steps, count = round(seconds / dt), starts_of(name, starts)
    if name == "switches":
        block = round(SWITCH_SECONDS * seconds / SECONDS / dt)
        rng, known = np.random.default_rng(0), np.array([*COMMANDS.values()])
        orders = [rng.permutation(len(known))[: -(-steps // block)] for _ in range(count)]
        return np.repeat(known[np.array(orders).T], block, 0)[:steps]
    if name == "reverse":
        first = np.arange(steps) < round(REVERSE_SECONDS * seconds / SECONDS / dt)
        row = np.where(first[:, None], COMMANDS["forward 0.8"], COMMANDS["backward 0.6"])
    else:
        row = np.tile(COMMANDS[name], (steps, 1))
    return np.repeat(row[:, None], count, 1)


# --- Numbers of one command ---


def measure(recording, body, warm_up=WARM_UP):
    """Numbers of one command by name, NaN where there is nothing to measure; docs/play.md says what each one is."""
    times = np.arange(len(recording.alive)) * recording.dt
    rows = recording.alive & (times >= warm_up - 1e-9)[:, None]
    count = {"episodes": float(rows.shape[1]), "falls": float(fallen(recording).sum())}
    parts = [tracking(recording, rows), feet(recording, rows, body), trunk(recording, rows)]
    return count | {name: float(x) for part in [*parts, effort(recording, rows, body)] for name, x in part.items()}


def fallen(recording):
    """True (N,) where an episode ended in a fall."""
    return ~recording.alive[-1]


def reversals(recording):
    """Number of episodes that go backward in their last fifth, without a fall."""
    last = recording.lin_vel[-(len(recording.alive) // 5) :, :, 0].mean(0)
    return float(np.sum((last <= REVERSED) & ~fallen(recording)))


def mean(values):
    """Mean, NaN of nothing without a warning."""
    return np.mean(values) if np.size(values) else np.nan


def over_time(x, rows):
    """Means (M, ...) over the rows (T, N) of each of the M episodes that have some; x (T, N, ...)."""
    return np.array([x[rows[:, n], n].mean(0) for n in np.flatnonzero(rows.any(0))]).reshape(-1, *x.shape[2:])


def tracking(r, rows):
    """Means of the velocities, and their distance from the command."""
    velocity = np.concatenate([r.lin_vel[..., :2], r.yaw_rate[..., None]], -1)
    off = over_time(velocity - r.command, rows)
    return dict(zip(("forward", "sideways", "turning"), map(mean, over_time(velocity, rows).T), strict=True)) | {
        "velocity_error": mean(np.linalg.norm(off[:, :2], axis=1)),
        "velocity_error_steps": mean(np.linalg.norm((velocity - r.command)[rows][:, :2], axis=1)),
        "turning_error": mean(np.abs(off[:, 2])),
    }


def distance(r, rows):
    """Path of the base [m] in all episodes, NaN for a command without a linear velocity."""
    if not r.command[rows][:, :2].any():
        return np.nan
    return np.linalg.norm(r.lin_vel[rows][:, :2], axis=1).sum() * r.dt


def runs(flags):
    """Start and stop of every run of True in (T,), as (runs, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int))).reshape(-1, 2)


def without_chatter(contact, dt):
    """Contact (T,) of one foot without flights, then without touches, that are shorter than CHATTER."""
    contact = contact.copy()
    for fill in (True, False):
        for start, stop in runs(contact != fill):
            if start > 0 and stop < len(contact) and (stop - start) * dt < CHATTER - 1e-9:
                contact[start:stop] = fill
    return contact


def swings(r, rows, touching, body):
    """Touch-downs of all feet, and for each foot the highest point of every whole swing above its stance [m]."""
    touchdowns, peaks = 0, [[] for _ in body.feet]
    for n in np.flatnonzero(rows.any(0)):
        for foot, found in enumerate(peaks):
            contact = without_chatter(touching[rows[:, n], n, foot], r.dt)
            height = r.foot_pos[rows[:, n], n, foot, 2] - body.sole
            touchdowns += np.sum(contact[1:] & ~contact[:-1])
            found += [height[a:b].max() for a, b in runs(~contact) if a > 0 and b < len(contact)]
    return touchdowns, peaks


def is_left(foot):
    """True for a left foot, by its name: left_foot, LeftFoot, leg_l_foot, LF_foot, RL_foot (rear left), LM (middle)."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", foot)]
    return bool({"left", "l", "lleg"} & {*words} or re.fullmatch(r"l[fmhrb]|[fmhrb]l", words[0] if words else ""))


def feet(r, rows, body):
    """Stance, swing, slip and peak force of the feet."""
    force, speed = np.linalg.norm(r.foot_force, axis=-1), np.linalg.norm(r.foot_vel, axis=-1)
    touching = force > touch(body.mass)
    duty = np.array([mean(touching[rows][:, foot]) for foot in range(len(body.feet))])
    touchdowns, peaks = swings(r, rows, touching, body)
    clearance = [np.median(found) if found else np.nan for found in peaks]
    left = np.array([is_left(foot) for foot in body.feet])
    slid = (np.linalg.norm(r.foot_vel[..., :2], axis=-1) * touching)[rows].sum() * r.dt / len(body.feet)
    seconds = rows.sum() * r.dt * len(body.feet)
    return {
        **{f"duty/{name}": x for name, x in zip(body.feet, duty, strict=True)},
        **{f"clearance/{name}": x for name, x in zip(body.feet, clearance, strict=True)},
        "duty": mean(duty),
        "duty_difference": abs(mean(duty[left]) - mean(duty[~left])),
        "duty_spread": duty.max() - duty.min(),
        "clearance": mean([x for x in clearance if np.isfinite(x)]),
        "stride_frequency": touchdowns / seconds if seconds else np.nan,
        "slip": slid / distance(r, rows),
        "still": mean((speed < STILL).all(-1)[rows]),
        "foot_force": percentile(force.max(-1)[rows], 99.9) / (body.mass * GRAVITY),
    }


def trunk(r, rows):
    """Mean height of the base, and standard deviations over time of its height and tilt, mean of the episodes.

    The height shows a robot that crouches, or walks on knees that the sensors of its feet cover.
    """
    whole, seen = {"height_std": r.height, "roll_std": r.roll, "pitch_std": r.pitch}, np.flatnonzero(rows.any(0))
    spread = {name: mean([x[rows[:, n], n].std() for n in seen]) for name, x in whole.items()}
    return spread | {"height": mean([r.height[rows[:, n], n].mean() for n in seen])}


def effort(r, rows, body):
    """Torques, joint limits, power, and how much of the actions is faster than a gait."""
    load = np.abs(r.torque[rows]) / body.torque_limit
    margin = np.minimum(r.joint_pos[rows] - body.low, body.high - r.joint_pos[rows]).min(-1)
    work = np.maximum(r.torque * r.joint_vel, 0)[rows].sum() * r.dt
    return {
        "torque_peak": percentile(load, 99.9),
        "torque_max": load.max() if load.size else np.nan,
        "torque_rms": np.sqrt((load**2).mean(0)).max() if load.size else np.nan,
        "joint_margin": percentile(margin, 0.1),
        "fast_action": fast_share(r, rows),
        "cost_of_transport": work / (body.mass * GRAVITY * distance(r, rows)),
    }


def percentile(values, q):
    """Percentile of all values, NaN of nothing."""
    return np.percentile(values, q) if np.size(values) else np.nan


def fast_share(r, rows):
    """Share of the actions' power, means removed, above HIGH; NaN if they never change."""
    fast = total = 0.0
    for n in np.flatnonzero(rows.sum(0) > 1):
        x = r.action[rows[:, n], n]
        power = (np.abs(np.fft.rfft(x - x.mean(0), axis=0)) ** 2).sum(1)
        fast += power[np.fft.rfftfreq(len(x), r.dt) > HIGH].sum()
        total += power.sum()
    return fast / total if total > 0 else np.nan


# --- Numbers of all commands ---


def slope(by_command, *names):
    """Slope of the mean yaw rate on its command, a line through 0."""
    wanted = np.array([COMMANDS[name][2] for name in names])
    done = np.array([by_command[name]["turning"] for name in names])
    return float(wanted @ done / (wanted @ wanted))


def summary(by_command, robustness=None):
    """Numbers of all commands together by name, ready for JSON: None for NaN.

    by_command: COMMANDS, and where there are any the SEQUENCES -> `measure`, which for "reverse" also has `reversed`,
    the count of `reversals`. robustness: name -> (falls, episodes), or None where it was not measured.
    """
    of, usual = [by_command[name] for name in COMMANDS], by_command[USUAL]
    left, right = ("turn left", "arc left"), ("turn right", "arc right")
    result = {
        "falls": sum(x["falls"] for x in of),
        "episodes": sum(x["episodes"] for x in of),
        "yaw_slope": slope(by_command, *left, *right),
        "yaw_slope_left": slope(by_command, *left),
        "yaw_slope_right": slope(by_command, *right),
        "drift": by_command["stand"]["velocity_error"],
        "still": by_command["stand"]["still"],
        "velocity_error": mean([x["velocity_error"] for x in of]),
        "turning_error": mean([x["turning_error"] for x in of]),
    }
    names = (
        "height",
        "stride_frequency",
        "duty",
        "duty_difference",
        "clearance",
        "slip",
        "cost_of_transport",
        "fast_action",
    )
    result |= {name: usual[name] for name in names}
    highest = ("torque_peak", "torque_max", "torque_rms", "foot_force")
    result |= {name: worst(of, name) for name in highest} | {"joint_margin": -worst(of, "joint_margin", -1)}
    for name in [name for name in SEQUENCES if name in by_command]:
        result |= {f"{name}/{what}": by_command[name][what] for what in ("falls", "episodes")}
    if "reversed" in by_command.get("reverse", {}):
        result["reverse/reversed"] = by_command["reverse"]["reversed"]
    for name, found in (robustness or {}).items():
        result |= {f"{name}/falls": found and found[0], f"{name}/episodes": found and found[1]}
    return {name: plain(value) for name, value in result.items()}


def worst(of, name, sign=1):
    """Largest number of this name times `sign`, NaN where no command has one."""
    found = [sign * x[name] for x in of if np.isfinite(x[name])]
    return max(found) if found else np.nan


def plain(value):
    """A number with four digits, None for NaN."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.4g}")


# --- Table ---

COLUMNS = {  # heading -> number, its factor and format
    "fwd": ("forward", 1, ".2f"),
    "side": ("sideways", 1, ".2f"),
    "turn": ("turning", 1, ".2f"),
    "error": ("velocity_error", 1, ".2f"),
    "falls": ("falls", 1, ".0f"),
    "duty%": ("duty", 100, ".0f"),
    "l-r%": ("duty_difference", 100, ".0f"),
    "lift cm": ("clearance", 100, ".1f"),
    "strides/s": ("stride_frequency", 1, ".1f"),
    "slip": ("slip", 1, ".2f"),
    "still%": ("still", 100, ".0f"),
    "height": ("height", 1, ".2f"),
    "tilt": ("pitch_std", 180 / np.pi, ".1f"),
    "torque": ("torque_peak", 1, ".2f"),
    "rms": ("torque_rms", 1, ".2f"),
    "margin": ("joint_margin", 1, ".2f"),
    "fast%": ("fast_action", 100, ".0f"),
    "CoT": ("cost_of_transport", 1, ".2f"),
    "force": ("foot_force", 1, ".1f"),
}


def lines(by_command, summary):
    """The table of all commands, and below it the block of limits, as text."""
    rows = [["command", *COLUMNS]]
    for name, numbers in by_command.items():
        cells = [(numbers[key] * factor, form) for key, factor, form in COLUMNS.values()]
        rows.append([name, *("-" if np.isnan(x) else f"{x:{form}}" for x, form in cells)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    table = [
        "  ".join([row[0].ljust(widths[0]), *(x.rjust(w) for x, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    return "\n".join([*table, "", "limits", *limits(summary)])


def limits(summary):
    """Lines of the block of limits."""

    def count(name, what="falls"):
        of = f"{name}/episodes" if f"{name}/episodes" in summary else "episodes"
        value = summary[f"{name}/{what}" if name else what]
        return "not measured" if value is None else f"{value:.0f} of {summary[of]:.0f} {what.replace('falls', 'fell')}"

    def show(*names):
        return ", ".join("-" if summary[name] is None else f"{summary[name]:.2f}" for name in names)

    yield f"  yaw rate over its command, left and right: {show('yaw_slope_left', 'yaw_slope_right')}"
    yield f"  drift of a robot told to stand: {show('drift')} m/s"
    yield f"  smallest joint margin: {show('joint_margin')} rad, highest torque: {show('torque_peak')} of the limit"
    yield f"  all commands: {count('')}"
    for name in [key.removesuffix("/falls") for key in summary if key.endswith("/falls")]:
        also = f", {count(name, 'reversed')}" if f"{name}/reversed" in summary else ""
        yield f"  {name}: {count(name)}{also}"
