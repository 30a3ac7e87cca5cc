"""Robot tasks. `envs.make("go1_loco")` is all a script needs; `envs.TASKS` lists the names, `envs.EXPLORE` robots."""

from envs import locomotion, parkour, pedipulation
from envs.base import replace_checked
from envs.explore import EXPLORE, Explore

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


def make(task, engine="auto", **overrides):
    """Build a task's environment; overrides replace fields of its config, e.g. make("go1_loco", noise=0.0).

    ValueError for a task, engine or field that does not exist, naming those that do.
    """
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}; choose one of {', '.join(TASKS)}")
    family, config = TASKS[task]
    return family(replace_checked(config, overrides), engine)


def make_explore(robot, engine="auto", **overrides):
    """Build a robot's exploration environment (stage 1). ValueError as for `make`."""
    if robot not in EXPLORE:
        raise ValueError(f"unknown robot {robot!r}; choose one of {', '.join(EXPLORE)}")
    return Explore(replace_checked(EXPLORE[robot], overrides), engine)
