"""Robot tasks. `envs.make("go1_loco")` builds one of `envs.TASKS`; `envs.make_explore("go1")` is for exploration."""

from pathlib import Path

import jax

from envs import gl, loader, locomotion, newcomers, parkour, pedipulation  # noqa: F401, gl precedes all with MuJoCo
from envs.config import FIXED, replace_checked
from envs.explore import EXPLORE, Explore

JAX_SETTINGS = {  # whatever JAX's variables of these names say: other values end in errors, or in other numbers
    "jax_enable_x64": False,
    "jax_disable_jit": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_default_prng_impl": "threefry2x32",
    "jax_threefry_partitionable": True,
}
for setting, value in JAX_SETTINGS.items():
    jax.config.update(setting, value)

TASKS = {
    "anymal_loco": (locomotion.AnymalLocomotion, locomotion.ANYMAL_LOCO),
    "go1_loco": (locomotion.Locomotion, locomotion.GO1_LOCO),
    "g1_loco": (locomotion.G1Locomotion, locomotion.G1_LOCO),
    "anymal_pedipulation": (pedipulation.Pedipulation, pedipulation.ANYMAL_PEDIPULATION),
    "anymal_parkour_walk": (parkour.Parkour, parkour.WALK),
    "anymal_climb_up": (parkour.Parkour, parkour.CLIMB_UP),
    "anymal_climb_down": (parkour.Parkour, parkour.CLIMB_DOWN),
    "anymal_crouch": (parkour.Parkour, parkour.CROUCH),
    "anymal_jump": (parkour.Parkour, parkour.JUMP),
}
OWN = {}  # tasks of your own, in the form of TASKS; tests and the study list every entry of TASKS by name
GENERIC = {"loco": (locomotion.Locomotion, newcomers.loco)}  # tasks of a robot from a file


def family(task):
    """The class of a task's environments, or None for an unknown task."""
    return (TASKS | OWN | GENERIC).get(task, (None,))[0]


def body_of(robot):
    """The body of a robot: of a file, see loader.py, or as a checkpoint holds it."""
    return robot if isinstance(robot, dict) else loader.load(robot)


def label(task, robot=None):
    """Name of a task for folders, after that of a robot from a file; or of a robot, by its name, file or body."""
    if robot:
        return f"{label(robot)}_{task}"
    if isinstance(task, str) and not Path(task).suffix:
        return task
    name = task["name"] if isinstance(task, dict) else loader.name_of(Path(task))
    return f"{name}_file" if name in EXPLORE else name  # not in the folders of the shipped robot


def make(task, engine="auto", /, robust=False, robot=None, **overrides):
    """Build a task's environment. Overrides replace fields of its config, as in make("go1_loco", noise=0.0).

    `robot` is the file (or body) of the robot of a task in GENERIC. `robust` first replaces the fields of its config's
    set for use on a robot. ValueError for an unknown task, engine or field, naming those that exist, for a value of a
    wrong type, for `robust` where the task has no such set, and for a robot that cannot be loaded.
    """
    if task in GENERIC and robot:
        family, build = GENERIC[task]
        config = build(body_of(robot))
    elif task in GENERIC:
        raise ValueError(f"--task {task} needs --robot FILE")
    elif robot:
        raise ValueError(f"robot cannot be set: {FIXED['robot']}; --robot FILE goes with --task {', '.join(GENERIC)}")
    elif task not in TASKS | OWN:
        raise ValueError(f"unknown task {task!r}; choose one of {', '.join(TASKS | OWN | GENERIC)}")
    else:
        family, config = (TASKS | OWN)[task]
    if not isinstance(robust, bool):  # text after --set robust=
        raise ValueError(f"robust cannot be set: {FIXED['robust']}")
    if robust and not config.robust:
        known = ", ".join(name for name, (_, config) in (TASKS | OWN).items() if config.robust)
        raise ValueError(f"{task} has no robust set; {known} have one")
    config = replace_checked(config, config.robust if robust else {})
    return family(replace_checked(config, overrides), engine)


def make_explore(robot, engine="auto", /, **overrides):
    """Build a robot's exploration environment for stage 1, of its name, file or body. ValueError as for `make`."""
    if isinstance(robot, str) and robot not in EXPLORE and not Path(robot).suffix:
        raise ValueError(f"unknown robot {robot!r}; choose one of {', '.join(EXPLORE)}, or a file")
    config = newcomers.explore(body_of(robot)) if isinstance(robot, dict) or robot not in EXPLORE else EXPLORE[robot]
    return Explore(replace_checked(config, overrides), engine)
