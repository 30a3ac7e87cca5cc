"""The paper's comparison: train and evaluate what grid.py plans with ppo_finetune.py, and keep the records.

    python results/study.py --status
    python results/study.py --tasks go1_loco --seeds 0 1 2 --budget-minutes 120
    python results/study.py --list | parallel -j 8

It trains what is missing, in the order of the plan, and resumes what was interrupted. A run uses the cores it may. Two
at once, each pinned to one of two cores (`taskset -c 0`), make 15 to 25% more steps.

A run is in runs/study/<scale>/<task>/<method>/seed<k>. Its small files are kept in the same folder under results, where
report.py reads them. Scales never mix.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from experiment import records
from results import recording
from results.grid import METHODS, PLAN, SCALES, TASKS

KEPT = ("args.json", "metrics.csv", "eval.json")


@dataclass(frozen=True)
class Args:
    """Leave out tasks, methods or seeds to run all that are planned."""

    tasks: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    scales: tuple[str, ...] = ("batch", "1024", "256")
    budget_minutes: float = 1e9  # stop after this time; the same command goes on
    list: bool = False  # print one command for each missing run, and train nothing
    status: bool = False  # print what has been trained and what each run is for, and train nothing


@dataclass(frozen=True)
class Cell:
    """One run of the study."""

    scale: str
    task: str
    method: str
    seed: int

    @property
    def folder(self):
        """The run's folder, under runs/ and under results/."""
        return f"study/{self.scale}/{self.task}/{self.method}/seed{self.seed}"

    def words(self):
        """Arguments of ppo_finetune.py, for a new run or to resume an interrupted one."""
        run = ROOT / "runs" / self.folder
        if (run / records.STATE).exists():
            return ["--resume", f"runs/{self.folder}"]
        robot, scale = envs.TASKS[self.task][1].robot, SCALES[self.scale]
        words = ["--task", self.task, "--preset", scale.preset, "--seed", str(self.seed)]
        words += METHODS[self.method].flags.format(robot=robot, weights=scale.weights).split()
        words += scale.flags.get(self.task, "").split()
        return [*words, "--run-dir", f"runs/{self.folder}", "--force"]

    def done(self):
        """True once the run's files are kept."""
        return all((ROOT / "results" / self.folder / name).exists() for name in KEPT)

    def share(self):
        """Share of its steps that the run has made, None before its first row."""
        return recording.share(self.folder)

    def lacks(self):
        """The PIDM that the run would start from, if it is not there."""
        words = self.words()
        path = words[words.index("--pretrained") + 1] if "--pretrained" in words else ""
        return path if not (ROOT / path).exists() else None


def planned(args):
    """Blocks of the plan with those of their runs that the arguments choose. UserError for a name that is unknown.

    One seed of every task and method comes before the next seed, so that an unfinished block can be compared.
    """
    for kind, known in {"tasks": TASKS, "methods": METHODS, "scales": SCALES}.items():
        for name in {*getattr(args, kind)} - known.keys():
            raise records.UserError(f"unknown name {name!r} in --{kind}; known: {', '.join(known)}")

    def chosen(kind, names):
        return [name for name in names if name in (getattr(args, kind) or names)]

    runs = {
        block: [
            Cell(block.scale, task, method, seed)
            for seed in chosen("seeds", block.seeds)
            for task in chosen("tasks", block.tasks)
            for method in chosen("methods", block.methods)
        ]
        for block in PLAN
        if block.scale in args.scales
    }
    if not any(runs.values()):
        raise records.UserError("no such run is planned; --status shows those that are, and results/grid.py plans them")
    return {block: cells for block, cells in runs.items() if cells}


def show_status(runs):
    """Print the runs of each block: `x` for a finished seed, a percentage for a part, `.` for none."""
    for block, cells in runs.items():
        print(f"{block.scale}: {block.why}")
        marks = {}
        for cell in cells:
            share = cell.share()
            mark = "x" if cell.done() else "." if share is None else f"{min(100 * share, 99):.0f}%"
            marks.setdefault((cell.task, cell.method), []).append(mark)
        for (task, method), seeds in marks.items():
            print(f"  {task:20}{method:28}{' '.join(seeds)}")
    every = [cell.done() for cells in runs.values() for cell in cells]
    print(f"{sum(every)} of {len(every)} runs")


def run(cell, seconds):
    """Train for at most `seconds`, then evaluate and keep the small files. Returns True if the run is complete."""
    log = ROOT / "runs" / cell.folder / "log.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        ended = recording.run_script(["ppo_finetune.py", *cell.words()], file, seconds)
        if not ended or (cell.share() or 0) < 1:  # a training that was asked to stop ends well, too
            return False
        recording.evaluate(cell.folder, ROOT / "results" / cell.folder, KEPT, file)
    return True


def train(cells, seconds):
    """Make these runs, one after the other, for at most `seconds`. UserError at the end if some failed."""
    start, failed = time.perf_counter(), []
    for cell in cells:
        left = seconds - (time.perf_counter() - start)
        try:
            if left <= 0 or not run(cell, left):
                print("out of time, or stopped; the same command goes on")
                break
            print(f"ran {cell.folder}  {(time.perf_counter() - start) / 60:.1f} min", flush=True)
        except records.UserError as error:  # the other runs may do better
            failed.append(cell.folder)
            print(f"error: {error}", file=sys.stderr)
    if failed:
        raise records.UserError(f"{len(failed)} failed; to start one anew, remove runs/{failed[0]}")


def main(args):
    """Train what is missing, or list it."""
    runs = planned(args)
    if args.status:
        return show_status(runs)
    missing = [cell for cells in runs.values() for cell in cells if not cell.done()]
    if not missing:
        words = "all of these runs are recorded; to repeat one, first move its folders out of that of its method, "
        print(words + "under runs/study and results/study", file=sys.stderr)  # what --list prints is run
    for path in dict.fromkeys(filter(None, (cell.lacks() for cell in missing))):
        print(f"left out: runs from {path}, which is missing; results/pidm.py makes it", file=sys.stderr)
    cells = [cell for cell in missing if not cell.lacks()]
    if not args.list:
        return train(cells, 60 * args.budget_minutes)
    for cell in cells:
        words = f"--tasks {cell.task} --methods {cell.method} --seeds {cell.seed} --scales {cell.scale}"
        print(f"python results/study.py {words}")
    return None


if __name__ == "__main__":
    with records.one_line_errors():  # SIGTERM stops the run under way, too
        main(tyro.cli(Args, description=__doc__))
