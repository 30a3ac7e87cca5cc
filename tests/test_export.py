"""A policy that leaves JAX acts as before. Tests of the ONNX file itself need requirements-export.txt."""

import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import play
import ppo_finetune
from envs.base import PROP
from tools import play_onnx

ROOT = Path(__file__).resolve().parent.parent
WALKER = ROOT / "results/tasks/go1_loco/policy.msgpack"


def readings(env, state):
    """Readings of a robot by name, from the noiseless observation of one environment."""
    blocks = {name: state.obs[where] / np.array(env.OBS[name][1]) for name, where in env.obs_slices().items()}
    return blocks | {"joint_pos": blocks["joint_pos"] + env.default_pose}


@pytest.mark.parametrize(("task", "network"), [("g1_loco", "mlp"), ("anymal_climb_up", "pidm")])
def test_onboard_policy_is_the_trained_one(task, network):
    """Fed with readings in SI units and its own history it gives the actions of the network in the environment."""
    quiet = {"noise": 0.0, "push_velocity": 0.0}
    quiet |= {"scan_noise": 0.0, "scan_shift": 0.0} if task == "anymal_climb_up" else {}
    env = envs.make(task, "c", **quiet)
    args = ppo_finetune.merge(ppo_finetune.Args(task=task, network=network, preset="smoke"), env.config.ppo)
    net = ppo_finetune.make_net(args, env)
    state = jax.jit(env.reset)(jax.random.key(0))
    params = net.init(jax.random.key(0), net.inputs(state.obs, state.history))
    if network == "pidm":
        params = ppo_finetune.warm_start(args, env, params, jax.random.key(1))  # its input normalisation
    noise = jax.random.key(1)  # initial networks answer about 0 to everything
    params = jax.tree.map(lambda x: x + 0.03 * jax.random.normal(noise, x.shape), params)
    policy, shapes = play.onboard(env, net, params)
    policy, step = jax.jit(policy), jax.jit(env.step)
    history = {"prop_history": state.history["prop"][1:], "action_history": jnp.zeros((5, env.action_dim))}
    for _ in range(8):
        given = readings(env, state) | history
        action, target, *after = policy(*(jnp.asarray(given[name], jnp.float32) for name in shapes))
        inputs = net.inputs(state.obs, state.history)
        np.testing.assert_allclose(action, net.apply(params, inputs, method=net.mean), atol=1e-4)
        np.testing.assert_allclose(target, env.default_pose + np.array(env.robot.action_scale) * action, atol=1e-6)
        history = dict(zip(history, after, strict=True))
        state = step(state, action)
    assert np.abs(action).max() > 1e-2, "the policy acts"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The recorded Go1 as an ONNX file."""
    pytest.importorskip("jax2onnx")
    pytest.importorskip("onnxruntime")
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    play.main(play.Args(str(WALKER), engine="c", export=str(path)))
    return path


def test_onnx_walks_in_plain_mujoco_as_jax_would(exported):
    """In JAX and ONNX actions are equal to 1e-5 along a rollout. The robot follows its command."""
    env, net, params, _ = play.load_policy(WALKER, "c")
    policy, shapes = play.onboard(env, net, params)
    policy, player, command = jax.jit(policy), play_onnx.Player(exported), (0.8, 0.0, 0.0)
    player.step(command)
    for _ in range(100):
        given = player.readings(command) | player.history
        want = policy(*(jnp.asarray(given[name], jnp.float32) for name in shapes))[0]
        np.testing.assert_allclose(player.step(command), want, atol=1e-5)
    velocity, falls = play_onnx.walk(player, command, 8.0)
    assert falls == 0 and np.abs(velocity - command).max() < 0.15, velocity


def test_metadata_of_the_file(exported):
    facts = play_onnx.Player(exported).facts
    assert facts["task"] == "go1_loco" and len(facts["joints"]) == len(facts["default_pose"]) == 12
    assert facts["action_scale"] == [0.25] * 12 and "gait_hz" not in facts, "no clock, no input of one"
    assert facts["command_ranges"]["forward [m/s]"] == [-1.0, 1.0] and not facts["robust"]
    assert np.shape(facts["joint_range"]) == (12, 2) and np.less(*np.transpose(facts["joint_range"])).all()
    assert facts["prop"] == list(PROP) and facts["dt"] == 0.02 and "commit" in facts["versions"]


def test_a_robot_from_a_file_comes_along(tmp_path):
    """Its model is in the policy file. An untrained policy holds it in its default pose, feet on the ground."""
    pytest.importorskip("jax2onnx")
    pytest.importorskip("onnxruntime")
    dog = shutil.copy(ROOT / "assets/go1.xml", tmp_path / "dog.xml")
    (tmp_path / "robot.toml").write_text("pose = { hip = 0.0, thigh = 0.9, calf = -1.8 }")
    args = {"task": "loco", "robot": str(dog), "preset": "smoke", "total_steps": 32, "run_dir": str(tmp_path / "run")}
    ppo_finetune.main(ppo_finetune.Args(**args))
    play.main(play.Args(str(tmp_path / "run/policy.msgpack"), engine="c", export=str(tmp_path / "dog.onnx")))
    player = play_onnx.Player(tmp_path / "dog.onnx")
    assert player.facts["robot"] == "dog" and player.model.nu == 12
    sites = [player.model.site(i).name for i in range(player.model.nsite)]
    feet = [player.data.site(name).xpos[2] for name in sites if name.endswith("_foot")]
    assert feet == pytest.approx([0.023] * 4, abs=1e-3), "radius of Go1's feet"
    height = player.data.qpos[2]
    _, falls = play_onnx.walk(player, (0.0, 0.0, 0.0), 2.0)
    assert falls == 0 and player.data.qpos[2] == pytest.approx(height, abs=0.05), "its PD loops give way a little"
    np.testing.assert_allclose(player.data.qpos[7:], player.pose, atol=0.3)


def test_bad_files_are_one_line(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    (tmp_path / "x.onnx").write_bytes(b"not a graph")
    for name in ("x.onnx", "missing.onnx"):
        with pytest.raises(SystemExit) as stop:
            play_onnx.main(play_onnx.Args(str(tmp_path / name)))
        assert stop.value.code == 2 and capsys.readouterr().err.count("\n") == 1


def test_export_without_its_package_is_one_line(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    refused(play.main, play.Args(str(WALKER), export="x.onnx"), "requirements-export.txt")


def test_only_a_policy_is_exported(refused, tmp_path):
    pytest.importorskip("jax2onnx")
    pidm = str(ROOT / "assets/pidm/go1.msgpack")
    refused(play.main, play.Args(pidm, export=str(tmp_path / "x.onnx")), "is not a policy")
    assert not (tmp_path / "x.onnx").exists()
