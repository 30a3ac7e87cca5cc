"""The study: its tasks, methods and scales, and the plan of its runs, which study.py trains and report.py reads.

Names of scales, tasks and methods are folders under results/study; those that have recorded runs must stay.
"""

from dataclasses import dataclass, field
from typing import Literal

SHIPPED = "--pretrained assets/pidm/{robot}.msgpack"
PART = "--pretrained results/pidm/{robot}/sizes"  # made by pidm.py --stages sizes
PAPER = "--weight-init {weights}"  # as in rsl_rl, a fork of which the paper used
UNSCALED = "--weight-init pytorch_unscaled"
SLOW = "--max-lr 0.003"  # rsl_rl: 0.01


@dataclass(frozen=True)
class Method:
    """A way to start a training."""

    title: str  # in tables and figures
    group: Literal["table 1", "table 2", "sizes", "beyond the paper"]  # its section of the report
    flags: str  # of ppo_finetune.py; {robot} is the task's, {weights} those of the scale


@dataclass(frozen=True)
class Scale:
    """What all runs in a folder of results/study have in common."""

    preset: str = "cpu"
    flags: dict[str, str] = field(default_factory=dict)  # task -> flags of ppo_finetune.py that go before the preset's
    weights: str = "pytorch"  # initial ones, of the methods of the paper
    earlier: tuple[str, ...] = ()  # tasks that have been changed since their runs


@dataclass(frozen=True)
class Block:
    """Runs that answer one question: each of the tasks with each method and seed."""

    why: str
    scale: str
    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: range


TASKS = {  # their titles in tables and figures, in the paper's order
    "anymal_loco": "ANYmal D locomotion",
    "anymal_pedipulation": "Pedipulation",
    "anymal_parkour_walk": "Parkour walk",
    "anymal_climb_up": "Climb up",
    "anymal_climb_down": "Climb down",
    "anymal_crouch": "Crouch",
    "anymal_jump": "Jump",
    "go1_loco": "Go1 locomotion",
    "g1_loco": "G1 locomotion",
}

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
    "pidm_random_unscaled": Method("PIDM random, unscaled", "beyond the paper", f"--network pidm {UNSCALED}"),
    "pidm_random_slow": Method("PIDM random, small steps", "beyond the paper", f"--network pidm {PAPER} {SLOW}"),
    "pidm_pretrained_slow": Method("PIDM pretrained, small steps", "beyond the paper", f"{SHIPPED} {PAPER} {SLOW}"),
    "pidm_pretrained_unscaled": Method("PIDM pretrained, unscaled", "beyond the paper", f"{SHIPPED} {UNSCALED}"),
}

MODULES = ("intention_encoder", "history_encoder", "backbone", "action_synthesizer")  # of the actor


def titles(*groups):
    """Title of each method of these groups, by name."""
    return {name: method.title for name, method in METHODS.items() if method.group in groups}


GO1, ANYMAL, G1, PEDIPULATION = ("go1_loco",), ("anymal_loco",), ("g1_loco",), ("anymal_pedipulation",)
CLIMB_UP, CLIMB_DOWN = ("anymal_climb_up",), ("anymal_climb_down",)
OTHERS = ("anymal_parkour_walk", "anymal_crouch", "anymal_jump")
SKILLS = OTHERS + CLIMB_UP + CLIMB_DOWN
WALKING = GO1 + ANYMAL  # tasks that are run at several batches

TABLE_1, TABLE_2, PARTS = (tuple(titles(group)) for group in ("table 1", "table 2", "sizes"))
PIDMS = ("pidm_random", "pidm_pretrained")
ORTHOGONAL = ("pidm_random_orthogonal",)
CONTROLS = (*ORTHOGONAL, "pidm_pretrained_orthogonal", "pidm_shuffled")
SLOW_PIDMS = ("pidm_random_slow", "pidm_pretrained_slow")
UNSCALED_PIDMS = ("pidm_random_unscaled", "pidm_pretrained_unscaled")


def blind(num_envs, total_steps, log_every):
    """Flags of the quadrupeds' blind tasks."""
    flags = f"--num-envs {num_envs} --total-steps {total_steps} --log-every {log_every}"
    return dict.fromkeys(GO1 + ANYMAL + PEDIPULATION, flags)


SIX_MILLION = dict.fromkeys(GO1 + PEDIPULATION, "--total-steps 6000000")
G1_AS_IT_WAS = {"g1_loco": "--total-steps 12000000 --desired-kl 0.01"}
G1_AT_512 = {"g1_loco": "--num-envs 512 --total-steps 8000000 --log-every 4"}
SCALES = {
    # Recorded with parkour's tasks as they were. Nothing is added to it.
    "cpu": Scale(flags=SIX_MILLION | G1_AS_IT_WAS, weights="pytorch_unscaled", earlier=SKILLS),
    "256": Scale(flags=blind(256, 6_000_000, 10)),
    "1024": Scale(flags=blind(1024, 10_000_000, 4)),
    # Isaac Lab's 4096 x 24; the paper names none. G1 and parkour need more iterations: 512 x 24 and 512 x 48.
    "batch": Scale(flags=blind(4096, 14_000_000, 1) | G1_AT_512),
    "gpu": Scale("gpu"),
    "smoke": Scale("smoke"),
}

PLAN = (  # in the order in which it is run
    Block("Table I: Go1 at Isaac Lab's batch, where it was not helped at 256", "batch", GO1, TABLE_1, range(5)),
    Block("Table I: ANYmal D at Isaac Lab's batch", "batch", ANYMAL, TABLE_1, range(3)),
    Block("is it knowledge, or the size of the initial weights? Go1", "batch", GO1, CONTROLS, range(3)),
    Block("is it knowledge, or the size of the initial weights? ANYmal D", "batch", ANYMAL, CONTROLS, range(1)),
    Block("what pretraining brings, over the batch", "1024", GO1 + ANYMAL, PIDMS, range(2)),
    Block("what first mean actions of almost 0 bring", "batch", GO1, UNSCALED_PIDMS, range(2)),
    Block("does a smaller largest step size spare the critic?", "batch", GO1 + ANYMAL, SLOW_PIDMS, range(2)),
    Block("Table I: G1 with its gait clock", "batch", G1, TABLE_1, range(3)),
    Block("Table I: parkour where success is to stand", "batch", SKILLS, TABLE_1, range(2)),
    Block("Table II: the actor or the critic alone", "batch", CLIMB_UP + CLIMB_DOWN, TABLE_2, range(1)),
    Block("how many transitions pretraining needs", "batch", CLIMB_UP + CLIMB_DOWN, PARTS, range(1)),
    Block("orthogonal weights without data", "batch", CLIMB_UP, ORTHOGONAL, range(1)),
    # The results need all above. What follows makes them firmer.
    Block("third seeds of parkour", "batch", SKILLS, TABLE_1, range(2, 3)),
    Block("second seeds of Table II and sizes", "batch", CLIMB_UP + CLIMB_DOWN, TABLE_2 + PARTS, range(1, 2)),
    Block("Table I: pedipulation at Isaac Lab's batch", "batch", PEDIPULATION, TABLE_1, range(3)),
    Block("orthogonal weights without data, other skills", "batch", OTHERS + CLIMB_DOWN, ORTHOGONAL, range(1)),
    Block("256 environments with first mean actions of almost 0", "256", GO1 + ANYMAL, PIDMS, range(2)),
    # Only if asked for by --scales.
    Block("Table I with 4096 environments and many more steps, for a GPU", "gpu", tuple(TASKS), TABLE_1, range(5)),
    Block("does the study run?", "smoke", GO1, TABLE_1, range(1)),
)


def is_earlier(scale, task):
    """Whether the runs of a task at a scale were made before the task was changed."""
    return scale in SCALES and task in SCALES[scale].earlier


def batch(runs):
    """Environments x steps of a rollout of a task's runs as text, empty if there are none."""
    settings = next((arm[0]["settings"] for arm in runs.values()), None)
    return "{num_envs} x {num_steps}".format(**settings) if settings else ""


def title(task, runs):
    """Title of a task, which says so if its runs were made before the task was changed."""
    earlier = any(run.get("earlier") for arm in runs.values() for run in arm)
    return TASKS.get(task, task) + " (earlier task)" * earlier


def titled(task, runs):
    """Title of a task with the batch of its runs."""
    return f"{title(task, runs)}, {batch(runs)}"


def by_scale(loaded, task):
    """Runs of a task at each scale that has both PIDMs (scale -> runs), the smallest batch first as in grid.py."""
    return {
        scale: study[task]
        for scale, study in loaded.items()
        if {"pidm_random", "pidm_pretrained"} <= study.get(task, {}).keys()
    }


def is_unscaled(scale):
    """Whether the first mean actions of the main methods are as PyTorch's weights make them, not almost 0."""
    return SCALES[scale].weights == "pytorch_unscaled"


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
    "march": False,
}
CLOCK = ("stance", "swing_height", "march")  # of the gait's clock, read only if there is one


def task_of(config):
    """A run's config as args.json has it, in a form in which runs of the same task are equal, whatever their age."""
    known = (LATER | config).items()
    other = ("robust", "body", "curriculum", "final_box")  # what --robust and --robot would set; what is gone
    task = {name: value for name, value in known if name not in other}
    if isinstance(seconds := task.get("command_seconds"), float):
        task["command_seconds"] = [seconds, seconds]
    return {name: value for name, value in task.items() if task["gait_hz"] or name not in CLOCK}
