"""Figures of the study: curves, controls, updates, success by level, and the size of the pretraining set.

Each function writes one file, the same bytes each time, and returns True; or nothing, and False, where the runs do not
allow the figure.
"""

import numpy as np

from experiment import figures
from results import measures
from results.grid import (
    METHODS,
    MODULES,
    SLOW_PIDMS,
    TABLE_1,
    TASKS,
    WALKING,
    batch,
    by_scale,
    is_unscaled,
    title,
    titled,
)

COLOURS = {  # of a method; dashed if only its initial weights or largest step size differ
    "mlp": "#009E73",
    "pidm_random": "#0072B2",
    "pidm_pretrained": "#D55E00",
    "pidm_shuffled": "#CC79A7",
    "pidm_actor": "#E69F00",
    "pidm_critic": "#56B4E9",
    "pidm_7k": "#BBBBBB",
    "pidm_70k": "#888888",
    "pidm_700k": "#444444",
}


def look_of(method):
    """Colour and line of a method, the same in every figure."""
    base = method.removesuffix("_orthogonal").removesuffix("_unscaled").removesuffix("_slow")
    return {"color": COLOURS[base], "linestyle": "-" if base == method else "--"}


def panels(rows, columns, width=4.6, height=3.3, **options):
    """A figure and its axes (rows, columns), each of this size [inch]."""
    size = width * columns, height * rows
    return figures.pyplot().subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, **options)


def band(ax, x, curves, label, look):
    """Draw the mean of curves (K, R) over x (R,), with all of them if there are up to three, else their spread."""
    curves = np.asarray(curves)
    mean = curves.mean(0)
    ax.plot(x, mean, label=label, **look)
    if len(curves) > 3:
        std = curves.std(0, ddof=1)
        ax.fill_between(x, mean - std, mean + std, color=look["color"], alpha=0.18, linewidth=0)
    elif len(curves) > 1:
        ax.plot(x, curves.T, color=look["color"], lw=0.6, alpha=0.6)


def legend_below(fig, axes, note, columns=4):
    """Draw one legend for all axes, below them, with a note."""
    entries = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    place = {"loc": "outside lower center", "ncols": min(len(entries), columns), "frameon": False, "fontsize": 9}
    fig.legend(entries.values(), entries.keys(), title=note, **place)


SHADE = "thick: mean over seeds; thin: each seed, of up to three; shaded: ± one standard deviation, of four or more"


def draw_task(ax, heading, runs, methods, extra=None):
    """Curves of a task, the level of 90%, and where each method gets there on average; steps on a second axis."""
    first = next(iter(runs.values()))[0]
    for method in [method for method in methods if method in runs]:
        curves = [run["indicator"] for run in runs[method]]
        band(ax, runs[method][0]["iteration"], curves, METHODS[method].title, look_of(method))
    if "pidm_random" in runs:
        goal = measures.goal_of(runs["pidm_random"])
        ax.axhline(0.9 * goal, color="0.3", lw=1, ls=":", label="90% of PIDM random's final")
        for method in [method for method in methods if method in runs]:
            there = np.isfinite(measures.values("to 90%", runs[method], goal)).all()
            mean = measures.counted("to 90%", runs[method], goal).mean()
            face = look_of(method)["color"] if there else "none"
            ax.plot(mean, 0.9 * goal, "o", ms=6, mfc=face, mec=look_of(method)["color"], zorder=3)
    if extra:
        ax.plot(*extra[1:], color="black", label=extra[0])
    parkour = "progress" in first["columns"]
    seeds_of = measures.seeds(runs, [method for method in methods if method in runs])
    ax.set(title=f"{heading} (n = {seeds_of})", xlabel="PPO iteration")
    ax.set_ylim(bottom=0 if parkour else None)
    ax.set_ylabel("curriculum progress" if parkour else "episode return")
    per_iteration = first["columns"]["env_steps"][-1] / first["iteration"][-1] / 1e6
    above = ax.secondary_xaxis("top", functions=(lambda x: x * per_iteration, lambda x: x / per_iteration))
    above.set_xlabel("environment steps [M]", fontsize=8)
    above.tick_params(labelsize=8)
    ax.grid(alpha=0.3)


def draw_curves(titled, path, methods=TABLE_1, extra=None):
    """Indicator over iterations, a panel for each title -> runs. `extra` (label, iteration, value) is on top."""
    if not titled:
        return False
    columns = min(len(titled), 3)
    alone = {"width": 8.0, "height": 5.5} if columns == 1 else {}
    fig, axes = panels(-(-len(titled) // columns), columns, **alone)
    for ax in axes.ravel()[len(titled) :]:
        ax.axis("off")
    for ax, (heading, runs) in zip(axes.ravel(), titled.items(), strict=False):
        draw_task(ax, heading, runs, methods, extra)
    dots = "dots: mean iteration at which a run gets there; hollow if some do not, and count by their length"
    legend_below(fig, axes.ravel(), f"{SHADE}\n{dots}", columns=4 if columns > 1 else 3)
    figures.save(fig, path, dpi=80)
    return True


def draw_controls(study, path):
    """Curves of the controls: on the left with PyTorch's initial weights, on the right with orthogonal ones."""
    left = ("pidm_random", "pidm_shuffled", "pidm_pretrained")
    right = [method for method in METHODS if method.endswith("_orthogonal")]
    known = {task: runs for task, runs in study.items() if "pidm_random" in runs and {*right} & runs.keys()}
    if not known:
        return False
    fig, axes = panels(len(known), 2, 5.2, sharey="row")
    for row, (task, runs) in zip(axes, known.items(), strict=True):
        for ax, methods, weights in zip(row, (left, right), ("PyTorch's", "orthogonal"), strict=True):
            draw_task(ax, titled(task, runs), runs, [method for method in methods if method in runs])
            ax.set_title(f"{ax.get_title()}\n{weights} weights", fontsize=10)
    legend_below(fig, axes.ravel(), SHADE, columns=3)
    figures.save(fig, path, dpi=80)
    return True


def draw_updates(study, path, task="anymal_pedipulation"):
    """Paper Fig. 7: mean change of a weight of the actor in the first iterations; below, per unit of step size."""
    runs = study.get(task, {})
    if not {"pidm_random", "pidm_pretrained"} <= runs.keys():
        return False
    fig, axes = panels(2, len(MODULES), 3.3, sharey="row", sharex=True)
    for column, module in zip(axes.T, MODULES, strict=True):
        for method in ("pidm_random", "pidm_pretrained"):
            chosen = runs[method][0]["iteration"] <= measures.EARLY
            x = runs[method][0]["iteration"][chosen]
            change = np.stack([run["columns"][f"update/actor/{module}"][chosen] for run in runs[method]])
            steps = np.stack([run["columns"]["lr"][chosen] for run in runs[method]])
            for ax, curves in zip(column, (change, change / steps), strict=True):
                band(ax, x, curves, METHODS[method].title, look_of(method) | {"marker": "o", "ms": 3})
        column[0].set_title(module.replace("_", " "))
        column[1].set_xlabel("PPO iteration")
        for ax in column:
            ax.set_ylim(0, None)
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("mean |change| of a weight\nper iteration")
    axes[1, 0].set_ylabel("the same over\nthe step size")
    fig.suptitle(
        f"{TASKS[task]}: updates of the actor (n = {measures.seeds(runs, ('pidm_random', 'pidm_pretrained'))})"
    )
    legend_below(fig, axes.ravel(), SHADE)
    figures.save(fig, path, dpi=80)
    return True


def success_of(arm):
    """Share [%] of the episodes of the mean action that succeed at each level (L,), mean over runs."""
    return 100 * np.mean([run["success"] for run in arm], axis=0)


def draw_success(study, path):
    """Success of the mean action by level, a heat map per method and a panel per task."""
    tasks = [task for task, runs in study.items() if any(run["success"] for arm in runs.values() for run in arm)]
    if not tasks:
        return False
    counts_of = {task: [m for m, arm in study[task].items() if arm[0]["success"]] for task in tasks}
    ratios = [len(methods) for methods in counts_of.values()]
    size = 8.0, 0.42 * sum(ratios) + 0.5 * len(tasks) + 0.6
    fig, axes = figures.pyplot().subplots(
        len(tasks), 1, figsize=size, layout="constrained", height_ratios=ratios, squeeze=False
    )
    for ax, (task, methods) in zip(axes.ravel(), counts_of.items(), strict=True):
        table = np.stack([success_of(study[task][m]) for m in methods])
        image = ax.imshow(table, vmin=0, vmax=100, cmap="viridis", aspect="auto")
        for (i, j), value in np.ndenumerate(table):
            ax.text(
                j, i, f"{value:.0f}", ha="center", va="center", color="black" if value > 60 else "white", fontsize=9
            )
        labels = [f"{METHODS[m].title} (n = {len(study[task][m])})" for m in methods]
        ax.set_yticks(range(len(methods)), labels, fontsize=9)
        ax.set_xticks(range(table.shape[1]), range(table.shape[1]), fontsize=8)
        ax.set_title(title(task, study[task]), fontsize=10, loc="left")
    axes[-1, 0].set_xlabel("level of the course: 0 easiest, 9 hardest")
    fig.colorbar(image, ax=axes, label="episodes of the mean action that succeed [%]", shrink=0.5, aspect=30)
    figures.save(fig, path, dpi=90)
    return True


def draw_sizes(study, path, errors, shipped):
    """Paper Sec. V-D: error of the PIDM (transitions -> rad) and, of tasks that were run with several sizes, iterations
    to converge, over its training set; that of the shipped PIDM has so many transitions.
    """
    if len(errors) < 2:
        return False
    methods = {7_000: "pidm_7k", 70_000: "pidm_70k", 700_000: "pidm_700k", shipped: "pidm_pretrained"}
    found = {
        task: {count: measures.compare(task, runs, method, "to 90%") for count, method in methods.items()}
        for task, runs in study.items()
    }
    known = {task: {n: one.value for n, one in each.items() if one is not None} for task, each in found.items()}
    known = {task: each for task, each in known.items() if len(each) > 1}
    fig, (axes,) = panels(1, 1 + bool(known))
    axes[0].semilogx(list(errors), list(errors.values()), "o-", color="0.3")
    axes[0].set(xlabel="transitions", ylabel="mean absolute error [rad]", ylim=(0, None))
    for (task, each), marker in zip(known.items(), "os^Dv", strict=False):
        axes[1].semilogx(list(each), list(each.values()), f"{marker}-", label=TASKS[task])
        axes[1].set(xlabel="transitions", ylabel="iterations to 90%, against random [%]")
        axes[1].axhline(0.0, color="0.6", lw=1)
        axes[1].legend(fontsize=8)
    for ax in axes:
        ax.grid(alpha=0.3)
    figures.save(fig, path, dpi=80)
    return True


def curves_by_scale(loaded):
    """Title -> runs of the walking quadrupeds that were run at several scales."""
    found = {}
    for task in WALKING:
        scales = by_scale(loaded, task)
        for scale, runs in scales.items() if len(scales) > 1 else ():
            key = f"{titled(task, runs)}{', unscaled' * is_unscaled(scale)}"
            found[f"{key}, {scale}" if key in found else key] = runs
    return found


CRITIC = {
    "lr": "step size",
    "critic_grad_norm": "norm of the\ncritic's gradient",
    "explained_variance": "explained\nvariance",
    "episode_return": "return",
}


def draw_critics(study, path):
    """Draw step size, critic and return of the walking quadrupeds in the first 100 iterations, a line for each run."""
    tasks = [task for task in WALKING if "pidm_random" in study.get(task, {})]
    if not tasks:
        return False
    fig, axes = panels(len(CRITIC), len(tasks), 5.2, 2.4, sharex=True, sharey="row")
    for column, task in zip(axes.T, tasks, strict=True):
        for method in TABLE_1 + SLOW_PIDMS:
            for run in study[task].get(method, ()):
                chosen = run["iteration"] <= measures.EARLY
                for ax, name in zip(column, CRITIC, strict=True):
                    label = METHODS[method].title
                    ax.plot(
                        run["iteration"][chosen], run["columns"][name][chosen], label=label, lw=1, **look_of(method)
                    )
        column[0].set_title(f"{TASKS[task]}, {batch(study[task])}")
        column[-1].set_xlabel("PPO iteration")
    for row, (name, what) in zip(axes, CRITIC.items(), strict=True):
        row[0].set_ylabel(what)
        for ax in row:
            ax.grid(alpha=0.3)
            ax.set_yscale("log" if name in ("lr", "critic_grad_norm") else "linear")
    axes[list(CRITIC).index("explained_variance"), 0].set_ylim(-0.5, 1.0)
    legend_below(fig, axes.ravel(), "a line for each run; explained variance is cut at -0.5", columns=3)
    figures.save(fig, path, dpi=80)
    return True


BATCH_PANELS = ("final", "area", "to 90%")


def draw_points(axes, task, scales, colour, marker, side):
    """A point for each scale, with its number of seeds. Returns the numbers of environments."""
    counts = []
    for scale, runs in scales.items():
        counts.append(runs["pidm_random"][0]["settings"]["num_envs"])
        x, unscaled = side * counts[-1], is_unscaled(scale)
        look = {"color": colour, "mfc": "none" if unscaled else colour}
        for ax, name in zip(axes, BATCH_PANELS, strict=True):
            one = measures.compare(task, runs, "pidm_pretrained", name)
            ax.plot(x, one.value, marker, label=TASKS[task] + ", unscaled first actions" * unscaled, **look)
            number = f" {len(runs['pidm_pretrained'])}"
            ax.text(x, one.value, number, color=colour, fontsize=7, va="bottom", ha="left" if side > 1 else "right")
            if one.interval:
                ax.vlines(x, *one.interval, color=colour, lw=1, ls=":" if unscaled else "-")
    return counts


def draw_batch(loaded, path):
    """What pretraining brings over the number of environments (scale -> task -> runs), on the walking quadrupeds."""
    fig, (axes,) = panels(1, len(BATCH_PANELS), 3.6)
    looks = zip(WALKING, ("#7F3C8D", "#0B8A6F"), "os", (0.95, 1.05), strict=True)
    ticks = sorted({count for task, *look in looks for count in draw_points(axes, task, by_scale(loaded, task), *look)})
    if len(ticks) < 2:
        figures.pyplot().close(fig)
        return False
    for ax, name in zip(axes, BATCH_PANELS, strict=True):
        ax.axhline(0.0, color="0.6", lw=1)
        less = " (fewer are better)" if measures.MEASURES[name].share else ""
        ax.set(xlabel="environments", title=measures.MEASURES[name].title + less, xscale="log")
        ax.set_xticks(ticks, ticks)
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("pretrained against random [%]")
    legend_below(fig, axes, "numbers: seeds; lines: 95% intervals over them")
    figures.save(fig, path, dpi=80)
    return True
