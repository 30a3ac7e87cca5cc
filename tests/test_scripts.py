"""Stage 3 and play.py end to end at smoke size, and what they say to bad input."""

import csv
import dataclasses
import json
import shutil
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro

import envs
import play
import ppo_explore
import ppo_finetune as script
from envs import render
from experiment import checkpoints, gait, records
from experiment.progress import Progress

ROOT = Path(__file__).resolve().parent.parent
SMOKE = script.Args(preset="smoke")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A smoke run of g1_loco and its folder."""
    out = tmp_path_factory.mktemp("runs") / "a"
    state = script.main(dataclasses.replace(SMOKE, task="g1_loco", run_dir=str(out)))
    return out, state


def test_run_folder(trained):
    out, state = trained
    record = json.loads((out / "args.json").read_text())
    assert record["task"] == "g1_loco" and record["num_envs"] == 4 and record["hidden"] == [256, 128, 128]
    assert record["versions"]["mujoco"] == "3.17.0" and record["versions"]["commit"]
    rows = list(csv.DictReader((out / "metrics.csv").open()))
    assert [float(row["env_steps"]) for row in rows] == [32, 64]
    assert {f"reward/{term}" for term in envs.TASKS["g1_loco"][1].weights} <= set(rows[0])
    assert (out / "curve.png").stat().st_size > 5000
    params, meta = checkpoints.load(out / "policy.msgpack", "policy")
    assert meta["task"] == "g1_loco"
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[0]), params, jax.device_get(state.params))
    assert not list(out.glob("*.tmp"))


def test_same_seed_same_weights(trained, tmp_path):
    """Two seeds in one program end with the bits of the same seeds alone, and with different weights."""
    both = script.main(dataclasses.replace(SMOKE, task="g1_loco", num_seeds=2, run_dir=str(tmp_path / "both")))
    alone = script.main(dataclasses.replace(SMOKE, task="g1_loco", seed=1, run_dir=str(tmp_path / "b")))
    for i, one in enumerate((trained[1], alone)):
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a[i], b[0]), both.params, one.params)
        params, meta = checkpoints.load(tmp_path / f"both/seed{i}/policy.msgpack", "policy")
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a, b[0]), params, jax.device_get(one.params))
        assert meta["args"]["seed"] == i
    rows = [(path / "metrics.csv").read_text() for path in (trained[0], tmp_path / "both/seed0")]
    first, second = ([line.split(",")[:2] + line.split(",")[3:] for line in text.splitlines()] for text in rows)
    assert first == second  # but for the seconds
    kernels = both.params["params"]["actor"]["Dense_0"]["kernel"]
    assert not np.array_equal(*kernels)


@pytest.fixture
def no_state(monkeypatch):
    """Makes the first state cheap, for runs that are refused after it."""
    monkeypatch.setattr(script, "init_state", lambda args, **_: jnp.zeros(1))


def test_seeds_whose_folder_is_taken_are_refused_together(no_state, tmp_path, refused):
    (tmp_path / "seed1").mkdir()
    (tmp_path / "seed1/metrics.csv").write_text("old\n")
    refused(script.main, dataclasses.replace(SMOKE, num_seeds=2, run_dir=str(tmp_path)), "seed1 holds a run")
    assert [path.name for path in tmp_path.iterdir()] == ["seed1"]


@pytest.fixture(scope="module")
def fresh(jitted):
    """Go1's environment, the parts of a training of 64 of them, and the state before it."""
    env = jitted("go1_loco").env
    args = dataclasses.replace(script.merge(SMOKE, env.config.ppo), num_envs=64)
    net, opt = script.make_net(args, env), script.optax.scale_by_adam()
    return env, (args, env, net, opt), script.init_state(args, env, net, opt)


def test_one_compile(fresh):
    """An iteration's output feeds the next one without another compilation: a weak type would ask for it."""
    _, parts, state = fresh
    before, (after, _) = jax.eval_shape(lambda state: (state, script.iteration(*parts, state)), state)
    assert jax.tree.structure(after) == jax.tree.structure(before)
    for (path, a), b in zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type), jax.tree_util.keystr(path)


@pytest.mark.parametrize(
    ("trained", "title"),
    [
        ({"network": "mlp", "pretrained": None}, "MLP"),
        ({"network": "pidm", "pretrained": None}, "random PIDM"),
        ({"network": "pidm", "pretrained": None, "policy": "x"}, "PIDM"),
        ({"network": "pidm", "pretrained": "x", "load_into": "both"}, "pretrained PIDM"),
        ({"network": "pidm", "pretrained": "x"}, "pretrained PIDM"),
        ({"network": "pidm", "pretrained": "x", "load_into": "none"}, "random PIDM"),
        ({"network": "pidm", "pretrained": "x", "load_into": "shuffled"}, "shuffled PIDM"),
        ({"network": "pidm", "pretrained": "x", "load_into": "critic"}, "PIDM, pretrained critic"),
    ],
)
def test_pictures_name_what_was_loaded(trained, title, fresh):
    assert play.title(fresh[0], {"args": trained}) == title


def test_first_clocks_are_spread(fresh):
    env, _, state = fresh
    clocks = np.asarray(state.env_state.clock)
    assert clocks.min() < 200 and clocks.max() > 800 and clocks.max() < env.episode_steps
    gaps = np.asarray(state.env_state.push_at) - clocks
    assert gaps.min() >= 500 and gaps.max() <= 750, "nobody is pushed at once"


ENDS = np.array([[0, 1, 0, 1], [0, 0, 2, 1], [0, 0, 0, 2]])  # robot, step -> 1: a fall, 2: the time limit


@flax.struct.dataclass
class Pose:
    qpos: jax.Array


@flax.struct.dataclass
class Played:
    """What `evaluate` reads of a State, and what ends its episodes."""

    obs: jax.Array
    history: dict
    terminated: jax.Array
    truncated: jax.Array
    physics: Pose
    metrics: dict
    number: jax.Array
    clock: jax.Array
    level: jax.Array


class Theatre:
    """Robots whose episodes end as ENDS says; qpos is the clock."""

    episode_steps = 4

    def at_level(self, level):
        return {"level": level}

    def reset(self, key, curriculum=None):
        known = jax.random.key_data(jax.random.split(jax.random.key(1), len(ENDS)))
        number = jnp.argmax((known == jax.random.key_data(key)).all(-1))
        level = jnp.float32(-1 if curriculum is None else curriculum["level"])
        return self.state(number, jnp.int32(0), level, jnp.int32(0))

    def state(self, number, clock, level, end):
        metrics = {"level": level, "steps": clock.astype(float), "episode_return": clock + jnp.float32(100) * number}
        pose = Pose(clock[None].astype(float))
        return Played(jnp.zeros(1), {}, end == 1, end == 2, pose, metrics, number, clock, level)

    def step(self, state, action):
        end = jnp.asarray(ENDS, jnp.int32)[state.number, state.clock]
        return self.state(state.number, state.clock + 1, state.level, end)


def test_an_evaluation_is_of_first_episodes_at_its_level():
    """They last 2, 3 and 4 steps; one of three is a fall, and what follows an episode counts for nothing."""
    net = SimpleNamespace(inputs=lambda obs, _: obs, apply=lambda _, obs, method: obs, mean=None)
    result, _, qpos = play.evaluate(Theatre(), net, None, 3, 7)
    want = {"level": 7, "steps": 19 / 9, "episode_return": 103, "falls": 1 / 3}
    assert {name: float(x) for name, x in result.items()} == pytest.approx(want)
    assert qpos.ravel().tolist() == [1.0] * 4, "the pose before the step that ended it"
    assert play.evaluate(Theatre(), net, None, 3)[0]["level"] == -1


@pytest.mark.parametrize("level", [None, 7])
def test_courses_are_evaluated_level_by_level(level, tmp_path, monkeypatch):
    """On no rough tiles; the picture is of the level asked for, else of level 4."""
    seen = []

    def evaluate(env, net, params, episodes, level=None):
        seen.append(env.config)
        like = jax.eval_shape(env.reset, jax.random.key(0)).replace(key=None)
        start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return {"at": -1.0 if level is None else level}, start, jnp.zeros((3, env.engine.model.nq))

    monkeypatch.setattr(play, "evaluate", evaluate)
    monkeypatch.setattr(render, "film", lambda *_, **words: {"title.txt": words["title"].encode()})
    policy = shutil.copy(ROOT / "results/tasks/anymal_jump/policy.msgpack", tmp_path)
    play.main(play.Args(str(policy), level=level))
    report = json.loads((tmp_path / "eval.json").read_text())
    got = {name: x["at"] for name, x in report.items() if name.startswith("level")}
    assert got == {f"level {i}": i for i in (range(10) if level is None else [level])}
    *tested, shown = seen
    assert {c.rough for c in seen} == {0} and {c.level for c in tested} == {None}
    assert shown.level == (4 if level is None else level) and shown.random_seconds == 0
    assert (tmp_path / "title.txt").read_text() == f"level {shown.level}, MLP"


def test_play_prints_and_draws(trained, capsys):
    out, _ = trained
    play.main(play.Args(str(out / "policy.msgpack"), episodes=2))
    printed = capsys.readouterr().out
    assert "lin_vel_error" in printed and "falls" in printed
    assert (out / "rollout.png").stat().st_size > 10_000 and (out / "rollout.gif").read_bytes()[:4] == b"GIF8"
    report = json.loads((out / "eval.json").read_text())
    assert 0 < report["task"]["episode_seconds"] < 20 and report["task"]["falls"] == 1.0
    assert report["gait"]["episodes"] == len(gait.COMMANDS) and report["gait"]["push of 1.0 m/s/episodes"] == 2
    assert "limits" in printed  # the lines of the gait


def test_pictures_without_opengl(jitted, monkeypatch, capsys):
    """Where no OpenGL works, all of which are tried in processes of their own, matplotlib draws the same files."""
    env = jitted("g1_loco").env
    physics = jax.tree.map(lambda x: x[0], jitted("g1_loco").start(1).physics)
    monkeypatch.setattr(subprocess, "run", lambda *words, **kwargs: subprocess.CompletedProcess(words, 1, "", ""))
    pictures = render.film(env, np.tile(physics.qpos, (60, 1)), physics)
    assert pictures.keys() == {"rollout.png", "rollout.gif"} and min(map(len, pictures.values())) > 2000
    assert "stick figures" in capsys.readouterr().out


def test_wrong_policies_are_refused(trained, tmp_path, refused):
    policy = trained[0] / "policy.msgpack"

    def check(path, *words, **changes):
        refused(play.main, play.Args(policy=str(path), **changes), *words)

    check(tmp_path / "none.msgpack", "cannot read policy", "No such file")
    cut = tmp_path / "cut.msgpack"
    cut.write_bytes(policy.read_bytes()[:-100])
    check(cut, "damaged")
    params, meta = checkpoints.load(policy, "policy")
    checkpoints.save(tmp_path / "task.msgpack", params, meta | {"task": "spot_loco"})
    check(tmp_path / "task.msgpack", "is a policy for 'spot_loco'", "g1_loco")
    checkpoints.save(tmp_path / "other.msgpack", params, meta | {"task": "go1_loco"})
    check(tmp_path / "other.msgpack", "this task needs")
    check(policy, "g1_loco has no level 3", level=3)
    check(policy, "--episodes must be", "not 0", episodes=0)
    check(policy, "--viewer and --web exclude each other", viewer=True, web=True)
    check(policy, "unknown option 'gravity'", set=("gravity=1",))
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".msgpack"]


# --- --set ---


def test_set_reaches_the_environment_and_the_records(tmp_path, monkeypatch):
    """--robust and then --set hold in the training, and are recorded; --resume and play.py start from them."""
    out, words = tmp_path / "run", ("push_velocity=0.25", "friction=0.3,1.2", "weights.slip=-0.5")
    made, make = [], envs.make
    monkeypatch.setattr(envs, "make", lambda *args, **fields: made.append(make(*args, **fields)) or made[-1])
    script.main(dataclasses.replace(SMOKE, robust=True, set=words, run_dir=str(out)))
    (env,) = made
    usual = dataclasses.replace(envs.TASKS["go1_loco"][1], **envs.TASKS["go1_loco"][1].robust)
    changes = {"push_velocity": 0.25, "friction": (0.3, 1.2), "weights": usual.weights | {"slip": -0.5}}
    assert env.config == dataclasses.replace(usual, **changes)
    record = json.loads((out / "args.json").read_text())
    assert record["robust"] is True and record["set"] == list(words)
    assert record["config"] == json.loads(json.dumps(dataclasses.asdict(env.config)))
    script.main(script.Args(resume=str(out)))
    assert made[1].config == env.config
    played, *_ = play.load_policy(out / "policy.msgpack", "c", ("friction=0.5,0.5",), noise=0.0)
    assert played.config == dataclasses.replace(env.config, friction=(0.5, 0.5), noise=0.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gravity=3"], "unknown option 'gravity'; choose one of action_delay"),
        (["friction=abc"], "friction takes two numbers like 0.3,1.2, not 'abc'"),
        (["weights.glide=1"], "unknown option 'weights.glide'; choose one of weights."),
        (["ppo={}"], "ppo cannot be set"),
        (["robot=h1.xml"], "robot cannot be set: it belongs to the task"),
        (["robust=false"], "robust cannot be set: --robust turns it on as a whole"),
        (["friction"], "--set takes NAME=VALUE, not 'friction'"),
        (["noise=0.5", "push_seconds=inf,inf"], "push_seconds takes two numbers"),
    ],
)
def test_what_cannot_be_set_is_refused(words, said, tmp_path, refused):
    refused(script.main, dataclasses.replace(SMOKE, set=tuple(words), run_dir=str(tmp_path / "run")), said)
    assert not (tmp_path / "run").exists()


def test_set_from_the_command_line(refused):
    """Several values behind one flag."""
    words = ["--preset", "smoke", "--set", "noise=0.5", "push_axes=3", "friction=0.3,1.2"]
    refused(ppo_explore.main, tyro.cli(ppo_explore.Args, args=words), "push_axes takes 2 or 6, not '3'")


# --- Faults ---


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"task": "go2_loco"}, ["unknown task 'go2_loco'", "go1_loco"]),
        ({"engine": "bullet"}, ["unknown engine 'bullet'", "c, mjx"]),
        ({"task": "anymal_jump", "robust": True}, ["anymal_jump has no robust set; anymal_loco, go1_loco, g1_loco"]),
        ({"num_envs": 0}, ["--num-envs must be at least 1"]),
        ({"num_minibatches": 5}, ["5 minibatches do not divide", "16"]),
        ({"total_steps": -1}, ["--total-steps must be at least 1"]),
        ({"total_steps": 10**12}, ["--total-steps must be at least 1", "below 1000000000000"]),
        (
            {"task": "anymal_loco", "policy": str(ROOT / "results/tasks/go1_loco/policy.msgpack")},
            ["is a policy for robot go1, here is robot anymal_d"],
        ),
        (
            {"task": "go1_loco", "network": "pidm", "policy": str(ROOT / "results/tasks/go1_loco/policy.msgpack")},
            ["has the network mlp; give --network mlp"],
        ),
        ({"seed": -1}, ["--seed must be at least 0, not -1"]),
        ({"seed": 2**32}, ["--seed must be at least 0", "below 4294967296"]),
        ({"lr": -1.0}, ["--lr must be above 0, not -1.0"]),
        ({"init_std": float("nan")}, ["--init-std must be above 0, not nan"]),
        ({"hidden": (64, 0)}, ["--hidden must be at least 1, not 0"]),
    ],
)
def test_bad_arguments_are_refused(changes, words, tmp_path, refused):
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(tmp_path / "run"), **changes), *words)
    assert not (tmp_path / "run").exists()


def test_out_of_memory_names_what_to_lower(tmp_path, refused, monkeypatch):
    def full(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 99 bytes.")

    monkeypatch.setattr(script, "make_chunk", full)
    args = dataclasses.replace(SMOKE, run_dir=str(tmp_path / "run"))
    refused(script.main, args, "out of memory", "--num-envs", "allocating 99 bytes")


def test_a_run_is_not_overwritten(trained, no_state, refused):
    before = (trained[0] / "metrics.csv").read_bytes()
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(trained[0])), "holds a run", "--force")
    assert (trained[0] / "metrics.csv").read_bytes() == before


def start_run(folder, **changes):
    records.start_runs([dataclasses.replace(SMOKE, run_dir=str(folder), **changes)], SMOKE)


def test_force_takes_the_old_results_away(tmp_path):
    """A run that is stopped before its first row must not leave its arguments beside another's weights."""
    for name in (*records.RESULTS, records.STATE, "mine.txt"):
        (tmp_path / name).write_text("old")
    with pytest.raises(records.UserError, match="--force"):
        start_run(tmp_path)
    assert len(list(tmp_path.iterdir())) == len(records.RESULTS) + 2
    start_run(tmp_path, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["args.json", "mine.txt"]


def test_several_seeds_share_the_board_above_them(tmp_path):
    (tmp_path / "events.out.tfevents.1").touch()
    seeds = [dataclasses.replace(SMOKE, run_dir=str(tmp_path / f"seed{seed}")) for seed in range(2)]
    records.start_runs(seeds, SMOKE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seed0", "seed1"]


@pytest.mark.parametrize("name", [*records.RESULTS, "meta.json"])
def test_any_result_makes_a_folder_a_run(name, tmp_path):
    """Weights alone, say of somebody else's training, are not overwritten either."""
    (tmp_path / name).write_text("old")
    with pytest.raises(records.UserError, match="--force"):
        start_run(tmp_path)


def test_unknown_preset_lists_the_right_ones(capsys):
    with pytest.raises(SystemExit) as stop:
        tyro.cli(script.Args, args=["--preset", "huge"])
    assert stop.value.code == 2 and "smoke" in capsys.readouterr().err


def test_interrupt_keeps_the_files(tmp_path, monkeypatch, capsys):
    """Ctrl-C after the first row ends the run with policy, metrics and curve in place."""
    show = Progress.show

    def interrupt(*inputs):
        show(*inputs)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "show", interrupt)
    before = signal.getsignal(signal.SIGINT)
    script.main(dataclasses.replace(SMOKE, total_steps=100_000_000, run_dir=str(tmp_path)))
    assert "interrupted" in capsys.readouterr().out and signal.getsignal(signal.SIGINT) == before
    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert len(rows) == 1 and None not in rows[0].values()
    checkpoints.load(tmp_path / "policy.msgpack", "policy")
    assert (tmp_path / "curve.png").exists()
