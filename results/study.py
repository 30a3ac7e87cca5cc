"""Run the comparison: tasks x methods x seeds of ppo_finetune.py, what is missing only.

    python results/study.py --tasks go1_loco --seeds 0 1 2 --total-steps 5000000
    python results/study.py --tasks anymal_loco --jobs 2
    python results/study.py --list

A run is trained and evaluated in runs/study/<scale>/<task>/<method>/seed<k>; its small files are kept under
results/study in the same folders, where report.py reads them.
"""

import csv
import itertools
import json
import shlex
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import recording

import envs

PIDM = "assets/pidm/{robot}.msgpack"
METHODS = {  # method -> arguments of ppo_finetune.py
    "mlp": ("--network", "mlp"),
    "pidm_random": ("--network", "pidm"),
    "pidm_pretrained": ("--pretrained", PIDM),
    "pidm_shuffled": ("--pretrained", PIDM, "--init", "shuffled"),
    "pidm_actor": ("--pretrained", PIDM, "--init", "actor"),
    "pidm_critic": ("--pretrained", PIDM, "--init", "critic"),
    # beyond the paper
    "pidm_scaled": ("--pretrained", PIDM, "--core-scale", "0.5"),  # features as large as fresh ones
    "pidm_slow": ("--pretrained", PIDM, "--warm-iterations", "50"),
}
KEPT = ("args.json", "metrics.csv", "eval.json")


@dataclass(frozen=True)
class Args:
    tasks: tuple[str, ...] = ("go1_loco",)
    methods: tuple[str, ...] = ("mlp", "pidm_random", "pidm_pretrained", "pidm_shuffled")
    seeds: tuple[int, ...] = (0, 1, 2)
    scale: str = "cpu"  # preset
    total_steps: int | None = None  # None: the preset's
    jobs: int = 1  # runs at once, on the same machine: together a little faster, each slower
    budget_minutes: float = 1e9  # start no run after this
    list: bool = False  # print the training commands and stop


def command(args, task, method, folder, seed):
    """The arguments of ppo_finetune.py for one run."""
    robot = envs.TASKS[task][1].robot
    words = ["--task", task, "--preset", args.scale, "--seed", str(seed)]
    words += [word.format(robot=robot) for word in METHODS[method]]
    words += ["--total-steps", str(args.total_steps)] if args.total_steps else []
    return [*words, "--run-dir", f"runs/{folder}", "--force"]


def finished(folder):
    """Whether the kept copy of a run reached its steps and was evaluated."""
    kept = ROOT / "results" / folder
    if not all((kept / name).exists() for name in KEPT):
        return False
    wanted = json.loads((kept / "args.json").read_text())["total_steps"]
    with (kept / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return float(rows[-1]["env_steps"]) >= wanted


def run(task, words, folder):
    """Train, evaluate and keep the small files."""
    log = ROOT / "runs" / folder / "log.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:
        recording.finetune(words, file)
        recording.evaluate(task, folder, ROOT / "results" / folder, KEPT, file)


def main(args):
    """All seeds of a method come after one seed of every method, so that a stopped study can be compared."""
    for name in {*args.tasks} - envs.TASKS.keys() | {*args.methods} - METHODS.keys():
        print(f"error: unknown task or method {name!r}; known: {', '.join([*envs.TASKS, *METHODS])}", file=sys.stderr)
        sys.exit(2)
    start = time.perf_counter()

    def one(task, seed, method):
        folder = f"study/{args.scale}/{task}/{method}/seed{seed}"
        words = command(args, task, method, folder, seed)
        if args.list:
            print(shlex.join(["python", "ppo_finetune.py", *words]))
        elif finished(folder):
            print(f"done     {folder}", flush=True)
        elif time.perf_counter() - start > 60 * args.budget_minutes:
            print(f"no time  {folder}", flush=True)
        else:
            run(task, words, folder)
            print(f"ran      {folder}  {(time.perf_counter() - start) / 60:.1f} min", flush=True)

    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(lambda cell: one(*cell), itertools.product(args.tasks, args.seeds, args.methods)))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
