"""Turn the recorded runs under results/study into tables and curves: results/study/README.md and curves.png.

    python results/report.py
    python results/report.py --check
    python results/report.py --beside runs/demo

Metrics are the paper's: final performance (mean return of the last 5% of rows) and iterations to 90% of the final
performance of PIDM random, both against PIDM random; beside them iterations to 50%, area under the curve, and return
and velocity error of the mean action. Intervals are 95% bootstrap intervals over seeds. --check fails if the README is
not what the runs give; --beside draws a run of yours with the recorded ones of its task.
"""

import csv
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from envs import records

STUDY = ROOT / "results/study"
METHODS = {
    "mlp": "MLP",
    "pidm_random": "PIDM random",
    "pidm_pretrained": "PIDM pretrained",
    "pidm_shuffled": "PIDM shuffled",
    "pidm_actor": "PIDM pretrained, actor only",
    "pidm_critic": "PIDM pretrained, critic only",
    "pidm_scaled": "PIDM pretrained, scaled",
    "pidm_slow": "PIDM pretrained, slow start",
}
PAPER = {  # Table I: method -> task -> (final performance, iterations to 90 %), percent against PIDM random
    "mlp": {"go1_loco": (0.6, 2.2), "anymal_loco": (0.5, -28.7), "g1_loco": (-0.2, -46.7)},
    "pidm_pretrained": {"go1_loco": (3.6, -17.7), "anymal_loco": (10.1, -33.1), "g1_loco": (10.0, -34.0)},
}
COLUMNS = ("iteration", "seconds", "episode_return", "lr", "action_std")  # of metrics.csv


@dataclass(frozen=True)
class Args:
    check: bool = False  # compare with the README on disk instead of writing it
    beside: str | None = None  # a run folder: draw its curve with those of the study


def load_run(folder):
    """One run: steps (R,), returns (R,), the evaluation and the settings; None, with a warning, if it is not whole."""
    try:
        record = json.loads((folder / "args.json").read_text())
        result = json.loads((folder / "eval.json").read_text())
        with (folder / "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        columns = {name: np.array([float(row[name]) for row in rows]) for name in COLUMNS}
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"warning: {folder.relative_to(ROOT)} left out: {error}", file=sys.stderr)
        return None
    steps = record["num_envs"] * record["num_steps"]
    if columns["iteration"][-1] * steps < record["total_steps"]:
        print(f"warning: {folder.relative_to(ROOT)} left out: stopped before its last step", file=sys.stderr)
        return None
    keys = ("num_envs", "num_steps", "total_steps", "lr", "num_epochs", "mirror_coef", "config")
    return {
        "iteration": columns["iteration"],
        "return": columns["episode_return"],
        "lr": columns["lr"],
        "action_std": columns["action_std"],
        "seconds": columns["seconds"][-1],
        "errors": result["task"],
        "settings": {key: record[key] for key in keys},
        "seed": record["seed"],
        "versions": record["versions"],
    }


def load_task(folder):
    """method -> runs by seed. Runs whose settings differ from the first one's are left out with a warning."""
    runs, settings = {}, None
    for method in METHODS:
        for seed in sorted((folder / method).glob("seed*")):
            one = load_run(seed)
            if one is None:
                continue
            settings = settings or one["settings"]
            if one["settings"] != settings:
                print(f"warning: {seed.relative_to(ROOT)} left out: other settings than the rest", file=sys.stderr)
                continue
            runs.setdefault(method, []).append(one)
    return runs


def final(run):
    """Mean return of the last 5% of rows."""
    return run["return"][-max(len(run["return"]) // 20, 1) :].mean()


def area(run):
    """Mean return over the whole training."""
    return np.nanmean(run["return"])


def iterations_to(run, level):
    """First iteration at which the return, averaged over 5 rows, is at least `level`; NaN if never."""
    smooth = np.convolve(run["return"], np.ones(5) / 5, "valid")
    reached = np.flatnonzero(smooth >= level)
    return run["iteration"][reached[0] + 4] if len(reached) else np.nan


def interval(values, baseline):
    """Percent of mean(values) against mean(baseline), with a 95% bootstrap interval over the seeds of both."""
    values, baseline = np.asarray(values), np.asarray(baseline)
    rng = np.random.default_rng(0)
    draws = [rng.choice(x, (10_000, len(x))).mean(1) for x in (values, baseline)]
    spread = 100 * (draws[0] / draws[1] - 1)
    middle = 100 * (values.mean() / baseline.mean() - 1)
    if len(values) < 2:
        return f"{middle:+.1f}"
    return f"{middle:+.1f} [{np.quantile(spread, 0.025):+.1f}, {np.quantile(spread, 0.975):+.1f}]"


def against_random(values, baseline, is_baseline):
    """A cell: nothing for the baseline itself, `not reached` where a seed did not."""
    missing = int(np.isnan(values).sum())
    if missing:
        return f"not reached by {missing} of {len(values)}"
    return "0" if is_baseline else interval(values, baseline)


def table(task, runs):
    """Markdown lines of one task."""
    baseline = runs.get("pidm_random")
    if not baseline:
        return ["PIDM random was not run, so there is nothing to compare with."]
    goal = np.mean([final(run) for run in baseline])
    measures = {
        "final": final,
        "to 90%": lambda run: iterations_to(run, 0.9 * goal),
        "to 50%": lambda run: iterations_to(run, 0.5 * goal),
        "area": area,
    }
    rows = []
    for method, title in METHODS.items():
        if method not in runs:
            continue
        mine = runs[method]
        values = {name: [measure(run) for run in mine] for name, measure in measures.items()}
        percent = {
            name: against_random(values[name], [measure(run) for run in baseline], method == "pidm_random")
            for name, measure in measures.items()
        }
        mean = {name: np.mean([run["errors"][name] for run in mine]) for name in mine[0]["errors"]}
        paper = PAPER.get(method, {}).get(task)
        rows.append(
            {
                "method": title,
                "seeds": ", ".join(str(run["seed"]) for run in mine),
                "final return": f"{np.mean(values['final']):.2f} ± {np.std(values['final']):.2f}",
                "% of random": percent["final"],
                "paper": f"{paper[0]:+.1f}" if paper else "",
                "iterations to 90%": cell_of_counts(values["to 90%"]),
                "% of random ": percent["to 90%"],
                "paper ": f"{paper[1]:+.1f}" if paper else "",
                "iterations to 50%": cell_of_counts(values["to 50%"]),
                "% of random  ": percent["to 50%"],
                "area, % of random": percent["area"],
                "mean action: return": f"{mean['episode_return']:.2f}",
                "velocity error [m/s]": f"{mean['lin_vel_error']:.3f}",
                "falls": f"{100 * mean['falls']:.0f}%",
                "minutes": f"{np.mean([run['seconds'] for run in mine]) / 60:.1f}",
            }
        )
    return markdown(rows)


def markdown(rows):
    """Lines of a table from rows, dicts of the same columns. Trailing blanks tell columns of one title apart."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return ["| " + " | ".join(cell.strip() for cell in line) + " |" for line in lines]


def noise_table(runs):
    """Markdown lines: how the KL-controlled step size and the action std went, which the noisy return hangs on."""
    rows = []
    for method, mine in runs.items():
        shrink = [np.log(run["action_std"][-1] / run["action_std"][0]) / run["lr"].sum() for run in mine]
        rows.append(
            {
                "method": METHODS[method],
                "mean step size": f"{np.mean([run['lr'].mean() for run in mine]):.3g}",
                "final action std": f"{np.mean([run['action_std'][-1] for run in mine]):.3f}",
                "change of log std over summed step sizes": f"{np.mean(shrink):.0f}",
            }
        )
    return markdown(rows)


def cell_of_counts(counts):
    """Mean of iteration counts, NaN where a level was not reached."""
    return "not reached" if np.isnan(counts).all() else f"{np.nanmean(counts):.0f}"


def draw(tasks, path, extra=None):
    """Mean and std of the return over iterations, a panel a task; `extra` (label, iteration, return) goes on top."""
    plt = records.pyplot()
    fig, axes = plt.subplots(1, len(tasks), figsize=(5.5 * len(tasks), 3.6), constrained_layout=True, squeeze=False)
    for ax, (task, runs) in zip(axes[0], tasks.items(), strict=True):
        for method, mine in runs.items():
            curves = np.stack([run["return"] for run in mine])
            iteration, mean, std = mine[0]["iteration"], curves.mean(0), curves.std(0)
            (line,) = ax.plot(iteration, mean, label=f"{METHODS[method]} ({len(mine)})")
            ax.fill_between(iteration, mean - std, mean + std, alpha=0.15, color=line.get_color())
        if extra:
            ax.plot(*extra[1:], color="black", label=extra[0])
        ax.set(title=task, xlabel="PPO iteration", ylabel="episode return")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    fig.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(fig)


def report(scale):
    """Text of the report of one scale, and task -> runs."""
    tasks = {folder.name: load_task(folder) for folder in sorted((STUDY / scale).iterdir()) if folder.is_dir()}
    lines = []
    for task, runs in tasks.items():
        any_run = next(iter(runs.values()))[0]
        s, v = any_run["settings"], any_run["versions"]
        lines += [f"## {task}, scale {scale}", ""]
        lines += [
            f"{s['num_envs']} x {s['num_steps']}, {s['total_steps'] / 1e6:.1f} M steps, engine `c`, {v['machine']}."
        ]
        lines += ["", *table(task, runs), "", *noise_table(runs), ""]
    return lines, tasks


def beside(folder):
    """Draw a run with the study's of its task into its own folder; UserError if either is missing."""
    try:
        task = json.loads((folder / "args.json").read_text())["task"]
        with (folder / "metrics.csv").open() as file:
            rows = [(float(row["iteration"]), float(row["episode_return"])) for row in csv.DictReader(file)]
    except (OSError, ValueError, KeyError) as error:
        raise records.UserError(f"{folder} is not a run of ppo_finetune.py: {error}") from None
    if not (STUDY / "cpu" / task).is_dir():
        raise records.UserError(f"results/study has no runs of {task}")
    path = folder / "beside_recorded.png"
    draw({task: load_task(STUDY / "cpu" / task)}, path, ("this run", *zip(*rows, strict=True)))
    print(f"wrote {path}")


HEAD = """# Study

Written by `python results/report.py` from the runs beside it; `--check` compares. Final return and area are the noisy
policy's in training; then follow return, velocity error and falls of its mean action, over 64 episodes of 20 s.
Percentages are against PIDM random, with 95% bootstrap intervals over seeds (with so few seeds they are rough).
`PIDM shuffled` has the pretrained weights permuted within each layer: the same scale, no knowledge. Minutes are of
machines that may have run two trainings at once.

![curves](curves.png)
"""


def main(args):
    """Write the report, or with --check exit 1 where it differs from the one on disk."""
    if args.beside:
        return beside(Path(args.beside))
    lines, tasks = report("cpu")
    text = "\n".join([HEAD, *lines]).rstrip() + "\n"
    if args.check:
        if (STUDY / "README.md").read_text() != text:
            sys.exit("results/study/README.md is not what the runs give; run results/report.py")
        return None
    records.replace_text(STUDY / "README.md", text)
    draw(tasks, STUDY / "curves.png")
    print(text)
    return None


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except records.UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
