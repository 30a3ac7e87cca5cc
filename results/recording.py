"""Train a task, evaluate it, and keep the small files of the run: what tasks.py and study.py share."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path

from envs import records

ROOT = Path(__file__).resolve().parent.parent


def finetune(words, log=None, seconds=None):
    """Run ppo_finetune.py with these arguments; its output goes to the open file `log`, else to the terminal.

    After `seconds` it is asked to stop, as when this process is. Returns whether it came to its end by itself.
    UserError if it fails.
    """
    process = subprocess.Popen([sys.executable, "ppo_finetune.py", *words], cwd=ROOT, stdout=log, stderr=log)
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
        raise records.UserError(f"ppo_finetune.py {' '.join(words)} ended with exit code {code}{where}")
    return True


def evaluate(task, run, kept, names, log=None):
    """Evaluate the policy of runs/<run> and copy the files `names` of it to the folder `kept`."""
    finetune(["--task", task, "--eval", f"runs/{run}/policy.msgpack"], log)
    kept.mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copy(ROOT / "runs" / run / name, kept / name)
