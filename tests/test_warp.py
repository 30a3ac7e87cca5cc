"""Engine warp does what engine c does. It runs on a CPU too, slowly; skipped where warp-lang is not installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from experiment import devices
from experiment.run import Progress

pytest.importorskip("warp")


def drive(engine, task, steps, **options):
    """Physics of two robots, (steps, 2, ...), 1 mm in the ground at first and moved by the same random targets."""
    env = envs.make(task, engine, spawn_velocity=0.0, **options)
    physics = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2)).physics
    physics = physics.replace(qpos=physics.qpos.at[:, 2].add(-0.001))
    targets = env.default_pose + 0.05 * jax.random.normal(jax.random.key(1), (steps, 2, env.action_dim))
    step = jax.vmap(env.engine.step)
    return jax.device_get(jax.jit(lambda p, t: jax.lax.scan(lambda p, t: (step(p, t),) * 2, p, t)[1])(physics, targets))


@pytest.mark.parametrize("task", ["go1_loco", "anymal_climb_down"])
def test_warp_agrees_with_c(task):
    """On a plane, and on the box of climbing down; with each robot's own friction and masses."""
    options = {"level": 4} if task == "anymal_climb_down" else {}
    c, warp = (drive(engine, task, 25, **options) for engine in ("c", "warp"))
    np.testing.assert_allclose(c.qpos[:5], warp.qpos[:5], atol=1e-4)
    np.testing.assert_allclose(c.qpos, warp.qpos, atol=1e-2)
    np.testing.assert_allclose(c.torque[:5], warp.torque[:5], atol=0.1)
    np.testing.assert_allclose(c.sensors[:5], warp.sensors[:5], atol=5.0)  # contact forces reach 500 N
    assert not warp.overflow.any()


def test_overflow_is_seen_and_reported(capsys):
    """With room for one contact a simulation most are dropped: every robot says so, and so does the progress line."""
    env = envs.make("go1_loco", "warp")
    env.engine.contacts = 1
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))
    state = jax.jit(jax.vmap(env.step))(state, jnp.zeros((2, env.action_dim)))
    assert state.metrics["overflow"].all()
    row = {name: float(value.mean()) for name, value in state.metrics.items()}
    with Progress(1, ()) as progress:
        for _ in range(2):
            progress.show(row | {"env_steps": 0, "iteration": 1, "seconds": 0.0}, 0.0)
    assert capsys.readouterr().out.count("no room for some contacts") == 1


def test_seeds_and_environments_are_one_batch():
    """vmap over seeds of vmap over environments: room is made for all, numbers are those of one flat batch."""
    env = envs.make("go1_loco", "warp")
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    targets = env.default_pose + 0.2 * jax.random.normal(jax.random.key(1), (4, 12))
    flat = jax.jit(jax.vmap(env.engine.step))(state.physics, targets)
    nest = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), (state.physics, targets))
    nested = jax.jit(jax.vmap(jax.vmap(env.engine.step)))(*nest)
    np.testing.assert_allclose(flat.qpos, nested.qpos.reshape(4, -1), atol=1e-6)
    assert not nested.overflow.any()


def test_scripts_refuse_it_without_a_gpu():
    with pytest.raises(ValueError, match="engine warp needs an NVIDIA GPU, here is none that JAX sees; choose"):
        devices.check_engine(envs.make("go1_loco", "warp").engine)
