"""A run that stops anywhere and is resumed ends with the same bits as one that was not; bad states are refused.

So two runs of one seed, which these are, end with the same bits too.
"""

import csv
import dataclasses
import errno
import functools
import itertools
import json
import os
import shutil
import time

import flax
import jax
import numpy as np
import pytest

import ppo_explore
import ppo_finetune
import pretrain_pidm
from experiment import arguments, records, run

RESULT = {ppo_explore: "action.npy", pretrain_pidm: "pidm.msgpack", ppo_finetune: "policy.msgpack"}


class Interrupted(run.Progress):
    """As if Ctrl-C came during the first row."""

    def show(self, row, speed):
        super().show(row, speed)
        self.stopped = True


def rows_of(folder):
    """metrics.csv without what depends on the clock."""
    with (folder / "metrics.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def weights_of(path):
    """Everything in a result file but what names the run."""
    if path.suffix == ".npy":
        return {name: np.load(path.with_name(f"{name}.npy")) for name in ("x", "lin_vel", "action", "first", "rough")}
    return flax.serialization.msgpack_restore(path.read_bytes())["params"]


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    out = tmp_path_factory.mktemp("resume") / "data"
    args = ppo_explore.Args(preset="smoke", total_steps=1600, ensemble_batch=64, seed=3, run_dir=str(out))
    ppo_explore.main(args)
    return out, args


@pytest.fixture(scope="module")
def whole(collection, tmp_path_factory):
    """whole(script): folder of a finished run and its arguments, cached."""

    @functools.cache
    def finished(script):
        if script is ppo_explore:
            return collection
        changes = {"data": str(collection[0])} if script is pretrain_pidm else {}
        out = tmp_path_factory.mktemp("whole") / "run"
        args = script.Args(preset="smoke", seed=3, run_dir=str(out), **changes)
        script.main(args)
        return out, args

    return finished


@pytest.mark.parametrize("script", RESULT, ids=lambda script: script.__name__)
def test_resumed_run_has_the_same_bits(script, whole, tmp_path, monkeypatch):
    want, args = whole(script)
    broken = tmp_path / "broken"
    with monkeypatch.context() as patch:
        patch.setattr(run, "Progress", Interrupted)
        script.main(dataclasses.replace(args, run_dir=str(broken)))
    assert len(rows_of(broken)) == 1 < len(rows_of(want))
    script.main(script.Args(resume=str(broken)))
    assert rows_of(broken) == rows_of(want)
    jax.tree.map(np.testing.assert_array_equal, *(weights_of(folder / RESULT[script]) for folder in (want, broken)))


def test_every_iteration_of_a_collection_is_stored(collection):
    """50 of them in two chunks: gravity is a unit vector in every row, and no rollout comes twice."""
    x = np.load(collection[0] / "x.npy")
    np.testing.assert_allclose(np.linalg.norm(x[..., 3:6], axis=-1), 1.0, atol=1e-5)
    assert len(x) == 50 == len(np.unique(x.reshape(50, -1), axis=0))


def test_the_time_before_a_resume_counts(tmp_path):
    one = run.Run(ppo_finetune.Args(run_dir=str(tmp_path)), None, 10, ())
    one.rows = [[{"seconds": 100.0}]]
    with one:
        assert 100 <= one.seconds() < 200


def test_full_disk_ends_in_one_line_and_loses_nothing(whole, tmp_path, refused, monkeypatch):
    """The disk is full when the second row is written: one line; with room again --resume ends with the same bits."""
    want, args = whole(ppo_finetune)
    out, synced, sync = tmp_path / "full", [], os.fsync

    def full(file):
        synced.append(file)
        if len(synced) > 4:  # args.json; then metrics.csv, policy.msgpack and state.msgpack of the first row
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(file)

    monkeypatch.setattr(os, "fsync", full)
    broken = dataclasses.replace(args, run_dir=str(out), save_minutes=0.0)
    refused(ppo_finetune.main, broken, "cannot write", "No space left on device")
    assert len(rows_of(out)) == 1 and not list(out.glob("*.tmp"))
    monkeypatch.setattr(os, "fsync", sync)
    ppo_finetune.main(ppo_finetune.Args(resume=str(out)))
    assert rows_of(out) == rows_of(want)
    jax.tree.map(np.testing.assert_array_equal, *(weights_of(f / "policy.msgpack") for f in (want, out)))


def test_a_clock_that_jumps_changes_nothing_but_the_seconds(whole, tmp_path, monkeypatch):
    """The machine's clock goes back a day, then on by two: rows, weights and what --resume needs are as without it."""
    want, args = whole(ppo_finetune)
    jumps, clock, wall = itertools.cycle([0.0, -86_400.0, 86_400.0]), time.perf_counter, time.time
    for name, true in (("perf_counter", clock), ("time", wall), ("monotonic", time.monotonic)):
        monkeypatch.setattr(time, name, lambda true=true: true() + next(jumps))
    out = tmp_path / "jumps"
    ppo_finetune.main(dataclasses.replace(args, run_dir=str(out)))
    monkeypatch.undo()
    assert rows_of(out) == rows_of(want)
    jax.tree.map(np.testing.assert_array_equal, *(weights_of(f / "policy.msgpack") for f in (want, out)))
    states = [flax.serialization.msgpack_restore((f / records.STATE).read_bytes())["leaves"] for f in (want, out)]
    jax.tree.map(np.testing.assert_array_equal, *states)


def test_stage_two_of_a_robot_from_a_file_goes_on(tmp_path):
    """Its args.json holds the body, but the script has no --robot."""
    args = dataclasses.asdict(pretrain_pidm.Args(run_dir=str(tmp_path)))
    record = args | {"config": {"body": {"digest": "d"}}, "versions": {}}
    (tmp_path / "args.json").write_text(json.dumps(record))
    resumed = arguments.resumed(pretrain_pidm.Args(resume=str(tmp_path)))
    assert resumed.run_dir == str(tmp_path) and resumed.epochs == args["epochs"]


def test_what_cannot_be_resumed_is_refused(whole, tmp_path, refused):
    def check(*words, folder=tmp_path / "run"):
        refused(ppo_finetune.main, ppo_finetune.Args(resume=str(folder)), *words)

    check("cannot resume from", "No such file", folder=tmp_path / "none")
    out = tmp_path / "run"
    shutil.copytree(whole(ppo_finetune)[0], out)
    record, state = json.loads((out / "args.json").read_text()), (out / records.STATE).read_bytes()
    (out / records.STATE).write_bytes(state[:-50])
    check("is damaged")
    (out / records.STATE).write_bytes(state)
    (out / "args.json").write_text(json.dumps(record | {"num_envs": 8}))
    check("other code or settings")
    content = flax.serialization.msgpack_restore(state)
    content["leaves"].pop(str(len(content["leaves"]) - 1))
    (out / "args.json").write_text(json.dumps(record))
    (out / records.STATE).write_bytes(flax.serialization.msgpack_serialize(content))
    check("other code or settings")
    (out / records.STATE).write_bytes(state)
    (out / "args.json").write_text("{")
    check("args.json is damaged")
    (out / "args.json").write_text(json.dumps(record | {"lr": "fast"}))
    check("args.json is damaged")
    assert (out / records.STATE).read_bytes() == state


@pytest.mark.parametrize("script", RESULT, ids=lambda script: script.__name__)
def test_arguments_of_another_version_are_refused(script, tmp_path, refused):
    """A name that is unknown today, or one that was unknown then, is named and never filled in silently."""
    record = dataclasses.asdict(script.Args()) | {"config": {}, "versions": {}}
    missing = {name: value for name, value in record.items() if name != "seed"}
    for content, name in (
        (record | {"core_scale": 1.0}, "core_scale"),
        (missing, "seed"),
        (missing | {"warm": 1}, "seed, warm"),
    ):
        (tmp_path / "args.json").write_text(json.dumps(content))
        refused(script.main, script.Args(resume=str(tmp_path)), "args.json is of another version", f"in {name};")
    assert [path.name for path in tmp_path.iterdir()] == ["args.json"]


@pytest.mark.parametrize(
    ("script", "changes", "flag"),
    [
        (ppo_finetune, {"lr": 1e-4}, "--lr"),
        (ppo_finetune, {"set": ("noise=0.5",)}, "--set"),
        (ppo_finetune, {"run_dir": "elsewhere"}, "--run-dir"),
        (ppo_finetune, {"robust": True}, "--robust"),
        (ppo_explore, {"num_envs": 8}, "--num-envs"),
        (pretrain_pidm, {"mirror": False}, "--mirror"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_second_argument_beside_resume_is_refused(script, changes, flag, tmp_path, refused):
    refused(script.main, script.Args(resume=str(tmp_path), **changes), f"{flag} cannot change with --resume")
    assert not list(tmp_path.iterdir())
