"""Run a script, see how far its training got, evaluate the policy and copy the small files of a run."""

import json
import signal
import subprocess
import sys
from pathlib import Path

from experiment import records

ROOT = Path(__file__).resolve().parent.parent


def run_script(words, log=None, seconds=None):
    """Run a script with its arguments. Output goes to the open file `log`, else to the terminal.

    After `seconds`, or when this process is stopped, the script is asked to stop. Returns True if it ended by itself.
    UserError if it fails.
    """
    process = subprocess.Popen([sys.executable, *words], cwd=ROOT, stdout=log, stderr=log)
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        return False
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.wait()
    if code:
        where = f"; see {log.name}" if log else ""
        raise records.UserError(f"{' '.join(words)} ended with exit code {code}{where}")
    return True


def share(run):
    """Share of its steps that the training runs/<run> has made, None before its first row."""
    folder = ROOT / "runs" / run
    try:
        total = json.loads((folder / "args.json").read_text())["total_steps"]
        return records.read_rows(folder / "metrics.csv")[-1]["env_steps"] / total
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None


def evaluate(run, folder, names, log=None):
    """Evaluate the policy of runs/<run>, and copy the files `names` of the run to `folder`."""
    run_script(["play.py", f"runs/{run}/policy.msgpack"], log)
    for name in names:
        records.write(folder / name, (ROOT / "runs" / run / name).read_bytes())
