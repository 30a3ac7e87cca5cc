"""Load the recorded runs under results/study, and turn them into the tables of the report.

A study is task -> method -> runs. A table is a list of lines of Markdown.
"""

import itertools
import json
import os
import sys
from pathlib import Path

import numpy as np

from experiment import records
from results import grid, measures
from results.grid import METHODS, SCALES, TABLE_1, TASKS, is_earlier, task_of
from results.measures import MEASURES

ROOT = Path(__file__).resolve().parent.parent
INDICATORS = ("progress_reached", "progress", "episode_return")  # the first that a run has; older ones lack the first
PAPER_TASKS = (
    *("anymal_loco", "anymal_pedipulation", "anymal_parkour_walk", "anymal_climb_up", "anymal_climb_down"),
    *("anymal_crouch", "anymal_jump", "go1_loco", "g1_loco"),
)
PAPER = {  # measure -> method -> percent against PIDM random by task, in the order of PAPER_TASKS; Tables I and II
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
    ("pidm_pretrained", "pidm_random_orthogonal"),
    ("mlp_orthogonal", "mlp"),
    ("pidm_pretrained_unscaled", "pidm_random_unscaled"),
    ("pidm_random_slow", "pidm_random"),
    ("pidm_pretrained_slow", "pidm_random_slow"),
    ("pidm_pretrained_slow", "pidm_pretrained"),
)
COMPARED = {
    "final": "final",
    "mean action": "mean action",
    "area": "mean of training",
    "to 50%": "to 50%",
    "to 90%": "to 90%",
}
GAIT = {  # the figures of tools/gait.py that are shown, and their titles
    "falls": "falls at fixed commands",
    "push of 1.0 m/s/falls": "after a push of 1 m/s",
    "yaw_slope": "yaw rate over its command",
    "stride_frequency": "strides a second",
    "clearance": "feet rise by [m]",
    "slip": "slip per metre",
    "cost_of_transport": "cost of transport",
}


# --- Runs ---


def left_out(folder, why):
    """Print a warning that a run is not counted."""
    print(f"warning: {os.path.relpath(folder)} left out: {why}", file=sys.stderr)


def load_run(folder, evaluated=True):
    """One run: its columns, each (R,), its settings, and its evaluation unless `evaluated` is False.

    None, with a warning, if it is incomplete.
    """
    try:
        record = json.loads((folder / "args.json").read_text())
        result = json.loads((folder / "eval.json").read_text()) if evaluated else {}
        rows = records.read_rows(folder / "metrics.csv")
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        complete = bool(columns["env_steps"][-1] >= float(record["total_steps"]))
        indicator = next(name for name in INDICATORS if name in columns)
        keys = ("num_envs", "num_steps", "total_steps", "lr", "num_epochs", "mirror_coef")
        success = {name: one["episode_success"] for name, one in result.items() if name.startswith("level ")}
        run = {
            "columns": columns,
            "iteration": columns["iteration"],
            "indicator": columns[indicator],
            "errors": dict(result.get("task", {})),
            "gait": result.get("gait", {}),
            "success": list(success.values()),
            "settings": {key: record[key] for key in keys}
            | {"config": task_of(record["config"]), "levels": list(success), "indicator": indicator, "rows": len(rows)},
            "seed": record["seed"],
            "earlier": is_earlier(*folder.parts[-4:-2]),
            "versions": record["versions"],
        }
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
        return left_out(folder, repr(error))
    return run if complete else left_out(folder, "stopped before its last step")


def load_task(folder, evaluated=True):
    """Runs of each method, by seed. Runs whose settings differ from the first one's are left out with a warning."""
    runs, settings = {}, None
    for method in METHODS:
        for seed in sorted(path for path in (folder / method).glob("seed*") if path.name[4:].isdigit()):
            run = load_run(seed, evaluated)
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


def of_paper(method, name):
    """The paper's percentages (task -> one, None where it has none)."""
    return dict(zip(PAPER_TASKS, PAPER.get(name, {}).get(method, ()), strict=False))


def paper(method, name, task):
    """The paper's percentage as text, empty if it has none."""
    known = of_paper(method, name).get(task)
    return "" if known is None else f"{known:+.1f}"


def paper_mean(method, name, tasks):
    """The paper's mean over those of these tasks that it has as text, empty if it has none."""
    known = [value for task, value in of_paper(method, name).items() if task in tasks]
    return f"{np.mean(known):+.1f}" if known else ""


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
        row = {"task": grid.title(task, runs), "batch": grid.batch(runs), "seeds": measures.seeds(runs, TABLE_1)}
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
        row = {"task": grid.title(task, runs)}
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
                devices = {on_cpu(run) for arm in arms.values() for run in arm}
                row = {"task": grid.title(task, runs), "batch": grid.batch(runs) + " *" * (len(devices) > 1)}
                row |= {"method": METHODS[method].title, "against": METHODS[against].title}
                row["seeds"] = ", ".join(str(run["seed"]) for run in arms[method])
                row |= compared(task, arms, method, against)
                row["better at the end, of seeds"] = wins(arms, method, "final", against)
                rows.append(row | {"early updates of the backbone [%]": early_updates(arms, method, against)})
    return markdown(rows)


def on_cpu(run):
    """True if a run was made on a CPU, which older records call cpu:0."""
    return run.get("versions", {}).get("device", "cpu").startswith("cpu")


def compared(task, runs, method, against="pidm_random"):
    """Cells of a method's changes against another on one task, empty where a measure is missing."""
    found = {title: measures.compare(task, runs, method, name, against) for name, title in COMPARED.items()}
    return {f"{title} [%]": shown(estimate, "") for title, estimate in found.items()}


def against_mlp(study):
    """The pretrained PIDM against the MLP on each task; the 90% are the MLP's."""
    return markdown(
        [
            {"task": grid.title(task, runs), "seeds": measures.seeds(runs, ("pidm_pretrained", "mlp"))}
            | compared(task, runs, "pidm_pretrained", "mlp")
            for task, runs in study.items()
            if {"pidm_pretrained", "mlp"} <= runs.keys()
        ]
    )


def gait_table(study):
    """How the mean action walks on flat ground, mean over the seeds of which it was measured."""
    rows = []
    for task, runs in study.items():
        for method, arm in runs.items():
            if mine := [run["gait"] for run in arm if run["gait"]]:
                row = {"task": grid.title(task, runs), "method": METHODS[method].title, "seeds": str(len(mine))}
                for name, title in GAIT.items():
                    episodes = name.replace("falls", "episodes")
                    known = [gait for gait in mine if gait[name] is not None]
                    each = [gait[name] / (gait[episodes] if episodes != name else 1) for gait in known]
                    row[title] = f"{np.mean(each):.3g}" if each else ""
                rows.append(row)
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
    for task in grid.WALKING:
        found = grid.by_scale(loaded, task)
        for scale, runs in found.items() if len(found) > 1 else ():
            row = {"task": TASKS[task], "batch": grid.batch(runs), "initial weights": SCALES[scale].weights}
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
            for name in ("lr", *(f"update/actor/{module}" for module in grid.MODULES))
        }
        step = ratio.pop("lr")
        row = {"task": grid.title(task, runs), "seeds": measures.seeds(runs, ("pidm_pretrained", "pidm_random"))}
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
            row = {"task": grid.title(task, runs), "method": METHODS[method].title}
            row["seeds"] = ", ".join(str(run["seed"]) for run in mine)
            row["final"] = spread(each["final"])
            row["gained in the last third [%]"] = f"{100 * np.mean([measures.late_gain(run) for run in mine]):.0f}"
            row["mean of the training"] = spread(each["area"])
            highest = [run["columns"]["progress"] for run in mine if "progress_reached" in run["columns"]]
            row["solved at the end"] = spread([one[-1] for one in highest]) if highest else ""
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
            row = {"task": grid.title(task, runs), "method": METHODS[method].title, "seeds": str(len(mine))}
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
        size = f"{grid.batch(runs)}, {one['settings']['total_steps'] / 1e6:.1f} M steps"
        each = [run["versions"] for arm in runs.values() for run in arm]
        machines = sorted({"{device}, {machine}, jax {jax}".format(**versions) for versions in each})
        lines.append(f"- {grid.title(task, runs)}: `{task}`, {size}, {'; '.join(machines)}")
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


def sizes_of(folder):
    """Mean absolute error [rad] on held-out transitions, by number of those that the PIDMs of a folder had."""
    found = {}
    for path in [*folder.glob("sizes/*_validation.json"), folder / "validation.json"]:
        stem = path.stem.removesuffix("validation")
        found[transitions(path.with_name(f"{stem}metrics.csv"))] = json.loads(path.read_text())["error_rad"]
    return dict(sorted(found.items()))


def transitions(path):
    """Number of transitions that a PIDM was trained on, from its metrics.csv: the samples of the first epoch."""
    return int(records.read_rows(path)[0]["samples"])
