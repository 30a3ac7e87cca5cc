"""Run folders, policy files, progress and curves: what scripts write down, and how they report it.

Every file is replaced in one step, so that a stopped run leaves none half-written.
"""

import csv
import dataclasses
import json
import os
import platform
import signal
import subprocess
import sys
from pathlib import Path

import flax
import jax
import jax.numpy as jnp
import mujoco


class UserError(Exception):
    """Bad input: printed as one line, exit code 2."""


def versions():
    """What a run must name to be repeatable."""
    git = subprocess.run(["git", "describe", "--always", "--dirty", "--abbrev=12"], capture_output=True, text=True)
    return {
        "commit": git.stdout.strip() or "unknown",
        "device": str(jax.devices()[0]),
        "machine": f"{platform.machine()}, {cpu_count()} CPUs",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }


def cpu_count():
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def replace_text(path, text):
    """Write a whole text file in one step."""
    tmp = path.with_name(path.name + ".tmp")
    tmp.write_text(text)
    tmp.replace(path)


def start_run(args, config, folder, force):
    """Create the run folder with args.json in it and return it. Refuses to overwrite a run unless `force`.

    args and config (the task's) are dataclasses; both are recorded, with versions, commit and device.
    """
    out = Path(folder)
    if (out / "metrics.csv").exists() and not force:
        raise UserError(f"{out} holds a run already; pass --force to overwrite it or --run-dir for another folder")
    record = dataclasses.asdict(args) | {"config": dataclasses.asdict(config), "versions": versions()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "metrics.csv").unlink(missing_ok=True)
        replace_text(out / "args.json", json.dumps(record, indent=1) + "\n")
    except OSError as error:
        raise UserError(f"cannot write to {out}: {error.strerror}") from None
    return out


def save(path, params, args):
    """Write weights, task and arguments as one msgpack file, in one step."""
    meta = {"task": args.task, "args": dataclasses.asdict(args), "versions": versions()}
    blob = flax.serialization.msgpack_serialize(
        {"params": flax.serialization.to_state_dict(jax.device_get(params)), "meta": json.dumps(meta)}
    )
    tmp = path.with_name(path.name + ".tmp")
    tmp.write_bytes(blob)
    tmp.replace(path)


def load(path):
    """Read what `save` wrote: params and meta. UserError if the file is missing or is not one of ours."""
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
        meta = json.loads(content["meta"])
        assert {"task", "args"} <= meta.keys()
        return content["params"], meta
    except OSError as error:
        raise UserError(f"cannot read policy {path}: {error.strerror}") from None
    except Exception:  # msgpack has no common error class; whatever it says, the file is not a policy
        raise UserError(f"{path} is not a policy file, or it is damaged") from None


def check_shapes(path, params, like):
    """UserError unless params has the leaves and shapes of `like`."""
    shapes = [{jax.tree_util.keystr(k): jnp.shape(v) for k, v in jax.tree.leaves_with_path(t)} for t in (params, like)]
    for name in sorted(shapes[0].keys() | shapes[1].keys()):
        if shapes[0].get(name) != shapes[1].get(name):
            raise UserError(f"{path}: {name} is {shapes[0].get(name)}, this task needs {shapes[1].get(name)}")


def line(row):
    """A row of numbers as text."""
    return "  ".join(f"{name} {float(value):.4g}" for name, value in row.items())


def log_row(path, row):
    """Append one row to a CSV file."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow(row)


def plot_curve(csv_path, out_path):
    """Draw return, fall rate, task metrics and reward terms over environment steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with csv_path.open() as file:
        rows = list(csv.DictReader(file))
    columns = {name: [float(row[name]) for row in rows] for name in rows[0]}
    names = ["episode_return", "fall_rate", *(name for name in columns if name.endswith("_error")), "action_std"]
    terms = [name for name in columns if name.startswith("reward/")]
    fig, axes = plt.subplots(1, len(names) + 1, figsize=(3.2 * (len(names) + 1), 2.8), constrained_layout=True)
    for ax, name in zip(axes, names, strict=False):
        ax.plot(columns["env_steps"], columns[name])
        ax.set_title(name)
    for name in terms:
        axes[-1].plot(columns["env_steps"], columns[name], label=name.removeprefix("reward/"), lw=1)
    axes[-1].set_title("reward terms per step")
    axes[-1].legend(fontsize=5)
    for ax in axes:
        ax.set_xlabel("environment steps")
        ax.grid(alpha=0.3)
    fig.savefig(out_path, dpi=110, metadata={"Software": None})
    plt.close(fig)


class Reporter:
    """Progress: a live bar on a terminal, one plain line a row elsewhere. Ctrl-C sets `stopped`, to end after a row."""

    SHOWN = ("episode_return", "fall_rate", "lin_vel_error", "kl", "action_std")

    def __init__(self, total):
        self.total, self.bar, self.stopped = total, None, False

    def stop(self, *_):
        self.stopped = True  # an exception could strike inside the physics callback

    def __enter__(self):
        self.handler = signal.signal(signal.SIGINT, self.stop)
        if sys.stdout.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            columns = BarColumn(bar_width=20), TextColumn("{task.percentage:.0f}%"), TimeRemainingColumn()
            self.bar = Progress(*columns, TextColumn("{task.description}"))
            self.bar.start()
            self.task = self.bar.add_task("compiling", total=self.total)
        return self

    def __exit__(self, *_):
        signal.signal(signal.SIGINT, self.handler)
        if self.bar:
            self.bar.stop()

    def show(self, row, speed):
        shown = {name: row[name] for name in self.SHOWN if name in row}
        text = f"{row['env_steps'] / 1e6:.2f}M steps  {speed:,.0f}/s  {line(shown)}"
        if self.bar:
            self.bar.update(self.task, completed=row["iteration"], description=text)
        else:
            print(f"{row['seconds']:6.0f} s  {text}", flush=True)
