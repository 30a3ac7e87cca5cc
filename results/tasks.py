"""Train tasks from scratch with a preset, evaluate, and replace what results/tasks/<task> holds.

The recorded G1, robust policies and parkour, but for crouching, were made in several trainings: docs/ppo_finetune.md.

    python results/tasks.py --tasks anymal_climb_up anymal_jump
    python results/tasks.py --tasks anymal_climb_up --stages look

If a task has levels, levels.png shows the share of environments at each level at the end of training, and the share of
episodes there in which the trained policy's mean action succeeds.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from experiment import figures, records
from results import recording

KEPT = ("args.json", "metrics.csv", "curve.png", "eval.json", "policy.msgpack", "rollout.png", "rollout.gif")


@dataclass(frozen=True)
class Args:
    tasks: tuple[str, ...] = tuple(envs.TASKS)
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"
    stages: tuple[Literal["train", "look"], ...] = ("train", "look")


def draw_levels(folder):
    """Draw levels.png of a kept run."""
    last = records.read_rows(folder / "metrics.csv")[-1]
    result = json.loads((folder / "eval.json").read_text())
    names = [name for name in last if name.startswith("level/")]
    level = np.arange(len(names))
    fig, ax = figures.pyplot().subplots(figsize=(4.5, 2.8), constrained_layout=True)
    ax.bar(level - 0.2, [last[name] for name in names], 0.4, label="environments at the end of training")
    success = [result[f"level {i}"]["episode_success"] for i in level]
    ax.bar(level + 0.2, success, 0.4, label="success of the mean action")
    ax.set(xlabel=f"level of {folder.name}", xticks=level, ylim=(0, 1))
    fig.legend(fontsize=7, loc="outside upper center", ncols=2)
    ax.grid(alpha=0.3)
    figures.save(fig, folder / "levels.png")


def main(args):
    """Train, evaluate and keep a run of each task. UserError for an unknown one."""
    for name in {*args.tasks} - envs.TASKS.keys():
        raise records.UserError(f"unknown task {name!r}; known: {', '.join(envs.TASKS)}")
    for task in args.tasks:
        run, folder = f"tasks/{task}", ROOT / "results/tasks" / task
        if "train" in args.stages:
            words = ["--task", task, "--preset", args.preset, "--run-dir", f"runs/{run}", "--force"]
            recording.run_script(["ppo_finetune.py", *words])
            if (recording.share(run) or 0) < 1:
                raise records.UserError(f"runs/{run} was stopped before its end; {folder} stays as it is")
        if "look" in args.stages:
            recording.evaluate(run, folder, KEPT)
            if envs.TASKS[task][0].LEVELS:
                draw_levels(folder)
                print(f"wrote {folder / 'levels.png'}")


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
