"""Robot tasks. `envs.make("go1_loco")` builds one of `envs.TASKS`; `envs.make_explore("go1")` is for exploration."""

import jax

from envs import gl, locomotion, parkour, pedipulation  # noqa: F401, gl comes before all that imports MuJoCo
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


def make(task, engine="auto", /, robust=False, **overrides):
    """Build a task's environment. Overrides replace fields of its config, as in make("go1_loco", noise=0.0).

    `robust` first replaces those of its config's set for use on a robot. ValueError for an unknown task, engine or
    field, naming those that exist, for a value of a wrong type, and for `robust` where the task has no such set.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}; choose one of {', '.join(TASKS)}")
    family, config = TASKS[task]
    if not isinstance(robust, bool):  # text after --set robust=
        raise ValueError(f"robust cannot be set: {FIXED['robust']}")
    if robust and not config.robust:
        known = ", ".join(name for name, (_, config) in TASKS.items() if config.robust)
        raise ValueError(f"{task} has no robust set; {known} have one")
    config = replace_checked(config, config.robust if robust else {})
    return family(replace_checked(config, overrides), engine)


def make_explore(robot, engine="auto", /, **overrides):
    """Build a robot's exploration environment for stage 1. ValueError as for `make`."""
    if robot not in EXPLORE:
        raise ValueError(f"unknown robot {robot!r}; choose one of {', '.join(EXPLORE)}")
    return Explore(replace_checked(EXPLORE[robot], overrides), engine)
