"""PPO pieces against hand-worked numbers and plain numpy; the functions under test are the script's own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import ppo_finetune as script
from envs.base import State

ARGS = script.Args(
    shuffle_blocks=1,
    num_envs=4,
    num_steps=3,
    num_minibatches=2,
    gamma=0.9,
    gae_lambda=0.8,
    entropy_coef=0.01,
    mirror_coef=0.1,
    desired_kl=0.01,
)


def test_gae_by_hand():
    """gamma 0.9, lambda 0.8, rewards 1 2 3, values 0.5 1 1.5, then V = 2; nothing ends.

    delta = 1+0.9*1-0.5 = 1.4, 2+0.9*1.5-1 = 2.35, 3+0.9*2-1.5 = 3.3
    A_2 = 3.3, A_1 = 2.35+0.72*3.3 = 4.726, A_0 = 1.4+0.72*4.726 = 4.80272
    """
    reward, value = jnp.array([[1.0], [2.0], [3.0]]), jnp.array([[0.5], [1.0], [1.5]])
    advantage, ret = script.gae(ARGS, reward, jnp.zeros((3, 1)), value, jnp.array([2.0]))
    np.testing.assert_allclose(advantage[:, 0], [4.80272, 4.726, 3.3], rtol=1e-6)
    np.testing.assert_allclose(ret[:, 0], [5.30272, 5.726, 4.8], rtol=1e-6)


def test_termination_cuts_the_advantage():
    """Steps after the end of an episode do not change the advantages before it."""
    value, done = jnp.ones((3, 1)), jnp.array([[0.0], [1.0], [0.0]])
    calm, _ = script.gae(ARGS, jnp.zeros((3, 1)), done, value, jnp.array([0.0]))
    wild, _ = script.gae(ARGS, jnp.array([[0.0], [0.0], [99.0]]), done, value, jnp.array([99.0]))
    np.testing.assert_array_equal(calm[:2], wild[:2])
    assert calm[1, 0] == -1.0


class Clockwork:
    """An environment of numbers: V(final_obs) is known, env 0 times out, env 1 fails, env 2 goes on."""

    bootstrap_time_outs = True

    def step(self, state, action):
        ends = state.obs[0]
        return state.replace(
            reward=jnp.float32(1.0),
            terminated=ends == 1,
            truncated=ends == 0,
            final_obs=jnp.array([5.0]),
            metrics={"episode_return": 0.0, "episode_seconds": 0.0},
        )


class Plain:
    """A 'network' whose value is obs and whose action is 0."""

    def inputs(self, obs, history):
        return {"obs": obs}

    def apply(self, params, inputs, method=None):
        value = inputs["obs"][..., 0]
        return value if method is not None else (jnp.zeros((*value.shape, 1)), jnp.zeros(1), value)

    def value(self):
        raise AssertionError("only a name")


@pytest.mark.parametrize("bootstraps", [True, False])
def test_time_out_bootstraps_and_termination_does_not(bootstraps):
    """Only the time-out gets gamma * V(final_obs) = 0.9 * 5, and only where the task wants it; reward stays 1."""
    env = Clockwork()
    env.bootstrap_time_outs = bootstraps
    blank = dict.fromkeys(field.name for field in dataclasses.fields(State))
    three = jnp.zeros(3)
    state = State(
        **blank
        | {
            "obs": jnp.array([[0.0], [1.0], [2.0]]),
            "final_obs": jnp.zeros((3, 1)),
            "history": {},
            "final_history": {},
            "reward": three,
            "terminated": three > 0,
            "truncated": three > 0,
            "metrics": {"episode_return": three, "episode_seconds": three},
        }
    )
    args = dataclasses.replace(ARGS, num_steps=1)
    _, (roll, metrics) = script.rollout(args, env, Plain(), {}, state, jax.random.key(0))
    np.testing.assert_allclose(roll.bootstrap[0], [4.5 if bootstraps else 0.0, 0, 0], rtol=1e-6)
    np.testing.assert_array_equal(roll.done[0], [True, True, False])
    np.testing.assert_array_equal(roll.reward[0], [1, 1, 1])
    assert metrics["sum/falls"][0] == 1 and metrics["sum/episodes"][0] == 2


class Fixed:
    """A 'network' that returns given numbers, to work the losses by hand."""

    def __init__(self, mean, log_std, value):
        self.out = jnp.asarray(mean), jnp.asarray(log_std), jnp.asarray(value)

    def apply(self, params, inputs):
        return self.out


class NoMirrors:
    """An environment of a robot without symmetry."""

    mirrors = {}


def made_up(**fields):
    """A minibatch of two samples, zeros but for these fields."""
    zeros = jnp.zeros(2)
    base = dict(inputs={"obs": zeros}, action=jnp.zeros((2, 1)), mean=jnp.zeros((2, 1)), log_prob=zeros, value=zeros)
    return script.Rollout(**base | dict(reward=zeros, bootstrap=zeros, done=zeros) | fields)


def test_losses_by_hand():
    """Ratios 2 and 0.5 with advantages 1 and -1: min(2, 1.2) = 1.2 and min(-0.5, -0.8) = -0.8, so the loss is -0.2.

    Values: old 0, new 1, return 2: clipped to 0.2, the larger error (2-0.2)^2 = 3.24 counts.
    Old 0, new -0.1, return -1: within the clip, (0.9)^2 = 0.81. Mean 2.025.
    """
    log_std = jnp.zeros(1)
    density = -0.5 * np.log(2 * np.pi)
    roll = made_up(log_prob=density - jnp.log(jnp.array([2.0, 0.5])))
    net = Fixed(jnp.zeros((2, 1)), log_std, jnp.array([1.0, -0.1]))
    batch = roll, jnp.array([1.0, -1.0]), jnp.array([2.0, -1.0])
    loss, m = script.ppo_loss(ARGS, NoMirrors, net, {}, log_std, batch, jax.random.key(0))
    assert m["policy_loss"] == pytest.approx(-0.2, rel=1e-5)
    assert m["value_loss"] == pytest.approx(2.025, rel=1e-5)
    assert m["entropy"] == pytest.approx(0.5 * np.log(2 * np.pi * np.e), rel=1e-6)
    assert m["clip_fraction"] == 1.0 and m["kl"] == 0.0
    assert loss == pytest.approx(-0.2 + 2.025 - 0.01 * float(m["entropy"]), rel=1e-5) and "mirror_loss" not in m


def test_no_gradient_beyond_the_clip():
    """A ratio above 1.2 with a positive advantage no longer moves the policy; below it does."""

    def policy_loss(mean, old_log_prob):
        net = Fixed(jnp.full((2, 1), mean), jnp.zeros(1), jnp.zeros(2))
        roll = made_up(action=jnp.ones((2, 1)), log_prob=jnp.full(2, old_log_prob))
        batch = roll, jnp.ones(2), jnp.zeros(2)
        return script.ppo_loss(ARGS, NoMirrors, net, {}, jnp.zeros(1), batch, jax.random.key(0))[1]["policy_loss"]

    now = float(script.log_prob(jnp.zeros(1), jnp.zeros(1), jnp.ones(1)))
    slope = jax.grad(policy_loss)
    assert slope(0.0, now - np.log(1.5)) == 0.0
    assert slope(0.0, now - np.log(1.1)) < 0.0


def test_gaussian_kl_against_sampling():
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(2, 3))
    log_std = 0.3 * rng.normal(size=(2, 3))
    got = script.gaussian_kl(mean[0], log_std[0], mean[1], log_std[1])
    samples = mean[0] + np.exp(log_std[0]) * rng.normal(size=(400_000, 3))
    logp = [np.asarray(script.log_prob(mean[i], log_std[i], samples), np.float64) for i in range(2)]
    assert got == pytest.approx(np.mean(logp[0] - logp[1]), rel=0.02)
    assert script.gaussian_kl(mean[0], log_std[0], mean[0], log_std[0]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("lr", "kl", "want"),
    [
        (1e-3, 0.03, 1e-3 / 1.5),
        (1e-3, 0.004, 1.5e-3),
        (1e-3, 0.01, 1e-3),
        (1e-5, 1.0, 1e-5),
        (9e-3, 1e-4, 1e-2),
        (1e-3, 0, 1e-3),
    ],
)
def test_adaptive_step_size(lr, kl, want):
    assert script.adapt_lr(ARGS, jnp.float32(lr), kl) == pytest.approx(want, rel=1e-5)


def test_step_size_has_a_largest_value():
    args = dataclasses.replace(ARGS, max_lr=3e-3)
    assert script.adapt_lr(args, jnp.float32(2.5e-3), 1e-4) == pytest.approx(3e-3, rel=1e-5)


def test_no_run_starts_above_its_largest_step_size(jitted):
    env = jitted("go1_loco").env
    args = script.merge(script.Args(preset="smoke", max_lr=5e-4), env.config.ppo)
    assert script.init_state(args, env, script.make_net(args, env), optax.scale_by_adam()).lr == np.float32(5e-4)


def test_gradients_are_clipped_apart():
    grads = {
        "params": {"actor": {"w": jnp.array([3.0, 4.0])}, "log_std": jnp.zeros(1), "critic": {"w": jnp.array([0.3])}}
    }
    clipped, norms = script.clip_gradients(ARGS, grads)
    np.testing.assert_allclose(norms, [5.0, 0.3], rtol=1e-6)
    np.testing.assert_allclose(clipped["params"]["actor"]["w"], [0.6, 0.8], rtol=1e-5)
    np.testing.assert_allclose(clipped["params"]["critic"]["w"], [0.3], rtol=1e-6)


def test_mirror_loss_of_an_equivariant_policy_is_zero(jitted):
    """A policy that commands mirrored actions for mirrored observations pays nothing; a lopsided one does."""
    env = jitted("anymal_loco").env
    inputs = {"obs": jax.random.normal(jax.random.key(0), (16, env.obs_dim))}

    class Policy:
        mean = None

        def __init__(self, lean):
            self.lean = lean

        def apply(self, params, inputs, method):
            return jnp.tanh(inputs["obs"][:, 12:24]) + self.lean  # joint positions map onto actions joint by joint

    losses = []
    for lean in (0.0, 0.1):
        policy = Policy(lean)
        mean = policy.apply({}, inputs, None)
        losses.append([float(script.mirror_loss(env, policy, {}, inputs, mean, jax.random.key(k))) for k in range(6)])
    assert max(losses[0]) < 1e-12 < 1e-4 < min(losses[1])


def test_update_visits_every_sample_once_an_epoch(monkeypatch):
    """A loss that counts the samples it is given sees each of the T*N exactly E times."""
    args = dataclasses.replace(ARGS, num_epochs=3, mirror_coef=0.0)

    def counting(args, env, net, params, log_std_old, batch, key):
        seen = jax.nn.one_hot(batch[0].inputs["obs"], 12).sum(0)
        return 0.0 * params["params"]["actor"], {"kl": jnp.float32(0), "seen": seen}

    monkeypatch.setattr(script, "ppo_loss", counting)
    monkeypatch.setattr(jnp, "mean", lambda x: x.sum(axis=(0, 1)) if x.ndim > 2 else x.mean())
    roll = jax.tree.map(lambda _: jnp.arange(12).reshape(3, 4), made_up())
    params = {"params": {"actor": jnp.float32(0), "critic": jnp.float32(0), "log_std": jnp.float32(0)}}
    opt = optax.scale_by_adam()
    state = script.TrainState(params, opt.init(params), jnp.float32(1e-3), None, None, 0)
    zeros = jnp.zeros((3, 4))
    _, metrics = script.update(args, None, None, opt, state, (roll, zeros, zeros), jax.random.key(0))
    np.testing.assert_array_equal(metrics["seen"], 3 * np.ones(12))


@pytest.mark.parametrize("blocks", [1, 2])
def test_minibatches_shuffle_within_blocks_of_environments(blocks):
    """Every sample once, half of every minibatch from each of two blocks, not in order."""
    args = dataclasses.replace(ARGS, num_envs=4, num_steps=6, num_minibatches=3, shuffle_blocks=blocks)
    env = jnp.tile(jnp.arange(4), (6, 1))
    sample = jnp.arange(24).reshape(6, 4)
    got, of_env = script.minibatches(args, jax.random.key(0), (sample, env))
    assert got.shape == (3, 8) and sorted(got.ravel().tolist()) == list(range(24)) != got.ravel().tolist()
    np.testing.assert_array_equal(got % 4, of_env)
    if blocks == 2:
        np.testing.assert_array_equal((of_env < 2).sum(1), 4)
