"""The benchmark measures, reports reasons for failures, and refuses bad arguments."""

import json
import time
from types import SimpleNamespace

import pytest

from experiment import records
from tools import bench


def test_a_figure_from_a_process_of_its_own():
    row = bench.in_process(120, "stepping", "go1_loco", "c", 4, False)
    assert row["steps/s"] > 0 and row["compile s"] > 0 and row["MiB"] > 50


def test_a_failure_gives_its_reason():
    assert "unknown task" in bench.in_process(120, "stepping", "go2_loco", "c", 4, False)["failed"]
    assert bench.in_process(0.01, "stepping", "go1_loco", "c", 4, False)["failed"].startswith("did not end in")


def test_what_takes_too_long_ends_with_all_that_it_started(tmp_path, monkeypatch):
    """Fault: a training goes on while the next figures are measured."""
    program, sign = tmp_path / "python", tmp_path / "alive"
    program.write_text(f"#!/bin/sh\n(sleep 1; touch {sign}) &\nwait\n")
    program.chmod(0o755)
    monkeypatch.setattr(bench.sys, "executable", str(program))
    assert "did not end" in bench.in_process(0.1, "training", "go1_loco")["failed"]
    time.sleep(1.2)
    assert not sign.exists()


def test_page_has_every_row(tmp_path):
    rows = [{"task": "go1_loco", "envs": 4, "steps/s": 12345.6}, {"task": "g1_loco", "failed": "did not end in 1 s"}]
    (tmp_path / "cpu.json").write_text(json.dumps({"engines": {"machine": {"cores": 2}, "rows": rows}}))
    bench.write_page(tmp_path)
    lines = (tmp_path / "README.md").read_text().splitlines()
    assert "| go1_loco | 4 | 12,346 |  |" in lines and "| g1_loco |  |  | did not end in 1 s |" in lines


def test_ratios():
    speeds = (("ours", 1, 100.0), ("a", 1, 50.0), ("ours", 2, 60.0), ("b", 2, 20.0), ("c", 2, None))
    rows = [{"what": what, "hidden": [width]} | ({"steps/s": v} if v else {}) for what, width, v in speeds]
    ratios = [(row.get("ours"), row.get("ours, small")) for row in bench.with_ratios(rows)]
    assert ratios == [(1.0, 1.0), (2.0, 2.0), (1.0, 100 / 60), (3.0, 5.0), (None, None)]


def test_training_is_measured_at_the_scale_of_the_device(monkeypatch):
    """A CPU trains 512 environments on engine c; an accelerator each number of them on each engine."""
    monkeypatch.setattr(bench, "in_process", lambda *inputs: {"asked": inputs[2:]})
    args = bench.Args(tasks=("go1_loco",), engines=("mjx", "warp"), counts=(1024, 4096))
    asked = [row["asked"] for row in bench.training_rows(args)]
    assert asked == [("go1_loco", 512, None, 1, ("--engine", "c"))]
    monkeypatch.setattr(bench.jax, "default_backend", lambda: "gpu")
    asked = [(row["engine"], row["asked"][1], row["asked"][4][1]) for row in bench.training_rows(args)]
    assert asked == [("mjx", 1024, "mjx"), ("mjx", 4096, "mjx"), ("warp", 1024, "warp"), ("warp", 4096, "warp")]


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"tasks": ("go2_loco",)}, "unknown task 'go2_loco'"), ({"parts": ("peers",)}, "--peers PYTHON.*tools/peers.py")],
)
def test_bad_arguments(changes, words):
    with pytest.raises(records.UserError, match=words):
        bench.main(bench.Args(**changes))


def test_the_peers_command_names_a_script(monkeypatch):
    """It is started in the repository's root by another Python, so a wrong path would show only there."""
    commands = []

    def run(command, cwd, **_):
        commands.append((cwd / command[1]).exists())
        return SimpleNamespace(returncode=1, stderr="torch is missing\n")

    monkeypatch.setattr(bench.subprocess, "run", run)
    assert bench.run_peer(bench.Args(peers="python"), ["rsl_rl"]) == {"failed": "torch is missing"}
    assert commands == [True]
