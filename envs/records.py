"""Run folders, policy files, progress and curves: what scripts write down, and how they report it.

Every file is replaced in one step, so that a stopped run leaves none half-written.
"""

import contextlib
import csv
import dataclasses
import functools
import io
import json
import os
import platform
import signal
import subprocess
import sys
import types
import typing
from pathlib import Path

import flax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np


class UserError(Exception):
    """Bad input: printed as one line, exit code 2."""


@contextlib.contextmanager
def one_line_errors():
    """What a user can mend ends the program with one line and exit code 2, Ctrl-C before the first row with 1."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        what = str(error).splitlines()[0][:120]
        print(f"error: out of memory; lower --num-envs or --num-seeds, in stage 2 --batch ({what})", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit("interrupted")


@functools.cache
def versions():
    """What a run must name to be repeatable, as it was when the process first asked."""
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


def replace_bytes(path, blob):
    """Write a whole file in one step: after a crash or a loss of power the old or the new one is there, whole.

    UserError if it cannot be written; the old one stays.
    """
    tmp = path.with_name(path.name + ".tmp")
    try:
        with tmp.open("wb") as file:
            file.write(blob)
            file.flush()
            os.fsync(file.fileno())
        tmp.replace(path)
    except OSError as error:
        tmp.unlink(missing_ok=True)
        raise UserError(f"cannot write {path}: {error.strerror}; the files of the last row are untouched") from None


def replace_text(path, text):
    replace_bytes(path, text.encode())


def check_positive(args, names):
    """UserError unless these arguments are at least 1."""
    for name in names:
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1, not {getattr(args, name)}")


def check_minibatches(args):
    """UserError unless the minibatches divide a rollout, and devices and blocks its environments."""
    size, count = args.num_envs * args.num_steps, jax.device_count()
    if args.num_envs % args.shuffle_blocks or args.num_envs % count:
        raise UserError(
            f"{args.num_envs} environments cannot be split over {count} devices in {args.shuffle_blocks} blocks; "
            "change --num-envs or --shuffle-blocks"
        )
    if size // args.shuffle_blocks % args.num_minibatches:
        raise UserError(
            f"{args.num_minibatches} minibatches do not divide a rollout of {args.num_envs} environments x "
            f"{args.num_steps} steps = {size}; change --num-minibatches or --num-envs"
        )


def start_runs(each, config, force):
    """start_run in the run_dir of each of these arguments. UserError, and nothing touched, if one is taken."""
    for args in each:
        refuse_overwrite(Path(args.run_dir), force)
    return [start_run(args, config, args.run_dir, force) for args in each]


def refuse_overwrite(out, force):
    """UserError if the folder holds a run, unless `force`."""
    if any((out / name).exists() for name in RESULTS) and not force:
        raise UserError(f"{out} holds a run already; pass --force to overwrite it or --run-dir for another folder")


def start_run(args, config, folder, force):
    """Create the run folder with args.json in it and return it. Refuses to overwrite a run unless `force`.

    args and config (the task's) are dataclasses; both are recorded, with versions, commit and device. Weights
    and measures of an old run go, so that a new one that is stopped early cannot be taken for it.
    """
    out = Path(folder)
    refuse_overwrite(out, force)
    if args.tensorboard:
        tensorboard()  # rather now than when the old run is gone
    record = dataclasses.asdict(args) | {"config": dataclasses.asdict(config), "versions": versions()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (*(out / name for name in (STATE, *RESULTS)), *out.glob("events.out.tfevents.*")):
            old.unlink(missing_ok=True)
        replace_text(out / "args.json", json.dumps(record, indent=1) + "\n")
    except OSError as error:
        raise UserError(f"cannot write to {out}: {error.strerror}") from None
    return out


def save(path, params, meta):
    """Write weights and a JSON-able dict that says what they are, as one msgpack file, in one step."""
    blob = flax.serialization.msgpack_serialize(
        {
            "params": flax.serialization.to_state_dict(jax.device_get(params)),
            "meta": json.dumps(meta | {"versions": versions()}),
        }
    )
    replace_bytes(path, blob)


KINDS = {"policy": {"task", "args"}, "PIDM checkpoint": {"robot", "layout", "history"}}  # and what their meta holds


def load(path, kind):
    """Read what `save` wrote: params and meta. UserError if the file is missing or is not one of that kind."""
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
        params, meta = content["params"], json.loads(content["meta"])
    except OSError as error:
        raise UserError(f"cannot read {kind} {path}: {error.strerror}") from None
    except Exception:  # msgpack has no common error class; whatever it says, the file is not ours
        raise UserError(f"{path} is not a {kind}, or it is damaged") from None
    if not KINDS[kind] <= meta.keys():
        raise UserError(f"{path} is not a {kind}; it holds {', '.join(sorted(meta))}")
    return params, meta


STATE = "state.msgpack"  # in a run folder: what --resume goes on from
RESULTS = (
    "metrics.csv",
    "policy.msgpack",
    "pidm.msgpack",
    "eval.json",
    "validation.json",
    "rollout.png",
    "rollout.gif",
)


def finite(tree):
    """Whether every number of a tree of arrays is."""
    return all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def save_state(out, state, rows):
    """Write all that a run needs to go on to the same bits, and its rows so far, in one step."""
    leaves = jax.device_get([jax.random.key_data(x) if is_key(x) else x for x in jax.tree.leaves(state)])
    blob = flax.serialization.msgpack_serialize(
        {"leaves": {str(i): np.asarray(x) for i, x in enumerate(leaves)}, "rows": json.dumps(rows)}
    )
    replace_bytes(out / STATE, blob)


def load_state(folder, like):
    """State and rows that `save_state` wrote; UserError if there are none, or if the state is not one like `like`."""
    path = Path(folder) / STATE
    wanted, structure = jax.tree.flatten(like)
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
        leaves, rows = [content["leaves"][str(i)] for i in range(len(content["leaves"]))], json.loads(content["rows"])
        same = len(leaves) == len(wanted)
        leaves = [jax.random.wrap_key_data(x) if is_key(w) else x for x, w in zip(leaves, wanted, strict=False)]
        same &= all(x.shape == w.shape and x.dtype == w.dtype for x, w in zip(leaves, wanted, strict=False))
    except OSError as error:
        raise UserError(f"cannot resume from {path}: {error.strerror}") from None
    except Exception:  # msgpack has no common error class; whatever it says, the file is not ours
        raise UserError(f"{path} is damaged; start the run again with --force") from None
    if not same:
        raise UserError(f"{path} was written by other code or settings than these; start the run again with --force")
    return structure.unflatten(leaves), rows


def is_key(x):
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def resumed(args):
    """The arguments of the run in the folder args.resume, which goes on there. UserError if it holds none."""
    path = Path(args.resume) / "args.json"
    try:
        record = json.loads(path.read_text())
        fields = [field for field in dataclasses.fields(args) if field.name in record]
        sane = all(fits(record[field.name], field.type) for field in fields)
    except OSError as error:
        raise UserError(f"cannot resume from {path}: {error.strerror}") from None
    except (ValueError, TypeError, RecursionError):
        sane = False
    if not sane:
        raise UserError(f"{path} is damaged; start the run again")
    found = {f.name: tuple(record[f.name]) if isinstance(record[f.name], list) else record[f.name] for f in fields}
    return type(args)(**found | {"resume": args.resume, "run_dir": args.resume, "force": False})


def fits(value, kind):
    """Whether a value read from JSON is what the annotation of an argument says, and no absurd number."""
    inner = typing.get_args(kind)
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return any(fits(value, one) for one in inner)
    if typing.get_origin(kind) is typing.Literal:
        return value in inner
    if typing.get_origin(kind) is tuple:
        return isinstance(value, list) and len(value) < 100 and all(fits(one, inner[0]) for one in value)
    if kind is float:
        return type(value) in (int, float) and abs(value) < 1e12
    return type(value) is kind and not (kind is int and abs(value) >= 2**31)


def check_shapes(path, params, like):
    """UserError unless params has the leaves and shapes of `like`."""
    shapes = [{jax.tree_util.keystr(k): jnp.shape(v) for k, v in jax.tree.leaves_with_path(t)} for t in (params, like)]
    for name in sorted(shapes[0].keys() | shapes[1].keys()):
        if shapes[0].get(name) != shapes[1].get(name):
            raise UserError(f"{path}: {name} is {shapes[0].get(name)}, this task needs {shapes[1].get(name)}")


def line(row):
    """A row of numbers as text."""
    return "  ".join(f"{name} {float(value):.4g}" for name, value in row.items())


def save_rows(path, rows):
    """Write rows, dicts of the same names, as a whole CSV file in one step."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_text(path, text.getvalue())


def make_row(args, iterations, seconds, metrics):
    """One CSV row from a chunk's metrics (log_every,): means, and means over the episodes that ended."""
    metrics = {name: value.sum() if name.startswith("sum/") else value.mean() for name, value in metrics.items()}
    episodes, falls = metrics.pop("sum/episodes"), metrics.pop("sum/falls")
    ended = {name.removeprefix("sum/"): metrics.pop(name) for name in list(metrics) if name.startswith("sum/")}
    ended = {name: value / max(episodes, 1) for name, value in ({"fall_rate": falls} | ended).items()}
    if not episodes:  # say so, instead of 0
        ended = dict.fromkeys(ended, float("nan"))
    steps = args.num_envs * args.num_steps
    row = {"iteration": iterations, "env_steps": iterations * steps, "seconds": seconds, **ended, **metrics}
    return {name: float(f"{float(value):.6g}") for name, value in row.items()}


def mean_row(rows):
    """Mean of several rows, column by column."""
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def pyplot():
    """matplotlib.pyplot without a display; it is slow to load, so only where something is drawn."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def plot_curves(rows, names, groups, path, over="env_steps"):
    """Draw each named column over column `over`, then each group (title -> names) in one panel."""
    plt = pyplot()
    panels = {name: [name] for name in names} | groups
    steps = [row[over] for row in rows]
    fig, axes = plt.subplots(1, len(panels), figsize=(3.2 * len(panels), 2.8), constrained_layout=True)
    for ax, (title, columns) in zip(axes, panels.items(), strict=True):
        for name in columns:
            ax.plot(steps, [row[name] for row in rows], label=name.split("/")[-1], lw=1)
        if len(columns) > 1:
            ax.legend(fontsize=5)
        ax.set_title(title)
        ax.set_xlabel(over.replace("_", " "))
        ax.grid(alpha=0.3)
    fig.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(fig)


def tensorboard():
    """The package that writes TensorBoard's files; UserError if it is missing."""
    try:
        import tensorboardX
    except ImportError:
        raise UserError("--tensorboard needs tensorboardX: pip install -r requirements-watch.txt") from None
    return tensorboardX


class Reporter:
    """Progress: a live bar on a terminal, else a line a row. Ctrl-C and SIGTERM set `stopped`, to end after a row."""

    def __init__(self, total, names, over="env_steps", board=None):
        """total: iterations of the run; names: the columns to show; over: the column that counts the work done.

        board: a folder for TensorBoard's files, or None.
        """
        self.total, self.names, self.over, self.bar, self.stopped = total, names, over, None, False
        self.warned, self.board = False, tensorboard().SummaryWriter(str(board)) if board else None

    def stop(self, *_):
        self.stopped = True  # an exception could strike inside the physics callback

    def __enter__(self):
        self.handlers = {sign: signal.signal(sign, self.stop) for sign in (signal.SIGINT, signal.SIGTERM)}
        if sys.stdout.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            columns = BarColumn(bar_width=20), TextColumn("{task.percentage:.0f}%"), TimeRemainingColumn()
            self.bar = Progress(*columns, TextColumn("{task.description}"))
            self.bar.start()
            self.task = self.bar.add_task("compiling", total=self.total)
        return self

    def __exit__(self, *_):
        for sign, handler in self.handlers.items():
            signal.signal(sign, handler)
        if self.bar:
            self.bar.stop()
        if self.board:
            self.board.close()

    def show(self, row, speed):
        if row.get("overflow") and not self.warned:
            self.warned = True
            print("warning: the engine had no room for some contacts; raise `contacts` in envs/engine.py")
        for name, value in row.items() if self.board else ():
            self.board.add_scalar(name, value, int(row[self.over]))
        shown = {name: row[name] for name in self.names if name in row}
        text = f"{row[self.over] / 1e6:.2f}M {self.over.removeprefix('env_')}  {speed:,.0f}/s  {line(shown)}"
        if self.bar:
            self.bar.update(self.task, completed=row["iteration"], description=text)
        else:
            print(f"{row['seconds']:6.0f} s  {text}", flush=True)
