"""Tasks and methods of the study, which study.py trains and report.py reads.

Their names are folders under results/study; those that have recorded runs must stay.
"""

from dataclasses import dataclass
from typing import Literal

SHIPPED = "--pretrained assets/pidm/{robot}.msgpack"
PART = "--pretrained results/pidm/{robot}/sizes"  # made by pidm.py --stages sizes
PAPER = "--weight-init pytorch"  # rsl_rl's, a fork of which the paper used


@dataclass(frozen=True)
class Method:
    """A way to start a training."""

    title: str  # in tables and figures
    group: Literal["table 1", "table 2", "sizes", "beyond the paper"]  # its section of the report
    flags: str  # of ppo_finetune.py; {robot} is the task's


@dataclass(frozen=True)
class Task:
    """A task and the methods that the study compares on it."""

    title: str  # in tables and figures
    methods: tuple[str, ...]
    steps: int | None = None  # at scale cpu, where the preset has too few for the PIDM to converge, or far too many


METHODS = {
    "mlp": Method("MLP", "table 1", f"--network mlp {PAPER}"),
    "pidm_random": Method("PIDM random", "table 1", f"--network pidm {PAPER}"),
    "pidm_pretrained": Method("PIDM pretrained", "table 1", f"{SHIPPED} {PAPER}"),
    "pidm_shuffled": Method("PIDM shuffled", "beyond the paper", f"{SHIPPED} --load-into shuffled {PAPER}"),
    "pidm_actor": Method("PIDM pretrained, actor only", "table 2", f"{SHIPPED} --load-into actor {PAPER}"),
    "pidm_critic": Method("PIDM pretrained, critic only", "table 2", f"{SHIPPED} --load-into critic {PAPER}"),
    "pidm_7k": Method("PIDM pretrained on 7 k", "sizes", f"{PART}/7000.msgpack {PAPER}"),
    "pidm_70k": Method("PIDM pretrained on 70 k", "sizes", f"{PART}/70000.msgpack {PAPER}"),
    "pidm_700k": Method("PIDM pretrained on 700 k", "sizes", f"{PART}/700000.msgpack {PAPER}"),
    "mlp_orthogonal": Method("MLP, orthogonal", "beyond the paper", "--network mlp"),
    "pidm_random_orthogonal": Method("PIDM random, orthogonal", "beyond the paper", "--network pidm"),
    "pidm_pretrained_orthogonal": Method("PIDM pretrained, orthogonal", "beyond the paper", SHIPPED),
    "pidm_history_orthogonal": Method(
        "PIDM pretrained, history encoder only, orthogonal",
        "beyond the paper",
        f"{SHIPPED} --load-into history_encoder",
    ),
}


def titles(*groups):
    """Title of each method of these groups, by name."""
    return {name: method.title for name, method in METHODS.items() if method.group in groups}


TABLE_1 = tuple(titles("table 1"))
ABLATIONS = tuple(titles("table 2", "sizes"))
ORTHOGONAL = tuple(name for name in METHODS if name.endswith("_orthogonal"))

TASKS = {  # in the paper's order
    "anymal_loco": Task("ANYmal D locomotion", (*TABLE_1, *ORTHOGONAL, "pidm_shuffled")),
    "anymal_pedipulation": Task("Pedipulation", (*TABLE_1, "pidm_shuffled"), 6_000_000),
    "anymal_parkour_walk": Task("Parkour walk", TABLE_1),
    "anymal_climb_up": Task("Climb up", (*TABLE_1, *ABLATIONS, "pidm_shuffled")),
    "anymal_climb_down": Task("Climb down", (*TABLE_1, *ABLATIONS, "pidm_shuffled")),
    "anymal_crouch": Task("Crouch", TABLE_1),
    "anymal_jump": Task("Jump", TABLE_1),
    "go1_loco": Task("Go1 locomotion", (*TABLE_1, *ORTHOGONAL, "pidm_shuffled"), 6_000_000),
    "g1_loco": Task("G1 locomotion", (*TABLE_1, "pidm_shuffled"), 12_000_000),
}

# Fields that the config of an older run lacks, at the values that leave its task as it was.
LATER = {
    "motor_strength": [1.0, 1.0],
    "joint_friction": [0.0, 0.0],
    "action_delay": [0.0, 0.0],
    "sensor_lag": [0.0, 0.0],
    "turning": 0.0,
    "on_the_spot": 0.0,
    "tracking_seconds": 0.0,
    "gait_hz": 0.0,
}
CLOCK = ("stance", "swing_height")  # of the gait's clock, read only if there is one


def task_of(config):
    """A run's config as args.json has it, in a form in which runs of the same task are equal, whatever their age."""
    known = (LATER | config).items()
    task = {name: value for name, value in known if name not in ("robust", "body")}  # what --robust, --robot would set
    if isinstance(seconds := task.get("command_seconds"), float):
        task["command_seconds"] = [seconds, seconds]
    return {name: value for name, value in task.items() if task["gait_hz"] or name not in CLOCK}
