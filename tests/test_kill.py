"""kill -9 at a random moment: what a script left can be read, and --resume goes on from it, as often as it happens.

KILLS=20 python -m pytest tests/test_kill.py
"""

import csv
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import flax
import numpy as np
import pytest
from test_resume import Interrupted

import ppo_explore
import ppo_finetune
import pretrain_pidm
from experiment import checkpoints, records, run

ROOT = Path(__file__).resolve().parent.parent
KILLS = int(os.environ.get("KILLS", "1"))
ENDLESS = {
    "ppo_explore.py": ("--robot", "go1", "--total-steps", "1000000", "--ensemble-batch", "64", "--save-minutes", "0"),
    "pretrain_pidm.py": ("--epochs", "100000"),
    "ppo_finetune.py": ("--task", "go1_loco", "--total-steps", "100000000", "--save-minutes", "0"),
}
MAIN = {"ppo_explore.py": ppo_explore, "pretrain_pidm.py": pretrain_pidm, "ppo_finetune.py": ppo_finetune}
RESULT = {"pretrain_pidm.py": ("pidm.msgpack", "PIDM checkpoint"), "ppo_finetune.py": ("policy.msgpack", "policy")}


def rows_of(folder):
    """All of metrics.csv; a torn line would have fewer numbers, or some that are none."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.reader(file))
    assert all(len(row) == len(rows[0]) for row in rows)
    assert np.isfinite([float(row[0]) for row in rows[1:]]).all()
    return rows[1:]


def saved_rows(folder):
    """Number of rows in the state from which --resume goes on; the state is whole."""
    content = flax.serialization.msgpack_restore((folder / records.STATE).read_bytes())
    return len(json.loads(content["rows"]))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("kill") / "data"
    ppo_explore.main(ppo_explore.Args(preset="smoke", total_steps=800, ensemble_batch=64, run_dir=str(out)))
    return out


@pytest.mark.parametrize("script", ENDLESS)
def test_killed_at_any_moment(script, data, tmp_path, monkeypatch):
    rng, out, before = random.Random(script), tmp_path / "run", 0
    extra = ("--data", data) if script == "pretrain_pidm.py" else ()
    words = [*ENDLESS[script], *extra, "--preset", "smoke", "--run-dir", out]
    for _ in range(KILLS):
        with subprocess.Popen(
            [sys.executable, script, *map(str, words)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process:
            patience = time.monotonic() + 600
            while not (out / records.STATE).exists() or saved_rows(out) <= before:
                assert process.poll() is None, process.stdout.read().decode()
                assert time.monotonic() < patience, "no new row in ten minutes"
                time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 0.5))
            process.kill()
        assert len(rows_of(out)) >= saved_rows(out) > before
        before = saved_rows(out)
        if script in RESULT:
            name, kind = RESULT[script]
            checkpoints.load(out / name, kind)
        words = ["--resume", out]
    monkeypatch.setattr(run, "Progress", Interrupted)
    MAIN[script].main(MAIN[script].Args(resume=str(out)))
    assert len(rows_of(out)) == before + 1
