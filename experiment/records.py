"""Files of a run: arguments, checkpoints, the state for --resume, rows of numbers. And errors that a user can mend.

Every file is replaced in one step, so that a stopped run leaves none half-written.
"""

import contextlib
import csv
import dataclasses
import functools
import importlib.metadata
import io
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
import numpy as np

import envs
from envs.config import fits
from envs.engine import cpu_count

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

ROOT = Path(__file__).resolve().parent.parent


class UserError(Exception):
    """Bad input: printed as one line, exit code 2."""


@contextlib.contextmanager
def one_line_errors():
    """Errors of user or machine print one line and exit with code 2. An early Ctrl-C or SIGTERM exits with code 1."""
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal may lack the letters of a path
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    except (UserError, OSError, MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, BrokenPipeError):  # the reader of our output, as in `| head`, has left
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115, for the rest of the process
            sys.exit(1)
        print(f"error: {in_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit("interrupted")
    finally:
        signal.signal(signal.SIGTERM, previous)
        while CLAIMS:
            os.close(CLAIMS.popitem()[1])


def in_one_line(error):
    """A message for an error of user or machine; any other is raised again."""
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, OSError):
        nameless = "the working directory" if isinstance(error, FileNotFoundError) else "the system"  # of os.getcwd
        return f"{error.filename or nameless}: {error.strerror or error}"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        what = str(error).split("\n")[0][:120]
        return f"out of memory; lower --num-envs or --num-seeds, in stage 2 --batch ({what})"
    raise error


CLAIMS = {}  # run folder -> descriptor, whose lock keeps other processes out


def claim(folder):
    """Keep other processes from writing a run folder until this one is done. UserError if another one is at it."""
    path = Path(folder).resolve()
    if fcntl is None or path in CLAIMS or not path.is_dir():
        return
    file = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise UserError(f"another process is writing {folder}; wait for it, or choose another --run-dir") from None
    except OSError:  # a file system without locks
        pass
    CLAIMS[path] = file


@functools.cache
def versions():
    """Commit, device and versions, read once per process."""
    return {
        "commit": commit(),
        "device": jax.devices()[0].device_kind,
        "machine": f"{platform.machine()}, {cpu_count()} CPUs",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": importlib.metadata.version("mujoco"),
    }


def commit():
    """Commit of the project, with -dirty if files differ; "unknown" without git or where it is no checkout."""

    def git(*words):
        clean = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
        run = subprocess.run(["git", *words], cwd=ROOT, env=clean, capture_output=True, check=True)
        return os.fsdecode(run.stdout).strip()

    try:
        inside = Path(git("rev-parse", "--show-toplevel")).resolve() == ROOT  # not a copy within another checkout
        return git("describe", "--always", "--dirty", "--abbrev=12") if inside else "unknown"
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def replace_bytes(path, blob):
    """Write a file in one step: after a crash or a loss of power it is the old or the new one, whole.

    UserError if it cannot be written; the old one stays.
    """
    if path.exists() and not path.is_file():  # /dev/null would become a file
        raise UserError(f"cannot write {path}: it is {'a folder' if path.is_dir() else 'not a file'}")
    tmp = path.with_name(path.name + ".tmp")
    try:
        with tmp.open("wb") as file:
            file.write(blob)
            file.flush()
            os.fsync(file.fileno())
        tmp.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            tmp.unlink()
        before = "; what it held before is untouched" if path.exists() else ""
        raise UserError(f"cannot write {path}: {error.strerror}{before}") from None


def write(path, blob):
    """`replace_bytes` where the folder may be missing."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from None
    replace_bytes(path, blob)


def replace_text(path, text):
    """`replace_bytes` for text, in UTF-8."""
    replace_bytes(path, text.encode())


ABOVE_0 = ("lr", "max_lr", "ensemble_lr", "desired_kl", "init_std", "clip", "max_grad_norm")  # flags of all scripts


def filled(args, values):
    """The arguments with fields that are None filled in from `values`; UserError unless all counts are at least 1.

    Seeds are at least 0 and fit into 32 bits, since JAX drops the bits above. Counts are below 1e12, as --resume wants
    them. Step sizes and stds are above 0.
    """
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    for name, value in dataclasses.asdict(args).items():
        flag = f"--{name.replace('_', '-')}"
        least, most = (0, 2**32 - getattr(args, "num_seeds", 1) + 1) if name == "seed" else (1, 10**12)
        for number in value if type(value) is tuple else (value,):
            if type(number) is int and not least <= number < most:
                raise UserError(f"{flag} must be at least {least}, not {number}, and below {most}")
        if name in ABOVE_0 and not value > 0:
            raise UserError(f"{flag} must be above 0, not {value}")
    return args


def check_minibatches(args):
    """Return args. UserError unless the minibatches divide a rollout, and devices and blocks its environments."""
    size, count = args.num_envs * args.num_steps, jax.device_count()
    if args.num_envs % args.shuffle_blocks or args.num_envs % count:
        raise UserError(
            f"{args.num_envs} environments cannot be split over {count} devices in {args.shuffle_blocks} blocks; "
            "change --num-envs or --shuffle-blocks"
        )
    if size // args.shuffle_blocks % args.num_minibatches:
        raise UserError(
            f"{args.num_minibatches} minibatches do not divide the {size // args.shuffle_blocks} samples of a block: "
            f"{args.num_envs} environments x {args.num_steps} steps / {args.shuffle_blocks}; "
            "change --num-minibatches or --num-envs"
        )
    return args


def start_runs(each, config):
    """Create the folder of each of these arguments, with args.json. UserError, and nothing touched, if one is taken.

    args and config (the task's) are dataclasses; both are recorded, with versions, commit and device. Results of an
    older run are removed, so that a new one that is stopped early cannot be taken for it.
    """
    for args in each:
        if any((Path(args.run_dir) / name).exists() for name in (*RESULTS, "meta.json")) and not args.force:
            raise UserError(
                f"{args.run_dir} holds a run; pass --force to overwrite it, or --run-dir for another folder"
            )
        claim(args.run_dir)
        if args.tensorboard:
            tensorboard()  # a missing package must show before the old run is gone
    for args in each:
        folder = Path(args.run_dir)
        record = dataclasses.asdict(args) | {"config": dataclasses.asdict(config), "versions": versions()}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            claim(folder)
            boards = (folder, folder.parent) if len(each) > 1 else (folder,)  # several seeds share one
            events = [path for board in boards for path in board.glob("events.out.tfevents.*")]
            for old in (*(folder / name for name in (STATE, *RESULTS)), *events):
                old.unlink(missing_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}") from None
        replace_text(folder / "args.json", json.dumps(record, indent=1) + "\n")


def tensorboard():
    """The package that writes TensorBoard's files; UserError if it is missing."""
    try:
        import tensorboardX
    except ImportError:
        raise UserError("--tensorboard needs tensorboardX: pip install -r requirements-watch.txt") from None
    return tensorboardX


def save(path, params, meta):
    """Write weights and a JSON-able dict that describes them as one msgpack file."""
    blob = flax.serialization.msgpack_serialize(
        {
            "params": flax.serialization.to_state_dict(jax.device_get(params)),
            "meta": json.dumps(meta | {"versions": versions()}),
        }
    )
    replace_bytes(path, blob)


KINDS = {"policy": {"task", "args"}, "PIDM checkpoint": {"robot", "layout", "history"}}  # names in their meta


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


STATE = "state.msgpack"  # in a run folder; --resume starts from it
RESULTS = (
    "metrics.csv",
    "policy.msgpack",
    "pidm.msgpack",
    "eval.json",
    "validation.json",
    "rollout.png",
    "rollout.gif",
    "nan.npz",
    "curve.png",
    "beside_recorded.png",
    "accuracy.png",
    "distribution.png",
)


def load_networks(path, like, env):
    """Params of a policy file, but with the action std of `like`. UserError if it lacks the leaves and shapes of that.

    A trained policy has a small std, with which it would hardly explore. UserError also if it is of another robot,
    body, observation or network.
    """
    params, meta = load(Path(path), "policy")
    family, config = (envs.TASKS | envs.OWN).get(meta["task"], (None, None))  # robots from a file differ in body
    if config and config.robot != env.robot.name:
        raise UserError(f"{path} is a policy for robot {config.robot}, here is robot {env.robot.name}")
    if family and [*family.OBS] != [*type(env).OBS]:  # of as many numbers, say
        raise UserError(f"{path} sees {', '.join(family.OBS)}; this task has {', '.join(type(env).OBS)}")
    here = "pidm" if "normalizer" in like else "mlp"
    network = meta["args"].get("network", here)
    if network != here:
        raise UserError(f"{path} has the network {network}; give --network {network}")
    check_body(path, meta, env)
    check_shapes(path, params, like)
    params = jax.tree.map(jnp.asarray, params)
    return params | {"params": params["params"] | {"log_std": like["params"]["log_std"]}}


def load_pidm(path, env, like):
    """Params and normalizer of a PIDM checkpoint, of which the parts in `like` (same keys) are returned.

    UserError if it was made for another robot, layout of x or K, or if a part has other shapes.
    """
    if not path.exists():
        ways = "--pretrained names one; with --load-into none only its input normalisation is used"
        raise UserError(f"cannot read PIDM checkpoint {path}: No such file or directory; {ways}")
    content, meta = load(path, "PIDM checkpoint")
    ours = {"robot": env.robot.name, "layout": list(env.prop_layout), "history": env.config.history}
    since = {"action_scale": list(env.robot.action_scale), "dt": env.dt}  # older checkpoints do not say
    for name, here in (ours | {name: x for name, x in since.items() if meta.get(name) is not None}).items():
        if meta[name] != here:
            raise UserError(f"{path} was made for {name} {meta[name]}, here is {name} {here}")
    check_body(path, meta, env)
    parts = {kind: {name: x for name, x in content.get(kind, {}).items() if name in like[kind]} for kind in like}
    check_shapes(path, parts, like)
    return parts


def check_body(path, meta, env):
    """UserError if a checkpoint is of another body than the environment's robot, by their digests."""
    theirs, ours = (body.get("digest", "none: a shipped robot") for body in (meta.get("body", {}), env.config.body))
    if theirs != ours:
        raise UserError(f"{path} was made for another body: its digest is {theirs}, here it is {ours}")


def read_rows(path):
    """Rows of numbers that `save_rows` wrote to a metrics.csv."""
    with path.open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def finite(tree):
    """True if every number of a tree of arrays is finite."""
    return all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def save_state(out, state, rows):
    """Write the whole state of a run, from which it goes on to the same bits, and its rows so far."""
    leaves = jax.device_get([jax.random.key_data(x) if is_key(x) else x for x in jax.tree.leaves(state)])
    blob = flax.serialization.msgpack_serialize(
        {"leaves": {str(i): np.asarray(x) for i, x in enumerate(leaves)}, "rows": json.dumps(rows)}
    )
    replace_bytes(out / STATE, blob)


def load_state(folder, like):
    """State and rows that `save_state` wrote. UserError if there are none, or not with the leaves of `like`."""
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
    """True for arrays of random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def resumed(args, *may_change):
    """The arguments of the run in the folder args.resume, to go on with; those named in may_change can be given anew.

    UserError if the folder has no run, or one with other arguments than today's, or if more arguments are given.
    """
    path, fields = Path(args.resume) / "args.json", dataclasses.fields(args)
    flags = [word.split("=")[0][2:].replace("-", "_") for word in sys.argv[1:] if word.startswith("--")]
    typed = {flag.removeprefix("no_") for flag in flags}  # also those with the value of the default
    given = {f.name: getattr(args, f.name) for f in fields if f.name in typed or getattr(args, f.name) != f.default}
    for name in sorted(given.keys() - {"resume", *may_change}):
        raise UserError(f"--{name.replace('_', '-')} cannot change with --resume; leave it out, or start a new run")
    try:
        record = json.loads(path.read_text())
        names = record.keys() - {"config", "versions"}
        other = sorted(names ^ {field.name for field in fields})
        intact = bool(other) or all(fits(record[field.name], field.type) for field in fields)
        from_file = bool(record.get("config", {}).get("body"))
    except OSError as error:
        raise UserError(f"cannot resume from {path}: {error.strerror}") from None
    except (ValueError, TypeError, AttributeError, RecursionError):
        intact = False
    if not intact:
        raise UserError(f"{path} is damaged; start the run again")
    if other:
        raise UserError(
            f"{path} is of another version or stage, which differs in {', '.join(other)[:99]}; start the run again"
        )
    found = {f.name: tuple(record[f.name]) if isinstance(record[f.name], list) else record[f.name] for f in fields}
    found |= {"robot": str(path)} if from_file and "robot" in found else {}  # the file may have changed since
    return type(args)(**found | given | {"resume": args.resume, "run_dir": args.resume, "force": False})


def extend(args):
    """Record in args.json that the run args.resume goes on to another total_steps."""
    path = Path(args.resume) / "args.json"
    record = json.loads(path.read_text())
    if record.get("total_steps") != getattr(args, "total_steps", None):
        replace_text(path, json.dumps(record | {"total_steps": args.total_steps}, indent=1) + "\n")


def check_shapes(path, params, like):
    """UserError unless params has the leaves and shapes of `like`, named after the file `path`."""
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
