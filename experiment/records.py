"""Files of a run: how they are written, what describes it, rows of numbers. And errors that a user can mend.

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

import jax

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


def read_rows(path):
    """Rows of numbers that `save_rows` wrote to a metrics.csv."""
    with path.open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


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
