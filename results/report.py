"""Turn the recorded runs under results/study into the paper's tables and figures.

    python results/report.py
    python results/report.py --check
    python results/report.py --beside runs/demo
    python results/report.py --live runs/demo

Writes results/README.md, the figures it shows, and the table in the project's README.
The indicator of a task is the paper's: mean return of the noisy policy, for parkour the curriculum's progress. Final
performance is its mean over the last 5% of rows. Iterations to converge are those to 90% of PIDM random's final
performance. Both are percentages against PIDM random. Brackets are 95% bootstrap intervals over seeds.
"""

import csv
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from experiment import figures, records
from results.grid import METHODS, TASKS, titles

STUDY = ROOT / "results/study"
DISCUSSION = ROOT / "results/discussion.md"  # written by hand; a part of the page
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
DRAWS = 10_000  # bootstrap samples


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
        keys = ("num_envs", "num_steps", "total_steps", "lr", "num_epochs", "mirror_coef", "config")
        success = {name: one["episode_success"] for name, one in result.items() if name.startswith("level ")}
        run = {
            "columns": columns,
            "iteration": columns["iteration"],
            "indicator": columns["progress" if "progress" in columns else "episode_return"],
            "errors": dict(result.get("task", {})),
            "success": list(success.values()),
            "settings": {key: record[key] for key in keys} | {"levels": list(success)},
            "seed": record["seed"],
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


# --- Measures ---


def final(run):
    """Mean indicator of the last 5% of rows."""
    return run["indicator"][-max(len(run["indicator"]) // 20, 1) :].mean()


def late_gain(run):
    """Share of the final performance gained in the last third of the training: near 0 once the curve is flat."""
    rows = len(run["indicator"])
    end, width = max(2 * rows // 3, 1), max(rows // 20, 1)
    return 1 - run["indicator"][end - width : end].mean() / final(run)


def area(run):
    """Mean indicator over the whole training."""
    return np.nanmean(run["indicator"])


def iterations_to(run, level):
    """First iteration at which the indicator, averaged over 5 rows, is at least `level`; NaN if never."""
    width = min(5, len(run["indicator"]))
    smooth = np.convolve(run["indicator"], np.ones(width) / width, "valid")
    reached = np.flatnonzero(smooth >= level)
    return run["iteration"][reached[0] + width - 1] if len(reached) else np.nan


def measures(runs):
    """Functions of a run, by name; levels are shares of PIDM random's final performance."""
    goal = np.mean([final(run) for run in runs["pidm_random"]])
    return {
        "final": final,
        "to 90%": lambda run: iterations_to(run, 0.9 * goal),
        "to 50%": lambda run: iterations_to(run, 0.5 * goal),
        "area": area,
    }


def percent(values, baseline):
    """Percentage of mean(values) against mean(baseline), and DRAWS bootstrap samples of it."""
    values, baseline = np.asarray(values), np.asarray(baseline)
    rng = np.random.default_rng(0)
    draws = [rng.choice(x, (DRAWS, len(x))).mean(1) for x in (values, baseline)]
    return 100 * (values.mean() / baseline.mean() - 1), 100 * (draws[0] / draws[1] - 1)


def interval(middle, draws):
    """A percentage as text, with its 95% interval unless all draws are equal."""
    if np.ptp(draws) == 0:
        return f"{middle:+.1f}"
    return f"{middle:+.1f} [{np.quantile(draws, 0.025):+.1f}, {np.quantile(draws, 0.975):+.1f}]"


def compare(runs, method, name, at_least=False):
    """Percentage of one measure against PIDM random, with draws, or words if there is none.

    With at_least, a run that never reaches a level counts as if it did at its last iteration.
    """
    if method not in runs or "pidm_random" not in runs:
        return "not run"
    measure = measures(runs)[name]
    values, baseline = (np.array([measure(run) for run in runs[m]]) for m in (method, "pidm_random"))
    missing = np.isnan(values)
    if np.isnan(baseline).any():
        return f"not reached by {np.isnan(baseline).sum()} of {len(baseline)} PIDM random"
    if missing.any() and not at_least:
        return f"not reached by {missing.sum()} of {len(values)}"
    return percent(np.where(missing, [run["iteration"][-1] for run in runs[method]], values), baseline)


def cell(runs, method, name):
    """`compare` as text."""
    found = compare(runs, method, name)
    return found if isinstance(found, str) else interval(*found)


def paper(method, name, task):
    """The paper's percentage as text, empty if it has none."""
    known = dict(zip(TASKS, PAPER[name].get(method, ()), strict=False)).get(task)
    return "" if known is None else f"{known:+.1f}"


# --- Tables ---


def markdown(rows):
    """Lines of a table from rows, dicts of the same columns. Trailing blanks, which tell titles apart, are dropped."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return ["| " + " | ".join(cell.strip() for cell in line) + " |" for line in lines]


def seeds(runs, methods):
    """Number of seeds of each of these methods, or one number if they agree."""
    counts = [len(runs.get(method, ())) for method in methods]
    return str(counts[0]) if len(set(counts)) == 1 else " / ".join(map(str, counts))


def table_1(study, tasks=tuple(TASKS)):
    """Paper Table I: final performance and iterations to converge of MLP and pretrained PIDM, against PIDM random."""
    methods = {"mlp": "MLP", "pidm_pretrained": "pretrained"}
    names = {"final": "final", "to 90%": "iterations"}
    columns = [(f"{title}: {label} [%]", m, n) for n, title in names.items() for m, label in methods.items()]
    rows = []
    for task in tasks:
        runs = study.get(task, {})
        row = {"task": TASKS[task].title, "seeds": seeds(runs, ("mlp", "pidm_random", "pidm_pretrained"))}
        for i, (head, method, name) in enumerate(columns):
            row |= {head: cell(runs, method, name), "paper" + " " * i: paper(method, name, task)}
        rows.append(row)
    row = {"task": "mean of the tasks with several seeds", "seeds": ""}
    for i, (head, method, name) in enumerate(columns):
        mean, known = mean_over_tasks(study, method, name)
        theirs = [dict(zip(TASKS, PAPER[name][method], strict=False))[task] for task in known]
        row |= {head: mean, "paper" + " " * i: f"{np.mean(theirs):+.1f}" if known else ""}
    return markdown([*rows, row])


def mean_over_tasks(study, method, name):
    """Mean percentage with its interval as text, "at least" if a run never got there; and the tasks that it is of.

    These have several seeds of both methods, for one seed gives no interval.
    """
    several = [t for t, runs in study.items() if all(len(runs.get(m, ())) > 1 for m in (method, "pidm_random"))]
    found = {task: compare(study[task], method, name, at_least=True) for task in several}
    known = {task: value for task, value in found.items() if not isinstance(value, str)}
    if not known:
        return "not run", known
    text = interval(*(np.mean(x, axis=0) for x in zip(*known.values(), strict=True)))
    bound = any(isinstance(compare(study[task], method, name), str) for task in known)
    return ("at least " if bound else "") + text, known


def along_the_way(study):
    """Iterations to half of PIDM random's final performance, and the mean of the whole training (not in the paper)."""
    methods = {"mlp": "MLP", "pidm_pretrained": "pretrained"}
    names = {"to 50%": "iterations to 50%", "area": "mean of the training"}
    columns = [(f"{title}: {label} [%]", m, n) for n, title in names.items() for m, label in methods.items()]
    ran = {task: runs for task, runs in study.items() if "pidm_random" in runs}
    rows = [{"task": TASKS[t].title} | {head: cell(r, m, n) for head, m, n in columns} for t, r in ran.items()]
    return markdown(rows) if rows else []


def ablation(study, methods, tasks):
    """Final performance, iterations and seeds on each task; a row for each of `methods` (name -> title)."""
    rows = []
    for method, title in methods.items():
        row = {"method": title, "seeds": " / ".join(str(len(study.get(task, {}).get(method, ()))) for task in tasks)}
        for i, task in enumerate(tasks):
            runs = study.get(task, {})
            for j, name in enumerate(("final", "to 90%")):
                what = "final" if name == "final" else "iterations"
                row[f"{TASKS[task].title}: {what} [%]"] = cell(runs, method, name)
                row["paper" + " " * (2 * i + j)] = paper(method, name, task)
        rows.append(row)
    empty = [column for column in rows[0] if not any(row[column] for row in rows)]  # the paper has no such runs
    return markdown([{column: text for column, text in row.items() if column not in empty} for row in rows])


def details(runs):
    """Lines of two tables of one task: every method in absolute figures; its mean action, step size and noise."""
    functions = measures(runs) if "pidm_random" in runs else {"final": final, "area": area}
    progress, ends = [], []
    for method, mine in runs.items():
        values = {name: [function(run) for run in mine] for name, function in functions.items()}
        last = {name: np.mean([run["columns"][name][-1] for run in mine]) for name in ("action_std", "seconds")}
        row = {
            "method": METHODS[method].title,
            "seeds": ", ".join(str(run["seed"]) for run in mine),
            "final": spread(values["final"]),
            "of it in the last third [%]": f"{100 * np.mean([late_gain(run) for run in mine]):.0f}",
            "area [%]": "0" if method == "pidm_random" else cell(runs, method, "area"),
            "iterations to 50%": counts(values["to 50%"]) if "to 50%" in values else "no PIDM random",
            "iterations to 90%": counts(values["to 90%"]) if "to 90%" in values else "no PIDM random",
        }
        progress.append(row | {"minutes": f"{last['seconds'] / 60:.1f}"})
        row = {"method": METHODS[method].title}
        for name in sorted(mine[0]["errors"].keys() - {"diverged"}):
            row[f"mean action: {name}"] = f"{np.mean([run['errors'][name] for run in mine]):.3g}"
        if mine[0]["success"]:
            by_level = 100 * np.mean([run["success"] for run in mine], axis=0)
            row["mean action: success by level [%]"] = " ".join(f"{share:.0f}" for share in by_level)
        shrink = [np.log(r["columns"]["action_std"][-1] / r["columns"]["action_std"][0]) for r in mine]
        steps = [r["columns"]["lr"].sum() for r in mine]
        row |= {
            "mean step size": f"{np.mean([r['columns']['lr'].mean() for r in mine]):.3g}",
            "final action std": f"{last['action_std']:.3f}",
            "change of log std over summed step sizes": f"{np.mean(np.divide(shrink, steps)):.0f}",
        }
        ends.append(row)
    return [*markdown(progress), "", *markdown(ends)]


def spread(values):
    """Mean and std over seeds as text; a single seed has no std."""
    return f"{np.mean(values):.4g}" + (f" ± {np.std(values):.2g}" if len(values) > 1 else "")


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


# --- Figures ---


def panels(count, width=3):
    """A figure and `count` axes, in rows of at most `width`."""
    columns = min(count, width)
    rows = -(-count // columns)
    size = 5 * columns, 3.4 * rows
    fig, axes = figures.pyplot().subplots(rows, columns, figsize=size, constrained_layout=True, squeeze=False)
    for ax in axes.ravel()[count:]:
        ax.axis("off")
    return fig, axes.ravel()[:count]


def look_of(method):
    """Colour and line of a method: the same in every panel, dashed if only its initial weights differ."""
    bases = list(dict.fromkeys(name.removesuffix("_orthogonal") for name in METHODS))
    base = method.removesuffix("_orthogonal")
    return {"color": f"C{bases.index(base) % 10}", "linestyle": "-" if base == method else "--"}


def draw_curves(study, path, extra=None):
    """Mean and std of the indicator over iterations, a panel per task. `extra` (label, iteration, value) is on top."""
    fig, axes = panels(len(study))
    for ax, (task, runs) in zip(axes, study.items(), strict=True):
        for method, mine in runs.items():
            values = np.stack([run["indicator"] for run in mine])
            iteration, mean, std = mine[0]["iteration"], values.mean(0), values.std(0)
            ax.plot(iteration, mean, label=f"{METHODS[method].title} ({len(mine)})", **look_of(method))
            ax.fill_between(iteration, mean - std, mean + std, alpha=0.15, color=look_of(method)["color"], linewidth=0)
        if extra:
            ax.plot(*extra[1:], color="black", label=extra[0])
        parkour = "progress" in next(iter(runs.values()))[0]["columns"]
        ax.set(title=TASKS[task].title, xlabel="PPO iteration", ylabel="progress" if parkour else "episode return")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    figures.save(fig, path, dpi=100)


def draw_updates(study, path):
    """Paper Fig. 6: mean change of a weight of the actor per iteration, by submodule, random against pretrained."""
    methods = {"pidm_random": "--", "pidm_pretrained": "-"}
    known = {task: runs for task, runs in study.items() if all(m in runs for m in methods)}
    if not known:
        return False
    fig, axes = panels(len(known))
    for ax, (task, runs) in zip(axes, known.items(), strict=True):
        names = [name for name in runs["pidm_random"][0]["columns"] if name.startswith("update/actor/")]
        for i, name in enumerate(names):
            for method, style in methods.items():
                mean = np.mean([run["columns"][name] for run in runs[method]], axis=0)
                label = f"{name.removeprefix('update/actor/')}, {METHODS[method].title.removeprefix('PIDM ')}"
                ax.semilogy(runs[method][0]["iteration"], mean, style, color=f"C{i}", label=label, linewidth=1)
        ax.set(title=TASKS[task].title, xlabel="PPO iteration", ylabel="mean change of a weight")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=6)
    figures.save(fig, path, dpi=100)
    return True


def sizes_of(robot):
    """Normalised error on held-out transitions, by number of those trained on, of what results/pidm.py has made."""
    folder, found = ROOT / f"results/pidm/{robot}", {}
    for path in [*folder.glob("sizes/*_validation.json"), folder / "validation.json"]:
        stem = path.stem.removesuffix("validation")
        args = json.loads(path.with_name(f"{stem}args.json").read_text())
        count = args["num_samples"] or json.loads((folder / "explore/meta.json").read_text())["transitions"]
        found[count] = json.loads(path.read_text())["normalized_error"]
    return dict(sorted(found.items()))


def draw_sizes(study, path, robot="anymal_d"):
    """Paper Sec. V-D: error of the PIDM, and iterations to converge, over the size of its training set."""
    errors = sizes_of(robot)
    if len(errors) < 2:
        return False
    methods = {7_000: "pidm_7k", 70_000: "pidm_70k", 700_000: "pidm_700k", max(errors): "pidm_pretrained"}
    fig, (left, right) = panels(2)
    left.semilogx(list(errors), list(errors.values()), "o-")
    left.set(xlabel="transitions", ylabel="error over action magnitude")
    for task, runs in study.items():
        known = {count: compare(runs, method, "to 90%") for count, method in methods.items()}
        known = {count: value[0] for count, value in known.items() if not isinstance(value, str)}
        if len(known) > 1:
            right.semilogx(list(known), list(known.values()), "o-", label=TASKS[task].title)
    right.set(xlabel="transitions", ylabel="iterations to 90%, against random [%]")
    right.axhline(0.0, color="0.6", lw=1)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    if right.get_legend_handles_labels()[0]:
        right.legend(fontsize=8)
    figures.save(fig, path, dpi=100)
    return True


def draw_all(study):
    """Draw the figures that the runs allow, and remove those that they no longer allow."""
    draw_curves(study, STUDY / "curves.png")
    for draw, name in ((draw_updates, "updates.png"), (draw_sizes, "sizes.png")):
        if not draw(study, STUDY / name):
            (STUDY / name).unlink(missing_ok=True)


# --- Pages ---

HEAD = """# Results

Written by `python results/report.py` from the runs in [study](study); `--check` compares. Percentages are against PIDM
random.

- *Final performance* is the mean indicator of the last 5% of a training. The indicator is the episode return of the
  noisy policy; for parkour, the progress of the curriculum.
- *Iterations* are those to 90% of PIDM random's final performance; less is better.
- *Brackets* are 95% bootstrap intervals over seeds, rough if the seeds are few. A single seed counts as if it had no
  spread, so that the brackets hold that of PIDM random alone. If PIDM random has one seed as well, there are none.
- *Mean* is over the tasks with several seeds of both methods. For iterations, every run of PIDM random must have
  reached 90%. With "at least", some run of the other method did not, and counts as if it had in its last iteration.
"""
BEYOND = """`PIDM shuffled` has the pretrained weights permuted within each layer: the same numbers, no knowledge. Its
features are 56 to 78% as large as the loaded ones and fill half as many directions again ([features](pidm/README.md),
with orthogonal weights around both). `orthogonal` has orthogonal initial weights, our default. The others have
PyTorch's, as rsl_rl, a fork of which the paper used. `history encoder only` loads no backbone.
"""
PIDM = """Mean error of the shipped checkpoints on a collection that they have not seen. The action magnitude is
|a_t - q_t|, joint target minus joint angle. The figures are ANYmal D's, as in the paper, where most actions are smaller
than 1 rad and most errors than 0.4 rad. [pidm](pidm/README.md) has the other robots.
"""
BEGIN, END = "<!-- results/report.py writes from here -->", "<!-- to here -->"


def load_study(scale):
    """Runs of each task that has any, in the paper's order."""
    loaded = {task: load_task(STUDY / scale / task) for task in TASKS}
    return {task: runs for task, runs in loaded.items() if runs}


def page(study, updates):
    """Text of results/README.md."""
    lines = [
        HEAD,
        DISCUSSION.read_text("utf-8"),
        "## Table I",
        "",
        *table_1(study),
        "",
        "![curves](study/curves.png)",
        "",
    ]
    lines += ["Where the methods stand before they have converged:", "", *along_the_way(study), ""]
    climbing = ("anymal_climb_up", "anymal_climb_down")
    loaded = {"pidm_pretrained": METHODS["pidm_pretrained"].title}
    parts, sizes = titles("table 2") | loaded, titles("sizes") | loaded
    lines += ["## Table II: which network is pretrained", "", *ablation(study, parts, climbing), ""]
    lines += ["## Size of the pretraining set", "", *ablation(study, sizes, climbing), ""]
    errors = sizes_of("anymal_d")
    if len(errors) > 1:
        lines += [*markdown([{f"{count:,}": f"{error:.3f}" for count, error in errors.items()}]), ""]
        lines += ["Error over action magnitude on held-out transitions, by the number of those trained on.", ""]
        lines += ["![sizes](study/sizes.png)", ""]
    ran = set().union(*study.values())
    beyond = {method: title for method, title in titles("beyond the paper").items() if method in ran}
    if beyond and any("pidm_random" in runs for runs in study.values()):
        tasks = [task for task, runs in study.items() if beyond.keys() & runs.keys() and "pidm_random" in runs]
        lines += ["## Controls, and what the paper does not have", ""]
        lines += [BEYOND, *ablation(study, beyond, tasks), ""]
    if updates:
        lines += ["## Which weights move", "", "![updates](study/updates.png)", ""]
    lines += ["## Data and accuracy of the PIDM", "", PIDM, *pidm_table(), ""]
    lines += [f"![{name}](pidm/anymal_d/{name}.png)" for name in ("coverage", "distribution", "accuracy")]
    lines += ["", "## Each task", ""]
    for task, runs in study.items():
        one = next(iter(runs.values()))[0]
        s, v = one["settings"], one["versions"]
        size = f"{s['num_envs']} x {s['num_steps']}, {s['total_steps'] / 1e6:.1f} M steps"
        lines += [
            f"### {TASKS[task].title}",
            "",
            f"`{task}`, {size}, {v['device']}, {v['machine']}.",
            "",
            *details(runs),
            "",
        ]
    return "\n".join(lines).rstrip() + "\n"


def with_table(text, study):
    """Text of the project's README, with the rows of Table I that have runs between the two marks."""
    ran = [task for task in TASKS if "pidm_random" in study.get(task, {})]
    missing = ", ".join(f"`{task}`" for task in TASKS if task not in ran)
    lines = ["", *table_1(study, ran), ""] if ran else [""]
    lines += [f"Not all methods run yet: {missing}.", ""] if missing else []
    before, rest = text.split(BEGIN)
    return "\n".join([before + BEGIN, *lines, END + rest.split(END)[1]])


def beside(folder):
    """Draw a run with the recorded ones of its task, in its own folder. UserError if either is missing."""
    try:
        task = json.loads((folder / "args.json").read_text())["task"]
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        name = "progress" if "progress" in rows[0] else "episode_return"
        points = [(float(row["iteration"]), float(row[name])) for row in rows]
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise records.UserError(f"{folder} is not a run of ppo_finetune.py: {error}") from None
    runs = load_task(STUDY / "cpu" / task)
    if not runs:
        raise records.UserError(f"results/study has no runs of {task}")
    path = folder / "beside_recorded.png"
    draw_curves({task: runs}, path, ("this run", *zip(*points, strict=True)))
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
    study = load_study("cpu")
    if not study:
        raise records.UserError("results/study has no finished runs; run results/study.py")
    updates = any("pidm_pretrained" in runs and "pidm_random" in runs for runs in study.values())
    readme = (ROOT / "README.md").read_text("utf-8")
    pages = {ROOT / "results/README.md": page(study, updates), ROOT / "README.md": with_table(readme, study)}
    if args.check:
        for path, text in pages.items():
            if not path.exists() or path.read_text("utf-8") != text:
                sys.exit(f"{path.relative_to(ROOT)} is not what the runs give; run results/report.py")
        return None
    for path, text in pages.items():
        records.replace_text(path, text)
    draw_all(study)
    print("\n".join(table_1(study)))
    return None


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
