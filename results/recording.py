"""Train a task, evaluate its policy and copy the run's small files, for tasks.py and study.py."""

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


def evaluate(run, folder, names, log=None):
    """Evaluate the policy of runs/<run>, and copy the files `names` of the run to `folder`."""
    run_script(["play.py", f"runs/{run}/policy.msgpack"], log)
    for name in names:
        records.write(folder / name, (ROOT / "runs" / run / name).read_bytes())
