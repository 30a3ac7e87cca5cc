"""Stage 1: exploration environments, the ensemble, and what a collection leaves on disk."""

import dataclasses
import errno
import functools
import json
import os
import signal
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import pytest

import envs
import play
import ppo_explore as script
import ppo_finetune
import pretrain_pidm
from experiment import checkpoints, records
from experiment.progress import Progress

ROOT = Path(__file__).resolve().parent.parent
SMOKE = script.Args(preset="smoke", total_steps=400, ensemble_batch=64)


@pytest.fixture(scope="module")
def go1():
    return envs.make_explore("go1", "c")


# --- environments ---


def test_rough_ground_is_what_a_ray_meets(go1):
    data = mujoco.MjData(go1.model)
    mujoco.mj_forward(go1.model, data)
    xy = np.random.default_rng(0).uniform([5, -10], [25, 10], (500, 2))
    want = np.asarray(go1.ground_height(None, jnp.asarray(xy)))
    for point, height in zip(xy, want, strict=True):
        start = np.array([*point, 5.0])
        distance = mujoco.mj_ray(go1.model, data, start, np.array([0.0, 0, -1]), None, 1, -1, np.zeros(1, np.int32))
        assert abs(5.0 - distance - height) < 0.002
    assert want.max() > 0.05 and want.min() == 0.0


@pytest.fixture(scope="module")
def starts():
    """robot -> its environment and 200 starts, made once."""

    @functools.cache
    def get(robot):
        env = envs.make_explore(robot, "c")
        return env, jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))

    return get


@pytest.mark.parametrize("robot", envs.EXPLORE)
def test_robots_start_on_the_ground(robot, starts):
    """Some episodes start on the plane and some on rough ground; feet are on it, not in it, and masses differ."""
    env = starts(robot)[0]
    physics = starts(robot)[1].physics
    rough = np.asarray(env.on_rough(physics))
    assert 60 < rough.sum() < 140
    data = mujoco.MjData(env.model)
    for qpos in np.asarray(physics.qpos, np.float64):
        data.qpos[:] = qpos
        mujoco.mj_forward(env.model, data)
        feet = np.array([data.site(foot).xpos for foot in env.robot.feet])
        gaps = feet[:, 2] - env.robot.sole - np.asarray(env.ground_height(None, jnp.asarray(feet[:, :2])))
        assert -1e-3 < gaps.min() < 1e-3, gaps
    scales = np.asarray(physics.mass_scale)[:, 2:]
    assert 0.85 <= scales.min() < 0.9 and 1.1 < scales.max() <= 1.15
    assert np.ptp(scales, axis=1).min() > 0.1 and np.ptp(np.asarray(physics.qvel)[:, :6], axis=1).min() > 0, (
        "each its own"
    )
    assert np.ptp(np.asarray(physics.friction)) > 0.7
    qpos, qvel, w = np.asarray(physics.qpos), np.asarray(physics.qvel), env.config.spawn_velocity
    pose, (low, high) = np.array(env.robot.default_pose), env.config.spawn_joints
    factor = qpos[:, 7:][:, pose != 0] / pose[pose != 0]
    np.testing.assert_allclose(np.quantile(factor, [0, 0.5, 1]), [low, (low + high) / 2, high], atol=0.05)
    assert np.ptp(factor, axis=1).min() > (high - low) / 10 and not qvel[:, 6:].any(), "each joint has its own"
    np.testing.assert_allclose(np.quantile(qvel[:, :6], [0, 0.5, 1]), [-w, 0, w], atol=0.2 * w)


def test_rough_ground_has_an_end(go1):
    where = jnp.array([[7.5, 0.0, 0.3], [7.5, 9.0, 0.3], [-1.0, 0.0, 0.3]])
    assert go1.on_rough(SimpleNamespace(qpos=where)).tolist() == [True, False, False]


def test_explorers_are_pushed(starts):
    """Along the ground, by up to 0.5 m/s each way, when it is time."""
    env, state = starts("go1")
    physics, keys = jax.tree.map(lambda x: x[:64], state.physics), jax.random.split(jax.random.key(0), 64)
    push = jax.jit(jax.vmap(env.push, (0, 0, None, None)))
    kicks = [np.asarray(push(keys, physics, 10, at)[0].qvel - physics.qvel) for at in (10, 11)]
    assert 0.45 < np.abs(kicks[0][:, :2]).max() <= 0.5 + 1e-6 and not kicks[0][:, 2:].any() and not kicks[1].any()


@pytest.mark.parametrize("robot", envs.EXPLORE)
def test_todays_exploration_is_that_of_the_shipped_data(robot):
    """Arguments and numbers of the environment are those of the collection that results/pidm records."""
    record = json.loads((ROOT / f"results/pidm/{robot}/explore/meta.json").read_text())
    today = script.merge(script.Args(robot=robot), envs.EXPLORE[robot].ppo), envs.EXPLORE[robot]
    for was, now in zip((record["args"], record["config"]), today, strict=True):
        now = json.loads(json.dumps(dataclasses.asdict(now)))
        same = was.keys() & now.keys() - {"run_dir", "force", "spawn_xy"}
        assert {name: was[name] for name in same} == {name: now[name] for name in same} and len(same) > 20
    held_out = script.num_held_out(today[0])
    assert record["validation_envs"] == [*range(256 - held_out, 256)] and held_out == 20


def test_forces_come_and_go(starts):
    """The perturbing force stays until it changes, and is zero about half the time."""
    go1, state = starts("go1")
    step, seen = jax.jit(jax.vmap(go1.step)), []
    state = jax.tree.map(lambda x: x[:64], state)
    for _ in range(150):
        state = step(state, jnp.zeros((64, 12)))
        seen.append(np.asarray(state.physics.wrench[:, 1, :3]))
    pushed = np.any(np.stack(seen), -1)
    assert 22.0 < np.abs(seen).max() <= 25.0 and 0.2 < pushed[-20:].mean() < 0.56  # half of 1 - 0.99^140: 0.38 +- 0.06
    changes = (np.diff(np.stack(seen), axis=0) != 0).any(-1).mean()
    assert 0.004 < changes < 0.012  # 0.01 a step, of which a quarter is from none to none


def test_engines_agree_on_rough_ground():
    """A robot that stands on the height field for 10 control steps: both engines hold it up at the same place.

    Only that: MJX finds other contact points on the field's edges than C does, and moving robots part from there.
    """
    places = {}
    for engine in ("c", "mjx"):
        env = envs.make_explore("go1", engine, rough=1.0)
        if engine == "c":
            start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 4)).physics
            ground = np.asarray(env.ground_height(None, start.qpos[:, :2]))
        physics, step = start, jax.jit(jax.vmap(env.engine.step))
        for _ in range(10):
            physics = step(physics, jnp.broadcast_to(env.default_pose, (4, 12)))
        places[engine] = np.asarray(physics.qpos[:, :3])
    np.testing.assert_allclose(places["c"], places["mjx"], atol=0.02)
    above = places["c"][:, 2] - ground
    assert np.ptp(above) < np.ptp(ground) / 2, "they stand on the field, not on the plane below it"


# --- ensemble ---


def toy(key, count, spread=1.0):
    """Transitions of a linear system of Go1's sizes: delta = B a."""
    k_a, k_p = jax.random.split(key)
    action = spread * jax.random.normal(k_a, (count, 12))
    matrix = jax.random.normal(jax.random.key(9), (12, 30))
    prop = jax.random.normal(k_p, (count, 6, 30))
    return script.Transitions(prop, jnp.zeros((count, 5, 12)), action @ matrix, action)


@pytest.fixture(scope="module")
def fitted():
    """An ensemble retrained 40 times on the toy system, its error before and after, and its parts."""
    args = dataclasses.replace(SMOKE, members=3, ensemble_batch=128)
    member, opt = script.PIDM(script.MEMBER, 24), optax.adam(1e-3)
    buffer = toy(jax.random.key(0), 2048)
    norm = script.statistics(buffer)
    ensemble = script.init_ensemble(args, member, opt, norm, buffer, jax.random.key(1))
    params = ensemble.params
    retrain = jax.jit(lambda e, k: script.retrain(args, member, opt, e, buffer, 2048, k))
    losses = []
    for i in range(40):
        ensemble, loss = retrain(ensemble, jax.random.key(i))
        losses.append(float(loss))
    return member, params, ensemble, losses, buffer


def test_ensemble_learns_and_disagreement_shrinks(fitted):
    """Its members agree on what they were trained on, and less on actions three times as large."""
    member, params, ensemble, losses, buffer = fitted
    assert losses[-1] < losses[0] - 0.5

    def doubt(weights, batch):
        each = jax.vmap(partial(script.predict, member), (0, None, None))
        return float(script.disagreement(each(weights, ensemble.norm, batch)[0]).mean())

    known, novel = doubt(ensemble.params, buffer), doubt(ensemble.params, toy(jax.random.key(5), 512, spread=3.0))
    assert known < 0.5 * doubt(params, buffer) and novel > 2 * known


def test_equal_members_do_not_disagree(fitted):
    member, params, ensemble, _, buffer = fitted
    same = jax.tree.map(lambda x: jnp.repeat(x[:1], 3, 0), params)
    mean, _ = jax.vmap(partial(script.predict, member), (0, None, None))(same, ensemble.norm, buffer)
    np.testing.assert_allclose(script.disagreement(mean), 0.0, atol=1e-10)


def test_reward_scale_leaves_the_untrained_ensemble_behind(fitted):
    """The first rollout sets it; test_reference.py follows it from there."""
    member, _, ensemble, _, buffer = fitted
    seen = jax.tree.map(lambda x: x[:64].reshape(8, 8, *x.shape[1:]), buffer)
    raw, ensemble, metrics = script.measure_novelty(member, ensemble, seen)
    assert raw.shape == (8, 8)
    np.testing.assert_allclose(ensemble.scale, metrics["disagreement"])


def test_disagreement_is_the_variance_over_members():
    mean = np.random.default_rng(0).normal(size=(5, 7, 3))
    want = [np.mean([np.var(mean[:, b, a]) for a in range(3)]) for b in range(7)]
    np.testing.assert_allclose(script.disagreement(jnp.asarray(mean)), want, rtol=1e-5)


def test_bootstrap_draws_differ_per_member_and_stay_within_the_data():
    draws = np.asarray(script.draw_indices(jax.random.key(0), (8, 5, 512), 1000))
    assert draws.max() < 1000 and len(np.unique(draws[0, 0])) < 512  # with replacement
    for member in range(1, 5):
        assert (draws[:, member] == draws[:, 0]).mean() < 0.01


def test_nll_by_hand():
    """A member that predicts mean 0 and variance 1: half the mean square of the action."""
    member = script.PIDM(script.MEMBER, 24)
    buffer = toy(jax.random.key(0), 16)
    norm = script.statistics(buffer)
    one = jax.tree.map(lambda x: x[0], buffer)
    params = member.init(jax.random.key(0), script.flat_history(norm, one.prop, one.past), one.delta)["params"]
    zero = jax.tree.map(lambda x: jnp.zeros_like(x)[None], params)
    got = script.nll(member, zero, norm, jax.tree.map(lambda x: x[None], buffer))
    np.testing.assert_allclose(got, 0.5 * np.mean(np.asarray(buffer.action) ** 2), rtol=1e-5)


# --- a collection ---


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    out = tmp_path_factory.mktemp("collections") / "a"
    return out, script.main(dataclasses.replace(SMOKE, run_dir=str(out)))


def test_collection_on_disk(collected):
    """Stored x_t and a_t are the windows that the last rollout's ensemble data show; meta.json counts them."""
    out, state = collected
    meta = json.loads((out / "meta.json").read_text())
    assert meta["action_scale"] == [0.25] * 12
    assert meta["robot"] == "go1" and meta["transitions"] == 800 and meta["validation_envs"] == [3]
    arrays = {name: np.load(out / f"{name}.npy") for name in ("x", "action", "first", "rough", "lin_vel")}
    assert arrays["x"].shape == (25, 8, 4, 30) and arrays["lin_vel"].shape == (25, 8, 4, 3)
    assert arrays["first"][0, 0].all() and np.isfinite(arrays["x"]).all()
    np.testing.assert_allclose(np.linalg.norm(arrays["x"][..., 3:6], axis=-1), 1.0, atol=1e-5)  # gravity, no noise
    assert not list(out.glob("*.tmp"))
    # the ring buffer holds the last 8 rollouts with the environment's own histories
    dataset = pretrain_pidm.Dataset(out)
    flat = {name: np.asarray(x) for name, x in dataclasses.asdict(state.buffer).items()}
    index = np.arange(24 * 32, 25 * 32 - 4)  # last rollout but for its last step
    usable = np.isin(index, np.concatenate([dataset.train, dataset.validation]))
    slot = np.arange(32 - 4)  # iteration 24 wrote slot 0 of the ring
    got = dataset.windows(index[usable])
    np.testing.assert_array_equal(got["prop"], flat["prop"][slot[usable]])
    np.testing.assert_array_equal(got["past"], flat["past"][slot[usable]])
    np.testing.assert_allclose(got["next_x"] - got["prop"][:, -1], flat["delta"][slot[usable]], atol=1e-6)


def test_set_reaches_the_data_and_the_records(tmp_path):
    """All on the plane, with the numbers in args.json and meta.json; what is not named keeps its value.

    A random policy moves there, which does not learn.
    """
    out = tmp_path / "flat"
    args = dataclasses.replace(SMOKE, policy="random", run_dir=str(out), set=("rough=0", "friction=0.5,0.6"))
    state = script.main(args)
    assert float(jnp.exp(state.params["params"]["log_std"]).mean()) == pytest.approx(1.0)
    assert not np.load(out / "rough.npy").any()
    for name in ("args.json", "meta.json"):
        record = json.loads((out / name).read_text())
        assert record.get("args", record)["set"] == ["rough=0", "friction=0.5,0.6"]
        config = dataclasses.asdict(envs.EXPLORE["go1"]) | {"rough": 0.0, "friction": (0.5, 0.6)}
        assert record["config"] == json.loads(json.dumps(config))


def test_first_clocks_are_spread():
    """So that not all episodes reach their time limit together."""
    args = dataclasses.replace(SMOKE, num_envs=64)
    env = envs.make_explore("go1", "c")
    args = script.merge(args, env.config.ppo)
    net, member = script.ActorCritic((8,), 12, 1.0), script.PIDM(script.MEMBER, 24)
    opt = optax.scale_by_adam()
    state = script.init_state(args, env, net, opt, member, opt)
    clocks = np.asarray(state.env_state.clock)
    assert clocks.min() < 200 and 800 < clocks.max() < env.episode_steps
    for name, x in state.ensemble.norm.items():
        assert (np.asarray(x) == name.endswith("std")).all(), "inputs are as they are until they were measured"


def test_stages_one_to_three_through_files(collected, tmp_path):
    """Explore, pretrain, finetune and evaluate as a user would, each reading what the one before wrote."""
    pidm, run = tmp_path / "pidm", tmp_path / "run"
    pretrain_pidm.main(pretrain_pidm.Args(data=str(collected[0]), preset="smoke", run_dir=str(pidm)))
    args = ppo_finetune.Args(preset="smoke", pretrained=str(pidm / "pidm.msgpack"), run_dir=str(run))
    _, meta = checkpoints.load(pidm / "pidm.msgpack", "PIDM checkpoint")
    assert meta["action_scale"] == [0.25] * 12 and meta["dt"] == 0.02
    ppo_finetune.main(args)
    _, meta = checkpoints.load(run / "policy.msgpack", "policy")
    assert meta["args"]["network"] == "pidm"
    header = (run / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"update/actor/backbone", "update/actor/intention_encoder", "update/critic/value_synthesizer"} <= set(header)
    play.main(play.Args(policy=str(run / "policy.msgpack"), episodes=2))
    assert (run / "eval.json").exists()


# --- faults ---


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"robot": "spot"}, ["unknown robot 'spot'", "go1"]),
        ({"num_envs": 1}, ["--validation 0.08 of 1 environments"]),
        ({"validation": 0.0}, ["--validation 0.0"]),
        ({"members": 0}, ["--members must be at least 1"]),
        ({"members": 1}, ["--members 1 cannot disagree", "--policy random"]),
        ({"set": ("rough=2m",)}, ["rough takes a number like 0.5, not '2m'"]),
        ({"set": ("rough=-0.5",)}, ["rough must be from 0 to 1, not -0.5"]),
        ({"set": ("noise=1",)}, ["noise cannot be set here", "pretrain_pidm.py --noise"]),
        ({"set": ("calm=0.5",)}, ["unknown option 'calm'", "rough"]),
        ({"set": ("rough",)}, ["NAME=VALUE", "'rough'"]),
        ({"num_minibatches": 5}, ["5 minibatches do not divide"]),
    ],
)
def test_bad_arguments_are_refused(changes, words, tmp_path, refused):
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(tmp_path / "run"), **changes), *words)
    assert not (tmp_path / "run").exists()


@pytest.fixture
def no_state(monkeypatch):
    """Makes the first state cheap, for runs that are refused after it."""
    monkeypatch.setattr(script, "init_state", lambda args, **_: jnp.zeros(1))


def test_data_are_not_overwritten(collected, no_state, refused):
    before = (collected[0] / "x.npy").read_bytes()
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(collected[0])), "--force")
    assert (collected[0] / "x.npy").read_bytes() == before


def test_weights_that_are_not_finite_stop_the_collection(tmp_path, refused):
    """Before they are saved, and before the folder can be taken for a dataset."""
    out = tmp_path / "run"
    refused(
        script.main,
        dataclasses.replace(SMOKE, run_dir=str(out), lr=1e11, max_lr=1e11),
        "weights are not finite",
        "--lr",
    )
    assert not (out / "meta.json").exists() and not (out / records.STATE).exists()


def test_full_disk_is_one_line_and_leaves_no_arrays(tmp_path, no_state, refused, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)  # macOS has none
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(tmp_path / "run")), "cannot reserve", "No space left")
    assert not list((tmp_path / "run").glob("*.npy"))


def test_interrupted_collection_is_unfinished(tmp_path, monkeypatch, capsys, refused):
    """Ctrl-C after the first row: no meta.json, and stage 2 says why it refuses."""
    show = Progress.show

    def interrupt(*inputs):
        show(*inputs)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "show", interrupt)
    script.main(dataclasses.replace(SMOKE, total_steps=2400, run_dir=str(tmp_path)))
    assert "unfinished collection" in capsys.readouterr().out and not (tmp_path / "meta.json").exists()
    refused(pretrain_pidm.main, pretrain_pidm.Args(data=str(tmp_path), preset="smoke"), "unfinished collection")
