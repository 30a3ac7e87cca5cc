"""The paper's comparison: tasks x methods x seeds of ppo_finetune.py. Runs what is missing, goes on with what broke.

    python results/study.py --status
    python results/study.py --tasks go1_loco --seeds 0 1 2 --budget-minutes 120
    python results/study.py --list | parallel -j 8

A run uses the cores it may. Two at once, each pinned to one of two cores (`taskset -c 0`), make 15 to 25% more steps.

Without --tasks, --methods and --seeds it is the whole grid: Table I of the paper (nine tasks, three methods, five
seeds), Table II (actor or critic alone), the sizes of the pretraining set, a control with shuffled weights, and what
orthogonal first weights, our default, change. A run is trained and evaluated in
runs/study/<scale>/<task>/<method>/seed<k>; its small files are kept under results/study in the same folders, where
report.py reads them. Scales never mix.
"""

import csv
import json
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from envs import records
from results import recording

PIDM = "assets/pidm/{robot}.msgpack"
SMALL = "results/pidm/{robot}/sizes/{size}.msgpack"  # made by pidm.py --stages sizes
PAPER = ("--fresh", "pytorch")  # first weights of what is not loaded: rsl_rl's, a fork of which the paper used
METHODS = {  # method -> arguments of ppo_finetune.py
    "mlp": ("--network", "mlp", *PAPER),
    "pidm_random": ("--network", "pidm", *PAPER),
    "pidm_pretrained": ("--pretrained", PIDM, *PAPER),
    "pidm_shuffled": ("--pretrained", PIDM, "--init", "shuffled", *PAPER),
    "pidm_actor": ("--pretrained", PIDM, "--init", "actor", *PAPER),
    "pidm_critic": ("--pretrained", PIDM, "--init", "critic", *PAPER),
    "pidm_7k": ("--pretrained", SMALL.replace("{size}", "7000"), *PAPER),
    "pidm_70k": ("--pretrained", SMALL.replace("{size}", "70000"), *PAPER),
    "pidm_700k": ("--pretrained", SMALL.replace("{size}", "700000"), *PAPER),
    # beyond the paper
    "mlp_orthogonal": ("--network", "mlp"),
    "pidm_random_orthogonal": ("--network", "pidm"),
    "pidm_pretrained_orthogonal": ("--pretrained", PIDM),
    "pidm_history_orthogonal": ("--pretrained", PIDM, "--core", "history_encoder"),
    "pidm_scaled": ("--pretrained", PIDM, "--core-scale", "0.5", *PAPER),
    "pidm_slow": ("--pretrained", PIDM, "--warm-iterations", "50", *PAPER),
}
TABLE_1 = ("mlp", "pidm_random", "pidm_pretrained")
ORTHOGONAL = ("mlp_orthogonal", "pidm_random_orthogonal", "pidm_pretrained_orthogonal", "pidm_history_orthogonal")
ABLATIONS = ("pidm_actor", "pidm_critic", "pidm_7k", "pidm_70k", "pidm_700k")
GRID = {  # task -> methods; blind tasks first
    **dict.fromkeys(("go1_loco", "anymal_loco"), (*TABLE_1, *ORTHOGONAL, "pidm_shuffled")),
    **dict.fromkeys(("anymal_pedipulation", "g1_loco"), (*TABLE_1, "pidm_shuffled")),
    **dict.fromkeys(("anymal_climb_up", "anymal_climb_down"), (*TABLE_1, *ABLATIONS, "pidm_shuffled")),
    **dict.fromkeys(("anymal_crouch", "anymal_jump", "anymal_parkour_walk"), TABLE_1),
}
KEPT = ("args.json", "metrics.csv", "eval.json")
STEPS = {  # of scale cpu, where the preset's would end before the PIDM is done learning, or long after
    "go1_loco": 6_000_000,
    "anymal_pedipulation": 6_000_000,
    "g1_loco": 12_000_000,
}


@dataclass(frozen=True)
class Args:
    tasks: tuple[str, ...] = tuple(GRID)
    methods: tuple[str, ...] | None = None  # None: the task's in the grid
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    scale: Literal["smoke", "cpu", "gpu"] = "cpu"  # preset
    budget_minutes: float = 1e9  # then stop; the same command goes on
    list: bool = False  # print the commands of what is missing, one a line, and stop
    status: bool = False  # print what is there, and stop


@dataclass(frozen=True)
class Cell:
    """One run of the study."""

    scale: str
    task: str
    method: str
    seed: int

    @property
    def folder(self):
        """Below runs/ and below results/."""
        return f"study/{self.scale}/{self.task}/{self.method}/seed{self.seed}"

    def words(self):
        """Arguments of ppo_finetune.py: for a new run, or for one that broke."""
        run = ROOT / "runs" / self.folder
        if (run / records.STATE).exists():
            return ["--resume", f"runs/{self.folder}"]
        robot = envs.TASKS[self.task][1].robot
        words = ["--task", self.task, "--preset", self.scale, "--seed", str(self.seed)]
        words += [word.format(robot=robot) for word in METHODS[self.method]]
        words += ["--total-steps", str(STEPS[self.task])] if self.scale == "cpu" and self.task in STEPS else []
        return [*words, "--run-dir", f"runs/{self.folder}", "--force"]

    def done(self):
        """Share of its steps that a run has made, 1 if it is kept. None if it never started."""
        if all((ROOT / "results" / self.folder / name).exists() for name in KEPT):
            return 1.0
        run = ROOT / "runs" / self.folder
        try:
            with (run / "metrics.csv").open() as file:
                rows = list(csv.DictReader(file))
            return min(float(rows[-1]["env_steps"]) / json.loads((run / "args.json").read_text())["total_steps"], 0.99)
        except (OSError, ValueError, KeyError, IndexError):
            return None


def cells(args):
    """Runs in order: one seed of every method before the next seed, so that a stopped study can be compared."""
    for task in args.tasks:
        for seed in args.seeds:
            for method in args.methods or GRID[task]:
                yield Cell(args.scale, task, method, seed)


def show_status(every):
    """A line for each task and method: `x` a finished seed, a percentage one that broke, `.` one that never started."""
    found = {}
    for cell in every:
        done = cell.done()
        mark = "." if done is None else "x" if done == 1.0 else f"{100 * done:.0f}%"
        found.setdefault((cell.task, cell.method), []).append(mark)
    for (task, method), marks in found.items():
        print(f"{task:20}{method:28}{' '.join(marks)}")
    count = sum(marks.count("x") for marks in found.values())
    print(f"{count} of {sum(map(len, found.values()))} runs")


def run(cell, seconds):
    """Train for at most so long, then evaluate and keep the small files. Returns whether it came to its end."""
    log = ROOT / "runs" / cell.folder / "log.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        if not recording.finetune(cell.words(), file, seconds):
            return False
        recording.evaluate(cell.task, cell.folder, ROOT / "results" / cell.folder, KEPT, file)
    return True


def main(args):
    for name in {*args.tasks} - GRID.keys() | {*(args.methods or ())} - METHODS.keys():
        raise records.UserError(f"unknown task or method {name!r}; known: {', '.join([*GRID, *METHODS])}")
    every = list(cells(args))
    if args.status:
        return show_status(every)
    missing = [cell for cell in every if cell.done() != 1.0]
    start = time.perf_counter()
    for cell in missing:
        left = 60 * args.budget_minutes - (time.perf_counter() - start)
        if args.list:
            words = f"--tasks {cell.task} --methods {cell.method} --seeds {cell.seed} --scale {cell.scale}"
            print(f"python results/study.py {words}")
        elif left <= 0 or not run(cell, left):
            return print("out of time; the same command goes on")
        else:
            print(f"ran {cell.folder}  {(time.perf_counter() - start) / 60:.1f} min", flush=True)
    return None


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the run under way is asked to stop as well
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
