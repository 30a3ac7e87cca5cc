"""A training that breaks keeps its last good state, from which replay.py finds the robots that failed."""

import csv
from types import SimpleNamespace

import jax
import numpy as np
import optax
import pytest

import envs
import ppo_finetune
from experiment import checkpoints, records
from tools import replay


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished smoke run with a changed config: its folder and last state."""
    out = tmp_path_factory.mktemp("replay") / "run"
    args = ppo_finetune.Args(preset="smoke", engine="c", run_dir=str(out), set=("decimation=5",))
    return out, jax.tree.map(lambda x: x[0], ppo_finetune.train(args))


def test_a_robot_that_fails_is_found_and_dumped(run, capsys):
    """One of four environments is shot into the sky, after a look at the sound run. Forces on bodies come along."""
    out, state = run
    replay.main(replay.Args(str(out), iterations=1))
    assert "nothing failed from iteration 4 to 4" in capsys.readouterr().out and not (out / "nan.npz").exists()
    qvel = state.env_state.physics.qvel.at[2, 2].set(2000.0)
    broken = state.replace(env_state=state.env_state.replace(physics=state.env_state.physics.replace(qvel=qvel)))
    checkpoints.save_state(out, broken, [])
    replay.main(replay.Args(str(out)))
    assert f"iteration {int(state.iteration)}, step 0: 1 of 4 environments failed" in capsys.readouterr().out
    with np.load(out / "nan.npz") as dump:
        assert dump["environment"].tolist() == [2] and dump["task"] == "go1_loco"
        assert dump["qpos"].shape[1:] == (1, 19) and dump["ctrl"].shape[1:] == (1, 12)
        np.testing.assert_array_equal(dump["qvel"][0, 0], qvel[2])
        assert dump["xfrc_applied"].shape[1:] == (1, *state.env_state.physics.wrench.shape[1:])
    replay.main(replay.Args(str(out / "nan.npz")))
    out = capsys.readouterr().out
    assert "environment 2: " in out and out.count("physics step") == 5, "it has the config of the run"


def test_targets_of_a_dump_are_those_of_the_delayed_actions(monkeypatch):
    """All robots act one control step late: the second target is that of the first action."""
    args = ppo_finetune.Args(preset="smoke", engine="c", set=("action_delay=0.02,0.02",))
    env = envs.make(args.task, "c", action_delay=(0.02, 0.02))
    args = ppo_finetune.merge(args, env.config.ppo)
    net, opt = ppo_finetune.make_net(args, env), optax.scale_by_adam()
    state = ppo_finetune.init_state(args, env, net, opt)
    given = jax.random.normal(jax.random.key(0), (3, 4, 12))
    monkeypatch.setattr(ppo_finetune, "rollout", lambda *_: (None, (SimpleNamespace(action=given), None)))
    targets = jax.jit(lambda s: replay.trace(args, env, net, s))(state)[2]
    np.testing.assert_allclose(targets[0], np.tile(env.default_pose, (4, 1)))
    np.testing.assert_allclose(targets[1:], env.default_pose + env.action_scale * given[:-1], atol=1e-6)


def test_weights_that_are_not_finite_stop_the_run_and_keep_the_last_good_state(tmp_path, refused, capsys):
    out = tmp_path / "run"
    args = ppo_finetune.Args(preset="smoke", engine="c", run_dir=str(out), lr=1e11, max_lr=1e11, log_every=1)
    refused(ppo_finetune.main, args, "not finite after iteration", f"tools/replay.py {out}")
    with (out / "metrics.csv").open() as file:
        count = len(list(csv.DictReader(file)))
    replay.main(replay.Args(str(out), iterations=1))
    assert f"iteration {count - 1}: no robot failed, but the update" in capsys.readouterr().out, (
        "it starts before the broken iteration"
    )


def test_bad_dumps_are_refused(tmp_path):
    path = tmp_path / "nan.npz"
    path.write_bytes(b"junk")
    with pytest.raises(records.UserError, match="is not a dump"):
        replay.main(replay.Args(str(path)))
