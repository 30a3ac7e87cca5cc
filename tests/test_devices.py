"""Two devices, and two processes, do what one device does. Engine mjx, tiny sizes, CPU devices."""

import csv
import dataclasses
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import tyro

import ppo_explore
import ppo_finetune as script
import pretrain_pidm
from experiment import checkpoints

ROOT = Path(__file__).resolve().parent.parent
SMOKE = ("--preset", "smoke", "--engine", "mjx", "--num-envs", "8", "--log-every", "2", "--shuffle-blocks", "2")
TWO = "--xla_force_host_platform_device_count=2"


def start(words, flags="", **variables):
    """A script in a process of its own."""
    environ = os.environ | variables | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {flags}"}
    command = [sys.executable, *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(*processes):
    """Wait for processes that must succeed. Returns what they printed."""
    outputs = [process.communicate(timeout=900) for process in processes]
    for process, (_, err) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, err
    return [out for out, _ in outputs]


def here(module, words):
    """The same in this process, which has one device."""
    assert jax.device_count() == 1
    module.main(tyro.cli(module.Args, args=[str(word) for word in words[1:]]))


def hosts(words):
    """Two processes on loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    known = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    return [start([*words, "--distributed"], **known, JAX_PROCESS_ID=str(i)) for i in range(2)]


def weights(path, kind):
    """All numbers of a checkpoint in one vector."""
    leaves = []

    def collect(tree):
        for name in sorted(tree):
            collect(tree[name]) if isinstance(tree[name], dict) else leaves.append(np.ravel(tree[name]))

    collect(checkpoints.load(path, kind)[0])
    return np.concatenate(leaves)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_envs": 5}, ["5 environments cannot be split over 2 devices"]),
        ({"shuffle_blocks": 3}, ["in 3 blocks"]),
        ({"shuffle_blocks": 0}, ["--shuffle-blocks must be at least 1, not 0"]),
        ({"shuffle_blocks": -1}, ["--shuffle-blocks must be at least 1, not -1"]),
        ({"engine": "c"}, ["engine c works on one device, here are 2"]),
    ],
)
def test_what_cannot_be_split_is_refused(changes, words, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    args = script.Args(preset="smoke", engine="mjx", run_dir=str(tmp_path / "run"))
    refused(script.main, dataclasses.replace(args, **changes), *words)
    assert not (tmp_path / "run").exists()


def test_strangers_are_refused():
    """--distributed where nothing says who this process is; in a process of its own, for JAX must not have started."""
    process = start(["ppo_finetune.py", "--distributed"])
    _, err = process.communicate(timeout=600)
    assert process.returncode == 2 and err.startswith("error: --distributed: ") and "experiment/devices.py" in err, err


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A collection of one process and one of two, on engine mjx; and what the two processes printed."""
    out = tmp_path_factory.mktemp("devices")
    collect = ["ppo_explore.py", "--robot", "go1", *SMOKE, "--set", "rough=0", "--total-steps", "128", "--run-dir"]
    here(ppo_explore, [*collect, out / "one"])
    return out, finish(*hosts([*collect, out / "hosts"]))


def test_training_on_two_devices_is_training_on_one(tmp_path):
    """Sums over environments are made in another order: single precision and Adam's first steps allow 1e-4."""
    train = ["ppo_finetune.py", "--task", "go1_loco", *SMOKE, "--run-dir"]
    here(script, [*train, tmp_path / "one"])
    finish(start([*train, tmp_path / "two"], TWO))
    policies = [weights(tmp_path / name / "policy.msgpack", "policy") for name in ("one", "two")]
    np.testing.assert_allclose(*policies, atol=1e-4)
    rows = [list(csv.DictReader((tmp_path / name / "metrics.csv").open())) for name in ("one", "two")]
    for name in ("reward", "kl", "value_loss", "actor_grad_norm"):
        np.testing.assert_allclose(*(float(row[-1][name]) for row in rows), rtol=1e-3)


def test_two_hosts_collect_and_learn_as_one(runs):
    """Data of the first chunk, and what PPO learned in it: losses, KL, gradients."""
    out, _ = runs
    arrays = [np.load(out / name / "x.npy") for name in ("one", "hosts")]
    np.testing.assert_allclose(arrays[0][0], arrays[1][0], atol=1e-3)  # joint velocities are of order 5
    assert np.abs(arrays[0] - arrays[1]).mean() < 0.01
    rows = [list(csv.DictReader((out / name / "metrics.csv").open())) for name in ("one", "hosts")]
    for name in ("reward", "kl", "value_loss", "actor_grad_norm", "disagreement", "ensemble_nll"):
        np.testing.assert_allclose(*(float(row[-1][name]) for row in rows), rtol=1e-2)


def test_only_the_first_host_prints_and_writes(runs):
    out, printed = runs
    assert "wrote" in printed[0] and not any(word in printed[1] for word in ("wrote", "go1:", "steps"))
    hosts, one = ({path.name for path in (out / name).iterdir()} for name in ("hosts", "one"))
    assert hosts == one and "meta.json" in one


def test_stage_two_on_two_devices_is_stage_two_on_one(runs, tmp_path):
    pretrain = ["pretrain_pidm.py", "--data", runs[0] / "one", "--preset", "smoke", "--run-dir"]
    here(pretrain_pidm, [*pretrain, tmp_path / "a"])
    finish(start([*pretrain, tmp_path / "b"], TWO))
    checkpoints = [weights(tmp_path / name / "pidm.msgpack", "PIDM checkpoint") for name in "ab"]
    np.testing.assert_allclose(*checkpoints, atol=1e-4)
