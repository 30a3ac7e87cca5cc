"""Turn the recorded runs under results/study into the paper's tables and figures.

    python results/report.py
    python results/report.py --check
    python results/report.py --beside runs/demo
    python results/report.py --live runs/demo

Fills the marked places of README.md and results/README.md, writes results/study/README.md, and draws the figures. The
words around the marks are written by hand. The indicator of a task is the paper's: mean return of the noisy policy, for
parkour the curriculum's progress. measures.py has the measures and their statistics.
"""

import csv
import itertools
import json
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from experiment import figures, records
from results import drawing, measures
from results.grid import CONTROLS, METHODS, SCALES, TABLE_1, TASKS, is_earlier, task_of, titles
from results.measures import MEASURES

STUDY = ROOT / "results/study"
PAPER = {  # measure -> method -> percent against PIDM random by task, in the order of TASKS; Tables I and II
    "final": {
        "mlp": (0.5, 0.2, -0.8, -3.7, -0.3, 1.8, 11.1, 0.6, -0.2),
        "pidm_pretrained": (10.1, 6.3, 0.7, 0.4, 0.0, 1.8, 5.9, 3.6, 10.0),
        "pidm_actor": (None, None, None, 0.0, 0.0),
        "pidm_critic": (None, None, None, 0.2, 0.0),
    },
    "to 90%": {
        "mlp": (-28.7, 5.0, -18.7, 48.6, 35.3, -29.5, -53.0, 2.2, -46.7),
        "pidm_pretrained": (-33.1, -42.0, -35.3, -15.9, -41.8, -57.3, -49.3, -17.7, -34.0),
        "pidm_actor": (None, None, None, -10.9, -34.7),
        "pidm_critic": (None, None, None, -1.1, -21.5),
    },
}
PAIRS = (  # of methods of which one or both are beyond the paper: the second is what the first is compared with
    ("pidm_shuffled", "pidm_random"),
    ("pidm_pretrained", "pidm_shuffled"),
    ("pidm_random_orthogonal", "pidm_random"),
    ("pidm_pretrained_orthogonal", "pidm_random_orthogonal"),
    ("pidm_history_orthogonal", "pidm_random_orthogonal"),
    ("pidm_pretrained", "pidm_random_orthogonal"),
    ("mlp_orthogonal", "mlp"),
    ("pidm_pretrained_unscaled", "pidm_random_unscaled"),
    ("pidm_random_slow", "pidm_random"),
    ("pidm_pretrained_slow", "pidm_random_slow"),
)

CONTROLLED = {"final": "final", "mean action": "mean action", "area": "mean of training", "to 90%": "iterations"}


@dataclass(frozen=True)
class Args:
    check: bool = False  # write nothing; fail if a page on disk is not what the runs give
    beside: str | None = None  # a run's folder: draw its curve with the recorded ones of its task
    live: str | None = None  # a run's folder: redraw its curve.png every ten seconds until the run is complete


# --- Runs ---


def left_out(folder, why):
    """Print a warning that a run is not counted."""
    print(f"warning: {folder.relative_to(ROOT)} left out: {why}", file=sys.stderr)


def load_run(folder):
    """One run: its columns, each (R,), its evaluation and settings. None, with a warning, if it is incomplete."""
    try:
        record = json.loads((folder / "args.json").read_text())
        result = json.loads((folder / "eval.json").read_text())
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        complete = bool(columns["env_steps"][-1] >= float(record["total_steps"]))
        keys = ("num_envs", "num_steps", "total_steps", "lr", "num_epochs", "mirror_coef")
        success = {name: one["episode_success"] for name, one in result.items() if name.startswith("level ")}
        run = {
            "columns": columns,
            "iteration": columns["iteration"],
            "indicator": columns["progress" if "progress" in columns else "episode_return"],
            "errors": dict(result.get("task", {})),
            "success": list(success.values()),
            "settings": {key: record[key] for key in keys}
            | {"config": task_of(record["config"]), "levels": list(success)},
            "seed": record["seed"],
            "earlier": is_earlier(*folder.parts[-4:-2]),
            "versions": record["versions"],
        }
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        return left_out(folder, repr(error))
    return run if complete else left_out(folder, "stopped before its last step")


def load_task(folder):
    """Runs of each method, by seed. Runs whose settings differ from the first one's are left out with a warning."""
    runs, settings = {}, None
    for method in METHODS:
        for seed in sorted((folder / method).glob("seed*")):
            run = load_run(seed)
            if run is None:
                continue
            settings = settings or run["settings"]
            if run["settings"] != settings:
                left_out(seed, "other settings than the rest")
                continue
            runs.setdefault(method, []).append(run)
    return runs


# --- Tables ---


def markdown(rows):
    """Lines of a table from rows, dicts of the same columns. Trailing blanks, which tell titles apart, are dropped."""
    if not rows:
        return []
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return ["| " + " | ".join(cell.strip() for cell in line) + " |" for line in lines]


def without_empty(rows):
    """Rows without the columns that are empty in all of them, as the paper's where it has no such runs."""
    used = [column for column in rows[0] if any(row[column] for row in rows)]
    return [{column: row[column] for column in used} for row in rows]


def shown(estimate, none="not run"):
    """An Estimate as text."""
    return none if estimate is None else str(estimate)


def share(estimate):
    """An Estimate of a probability as text."""
    if estimate is None:
        return "not run"
    ends = "" if estimate.interval is None else " [{:.0f}, {:.0f}]".format(*estimate.interval)
    return f"{estimate.value:.0f}{ends}"


def paper(method, name, task):
    """The paper's percentage as text, empty if it has none."""
    known = dict(zip(TASKS, PAPER.get(name, {}).get(method, ()), strict=False)).get(task)
    return "" if known is None else f"{known:+.1f}"


def paper_mean(method, name, tasks):
    """The paper's mean over tasks as text, empty if it has none."""
    known = dict(zip(TASKS, PAPER.get(name, {}).get(method, ()), strict=False))
    return f"{np.mean([known[task] for task in tasks]):+.1f}" if known and tasks else ""


def columns_of(names):
    """Title, method and measure of the columns that compare the MLP and the pretrained PIDM in these measures."""
    methods = {"mlp": "MLP", "pidm_pretrained": "pretrained"}
    return [(f"{title}: {label} [%]", m, name) for name, title in names.items() for m, label in methods.items()]


def table_1(study, tasks=tuple(TASKS)):
    """Paper Table I: final performance and iterations to converge of MLP and pretrained PIDM, against PIDM random."""
    columns = columns_of({"final": "final", "to 90%": "iterations"})
    rows = []
    for task in tasks:
        runs = study.get(task, {})
        row = {"task": drawing.title(task, runs), "batch": drawing.batch(runs), "seeds": measures.seeds(runs, TABLE_1)}
        for i, (head, method, name) in enumerate(columns):
            found = measures.compare(task, runs, method, name)
            row |= {head: shown(found), "paper" + " " * i: paper(method, name, task)}
        rows.append(row)
    means = {
        "all": (measures.both, measures.mean_over_tasks),
        "several seeds": (measures.several, measures.mean_over_seeds),
    }
    for title, (chosen, mean) in means.items():
        row = {"task": f"mean, {title}", "batch": "", "seeds": ""}
        for i, (head, method, name) in enumerate(columns):
            row |= {head: shown(mean(study, method, name))}
            row |= {"paper" + " " * i: paper_mean(method, name, chosen(study, method))}
        rows.append(row)
    return markdown(rows)


def overall(study):
    """The main measures over all tasks: mean, interquartile mean, probability of improvement, and the paper's mean."""
    rows = []
    for method in ("pidm_pretrained", "mlp"):
        for name in ("final", "area", "to 50%", "to 90%"):
            row = {"method": METHODS[method].title, "measure": MEASURES[name].title}
            row["mean [%]"] = shown(measures.mean_over_tasks(study, method, name))
            row["paper"] = paper_mean(method, name, measures.both(study, method))
            row["interquartile mean [%]"] = shown(measures.interquartile_mean(study, method, name))
            row["probability of improvement [%]"] = share(measures.improvement(study, method, name))
            rows.append(row)
    return markdown(rows)


def along_the_way(study):
    """Measures of each task that the paper does not have, and the seeds in which pretraining helps."""
    columns = columns_of({"to 50%": "to 50%", "area": "mean of training", "to 90%, smooth": "to 90%, five rows"})
    rows = []
    for task, runs in study.items():
        if "pidm_random" not in runs:
            continue
        row = {"task": drawing.title(task, runs)}
        row |= {head: shown(measures.compare(task, runs, method, name)) for head, method, name in columns}
        for head, method, name in columns_of({"mean action": "mean action"}):
            row[head] = shown(measures.compare(task, runs, method, name), "")
        for title, name in (("better at the end", "final"), ("sooner at 90%", "to 90%")):
            row[f"pretrained {title}, of seeds"] = wins(runs, "pidm_pretrained", name)
        rows.append(row)
    return markdown(rows)


def wins(runs, method, name, against="pidm_random"):
    """Number of seeds in which a method is better than another, a tie as half, and of how many, as text."""
    if method not in runs:
        return "not run"
    each = measures.better(name, runs[method], runs[against])
    return f"{each.sum():g} of {len(each)}"


def ablation(study, methods, tasks):
    """Final performance, iterations and seeds on each task; a row for each of `methods` (name -> title).

    Empty if none of them ran.
    """
    if not any(method in study.get(task, {}) for task in tasks for method in methods.keys() - {"pidm_pretrained"}):
        return []
    rows = []
    for method, title in methods.items():
        row = {"method": title, "seeds": " / ".join(str(len(study.get(task, {}).get(method, ()))) for task in tasks)}
        for i, task in enumerate(tasks):
            for j, name in enumerate(("final", "to 90%")):
                what = "final" if name == "final" else "iterations"
                found = measures.compare(task, study.get(task, {}), method, name)
                row[f"{TASKS[task]}: {what} [%]"] = shown(found)
                row["paper" + " " * (2 * i + j)] = paper(method, name, task)
        rows.append(row)
    return markdown(without_empty(rows))


def controls(loaded):
    """Comparisons beyond the paper, on the seeds that both methods have; goals are those of the second one."""
    rows = []
    for task in TASKS:
        studies = [study[task] for study in loaded.values() if task in study]
        for runs, (method, against) in itertools.product(studies, PAIRS):
            if arms := measures.same_seeds(runs, method, against):
                row = {"task": drawing.title(task, runs), "batch": drawing.batch(runs)}
                row |= {"method": METHODS[method].title, "against": METHODS[against].title}
                row["seeds"] = ", ".join(str(run["seed"]) for run in arms[method])
                for name, title in CONTROLLED.items():
                    row[f"{title} [%]"] = shown(measures.compare(task, arms, method, name, against), "")
                row["better at the end, of seeds"] = wins(arms, method, "final", against)
                rows.append(row | {"early updates of the backbone [%]": early_updates(arms, method, against)})
    return markdown(rows)


def early_updates(runs, method, against):
    """Change [%] of the updates of the actor's backbone in the first iterations as text; empty for an MLP."""
    name = "update/actor/backbone"
    if any(name not in run["columns"] for m in (method, against) for run in runs[m]):
        return ""
    return f"{100 * (measures.early_ratio(name, runs[method], runs[against]) - 1):+z.0f}"


def batches_table(loaded):
    """What pretraining brings at each scale of a walking quadruped, of those with several; and what the MLP does."""
    rows = []
    for task in drawing.WALKING:
        found = drawing.by_scale(loaded, task)
        for scale, runs in found.items() if len(found) > 1 else ():
            row = {"task": TASKS[task], "batch": drawing.batch(runs), "initial weights": SCALES[scale].weights}
            row["seeds"] = measures.seeds(runs, TABLE_1)
            for method in ("pidm_pretrained", "mlp"):
                title = METHODS[method].title.removeprefix("PIDM ")
                for name in ("final", "area", "to 50%", "to 90%"):
                    what = {"final": "final", "area": "mean of training"}.get(name, name)
                    row[f"{what}: {title} [%]"] = shown(measures.compare(task, runs, method, name))
            rows.append(row)
    return markdown(without_empty(rows)) if rows else ["One batch so far."]


def updates_table(study):
    """Change [%] of the actor's updates in the first iterations, pretrained against random; also per step size."""
    rows = []
    for task, runs in study.items():
        if not {"pidm_pretrained", "pidm_random"} <= runs.keys():
            continue
        ratio = {
            name: measures.early_ratio(name, runs["pidm_pretrained"], runs["pidm_random"])
            for name in ("lr", *(f"update/actor/{module}" for module in drawing.MODULES))
        }
        step = ratio.pop("lr")
        row = {"task": drawing.title(task, runs), "seeds": measures.seeds(runs, ("pidm_pretrained", "pidm_random"))}
        row |= {name.split("/")[-1].replace("_", " "): f"{100 * (x - 1):+z.0f}" for name, x in ratio.items()}
        row |= {"step size": f"{100 * (step - 1):+z.0f}"}
        row |= {"backbone per step size": f"{100 * (ratio['update/actor/backbone'] / step - 1):+z.0f}"}
        rows.append(row)
    return markdown(rows)


def progress_table(study):
    """Every method of every task in absolute figures."""
    rows = []
    for task, runs in study.items():
        goal = measures.goal_of(runs["pidm_random"]) if "pidm_random" in runs else None
        for method, mine in runs.items():
            each = {name: measures.values(name, mine, goal) for name in ("final", "area")}
            row = {"task": drawing.title(task, runs), "method": METHODS[method].title}
            row["seeds"] = ", ".join(str(run["seed"]) for run in mine)
            row["final"] = spread(each["final"])
            row["of it in the last third [%]"] = f"{100 * np.mean([measures.late_gain(run) for run in mine]):.0f}"
            row["mean of the training"] = spread(each["area"])
            highest = [run["columns"]["progress_reached"] for run in mine if "progress_reached" in run["columns"]]
            row["progress reached at the end"] = spread([one[-1] for one in highest]) if highest else ""
            for name in ("to 50%", "to 90%"):
                known = goal is not None
                row[f"iterations {name}"] = counts(measures.values(name, mine, goal)) if known else "no PIDM random"
            row["mean step size"] = f"{np.mean([run['columns']['lr'].mean() for run in mine]):.3g}"
            row["final action std"] = f"{np.mean([run['columns']['action_std'][-1] for run in mine]):.3f}"
            row["minutes"] = f"{np.mean([run['columns']['seconds'][-1] for run in mine]) / 60:.1f}"
            rows.append(row)
    return markdown(without_empty(rows))


def actions_table(study):
    """What the mean action does at the end, in the tasks without levels: mean over seeds of evaluated episodes."""
    rows = []
    chosen = {task: runs for task, runs in study.items() if any(run["errors"] for arm in runs.values() for run in arm)}
    names = sorted(
        {name for runs in chosen.values() for arm in runs.values() for name in arm[0]["errors"]} - {"diverged"}
    )
    for task, runs in chosen.items():
        for method, mine in runs.items():
            row = {"task": drawing.title(task, runs), "method": METHODS[method].title, "seeds": str(len(mine))}
            for name in names:
                known = [run["errors"][name] for run in mine if name in run["errors"]]
                row[name.replace("_", " ")] = f"{np.mean(known):.3g}" if known else ""
            rows.append(row)
    return markdown(rows)


def sizes_and_machines(study):
    """Lines that say how large the runs of each task are, and on what they were made."""
    lines = []
    for task, runs in study.items():
        one = next(iter(runs.values()))[0]
        size = f"{drawing.batch(runs)}, {one['settings']['total_steps'] / 1e6:.1f} M steps"
        each = [run["versions"] for arm in runs.values() for run in arm]
        machines = sorted({"{device}, {machine}, jax {jax}".format(**versions) for versions in each})
        lines.append(f"- {drawing.title(task, runs)}: `{task}`, {size}, {'; '.join(machines)}")
    return lines


def spread(values):
    """Mean and std (ddof 1) over seeds as text; a single seed has no std."""
    return f"{np.mean(values):.4g}" + (f" ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else "")


def counts(values):
    """Mean of iteration counts as text, and how many are not NaN, unless all are. NaN: level not reached."""
    reached = np.isfinite(values)
    if not reached.any():
        return "not reached"
    return f"{np.nanmean(values):.0f}" + ("" if reached.all() else f" ({reached.sum()} of {len(values)})")


def pidm_table():
    """Error of each robot's shipped PIDM on held-out data, beside that of the paper's Fig. 4c for ANYmal D."""
    names = {"error_rad": "error [rad]", "error_over_change": "over the action magnitude"}
    rows = []
    for robot in ("anymal_d", "go1", "g1"):
        result = json.loads((ROOT / f"results/pidm/{robot}/validation.json").read_text())
        row = {"robot": robot} | {title: f"{result[name]:.3f}" for name, title in names.items()}
        rows.append(row | {"paper": "0.4 to 0.5" if robot == "anymal_d" else ""})
    return markdown(rows)


def sizes_of(robot):
    """Mean absolute error [rad] on held-out transitions, by number of those trained on by results/pidm.py."""
    folder, found = ROOT / f"results/pidm/{robot}", {}
    for path in [*folder.glob("sizes/*_validation.json"), folder / "validation.json"]:
        stem = path.stem.removesuffix("validation")
        with path.with_name(f"{stem}metrics.csv").open() as file:
            count = int(float(next(csv.DictReader(file))["samples"]))  # of the first epoch
        found[count] = json.loads(path.read_text())["error_rad"]
    return dict(sorted(found.items()))


# --- Pages ---

DETAILS = """# Every run of the study

Written by `python results/report.py`; [Results](../README.md) says what these tables mean. A folder has the arguments,
rows and evaluation of one run: `<scale>/<task>/<method>/seed<k>`. Figures after ± are standard deviations over seeds
(ddof 1). [grid.py](../grid.py) has the scales. Of each, the first table is of the training, the second of the mean
action at its end: without exploration noise, 64 episodes a seed, return, length [s], share of falls, errors of the
velocity [m/s], of the yaw rate [rad/s] and of the foot [m].
"""
MARKED = re.compile(r"(<!-- results/report\.py writes ?([\w -]*?) ?from here -->\n).*?(<!-- to here -->)", re.S)


def load_study():
    """Runs of each scale and task that has any: scale -> task -> method -> runs."""
    loaded = {scale: {task: load_task(STUDY / scale / task) for task in TASKS} for scale in SCALES}
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
    missing = ", ".join(f"`{task}`" for task in TASKS if task not in ran)
    lines = table_1(study, ran) if ran else []
    return lines + (["", f"Not all methods run yet: {missing}."] if missing else [])


def sizes(study, methods, tasks):
    """`ablation` of the sizes of the pretraining set, and below it the errors and the figure once there are two."""
    lines, errors = ablation(study, methods, tasks), sizes_of("anymal_d")
    if len(errors) < 2:
        return lines
    table = [*lines, ""] if lines else []
    line = ", ".join(f"{error:.3f} rad ({count:,})" for count, error in errors.items())
    line = f"Error by number of transitions: {line}." + " No task was run with the smaller sets yet." * (not table)
    return [*table, line, "", "![sizes](study/sizes.png)"]


def table_2(loaded):
    """Table II and, below it, the size of the pretraining set; or which methods have not run."""
    tables, missing, main = [], [], {"pidm_pretrained": METHODS["pidm_pretrained"].title}
    for group, table in (("table 2", ablation), ("sizes", sizes)):
        own = titles(group)
        lines = table(pick(loaded, own), own | main, ("anymal_climb_up", "anymal_climb_down"))
        tables += ["", *lines] if lines else []
        missing += [] if lines else own.values()
    return [*tables, *(["", f"Not run yet: {'; '.join(missing)}."] if missing else [])][1:]


def blocks(loaded):
    """Lines of each marked place, by its name; the unnamed one is in the project's README."""
    study = pick(loaded)
    return {
        "": readme_table(study),
        "table 1": table_1(study),
        "all tasks": overall(study),
        "table 2": table_2(loaded),
        "controls": controls(loaded),
        "batch": batches_table(loaded),
        "updates": updates_table(study),
        "accuracy": pidm_table(),
    }


def filled(text, lines):
    """Text of a page with the lines (name -> list) of its marked places."""
    return MARKED.sub(lambda mark: "\n".join([mark[1], *lines[mark[2]], "", mark[3]]), text)


def details(loaded):
    """Text of results/study/README.md."""
    parts = [DETAILS, "## Table I, along the way", "", *along_the_way(pick(loaded)), ""]
    for scale, study in loaded.items():
        tables = *progress_table(study), "", *actions_table(study)
        parts += [f"## {scale}", "", *sizes_and_machines(study), "", *tables, ""]
    return "\n".join(parts).rstrip() + "\n"


def draw_all(loaded):
    """Draw the figures that the runs allow, and remove those that they no longer allow."""
    study = pick(loaded)
    drawn = {
        "curves": lambda path: drawing.draw_curves(
            {drawing.title(task, runs): runs for task, runs in study.items()}, path
        ),
        "curves_batch": lambda path: drawing.draw_curves(drawing.curves_by_scale(loaded), path),
        "controls": lambda path: drawing.draw_controls(pick(loaded, CONTROLS), path),
        "critics": lambda path: drawing.draw_critics(loaded.get("batch", {}), path),
        "updates": lambda path: drawing.draw_updates(study, path),
        "success": lambda path: drawing.draw_success(study, path),
        "sizes": lambda path: drawing.draw_sizes(pick(loaded, titles("sizes")), path, sizes_of("anymal_d")),
        "batch": lambda path: drawing.draw_batch(loaded, path),
    }
    for name, draw in drawn.items():
        for path in (STUDY / f"{name}.png", STUDY / f"{name}.svg"):  # for the pages, and for print
            if not draw(path):
                path.unlink(missing_ok=True)


def beside(folder):
    """Draw a run with the recorded ones of its task, in its own folder. UserError if either is missing.

    The recorded ones are those of the same task, if there are any, and of the same number of environments.
    """
    try:
        args = json.loads((folder / "args.json").read_text())
        task, config = args["task"], task_of(args["config"])
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        name = "progress" if "progress" in rows[0] else "episode_return"
        points = [(float(row["iteration"]), float(row[name])) for row in rows]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise records.UserError(f"{folder} is not a run of ppo_finetune.py: {error}") from None
    known = [study[task] for study in load_study().values() if task in study]
    if not known:
        raise records.UserError(f"results/study has no runs of {task}")

    def likeness(runs):
        (one, *_), *_ = runs.values()
        return one["settings"]["config"] == config, drawing.batch(runs) == "{num_envs} x {num_steps}".format(**args)

    runs = max(known, key=likeness)
    if not likeness(runs)[0]:
        print(f"the recorded runs of {task} had other numbers in its config")
    path = folder / "beside_recorded.png"
    drawing.draw_curves(
        {drawing.title(task, runs): runs}, path, tuple(METHODS), ("this run", *zip(*points, strict=True))
    )
    print(f"wrote {path}")


def live(folder, seconds=10.0):
    """Redraw curve.png of a run until it has made its steps, or until Ctrl-C. UserError if it is no such run."""
    drawn = 0
    while True:
        try:
            total = json.loads((folder / "args.json").read_text())["total_steps"]
            with (folder / "metrics.csv").open() as file:
                rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
            steps = rows[-1]["env_steps"]
        except (OSError, ValueError, KeyError, IndexError) as error:
            raise records.UserError(f"{folder} has no rows of ppo_explore.py or ppo_finetune.py: {error!r}") from None
        if len(rows) > drawn:
            figures.plot_training(rows, folder / "curve.png")
            drawn = len(rows)
            print(f"{folder}/curve.png: {steps / 1e6:.2f} of {total / 1e6:.2f} M steps", flush=True)
        if steps >= total:
            return
        time.sleep(seconds)


def main(args):
    """Write the pages and figures. With --check, exit 1 if a page differs from the one on disk."""
    if args.beside:
        return beside(Path(args.beside))
    if args.live:
        return live(Path(args.live))
    loaded = load_study()
    if not loaded:
        raise records.UserError("results/study has no finished runs; run results/study.py")
    lines = blocks(loaded)
    pages = {path: filled(path.read_text("utf-8"), lines) for path in (ROOT / "README.md", ROOT / "results/README.md")}
    pages[STUDY / "README.md"] = details(loaded)
    if args.check:
        for path, text in pages.items():
            if not path.exists() or path.read_text("utf-8") != text:
                sys.exit(f"{path.relative_to(ROOT)} is not what the runs give; run results/report.py")
        return None
    for path, text in pages.items():
        records.replace_text(path, text)
    draw_all(loaded)
    print("\n".join(lines["table 1"]))
    return None


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
