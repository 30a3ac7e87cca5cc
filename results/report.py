"""Turn the recorded runs under results/study into the paper's tables and figures.

    python results/report.py
    python results/report.py --check
    python results/report.py --compare runs/go1_loco
    python results/report.py --beside runs/demo
    python results/report.py --live runs/demo

Fills the marked places of README.md and results/README.md, writes results/study/README.md, and draws the figures. The
words around the marks are written by hand. The indicator of a task is the paper's: mean return of the noisy policy, for
parkour the highest level reached. measures.py has the measures and their statistics.
"""

import json
import os
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from experiment import figures, records
from results import drawing, grid, tables
from results.grid import CONTROLS, METHODS, SCALES, TABLE_1, TASKS, task_of, titles

STUDY = ROOT / "results/study"
PARTS = ROOT / "results/pidm_large"  # PIDMs of the whole collection and of parts of it
SHIPPED = ROOT / "results/pidm/anymal_d/metrics.csv"  # of the PIDM that the study loads


@dataclass(frozen=True)
class Args:
    check: bool = False  # write nothing; fail if a page on disk is not what the runs give
    compare: str | None = None  # runs/<task>: draw its runs <method>/seed<k> together, and print what they reach
    beside: str | None = None  # a run's folder: draw its curve with the recorded ones of its task
    live: str | None = None  # a run's folder: redraw its curve.png every ten seconds until the run is complete


# --- Pages ---

DETAILS = """# Every run of the study

Written by `python results/report.py`; [Results](../README.md) says what these tables mean. A folder has the arguments,
rows and evaluation of one run: `<scale>/<task>/<method>/seed<k>`. Figures after ± are standard deviations over seeds
(ddof 1). [grid.py](../grid.py) has the scales. Each has up to three tables. The first is of the training; iterations
are those to 50% and 90% of the final performance of that scale's PIDM random with PyTorch's weights. The second is of
the mean action at its end: without exploration noise, 64 episodes a seed, return, length [s], share of falls, errors of
the velocity [m/s], of the yaw rate [rad/s] and of the foot [m]. The third is of its gait, by
[tools/gait.py](../../docs/play.md): falls as a share of the episodes, the rest from flat ground.
"""
CONTROLS_HEAD = """## Controls

Comparisons beyond the paper, on the seeds named, which both methods have; 50% and 90% are of the second one's final
performance. `orthogonal`: initial weights; all others have PyTorch's. Small steps are at most 0.003, not 0.01. `*`: one
ran on a CPU, the other on a GPU. Early updates are of the first 100 iterations. [Curves](controls.png) of 256
environments.
"""
MARKED = re.compile(r"(<!-- results/report\.py writes ?([\w -]*?) ?from here -->\n).*?(<!-- to here -->)", re.S)


def load_study():
    """Runs of each scale and task that has any: scale -> task -> method -> runs."""
    loaded = {
        scale: {task: tables.load_task(STUDY / scale / task) for task in TASKS} for scale in SCALES if scale != "smoke"
    }
    found = {scale: {task: runs for task, runs in study.items() if runs} for scale, study in loaded.items()}
    return {scale: study for scale, study in found.items() if study}


def pick(loaded, methods=TABLE_1):
    """Runs of each task at the scale that has most of these methods, of each at most two seeds counting.

    The later of grid.py where several have as many.
    """
    chosen = {}
    for task in TASKS:
        studies = [study[task] for study in reversed(loaded.values()) if task in study]
        if studies:
            chosen[task] = max(studies, key=lambda runs: sum(min(len(runs.get(m, ())), 2) for m in methods))
    return chosen


def readme_table(study):
    """Rows of Table I that have runs, for the project's README."""
    ran = [task for task in TASKS if "pidm_random" in study.get(task, {})]
    missing = ", ".join(f"`{task}`" for task in TASKS if not {*TABLE_1} <= study.get(task, {}).keys())
    lines = tables.table_1(study, ran) if ran else []
    return lines + (["", f"Not all methods run yet: {missing}."] if missing else [])


def sizes(study, methods, tasks):
    """`ablation` of the sizes of the pretraining set, and below it the errors and the figure once there are two."""
    lines, errors = tables.ablation(study, methods, tasks), tables.sizes_of(PARTS)
    if len(errors) < 2:
        return lines
    table = [*lines, ""] if lines else []
    line = ", ".join(f"{error:.3f} rad ({count:,})" for count, error in errors.items())
    line = f"Error by number of transitions: {line}." + " No task was run with the smaller sets yet." * (not table)
    return [*table, line, "", "![sizes](study/sizes.png)"]


def table_2(loaded):
    """Table II and, below it, the size of the pretraining set; or which methods have not run."""
    parts, missing, main = [], [], {"pidm_pretrained": METHODS["pidm_pretrained"].title}
    for group, table in (("table 2", tables.ablation), ("sizes", sizes)):
        own = titles(group)
        lines = table(pick(loaded, own), own | main, ("anymal_climb_up", "anymal_climb_down"))
        parts += ["", *lines] if lines else []
        missing += [] if lines else own.values()
    return [*parts, *(["", f"Not run yet: {'; '.join(missing)}."] if missing else [])][1:]


def blocks(loaded):
    """Lines of each marked place, by its name; the unnamed one is in the project's README."""
    study = pick(loaded)
    return {
        "": readme_table(study),
        "table 1": tables.table_1(study),
        "all tasks": tables.overall(study),
        "table 2": table_2(loaded),
        "batch": tables.batches_table(loaded),
        "updates": tables.updates_table(study),
        "accuracy": tables.pidm_table(),
    }


def filled(text, lines):
    """Text of a page with the lines (name -> list) of its marked places."""
    return MARKED.sub(lambda mark: "\n".join([mark[1], *lines[mark[2]], "", mark[3]]), text)


def details(loaded):
    """Text of results/study/README.md."""
    study = pick(loaded)
    parts = [DETAILS, "## Table I, along the way", "", *tables.along_the_way(study), ""]
    parts += ["## The pretrained PIDM against the MLP", "", *tables.against_mlp(study), ""]
    parts += [CONTROLS_HEAD, *tables.controls(loaded), ""]
    for scale, study in loaded.items():
        parts += [f"## {scale}", "", *tables.sizes_and_machines(study), ""]
        for table in (tables.progress_table(study), tables.actions_table(study), tables.gait_table(study)):
            parts += [*table, ""] if table else []
    return "\n".join(parts).rstrip() + "\n"


def draw_all(loaded):
    """Draw the figures that the runs allow, and remove those that they no longer allow."""
    study = pick(loaded)
    drawn = {
        "curves": lambda path: drawing.draw_curves(
            {grid.titled(task, runs): runs for task, runs in study.items()}, path
        ),
        "curves_batch": lambda path: drawing.draw_curves(drawing.curves_by_scale(loaded), path),
        "controls": lambda path: drawing.draw_controls(pick(loaded, CONTROLS), path),
        "critics": lambda path: drawing.draw_critics(loaded.get("batch", {}), path),
        "updates": lambda path: drawing.draw_updates(study, path),
        "success": lambda path: drawing.draw_success(study, path),
        "sizes": lambda path: drawing.draw_sizes(
            pick(loaded, titles("sizes")), path, tables.sizes_of(PARTS), tables.transitions(SHIPPED)
        ),
        "batch": lambda path: drawing.draw_batch(loaded, path),
    }
    for name, draw in drawn.items():
        for path in (STUDY / f"{name}.png", STUDY / f"{name}.svg"):  # for the pages, and for print
            if not draw(path):
                path.unlink(missing_ok=True)


def compare(folder):
    """Draw the runs of a task, <folder>/<method>/seed<k>, and print what they reach. UserError if none is complete."""
    runs = tables.load_task(folder.resolve(), evaluated=False)
    for other in sorted({path.parent.parent for path in folder.glob("*/seed*/args.json")}):
        if other.name not in METHODS:
            tables.left_out(other, f"methods are {', '.join(METHODS)}")
    if not runs:
        raise records.UserError(f"{folder} has no complete runs <method>/seed<k>; methods are {', '.join(METHODS)}")
    task = folder.resolve().name
    print("\n".join(tables.progress_table({task: runs})))
    if "pidm_random" in runs:
        others = [method for method in runs if method != "pidm_random"]
        rows = [{"against PIDM random": METHODS[m].title} | tables.compared(task, runs, m) for m in others]
        print("\n".join(["", *tables.markdown(tables.without_empty(rows) if rows else [])]))
    path = folder / "curves.png"
    drawing.draw_curves({grid.titled(task, runs): runs}, path, tuple(METHODS))
    print(f"wrote {path}")


def beside(folder):
    """Draw a run with the recorded ones of its task, in its own folder. UserError if either is missing.

    The recorded ones are those of the same task, if there are any, and of the same number of environments.
    """
    try:
        args = json.loads((folder / "args.json").read_text())
        task, config = args["task"], task_of(args["config"])
        rows = records.read_rows(folder / "metrics.csv")
        iterations = [row["iteration"] for row in rows]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise records.UserError(f"{folder} is not a run of ppo_finetune.py: {error}") from None
    known = [study[task] for study in load_study().values() if task in study]
    if not known:
        raise records.UserError(f"results/study has no runs of {task}")

    def likeness(runs):
        (one, *_), *_ = runs.values()
        return one["settings"]["config"] == config, grid.batch(runs) == "{num_envs} x {num_steps}".format(**args)

    runs = max(known, key=likeness)
    if not likeness(runs)[0]:
        print(f"the recorded runs of {task} had other numbers in its config")
    name = next(iter(runs.values()))[0]["settings"]["indicator"]
    path, this = folder / "beside_recorded.png", ("this run", iterations, [row[name] for row in rows])
    drawing.draw_curves({grid.titled(task, runs): runs}, path, tuple(METHODS), this)
    print(f"wrote {path}")


def live(folder, seconds=10.0):
    """Redraw curve.png of a run until it has made its steps, or until Ctrl-C. UserError if it is no such run."""
    drawn = 0
    while True:
        try:
            total = json.loads((folder / "args.json").read_text())["total_steps"]
            rows = records.read_rows(folder / "metrics.csv")
            steps = rows[-1]["env_steps"]
        except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
            raise records.UserError(f"{folder} has no rows of ppo_explore.py or ppo_finetune.py: {error!r}") from None
        if len(rows) > drawn:
            figures.plot_training(rows, folder / "curve.png")
            drawn = len(rows)
            print(f"{folder}/curve.png: {steps / 1e6:.2f} of {total / 1e6:.2f} M steps", flush=True)
        if steps >= total:
            return
        time.sleep(seconds)


def write_all(check):
    """Write the pages and figures. With `check`, exit 1 if a page differs from the one on disk."""
    loaded = load_study()
    if not loaded:
        raise records.UserError("results/study has no finished runs; run results/study.py")
    lines = blocks(loaded)
    pages = {path: filled(path.read_text("utf-8"), lines) for path in (ROOT / "README.md", ROOT / "results/README.md")}
    pages[STUDY / "README.md"] = details(loaded)
    if check:
        for path, text in pages.items():
            if not path.exists() or path.read_text("utf-8") != text:
                sys.exit(f"{path.relative_to(ROOT)} is not what the runs give; run results/report.py")
        return
    for path, text in pages.items():
        records.replace_text(path, text)
    draw_all(loaded)
    print(
        "\n".join([*lines["table 1"], "", f"wrote {', '.join(os.path.relpath(path) for path in pages)}, and figures"])
    )


def main(args):
    """Write the report, or compare, draw or follow runs. UserError for the folder of several seeds."""
    if args.compare:
        return compare(Path(args.compare))
    for folder, act in ((args.beside, beside), (args.live, live)):
        if folder and (several := sorted(Path(folder).glob("seed*/args.json"))):
            raise records.UserError(f"{folder} holds several seeds; give one, such as {several[0].parent}")
        if folder:
            return act(Path(folder))
    return write_all(args.check)


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
