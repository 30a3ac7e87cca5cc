"""Stage 2 and warm start: windows against a slow reference, mirrors and noise, what is loaded, what is refused."""

import copy
import dataclasses
import functools
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import envs
import ppo_finetune as finetune
import pretrain_pidm as script
from envs import pedipulation
from experiment import checkpoints, figures, records
from results import pidm

K, X, A = 5, 30, 12  # Go1
LAYOUT = ["ang_vel", "gravity", "joint_pos", "joint_vel"]


def write_dataset(folder, first, x, action, **changes):
    """A finished collection of given arrays (iterations, T, N, ...)."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"x": x, "action": action, "first": first, "rough": np.zeros_like(first)}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    iterations, steps, count = first.shape
    meta = {
        "robot": "go1",
        "layout": LAYOUT,
        "iterations": iterations,
        "num_steps": steps,
        "num_envs": count,
        "history": K,
        "validation_envs": [count - 1],
        "transitions": first.size,
        "args": {},
        "versions": {},
    }
    (folder / "meta.json").write_text(json.dumps(meta | changes))
    return folder


def random_dataset(folder, seed=0, iterations=6, steps=7, count=5, **changes):
    """Random numbers whose episodes have every length from 1 step on."""
    rng = np.random.default_rng(seed)
    first = rng.random((iterations, steps, count)) < 0.25
    first[0, 0] = True
    x = rng.normal(size=(*first.shape, X)).astype(np.float32)
    action = rng.normal(size=(*first.shape, A)).astype(np.float32)
    return write_dataset(folder, first, x, action, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return random_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def dataset(folder):
    return script.Dataset(folder)


@pytest.fixture(scope="module")
def go1():
    return envs.make_explore("go1", "c")


def replay(first, x, action):
    """Histories as an environment keeps them, step by step in plain Python: flat index -> prop, past."""
    steps, count = first.shape
    windows = {}
    for n in range(count):
        for t in range(steps):
            if first[t, n]:
                prop, past = [x[t, n]] * (K + 1), [np.zeros(A)] * K
            else:
                prop, past = [*prop[1:], x[t, n]], [*past[1:], action[t - 1, n]]
            windows[t * count + n] = np.array(prop), np.array(past)
    return windows


def test_windows_match_a_slow_replay(dataset, folder):
    """Every usable transition, over resets of every distance, has the history its environment had."""
    first = np.load(folder / "first.npy").reshape(-1, 5)
    want = replay(first, np.asarray(dataset.x), np.asarray(dataset.action))
    index = np.sort(np.concatenate([dataset.train, dataset.validation]))
    steps, count = first.shape
    usable = [t * count + n for t in range(steps - 1) for n in range(count) if not first[t + 1, n]]
    np.testing.assert_array_equal(index, usable)  # and only these: no window looks across a reset
    got = dataset.windows(index)
    for row, i in enumerate(index):
        np.testing.assert_array_equal(got["prop"][row], want[i][0])
        np.testing.assert_array_equal(got["past"][row], want[i][1])
        np.testing.assert_array_equal(got["next_x"][row], dataset.x[i // count + 1, i % count])
        np.testing.assert_array_equal(got["action"][row], dataset.action[i // count, i % count])


def test_validation_environments_are_held_out(dataset):
    assert set(dataset.validation % 5) == {4} and 4 not in set(dataset.train % 5)


def test_padding_is_the_environments(tmp_path, jitted):
    """Windows of a recorded rollout equal the histories that the environment itself kept, episode starts included."""
    task = jitted("go1_loco", noise=0.0, episode_seconds=0.16)
    state, rows = task.start(3), []
    first = np.ones(3, bool)
    for i in range(24):
        before, state = state, task.act(state, i)
        rows.append((first, before.history["prop"], before.history["action"], state.action))
        rows[-1] = (*rows[-1][:3], 0.5 * jax.random.normal(jax.random.key(i), (3, A)))
        first = np.asarray(state.terminated | state.truncated)
    first, prop, past, action = (np.stack(column) for column in zip(*rows, strict=True))
    assert first.sum() > 6  # some episodes ended
    folder = write_dataset(tmp_path / "d", first[None], prop[None, :, :, -1], action[None])
    data = script.Dataset(folder)
    index = np.sort(np.concatenate([data.train, data.validation]))
    got = data.windows(index)
    np.testing.assert_allclose(got["prop"], prop.reshape(-1, K + 1, X)[index], atol=1e-6)
    np.testing.assert_allclose(got["past"], past.reshape(-1, K, A)[index], atol=1e-6)


def test_noise_repeats_in_padding(dataset, go1):
    """Each state is read once: rows that pad a window show the same noisy first x; bounds are the tasks'."""
    batch = dataset.windows(dataset.train)
    width = script.noise_width(go1)
    noisy = script.add_noise(jax.random.key(0), width, batch)
    moved = np.asarray(noisy["prop"]) - batch["prop"]
    assert (np.abs(moved) <= np.asarray(width) + 1e-6).all() and np.abs(moved).max() > 1.4
    padded = np.flatnonzero(batch["pad"] >= 2)
    assert len(padded)
    for i in padded:
        np.testing.assert_array_equal(noisy["prop"][i, 0], noisy["prop"][i, batch["pad"][i]])


@pytest.mark.parametrize("robot", ["anymal_d", "g1"])
def test_mirrored_window_is_window_of_the_mirrored_trajectory(robot, tmp_path):
    env = envs.make_explore(robot, "c")
    rng = np.random.default_rng(0)
    first = rng.random((2, 9, 3)) < 0.2
    first[0, 0] = True
    x, action = (rng.normal(size=(*first.shape, n)).astype(np.float32) for n in (env.prop_dim, env.action_dim))
    plain = script.Dataset(write_dataset(tmp_path / "plain", first, x, action, robot=robot))
    for name, tables in env.mirrors.items():
        images = (array[..., tables[kind][0]] * tables[kind][1] for kind, array in (("prop", x), ("action", action)))
        other = script.Dataset(write_dataset(tmp_path / name, first, *images, robot=robot))
        want = other.windows(other.train)
        got = script.mirror_windows(tables, plain.windows(plain.train))
        for part in want:
            np.testing.assert_array_equal(got[part], want[part], err_msg=f"{name} {part}")


def test_normalizer_commutes_with_mirrors(dataset, go1):
    """A mirrored robot has mirrored statistics, or the network would see two input distributions."""
    norm = script.make_normalizer(script.Args(), go1, jax.random.key(0), dataset.windows(dataset.train))
    for tables in go1.mirrors.values():
        for name, kind in (("prop", "prop"), ("delta", "prop"), ("action", "action")):
            perm, sign = tables[kind]
            np.testing.assert_allclose(norm[f"{name}_mean"][perm] * sign, norm[f"{name}_mean"], atol=1e-5)
            np.testing.assert_allclose(norm[f"{name}_std"][perm], norm[f"{name}_std"], rtol=1e-5)


def linear_dataset(folder):
    """x_{t+1} = x_t + B a_t with a fixed matrix B: a network that inverts it names the action."""
    rng = np.random.default_rng(0)
    first = np.zeros((20, 10, 16), bool)
    first[0, 0] = True
    action = rng.normal(size=(*first.shape, A)).astype(np.float32)
    moves = action @ rng.normal(size=(A, X)).astype(np.float32)
    x = np.cumsum(moves.reshape(200, 16, X), 0).reshape(moves.shape) - moves
    return write_dataset(folder, first, x, action)


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A tiny pretraining on the linear system: its folder."""
    folder = tmp_path_factory.mktemp("linear")
    out = folder / "out"
    data = linear_dataset(folder / "data")
    script.main(script.Args(data=str(data), preset="smoke", noise=0.0, mirror=False, epochs=8, run_dir=str(out)))
    return out


def test_error_falls_on_a_linear_system(pretrained):
    result = json.loads((pretrained / "validation.json").read_text())
    assert result["error"] < 0.5 * result["mean_action_error"]
    np.testing.assert_allclose(result["mean_action_error"], (2 / np.pi) ** 0.5, rtol=0.1)  # E|a| of a unit Gaussian
    assert result["error_rad"] == pytest.approx(0.25 * result["error"])
    for name in ("curve.png", "accuracy.png", "distribution.png"):
        assert (pretrained / name).stat().st_size > 5000


def test_validation_sees_noise_and_compares_with_the_present(folder):
    """Predictions differ from those without noise; the last action and the change of the joints are those of t."""
    data, env = script.open_data(script.Args(data=str(folder)))
    net, index = script.PIDM(script.SIZES["go1"], A), data.validation[:20]
    windows = data.windows(index)
    variables = script.init_variables(script.Args(noise=0.0), env, net, windows)
    predictors = [script.make_predictor(script.Args(noise=noise), env, net) for noise in (1.0, 0.0)]
    noisy, quiet = (script.predict_all(predictor, env, variables, data, index) for predictor in predictors)
    np.testing.assert_allclose(quiet["predicted"], script.predict(net, variables, windows), atol=1e-5)
    assert np.abs(noisy["predicted"] - quiet["predicted"]).max() > 1e-3
    for outcome in (noisy, quiet):
        np.testing.assert_array_equal(outcome["last"], windows["past"][:, -1])
        change = 0.25 * windows["action"] - windows["prop"][:, -1, 6:18]
        np.testing.assert_allclose(outcome["change"], change, atol=1e-6)


def test_data_of_another_time_step_make_a_pidm_of_that_time_step(folder, tmp_path, refused):
    """Its own data validate it; a task with steps of 0.02 s refuses it."""
    data = random_dataset(tmp_path / "slow", config={"decimation": 8, "physics_dt": 0.005})
    script.main(script.Args(data=str(data), preset="smoke", run_dir=str(tmp_path / "run")))
    pidm = str(tmp_path / "run/pidm.msgpack")
    assert checkpoints.load(tmp_path / "run/pidm.msgpack", "PIDM checkpoint")[1]["dt"] == 0.04
    script.main(script.Args(data=str(data), eval=pidm))
    refused(script.main, script.Args(data=str(folder), eval=pidm), "dt 0.04, here is dt 0.02")


def test_training_samples_are_of_training_environments_alone(folder, tmp_path, monkeypatch):
    """As many as --num-samples asks for, each once. Their statistics are of noisy readings."""
    seen, run_epoch, make_normalizer = [], script.run_epoch, script.make_normalizer
    norms, judged, predict_all = [], [], script.predict_all

    def watched(args, data, index, *rest):
        seen.append((index, data))
        return run_epoch(args, data, index, *rest)

    def kept(*parts):
        norms.append(make_normalizer(*parts))
        return norms[-1]

    monkeypatch.setattr(script, "run_epoch", watched)
    monkeypatch.setattr(script, "make_normalizer", kept)
    monkeypatch.setattr(script, "predict_all", lambda *parts: judged.append(parts[-1]) or predict_all(*parts))
    script.main(script.Args(data=str(folder), preset="smoke", num_samples=60, run_dir=str(tmp_path / "run")))
    index, data = seen[0]
    assert len(index) == len({*index}) == 60 and {*index} <= {*data.train.tolist()}
    variance = np.square(norms[-1]["prop_std"])[18:]  # of joint velocities, whose noise is even within 1.5
    assert np.mean(variance) == pytest.approx(1 + 1.5**2 / 3, rel=0.1)
    held_out = {*data.validation.tolist()}
    assert [{*one} for one in judged] == [held_out] * 3, "two epochs and validation.json"


def test_an_epoch_takes_each_sample_once_with_noise_of_its_own(dataset):
    """40 of 43 in batches of 8, in an order and with keys that seed and epoch alone decide."""
    index, args = dataset.train[:43], script.Args(batch=8, epochs=9, seed=2)
    known = {float(a): i for i, a in zip(index, dataset.windows(index)["action"][:, 0], strict=True)}

    def epoch(number):
        taken, keys = [], []

        def step(variables, opt_state, batch, key, lr):
            taken.extend(known[float(a)] for a in np.asarray(batch["action"])[:, 0])
            keys.append(tuple(jax.random.key_data(key).tolist()))
            return variables, opt_state, jnp.float32(len(keys))

        assert script.run_epoch(args, dataset, index, step, ({}, {}), [1.0] * number)[1] == 3.0
        assert len({*taken}) == len(taken) == 40
        return taken, keys

    first, again, second = epoch(0), epoch(0), epoch(1)
    assert first == again and first[0] != second[0] and len({*first[1], *second[1]}) == 10


def test_an_error_that_is_not_finite_saves_nothing(folder, tmp_path, monkeypatch, refused):
    """Weights that break in the last step of an epoch have a sound loss, but no sound error."""
    errors, out = script.errors, tmp_path / "run"
    args = script.Args(data=str(folder), preset="smoke", epochs=3, run_dir=str(out))
    count = []

    def broken(*parts):
        count.append(1)
        return errors(*parts) | ({"error": float("nan")} if len(count) == 2 else {})

    monkeypatch.setattr(script, "errors", broken)
    refused(script.main, args, "the error is not finite after epoch 2")
    script.main(script.Args(resume=str(out)))
    assert [row["iteration"] for row in records.read_rows(out / "metrics.csv")] == [1, 2, 3]


@pytest.fixture
def step_sizes(monkeypatch):
    """Step sizes that trainings take, in order."""
    taken, make_step = [], script.make_step

    def recording(*parts):
        step = make_step(*parts)
        return lambda *inputs: taken.append(float(inputs[-1])) or step(*inputs)

    monkeypatch.setattr(script, "make_step", recording)
    return taken


def test_step_size_falls_to_zero_along_a_cosine(folder, tmp_path, step_sizes):
    """It starts at --lr, is half of it in the middle, and would be 0 at the step after the last."""
    args = script.Args(data=str(folder), preset="smoke", epochs=4, batch=32, lr=0.5, run_dir=str(tmp_path / "run"))
    script.main(args)
    count = len(step_sizes)
    assert count > 8
    np.testing.assert_allclose(step_sizes, 0.25 * (1 + np.cos(np.pi * np.arange(count) / count)), rtol=1e-5)


@pytest.mark.parametrize(
    ("errors", "starts"),
    [
        ([], 17),  # at the latest
        ([5, 4, 3, 2, 1], 17),
        ([5, 4, 4, 4], 17),  # two epochs without a lower error
        ([5, 4, 4, 4, 4], 5),
        ([4, 5, 6, 5, 1, 0.5], 4),  # lower errors as the step size falls do not raise it again
        ([9, 8, 9, 9, 7, 8, 8, 8, 6], 8),
        ([20 - i for i in range(17)] + [9, 9, 9], 17),
    ],
)
def test_the_step_size_falls_once_three_epochs_bring_nothing(errors, starts):
    assert script.decay(script.Args(epochs=20, patience=3), errors) == (starts, starts + 3)


def test_patience_ends_a_training_which_resumes_to_the_same_weights(folder, tmp_path, monkeypatch, step_sizes):
    """Errors that fall for three epochs only: two more at --lr, two in which it falls. Killed in each, it goes on."""
    made_up, killed, run_epoch, errors = [5, 4, 3, 3, 3, 2, 4, 1], [], script.run_epoch, script.errors
    past, judged = [], []

    def killable(*parts):
        past[:] = parts[-1]
        if len(past) in killed:
            raise RuntimeError("killed")
        return run_epoch(*parts)

    monkeypatch.setattr(script, "run_epoch", killable)
    monkeypatch.setattr(script, "errors", lambda *parts: errors(*parts) | {"error": made_up[len(past)]})
    monkeypatch.setattr(script, "validate", lambda predictor, env, variables, *_: judged.append(variables))
    args = script.Args(data=str(folder), preset="smoke", epochs=20, patience=2, run_dir=str(tmp_path / "whole"))
    script.main(args)
    whole = checkpoints.load(tmp_path / "whole/pidm.msgpack", "PIDM checkpoint")
    sizes, per_epoch = [*step_sizes], len(step_sizes) // 7
    assert len(sizes) == 7 * per_epoch and whole[1]["metrics"]["iteration"] == 6, "the best epoch is kept"
    jax.tree.map(np.testing.assert_array_equal, judged[0], whole[0])
    assert sizes[: 5 * per_epoch] == [np.float32(args.lr)] * 5 * per_epoch
    assert sizes[-2 * per_epoch] == np.float32(args.lr) and sizes[-1] < 0.6 * args.lr
    killed[:], step_sizes[:] = (2, 4, 6), []  # before it is flat, while it is, and as the step size falls
    with pytest.raises(RuntimeError):
        script.main(dataclasses.replace(args, run_dir=str(tmp_path / "part")))
    while killed:
        killed.pop(0)
        try:
            script.main(script.Args(resume=str(tmp_path / "part")))
        except RuntimeError:
            assert killed
    assert step_sizes == sizes
    part = checkpoints.load(tmp_path / "part/pidm.msgpack", "PIDM checkpoint")
    jax.tree.map(np.testing.assert_array_equal, part[0], whole[0])
    script.main(script.Args(resume=str(tmp_path / "part")))
    assert step_sizes == sizes, "a complete run is not trained further"


def test_patience_needs_more_epochs(folder, tmp_path, refused):
    args = script.Args(data=str(folder), preset="smoke", epochs=5, patience=5, run_dir=str(tmp_path / "run"))
    refused(script.main, args, "--patience 5 needs more --epochs than 5")


# --- warm start ---


def zero_inputs(env, net):
    """The arrays that a network reads, all zeros."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape), net.inputs(state.obs, state.history))


def start(env, task="go1_loco", **changes):
    """net, and params as a training starts with them: before and after the warm start."""
    args = finetune.merge(finetune.Args(task=task, preset="smoke", network="pidm", **changes), env.config.ppo)
    net = finetune.make_net(args, env)
    fresh = net.init(jax.random.key(0), zero_inputs(env, net))
    return net, fresh, finetune.warm_start(args, env, fresh, jax.random.key(1))


@pytest.mark.parametrize(
    ("load_into", "branches", "parts"),
    [
        ("both", ("actor", "critic"), ("history_encoder", "backbone")),
        ("actor", ("actor",), ("history_encoder", "backbone")),
        ("critic", ("critic",), ("history_encoder", "backbone")),
        ("history_encoder", ("actor", "critic"), ("history_encoder",)),
        ("none", (), ()),
    ],
)
def test_warm_start_loads_the_named_parts_and_no_others(pretrained, load_into, branches, parts, jitted, capsys):
    path = pretrained / "pidm.msgpack"
    _, fresh, warm = start(jitted("go1_loco").env, pretrained=str(path), load_into=load_into)
    pidm, _ = checkpoints.load(path, "PIDM checkpoint")
    for branch in ("actor", "critic"):
        for name, part in warm["params"][branch].items():
            loaded = name in parts and branch in branches
            want = pidm["params"][name] if loaded else fresh["params"][branch][name]
            jax.tree.map(np.testing.assert_array_equal, part, want)
    np.testing.assert_array_equal(warm["params"]["log_std"], fresh["params"]["log_std"])
    for name in ("prop_mean", "prop_std", "action_mean", "action_std"):
        np.testing.assert_array_equal(warm["normalizer"][name], pidm["normalizer"][name])
    said = [f"{branch}: loaded {' and '.join(sorted(parts))} from {path}" for branch in branches]
    assert capsys.readouterr().out.splitlines() == said


def test_without_a_checkpoint_only_the_input_scaling_is_loaded(jitted, capsys):
    _, fresh, warm = start(jitted("go1_loco").env)
    shipped, _ = checkpoints.load(finetune.SHIPPED / "go1.msgpack", "PIDM checkpoint")
    jax.tree.map(np.testing.assert_array_equal, warm["params"], fresh["params"])
    for name in ("prop_mean", "prop_std", "action_mean", "action_std"):
        np.testing.assert_array_equal(warm["normalizer"][name], shipped["normalizer"][name])
    assert "loaded" not in capsys.readouterr().out


def test_a_robot_without_a_shipped_checkpoint(pretrained, jitted, tmp_path, monkeypatch):
    """Its policy goes on as it was; a random PIDM is told where its input scaling can come from."""
    env, policy = jitted("go1_loco").env, tmp_path / "policy.msgpack"
    net, _, saved = start(env, pretrained=str(pretrained / "pidm.msgpack"))
    calm = saved["params"] | {"log_std": saved["params"]["log_std"] - 1}  # as after a training
    saved = saved | {"params": calm}
    checkpoints.save(policy, saved, {"task": "go1_loco", "args": {}})
    monkeypatch.setattr(finetune, "SHIPPED", tmp_path)
    args = finetune.Args(preset="smoke", network="pidm", policy=str(policy))
    state = finetune.init_state(finetune.merge(args, env.config.ppo), env, net, finetune.optax.scale_by_adam())
    for part in ("actor", "critic"):
        jax.tree.map(np.testing.assert_array_equal, state.params["params"][part], saved["params"][part])
    np.testing.assert_allclose(state.params["params"]["log_std"], calm["log_std"] + 1, err_msg="it explores anew")
    assert np.isclose(state.lr, 1e-4), "1e-3 overshoots in the first update"
    assert finetune.merge(args, env.config.ppo).run_dir == "runs/go1_loco/pidm/seed0", "not called random"
    monkeypatch.setitem(envs.TASKS, "stand", (pedipulation.Pedipulation, envs.TASKS["go1_loco"][1]))
    checkpoints.save(policy, saved, {"task": "stand", "args": {}})
    with pytest.raises(records.UserError, match=r"sees lin_vel, .*, target; this task has lin_vel, .*, command, "):
        checkpoints.load_networks(policy, saved, env)  # as many numbers in another order
    with pytest.raises(records.UserError, match="--load-into none"):
        start(env)
    other = finetune.Args(pretrained=str(pretrained / "pidm.msgpack"), load_into="none")
    assert finetune.merge(other, env.config.ppo).run_dir == "runs/go1_loco/pidm_random/seed0"


@pytest.mark.parametrize("gone", ["policy", "pretrained"])
def test_a_resumed_run_does_not_need_the_weights_it_began_with(gone, jitted):
    env = jitted("go1_loco").env
    args = finetune.Args(preset="smoke", network="pidm", resume="a run", **{gone: "gone.msgpack"})
    args, opt = finetune.merge(args, env.config.ppo), finetune.optax.scale_by_adam()
    net = finetune.make_net(args, env)
    assert jax.eval_shape(lambda: finetune.init_state(args, env, net, opt)).lr.shape == ()


def test_shuffled_weights_keep_their_values_and_lose_their_place(pretrained, jitted):
    path = pretrained / "pidm.msgpack"
    *_, warm = start(jitted("go1_loco").env, pretrained=str(path), load_into="shuffled")
    pidm, _ = checkpoints.load(path, "PIDM checkpoint")
    for branch in ("actor", "critic"):
        for part in ("history_encoder", "backbone"):
            got, want = (p[part]["Dense_1"]["kernel"] for p in (warm["params"][branch], pidm["params"]))
            np.testing.assert_array_equal(np.sort(np.ravel(got)), np.sort(np.ravel(want)))
            assert (np.asarray(got) == want).mean() < 0.01


def test_a_training_starts_from_the_loaded_history_encoder(pretrained, tmp_path):
    """--load-into history_encoder through a whole run: its first step size is far too small to move a weight far.

    The input scaling does not move at all: it gets no update.
    """
    path, out = pretrained / "pidm.msgpack", tmp_path / "run"
    args = finetune.Args(preset="smoke", pretrained=str(path), load_into="history_encoder", run_dir=str(out))
    state = finetune.main(dataclasses.replace(args, lr=1e-12, desired_kl=1e-30))
    params, (pidm, _) = state.params["params"], checkpoints.load(path, "PIDM checkpoint")
    np.testing.assert_array_equal(state.params["normalizer"]["prop_std"][0], pidm["normalizer"]["prop_std"])
    for branch in ("actor", "critic"):
        moved = {
            name: np.abs(params[branch][name]["Dense_1"]["kernel"][0] - pidm["params"][name]["Dense_1"]["kernel"]).max()
            for name in ("history_encoder", "backbone")
        }
        assert 0 < moved["history_encoder"] < 1e-3 < moved["backbone"]
    assert json.loads((out / "args.json").read_text())["load_into"] == "history_encoder"


@pytest.fixture(scope="module")
def first_rollout(jitted):
    """first_rollout(task): (24, 16, ...) states, with actions of a std of 1, cached."""

    @functools.cache
    def states(name):
        task = jitted(name)
        state, found = task.start(16), []
        for i in range(24):
            found.append(state)
            state = task.act(state, i, std=1.0)
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)

    return states


def first_state(env, states, task, **changes):
    """net, and params as `init_state` makes them, in an environment whose reset needs no compiler."""
    args = finetune.merge(finetune.Args(task=task, preset="smoke", **changes), env.config.ppo)
    net, env = finetune.make_net(args, env), copy.copy(env)
    env.reset = lambda key, clock: jax.tree.map(lambda x: x[0, 0], states)
    return net, finetune.init_state(args, env, net, optax.scale_by_adam()).params


def first_actions(env, states, task, **changes):
    """Mean actions (24, 16, A) of a new actor on these states of a task."""
    net, params = first_state(env, states, task, **changes)
    return np.asarray(net.apply(params, net.inputs(states.obs, states.history), method=net.mean))


@pytest.mark.parametrize(
    ("start_from", "weight_init"),
    [("mlp", "pytorch"), ("random", "pytorch"), ("pretrained", "pytorch"), ("pretrained", "orthogonal")],
)
@pytest.mark.parametrize("name", ["anymal_loco", "go1_loco", "g1_loco"])
def test_first_actions_wherever_the_first_rollout_gets(name, start_from, weight_init, jitted, first_rollout):
    """A new actor commands nearly the default pose (paper Sec. IV-E): no joint moves by 0.02 action units."""
    env = jitted(name).env
    path = finetune.SHIPPED / f"{env.robot.name}.msgpack"
    choices = {"mlp": {"network": "mlp"}, "random": {"network": "pidm"}, "pretrained": {"pretrained": str(path)}}
    actions = first_actions(env, first_rollout(name), name, weight_init=weight_init, **choices[start_from])
    assert actions.shape[:2] == (24, 16) and 0 < np.abs(actions).max() < 0.02


@pytest.mark.parametrize(("name", "size"), [("anymal_loco", 0.224), ("go1_loco", 0.226), ("g1_loco", 0.273)])
def test_first_actions_with_an_unscaled_last_layer(name, size, jitted, first_rollout):
    """Root mean square of a warm-started actor's actions, for this draw of the rest; results/pidm has 0.18 to 0.28."""
    env = jitted(name).env
    path = finetune.SHIPPED / f"{env.robot.name}.msgpack"
    changes = {"pretrained": str(path), "weight_init": "pytorch_unscaled"}
    actions = first_actions(env, first_rollout(name), name, **changes)
    assert (actions**2).mean() ** 0.5 == pytest.approx(size, rel=0.02)


def layers_of(params):
    """Name -> kernel and bias of each layer of actor and critic."""
    leaves = {jax.tree_util.keystr(k): np.asarray(x) for k, x in jax.tree.leaves_with_path(params["params"])}
    names = [name.removesuffix("['kernel']") for name in leaves if name.endswith("['kernel']")]
    return {name: (leaves[f"{name}['kernel']"], leaves[f"{name}['bias']"]) for name in names}


@pytest.mark.parametrize(("network", "last"), [("mlp", "['actor']['Dense_3']"), ("pidm", "_synthesizer']['Dense_1']")])
def test_first_weights_are_as_pytorch_makes_them(network, last, jitted, first_rollout):
    """Every weight and bias fills the interval within 1/sqrt(inputs); else matrices are orthogonal.

    `pytorch` has the same numbers, but for a hundredth of them in the actor's last layer.
    """
    env = jitted("go1_loco").env
    kinds = ("pytorch_unscaled", "pytorch", "orthogonal")
    states = first_rollout("go1_loco")
    whole, scaled, orthogonal = (
        layers_of(first_state(env, states, "go1_loco", network=network, weight_init=kind)[1]) for kind in kinds
    )
    for name, (kernel, bias) in whole.items():
        bound = len(kernel) ** -0.5
        assert 0.9 * bound < np.abs(kernel).max() <= bound and abs(kernel.std() * 3**0.5 / bound - 1) < 0.15
        assert 0 < np.abs(bias).max() <= bound
        factor = np.float32(0.01) if "actor" in name and name.endswith(last) else np.float32(1)
        np.testing.assert_array_equal(scaled[name][0], factor * kernel)
        np.testing.assert_array_equal(scaled[name][1], factor * bias)
    assert sum("actor" in name and name.endswith(last) for name in whole) == 1
    _, params = first_state(env, states, "go1_loco", network=network, init_std=0.4)
    np.testing.assert_allclose(np.exp(params["params"]["log_std"]), 0.4, rtol=1e-6)
    gains = {"actor": 0.01 if network == "mlp" else 0.003, "critic": 0.05}
    for name, (kernel, bias) in orthogonal.items():
        small = kernel if kernel.shape[0] < kernel.shape[1] else kernel.T
        ends = name.endswith((last, last.replace("actor", "critic")))
        gain = gains["critic" if "critic" in name else "actor"] if ends else 2**0.5
        np.testing.assert_allclose(small @ small.T, gain**2 * np.eye(len(small)), atol=1e-5)
        assert not bias.any()


@pytest.mark.parametrize("task", envs.TASKS)
def test_parameter_ratio(task):
    """A PIDM has about four times the parameters of the task's MLP (paper Sec. V-A)."""
    env = envs.make(task, "c")
    inputs = zero_inputs(env, finetune.PIDMActorCritic)
    for preset in ("cpu", "gpu"):
        args, counts = finetune.merge(finetune.Args(task=task, preset=preset), env.config.ppo), []
        for network in ("mlp", "pidm"):
            net = finetune.make_net(dataclasses.replace(args, network=network), env)
            shapes = jax.eval_shape(net.init, jax.random.key(0), inputs)["params"]
            counts.append(sum(leaf.size for leaf in jax.tree.leaves(shapes)))
        assert 3.5 < counts[1] / counts[0] < 4.5, counts


def test_commanded_change_is_target_minus_joint_angle(go1):
    """The joint targets of an action, minus the joint angles; test_envs.py ties the targets to the engine."""
    like = jax.eval_shape(go1.reset, jax.random.key(0)).replace(key=None)
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    action, angles = (np.linspace(-most, most, A, dtype=np.float32) for most in (2, 1))
    x = np.concatenate([np.full(6, 9.0), angles, np.full(A, 9.0)])
    moved = np.asarray(go1.joint_targets(state, action)) - (angles + np.array(go1.robot.default_pose))
    np.testing.assert_allclose(script.commanded_change(go1, x, action), moved, atol=1e-5)


def test_errors_on_made_up_predictions(go1, dataset):
    """All actions 2 and predicted as 1.5, joints commanded to move by 0.25 rad."""
    action = np.full((4, A), 2.0)
    outcome = {"predicted": action - 0.5, "action": action, "last": action - 1, "change": np.full((4, A), -0.25)}
    found = script.errors(go1, dataset, outcome)
    want = {"error": 0.5, "error_rad": 0.125, "normalized_error": 0.25, "error_over_change": 0.5}
    each = np.asarray(dataset.action).reshape(-1, A)[dataset.train].astype(np.float64).mean(0)
    want["mean_action_error"] = np.abs(2 - each).mean()
    assert {name: found[name] for name in want} == pytest.approx(want)
    assert found["last_action_error"] == pytest.approx(1.0)
    mixed = SimpleNamespace(robot=SimpleNamespace(action_scale=(0.1,) * 6 + (0.5,) * 6))
    assert script.errors(mixed, dataset, outcome)["error_rad"] == pytest.approx(0.5 * (0.1 + 0.5) / 2)


def test_eval_repeats_the_validation(pretrained, tmp_path):
    """--eval on the collection that a PIDM came from finds the errors that its training reported."""
    wanted = json.loads((pretrained / "validation.json").read_text())
    path = tmp_path / "pidm.msgpack"
    path.write_bytes((pretrained / "pidm.msgpack").read_bytes())
    script.main(script.Args(data=str(pretrained.parent / "data"), noise=0.0, eval=str(path)))
    assert json.loads((tmp_path / "validation.json").read_text()) == pytest.approx(wanted)
    assert {"accuracy.png", "distribution.png"} <= {file.name for file in tmp_path.iterdir()}


# --- bad input ---


def test_eval_of_another_robots_pidm_is_refused(pretrained, folder, tmp_path, refused):
    params, meta = checkpoints.load(pretrained / "pidm.msgpack", "PIDM checkpoint")
    for name, value in (("robot", "g1"), ("history", 3)):
        other = tmp_path / f"{name}.msgpack"
        checkpoints.save(other, params, meta | {name: value})
        refused(
            script.main,
            script.Args(data=str(folder), eval=str(other)),
            f"{name} {value}",
            f"here is {name} {meta[name]}",
        )
    cut = tmp_path / "cut.msgpack"
    checkpoints.save(cut, jax.tree.map(lambda x: x[..., :-1], params), meta)
    refused(script.main, script.Args(data=str(folder), eval=str(cut)), "this task needs")
    refused(script.main, script.Args(data=str(folder), eval=str(tmp_path / "none")), "--eval", "no such file")
    assert not (tmp_path / "validation.json").exists()


def test_bad_datasets_are_refused(tmp_path, refused):
    def check(folder, *words):
        out = tmp_path / "out"
        refused(script.main, script.Args(data=str(folder), preset="smoke", run_dir=str(out)), *words)
        assert not out.exists()

    check(tmp_path / "none", "not a folder")
    folder = random_dataset(tmp_path / "a")
    meta = (folder / "meta.json").read_text()
    (folder / "meta.json").unlink()
    check(folder, "unfinished collection")
    (folder / "meta.json").write_text(meta[:40])
    check(folder, "meta.json is damaged")
    for name in ("robot", "layout", "versions"):
        (folder / "meta.json").write_text(json.dumps({k: v for k, v in json.loads(meta).items() if k != name}))
        check(folder, "meta.json is damaged")
    (folder / "meta.json").write_text(meta)
    whole = (folder / "x.npy").read_bytes()
    (folder / "x.npy").write_bytes(whole[:-100])
    check(folder, "cannot read", "x.npy")
    np.save(folder / "x.npy", np.array([{"a": 1}], object), allow_pickle=True)
    check(folder, "cannot read", "x.npy")  # never unpickled
    (folder / "x.npy").write_bytes(whole)
    check(random_dataset(tmp_path / "b", robot="spot"), "'spot'")
    check(random_dataset(tmp_path / "c", robot="g1"), "x.npy", "30", "64")
    check(random_dataset(tmp_path / "d", layout=["gravity"]), "gravity")
    check(random_dataset(tmp_path / "e", validation_envs=[]), "validation")
    check(random_dataset(tmp_path / "f", action_scale=0.5), "action_scale = [0.5", "not [0.25")
    assert script.open_data(script.Args(data=str(random_dataset(tmp_path / "h", action_scale=0.25))))
    check(random_dataset(tmp_path / "g", config={"body": {"x": 1}}), "meta.json is damaged")


def test_a_handful_of_transitions_makes_a_figure(tmp_path):
    """A validation split can be that small after a smoke run."""
    change = np.random.default_rng(0).normal(size=(1, A)).astype(np.float32)
    figures.plot_accuracy(change, 0.1 * change, tmp_path / "accuracy.png")
    assert (tmp_path / "accuracy.png").stat().st_size > 10_000


def test_too_many_samples_are_refused(tmp_path, refused):
    folder = random_dataset(tmp_path / "a")
    args = script.Args(data=str(folder), preset="smoke", num_samples=10**6, run_dir=str(tmp_path / "out"))
    refused(script.main, args, "--num-samples 1000000")


def test_bad_checkpoints_are_refused(pretrained, tmp_path, jitted, refused):
    path = pretrained / "pidm.msgpack"
    params, meta = checkpoints.load(path, "PIDM checkpoint")
    env = jitted("go1_loco").env

    def check(checkpoint, *words):
        with pytest.raises(records.UserError) as error:
            start(env, pretrained=str(checkpoint))
        assert all(word in str(error.value) for word in words) and "\n" not in str(error.value), error.value

    def changed(name, params, meta):
        checkpoints.save(tmp_path / name, params, meta)
        return tmp_path / name

    check(tmp_path / "none", "cannot read PIDM checkpoint")
    ours = meta | {"action_scale": [0.25] * 12, "dt": 0.02}
    for name, value in {"robot": "g1", "layout": ["gravity"], "history": 3, "action_scale": [0.5], "dt": 0.04}.items():
        check(changed(name, params, meta | {name: value}), f"{name} {value}", f"{name} {ours[name]}")
    (tmp_path / "cut").write_bytes(path.read_bytes()[:-50])
    check(tmp_path / "cut", "damaged")
    check(changed("policy", params, {"task": "go1_loco", "args": {}}), "not a PIDM checkpoint")
    check(changed("empty", {"params": params["params"]}, meta), "action_mean", "is None, this task needs")
    check(changed("small", jax.tree.map(lambda x: x[..., :-1], params), meta), "this task needs")
    part = {"history_encoder": params["params"]["history_encoder"]}
    check(changed("part", params | {"params": part}, meta), "backbone", "is None, this task needs")
    refused(finetune.main, finetune.Args(preset="smoke", pretrained=str(path), network="mlp"), "--network mlp")


def test_a_refused_checkpoint_costs_no_run(pretrained, tmp_path, refused):
    """Even with --force: what the folder held is still there."""
    (tmp_path / "metrics.csv").write_text("old\n")
    args = finetune.Args(task="anymal_loco", preset="smoke", pretrained=str(pretrained / "pidm.msgpack"))
    refused(finetune.main, dataclasses.replace(args, run_dir=str(tmp_path), force=True), "robot go1")
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]
    assert (tmp_path / "metrics.csv").read_text() == "old\n"


def test_gathering_errors_are_raised(dataset, monkeypatch):
    """An error on the gathering thread reaches the training instead of stopping it for ever."""
    monkeypatch.setattr(dataset, "windows", lambda index: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        list(script.batches(dataset, dataset.train, 8))


def test_batches_are_all_of_the_index_in_order(dataset):
    """Sizes 8, 8, ..., rest; each batch the windows of its own part of the index, sorted."""
    index = np.random.default_rng(0).permutation(dataset.train)
    got = list(script.batches(dataset, index, 8))
    assert [len(batch["pad"]) for batch in got] == [8] * (len(index) // 8) + [len(index) % 8] * (len(index) % 8 > 0)
    for i, batch in enumerate(got):
        np.testing.assert_array_equal(batch["action"], dataset.windows(np.sort(index[8 * i : 8 * i + 8]))["action"])


@pytest.mark.parametrize("load_into", ["actor", "critic", "history_encoder", "shuffled", "none"])
def test_load_into_without_pretrained_is_refused(load_into, refused):
    args = finetune.Args(preset="smoke", load_into=load_into)
    refused(finetune.main, args, f"--load-into {load_into} needs --pretrained")


def test_the_map_counts_the_states_where_exploration_has_been(tmp_path):
    """A quarter of the first set lies in exploration's corner, all of the second, none of the third."""
    rng = np.random.default_rng(0)
    near, far = rng.random((300, 2)), 5 + rng.random((900, 2))
    rest = [*far, [9.0, 9.0]]  # a corner of the map
    sets = {"exploration": rng.random((3000, 2)), "some": np.array([*near, *far]), "all": near, "none": np.array(rest)}
    share = pidm.draw_coverage(sets, "map", tmp_path / "coverage.png", gridsize=12)
    assert share == {"some": 0.25, "all": 1.0, "none": 0.0}
    assert (tmp_path / "coverage.png").stat().st_size > 10_000
