"""A policy that leaves JAX acts as before. Tests of the ONNX file itself need requirements-export.txt."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import ppo_finetune as script
from envs.base import PROP
from results import play_onnx

ROOT = Path(__file__).resolve().parent.parent
WALKER = ROOT / "results/tasks/go1_loco/policy.msgpack"


def readings(env, state):
    """The blocks that a robot would measure, by name, taken from the noiseless observation of one environment."""
    blocks, start = {}, 0
    for name, (kind, scale) in env.OBS.items():
        stop = start + env.width(kind)
        blocks[name] = np.asarray(state.obs[start:stop]) / np.array(scale)
        start = stop
    blocks["joint_pos"] = blocks["joint_pos"] + np.asarray(env.default_pose)
    return blocks


@pytest.mark.parametrize(("task", "network"), [("go1_loco", "mlp"), ("g1_loco", "pidm"), ("anymal_climb_up", "pidm")])
def test_onboard_policy_is_the_trained_one(task, network):
    """Fed with readings in SI units and its own history it gives the actions of the network in the environment."""
    quiet = {"noise": 0.0, "push_velocity": 0.0}
    quiet |= {"scan_noise": 0.0, "scan_shift": 0.0} if task == "anymal_climb_up" else {}
    env = envs.make(task, "c", **quiet)
    args = script.merge(script.Args(task=task, network=network, preset="smoke"), env.config.ppo)
    net = script.make_net(args, env)
    params = script.init_params(args, env, net, jax.random.key(0))
    noise = jax.random.key(1)  # a fresh network answers 0 to everything
    params = jax.tree.map(lambda x: x + 0.03 * jax.random.normal(noise, x.shape), params)
    policy, shapes = script.onboard(env, net, params)
    policy, step = jax.jit(policy), jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(0))
    history = {"prop_history": state.history["prop"][1:], "action_history": jnp.zeros((5, env.action_dim))}
    for _ in range(8):
        given = readings(env, state) | history
        action, target, *after = policy(*(jnp.asarray(given[name], jnp.float32) for name in shapes))
        inputs = script.net_inputs(net, state.obs, state.history)
        np.testing.assert_allclose(action, net.apply(params, inputs, method=net.mean), atol=1e-4)
        np.testing.assert_allclose(target, env.default_pose + env.robot.action_scale * action, atol=1e-6)
        history = dict(zip(history, after, strict=True))
        state = step(state, action)
    assert np.abs(action).max() > 1e-2, "the policy acts"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The recorded Go1 as an ONNX file."""
    pytest.importorskip("jax2onnx")
    pytest.importorskip("onnxruntime")
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    script.main(script.Args(task="go1_loco", engine="c", eval=str(WALKER), export=str(path)))
    return path


def test_onnx_walks_in_plain_mujoco_as_jax_would(exported):
    """JAX follows the rollout of the ONNX policy: the same actions to 1e-5. The robot goes where it is told."""
    env = envs.make("go1_loco", "c")
    policy, shapes = script.onboard(env, *script.load_policy(script.Args(task="go1_loco", eval=str(WALKER)), env))
    policy, player, command = jax.jit(policy), play_onnx.Player(exported), (0.8, 0.0, 0.0)
    player.step(command)
    for _ in range(100):
        given = player.readings(command) | player.history
        want = policy(*(jnp.asarray(given[name], jnp.float32) for name in shapes))[0]
        np.testing.assert_allclose(player.step(command), want, atol=1e-5)
    velocity, falls = play_onnx.walk(player, command, 8.0)
    assert falls == 0 and np.abs(velocity - command).max() < 0.15, velocity


def test_the_file_says_what_it_is(exported):
    facts = play_onnx.Player(exported).facts
    assert facts["task"] == "go1_loco" and len(facts["joints"]) == len(facts["default_pose"]) == 12
    assert facts["prop"] == list(PROP) and facts["dt"] == 0.02 and "commit" in facts["versions"]


def test_bad_files_are_one_line(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    (tmp_path / "x.onnx").write_bytes(b"not a graph")
    for name in ("x.onnx", "missing.onnx"):
        with pytest.raises(SystemExit) as stop:
            play_onnx.main(play_onnx.Args(str(tmp_path / name)))
        assert stop.value.code == 2 and capsys.readouterr().err.count("\n") == 1


def test_export_without_its_package_is_one_line(refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    args = script.Args(task="go1_loco", eval=str(WALKER), export="x.onnx")
    refused(script.main, args, "requirements-export.txt")


def test_export_needs_a_policy(refused):
    refused(script.main, script.Args(export="x.onnx"), "--eval")
