"""Train a task, evaluate it, and keep the small files of the run: what tasks.py and study.py share."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def finetune(words, log=None):
    """Run ppo_finetune.py with these arguments; its output goes to the open file `log`, else to the terminal."""
    subprocess.run([sys.executable, "ppo_finetune.py", *words], cwd=ROOT, check=True, stdout=log, stderr=log)


def evaluate(task, run, kept, names, log=None):
    """Evaluate the policy of runs/<run> and copy the files `names` of it to the folder `kept`."""
    finetune(["--task", task, "--eval", f"runs/{run}/policy.msgpack"], log)
    kept.mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copy(ROOT / "runs" / run / name, kept / name)
