"""Curves of a training, and the figures of a PIDM's accuracy."""

import io

import numpy as np

from experiment import records

CURVES = ("episode_return", "disagreement", "ensemble_error", "ensemble_nll", "action_size", "fall_rate")
CURVES += ("progress_reached", "episode_success", "action_std")


def pyplot():
    """matplotlib.pyplot without a display. It is slow to load, so only where something is drawn."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def save(fig, path, dpi=110):
    """Write a figure as PNG or SVG in one step, the same bytes each time, and close it."""
    image, plt = io.BytesIO(), pyplot()
    with plt.rc_context({"svg.hashsalt": "fixed", "svg.fonttype": "none"}):  # names of parts; text stays text
        dated = "Date" if path.suffix == ".svg" else "Software"
        fig.savefig(image, format=path.suffix[1:], dpi=dpi, metadata={dated: None})
    plt.close(fig)
    records.replace_bytes(path, image.getvalue())


def plot_curves(rows, panels, path, over="env_steps"):
    """Draw each panel (title -> names of columns) over the column `over`."""
    fig, axes = pyplot().subplots(1, len(panels), figsize=(3.2 * len(panels), 2.8), constrained_layout=True)
    for ax, (title, columns) in zip(np.atleast_1d(axes), panels.items(), strict=True):
        for name in columns:
            ax.plot([row[over] for row in rows], [row[name] for row in rows], label=name.split("/")[-1], lw=1)
        if len(columns) > 1:
            ax.legend(fontsize=5)
        ax.set_title(title)
        ax.set_xlabel(over.replace("_", " "))
        ax.grid(alpha=0.3)
    save(fig, path)


def plot_training(rows, path):
    """Curves of stage 1 or 3: of what its rows have, and all reward terms in one panel."""
    errors = [name for name in rows[0] if name.endswith("_error") and name not in CURVES]
    panels = {name: [name] for name in (*CURVES, *errors) if name in rows[0]}
    terms = [name for name in rows[0] if name.startswith("reward/")]
    plot_curves(rows, panels | {"reward terms per step": terms}, path)


def plot_accuracy(change, error, path, samples=1000):
    """Absolute and normalised error [rad] over the action magnitude |a - q| [rad], both (B, A) (paper Fig. 4c).

    Points are the joints of `samples` transitions drawn at random, lines are means and quartiles of all.
    """
    drawn = np.random.default_rng(0).choice(len(change), min(samples, len(change)), replace=False)
    some = np.abs(change[drawn]).ravel(), np.abs(error[drawn]).ravel()
    size, error = np.abs(change).ravel(), np.abs(error).ravel()
    edges = np.linspace(0, np.quantile(size, 0.995), 21)
    bins = np.digitize(size, edges)
    rows = [(size[bins == i].mean(), error[bins == i]) for i in range(1, len(edges)) if (bins == i).sum() > 20]
    rows = rows or [(size.mean(), error)]  # of a handful of transitions
    magnitude = np.array([size for size, _ in rows])
    quantiles = np.array([np.quantile(errors, (0.25, 0.5, 0.75)) for _, errors in rows])
    mean = np.array([errors.mean() for _, errors in rows])
    fig, axes = pyplot().subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    for ax, unit, part in zip(axes, (1.0, magnitude), (1.0, np.maximum(some[0], 1e-6)), strict=True):
        ax.plot(some[0], some[1] / part, ".", ms=2, alpha=0.25, mew=0, color="0.4", label=f"{len(drawn)} transitions")
        ax.fill_between(magnitude, quantiles[:, 0] / unit, quantiles[:, 2] / unit, alpha=0.35, label="25% to 75%")
        ax.plot(magnitude, mean / unit, lw=2, label="mean")
        ax.set(xlabel="action magnitude |a - q| [rad]", xlim=(0, edges[-1]))
        ax.grid(alpha=0.3)
    axes[0].set(ylabel="error of the joint target [rad]", ylim=(0, np.quantile(error, 0.995)))
    axes[1].set(ylabel="the same / action magnitude", yscale="log", ylim=(0.03, 30))
    axes[0].legend(markerscale=5, loc="upper left")
    save(fig, path)


def plot_distribution(magnitude, rough, path):
    """Distribution of the action magnitude (B, A) [rad] on flat and on rough (B,) ground (paper Fig. 4b)."""
    fig, ax = pyplot().subplots(figsize=(4.5, 3), constrained_layout=True)
    edges = np.linspace(0, np.quantile(magnitude, 0.999), 41)
    for label, chosen, line in (("flat", ~rough, "-"), ("rough", rough, "--")):
        if chosen.any():
            density, _ = np.histogram(magnitude[chosen], edges, density=True)
            ax.stairs(density, edges, lw=1.5, ls=line, label=label)
    ax.set(xlabel="action magnitude |a - q| [rad]", ylabel="density", xlim=(0, edges[-1]), ylim=(0, None))
    ax.grid(alpha=0.3)
    ax.legend()
    save(fig, path)
