"""Whole steps of the three scripts on recorded inputs, against a reference in float64.

The reference is numpy alone: it follows the equations, back-propagates by hand and shares no function with the scripts.
Two things are taken over: which random numbers a key stands for, and the order of samples that `minibatches` makes.
"""

import dataclasses

import flax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import ppo_explore
import ppo_finetune
import pretrain_pidm
from experiment import devices, run

T, N, M, K = 8, 6, 4, 2  # rollout steps, environments, minibatches, history
OBS, X, A = 7, 10, 3  # observation, proprioception, action
MIRRORED = {"obs": OBS, "prop": X, "action": A}
TINY = {"history": (6, 5), "goal": (5, 4), "backbone": (7, 6), "head": (5,)}  # layer widths


# --- The reference: networks ---


def stack(tree, x, curved_end):
    """Dense layers with ELU between them, and after the last one if `curved_end`. x (B, I) -> (B, O).

    The second result maps a gradient of the output to those of the weights and of x.
    """
    inputs, slopes = [], []
    for i in range(len(tree)):
        layer = tree[f"Dense_{i}"]
        y = x @ layer["kernel"] + layer["bias"]
        low = np.exp(np.minimum(y, 0.0))
        curved = curved_end or i < len(tree) - 1
        inputs.append(x)
        slopes.append(np.where(y > 0, 1.0, low) if curved else np.ones_like(y))
        x = np.where(y > 0, y, low - 1) if curved else y

    def pull(grad):
        grads = {}
        for i in reversed(range(len(tree))):
            grad = grad * slopes[i]
            grads[f"Dense_{i}"] = {"kernel": inputs[i].T @ grad, "bias": grad.sum(0)}
            grad = grad @ tree[f"Dense_{i}"]["kernel"].T
        return grads, grad

    return x, pull


def pidm(tree, history, wanted, encoder, decoder, skip):
    """A PIDM (Fig. 3), whose decoder also sees the encoded input `wanted` if `skip`. Returns as `stack` does."""
    z_history, pull_history = stack(tree["history_encoder"], history, True)
    z_wanted, pull_wanted = stack(tree[encoder], wanted, True)
    z, pull_z = stack(tree["backbone"], np.concatenate([z_history, z_wanted], 1), True)
    out, pull_out = stack(tree[decoder], np.concatenate([z, z_wanted], 1) if skip else z, False)

    def pull(grad):
        grads = {}
        grads[decoder], grad = pull_out(grad)
        grad, skipped = np.split(grad, [z.shape[1]], 1)
        grads["backbone"], grad = pull_z(grad)
        grad, grad_wanted = np.split(grad, [z_history.shape[1]], 1)
        grads["history_encoder"], _ = pull_history(grad)
        grads[encoder], _ = pull_wanted(grad_wanted + (skipped if skip else 0.0))
        return grads

    return out, pull


def scaled(norm, name, x):
    return np.clip((x - norm[f"{name}_mean"]) / norm[f"{name}_std"], -5, 5)


def history_input(norm, prop, action):
    """prop (B, K+1, X) and action (B, K, A) -> (B, (K+1) X + K A)."""
    parts = scaled(norm, "prop", prop), scaled(norm, "action", action)
    return np.concatenate([part.reshape(len(part), -1) for part in parts], 1)


def branch(params, name, inputs):
    """Output of actor or critic (B, O), and the function from its gradient to those of the weights."""
    tree = params["params"][name]
    if "backbone" not in tree:
        out, pull = stack(tree, inputs["obs"], False)
        return out, lambda grad: pull(grad)[0]
    history = history_input(params["normalizer"], inputs["prop"], inputs["action"])
    end = {"actor": "action_synthesizer", "critic": "value_synthesizer"}[name]
    return pidm(tree, history, inputs["obs"], "intention_encoder", end, True)


# --- The reference: PPO ---


def advantages(args, reward, done, value, last_value):
    """A_t = sum of (gamma lambda)^k delta_{t+k} up to the end of the episode (Schulman et al. 2016, eq. 16)."""
    following = np.concatenate([value[1:], last_value[None]])
    delta = reward + args.gamma * following * (1 - done) - value
    advantage = np.zeros_like(delta)
    for t in range(len(delta)):
        weight = np.ones_like(last_value)
        for later in range(t, len(delta)):
            advantage[t] += weight * delta[later]
            weight = weight * args.gamma * args.gae_lambda * (1 - done[later])
    return advantage


def losses_and_gradients(args, params, batch, log_std_old, mirror):
    """Losses of one minibatch, and the gradient of their weighted sum for each weight."""
    log_std = params["params"]["log_std"]
    std, size = np.exp(log_std), len(batch["action"])
    mean, pull_mean = branch(params, "actor", batch["inputs"])
    value, pull_value = branch(params, "critic", batch["inputs"])
    value, advantage, ret = value[:, 0], batch["advantage"], batch["return"]
    loss = {}

    # L = -E[min(r A, clip(r) A)]; beyond the clip the loss is flat where clipping makes it smaller
    z = (batch["action"] - mean) / std
    log_prob = np.sum(-0.5 * z**2 - log_std - 0.5 * np.log(2 * np.pi), 1)
    ratio = np.exp(log_prob - batch["log_prob"])
    flat = ((ratio > 1 + args.clip) & (advantage > 0)) | ((ratio < 1 - args.clip) & (advantage < 0))
    limit = np.where(advantage > 0, 1 + args.clip, 1 - args.clip)
    loss["policy_loss"] = -np.mean(np.where(flat, limit, ratio) * advantage)
    slope = -np.where(flat, 0.0, ratio * advantage) / size  # of the loss over log_prob
    grad_mean = slope[:, None] * z / std
    grad_log_std = slope @ (z**2 - 1) - args.entropy_coef

    # the larger of two squared errors, one of a value near the old one
    moved = value - batch["value"]
    near = batch["value"] + np.clip(moved, -args.clip, args.clip)
    worse = (near - ret) ** 2 > (value - ret) ** 2
    loss["value_loss"] = np.mean(np.where(worse, near - ret, value - ret) ** 2)
    stuck = worse & (np.abs(moved) > args.clip)
    grad_value = args.value_coef * np.where(stuck, 0.0, 2 * (value - ret)) / size

    loss["entropy"] = np.sum(log_std + 0.5 * np.log(2 * np.pi * np.e))
    spread = np.exp(2 * log_std_old) + (mean - batch["mean"]) ** 2
    loss["kl"] = np.mean(np.sum(log_std - log_std_old + spread / (2 * std**2) - 0.5, 1))
    loss["clip_fraction"] = np.mean(np.abs(ratio - 1) > args.clip)

    # the actor on mirror images should answer with the mirror image; every fourth sample
    some = {name: x[::4] for name, x in batch["inputs"].items()}
    image = {name: mirror[name][1] * x[..., mirror[name][0]] for name, x in some.items()}
    wanted = mirror["action"][1] * mean[::4][:, mirror["action"][0]]
    answer, pull_answer = branch(params, "actor", image)
    loss["mirror_loss"] = np.mean((answer - wanted) ** 2)
    grad_answer = args.mirror_coef * 2 * (answer - wanted) / answer.size

    actor = jax.tree.map(np.add, pull_mean(grad_mean), pull_answer(grad_answer))
    return loss, {"actor": actor, "log_std": grad_log_std}, {"critic": pull_value(grad_value[:, None])}


class Adam:
    """Kingma and Ba 2015, algorithm 1, with step size 1."""

    def __init__(self, like):
        self.first = self.second = jax.tree.map(np.zeros_like, like)
        self.count = 0

    def step(self, grads):
        self.count += 1
        self.first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, self.first, grads)
        self.second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, self.second, grads)
        unbias = 1 - 0.9**self.count, 1 - 0.999**self.count
        return jax.tree.map(lambda m, v: m / unbias[0] / (np.sqrt(v / unbias[1]) + 1e-8), self.first, self.second)


def clipped(grads, limit):
    """Gradients of a norm of at most `limit`, and their norm before."""
    norm = np.sqrt(sum(np.sum(grad**2) for grad in jax.tree.leaves(grads)))
    return jax.tree.map(lambda grad: grad * min(1.0, limit / (norm + 1e-6)), grads), norm


@dataclasses.dataclass
class Trained:
    params: dict
    adam: Adam
    losses: dict  # arrays with an entry for each minibatch step
    sizes: list  # step sizes, the first one before all steps
    roll: dict


def ppo(args, params, lr, roll, minibatches):
    """All minibatch steps on a rollout of flat arrays (T N, ...); minibatches yields (indices, mirror tables).

    mirror is a mirror's tables of permutations and signs, as in `Env.mirrors`.
    """
    log_std_old, weights = params["params"]["log_std"], params["params"]
    standard = (roll["advantage"] - roll["advantage"].mean()) / (roll["advantage"].std() + 1e-8)
    adam, log, sizes = Adam(weights), [], [lr]
    for index, mirror in minibatches:
        batch = jax.tree.map(lambda x, index=index: x[index], roll | {"advantage": standard})
        loss, actor, critic = losses_and_gradients(args, params | {"params": weights}, batch, log_std_old, mirror)
        if loss["kl"] > 2 * args.desired_kl:
            lr = max(lr / 1.5, 1e-5)
        elif 1e-9 < loss["kl"] < args.desired_kl / 2:  # exactly 0 at the first step, but for rounding in float64
            lr = min(lr * 1.5, 1e-2)
        actor, loss["actor_grad_norm"] = clipped(actor, args.max_grad_norm)
        critic, loss["critic_grad_norm"] = clipped(critic, args.max_grad_norm)
        weights = jax.tree.map(lambda w, step, lr=lr: w - lr * step, weights, adam.step(actor | critic))
        log.append(loss)
        sizes.append(lr)
    losses = {name: np.array([one[name] for one in log]) for name in log[0]}
    return Trained(params | {"params": weights}, adam, losses, sizes, roll)


# --- Recorded inputs ---


@flax.struct.dataclass
class Frame:
    """A recorded environment state: what the scripts read of `envs.base.State`."""

    obs: jax.Array
    history: dict
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    final_obs: jax.Array
    final_history: dict
    physics: jax.Array  # here a number alone
    clock: jax.Array  # position in the recording
    number: jax.Array  # of the environment
    metrics: dict


@flax.struct.dataclass
class Speed:
    lin_vel: jax.Array


class Recording:
    """An environment that plays T + 1 recorded frames of N robots, in which the reward depends on the action as well.

    Observations and histories are independent random numbers, so that none can stand for another unnoticed.
    """

    bootstrap_time_outs, dt = True, 0.02
    prop_layout = ("ang_vel", "gravity", "joint_pos", "joint_vel")

    def __init__(self, seed):
        rng = np.random.default_rng(seed)

        def numbers(*shape):
            return rng.normal(size=(T + 1, N, *shape)).astype(np.float32)

        def history():
            return {"prop": 2 * numbers(K + 1, X), "action": numbers(K, A)}

        ends = rng.choice(3, (T + 1, N), p=(0.6, 0.2, 0.2))
        self.frames = Frame(
            obs=numbers(OBS),
            history=history(),
            reward=numbers(),
            terminated=ends == 1,
            truncated=ends == 2,
            final_obs=numbers(OBS),
            final_history=history(),
            physics=numbers(),
            clock=np.tile(np.arange(T + 1)[:, None], N),
            number=np.tile(np.arange(N), (T + 1, 1)),
            metrics={"episode_return": numbers(), "reward/some": numbers()},
        )
        self.mirrors = {name: self.tables(rng) for name in ("left_right", "front_back")}

    @staticmethod
    def tables(rng):
        signs = {name: rng.choice([-1.0, 1.0], size).astype(np.float32) for name, size in MIRRORED.items()}
        return {name: (rng.permutation(size), signs[name]) for name, size in MIRRORED.items()}

    def width(self, kind):
        return 2 if kind == "joint" else 3

    def motion(self, physics):
        return Speed(physics * jnp.arange(3.0))

    def on_rough(self, physics):
        return physics > 0

    def start(self):
        return jax.tree.map(lambda x: jnp.asarray(x[0]), self.frames)

    def step(self, state, action):
        after = jax.tree.map(lambda x: jnp.asarray(x)[state.clock + 1, state.number], self.frames)
        return after.replace(reward=after.reward + 0.3 * action.sum())


def float64(tree):
    """Arrays of a pytree as float64, or boolean or integer as they are."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def randomised(shapes, rng, *lead):
    """Weights and biases large enough for every part of a network to matter; no two normalizer entries alike."""

    def draw(path, leaf):
        name, shape = path[-1].key, (*lead, *leaf.shape)
        if name in ("prop_std", "action_std"):
            return jnp.asarray(0.3 + rng.random(shape), jnp.float32)
        return jnp.asarray(rng.normal(size=shape) * (0.1 if name == "log_std" else 0.35), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def random_normalizer(rng):
    """Mean and std of the PIDM's inputs."""
    sizes = {"prop": X, "action": A, "delta": X}
    norm = {f"{name}_mean": jnp.asarray(rng.normal(size=size), jnp.float32) for name, size in sizes.items()}
    return norm | {f"{name}_std": jnp.asarray(0.5 + rng.random(size), jnp.float32) for name, size in sizes.items()}


def shapes_of_pidm(net):
    history = np.zeros((K + 1) * X + K * A, np.float32)
    return jax.eval_shape(net.init, jax.random.key(0), history, np.zeros(X, np.float32))["params"]


def roll_out(args, params, env, key):
    """The rollout in numpy: flat arrays (T N, ...) for `ppo`, and done (T, N), bootstrap (T, N) and last value (N,)."""
    frames, std = float64(env.frames), np.exp(params["params"]["log_std"])
    noise = float64(jax.jit(jax.vmap(lambda k: jax.random.normal(k, (N, A))))(jax.random.split(key, T)))

    def flat(tree, rows):
        return jax.tree.map(lambda x: x[rows].reshape(-1, *x.shape[2:]), tree)

    def value_of(obs, history, rows):
        return branch(params, "critic", flat({"obs": obs, **history}, rows))[0][:, 0]

    before, after = slice(0, T), slice(1, T + 1)
    inputs = flat({"obs": frames.obs, **frames.history}, before)
    mean, value = branch(params, "actor", inputs)[0], value_of(frames.obs, frames.history, before)
    action = mean + std * noise.reshape(-1, A)
    log_prob = np.sum(-0.5 * noise**2, -1).ravel() - np.sum(np.log(std * (2 * np.pi) ** 0.5))
    reward = frames.reward[after] + 0.3 * action.sum(1).reshape(T, N)
    final_value = value_of(frames.final_obs, frames.final_history, after).reshape(T, N)
    bootstrap = np.where(frames.truncated[after], args.gamma * final_value, 0.0)
    done = (frames.terminated | frames.truncated)[after]
    last_value = value_of(frames.obs, frames.history, slice(T, T + 1))
    roll = {"inputs": inputs, "action": action, "mean": mean, "log_prob": log_prob, "value": value}
    return roll, reward, bootstrap, done, last_value


def orders(script, args, env, key):
    """Indices and mirror of every minibatch step."""

    def epoch(key):
        k_order, k_mirror = jax.random.split(key)
        chosen = [
            jax.random.randint(k, (), 0, len(env.mirrors)) for k in jax.random.split(k_mirror, args.num_minibatches)
        ]
        return script.minibatches(args, k_order, jnp.arange(T * N).reshape(T, N)), jnp.stack(chosen)

    order, chosen = jax.jit(jax.vmap(epoch))(jax.random.split(key, args.num_epochs))
    mirrors = [list(env.mirrors.values())[number] for number in np.ravel(chosen)]
    return zip(np.asarray(order).reshape(len(mirrors), -1), mirrors, strict=True)


def train(script, args, env, params, lr, keys, extra_reward=0.0):
    """One PPO iteration in numpy."""
    k_roll, k_update = keys
    roll, reward, bootstrap, done, last_value = roll_out(args, params, env, k_roll)
    value = roll["value"].reshape(T, N)
    roll["advantage"] = advantages(args, reward + bootstrap + extra_reward, done, value, last_value).ravel()
    roll["return"] = roll["advantage"] + roll["value"]
    return ppo(args, params, lr, roll, orders(script, args, env, k_update))


def compare(got, want, rtol=1e-5, atol=5e-6):
    """Every leaf of two pytrees of one structure, named in the message."""
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for (path, one), other in zip(jax.tree.leaves_with_path(want), jax.tree.leaves(got), strict=True):
        np.testing.assert_allclose(other, one, rtol, atol, err_msg=jax.tree_util.keystr(path))


def compare_training(args, state, report, want):
    """Weights, Adam's moments and losses after an iteration, on inputs that reach both sides of every bound."""
    assert 0.05 < want.losses["clip_fraction"].max() < 1
    for part in ("actor", "critic"):
        norms = want.losses[f"{part}_grad_norm"]
        assert norms.min() < args.max_grad_norm < norms.max(), norms
    assert set(np.sign(np.diff(want.sizes))) == {-1, 0, 1}, want.sizes
    compare({name: report[name] for name in want.losses}, {name: loss.mean() for name, loss in want.losses.items()})
    compare(state.params, want.params)
    compare(state.lr, want.sizes[-1])
    compare(state.opt_state.mu["params"], want.adam.first)
    compare(state.opt_state.nu["params"], want.adam.second)
    assert state.opt_state.count == want.adam.count == args.num_epochs * args.num_minibatches
    compare(report["action_std"], np.exp(want.params["params"]["log_std"]).mean())


# --- Stage 3 ---

STEPS = dict(num_envs=N, num_steps=T, num_epochs=3, num_minibatches=M, shuffle_blocks=2, max_grad_norm=1.0)
PPO = dict(gamma=0.9, gae_lambda=0.8, clip=0.1, value_coef=0.7, entropy_coef=0.02, mirror_coef=0.3, lr=2e-3)


@pytest.mark.parametrize(("network", "piece"), [("mlp", None), ("pidm", None), ("pidm", 8)])
def test_iteration_of_stage_three(network, piece, monkeypatch):
    """Losses, gradients, step size and weights after 12 minibatch steps on a rollout; or 9, each in two pieces of 8."""
    env, key, opt = Recording(0), jax.random.key(3), optax.scale_by_adam()
    args = ppo_finetune.Args(network=network, desired_kl=0.008, **STEPS, **PPO)
    if piece:
        monkeypatch.setattr(devices, "PIECE", piece)
        args = dataclasses.replace(args, num_minibatches=3, desired_kl=0.004)
    if network == "mlp":
        net = ppo_finetune.ActorCritic((6, 5), A, 1.0)
    else:
        net = ppo_finetune.PIDMActorCritic(TINY, X, A, 1.0, "orthogonal")
    start = env.start()
    params = randomised(jax.eval_shape(net.init, key, net.inputs(start.obs, start.history)), np.random.default_rng(1))
    state = ppo_finetune.TrainState(params, jax.jit(opt.init)(params), jnp.float32(args.lr), start, key, jnp.int32(5))
    after, report = jax.jit(lambda state: ppo_finetune.iteration(args, env, net, opt, state))(state)

    want = train(ppo_finetune, args, env, float64(params), args.lr, jax.random.split(jax.random.fold_in(key, 5)))
    compare_training(args, after, report, want)
    compare(report["explained_variance"], 1 - np.var(want.roll["advantage"]) / np.var(want.roll["return"]))
    changes = [name for name in report if name.startswith("update/")]
    assert len(changes) == (8 if network == "pidm" else 0)
    for name in changes:
        _, part, module = name.split("/")
        old, new = (tree["params"][part][module] for tree in (float64(params), want.params))
        compare(report[name], np.mean([np.abs(new[i]["kernel"] - old[i]["kernel"]).mean() for i in new]))
    assert after.iteration == 6 and int(after.env_state.clock[0]) == T


class FoundError(Exception):
    pass


@pytest.mark.parametrize(
    ("script", "more", "sizes"),
    [(ppo_finetune, {}, {"opt": 1.0}), (ppo_explore, {"ensemble_lr": 0.25}, {"opt": 1.0, "member_opt": -0.25})],
)
def test_trainings_have_the_adam_of_the_reference(script, more, sizes, tmp_path, monkeypatch):
    """The scripts' own optimisers, on gradients so small that epsilon shows."""

    def start(self, init):
        raise FoundError(init.keywords)

    monkeypatch.setattr(run.Run, "start", start)
    with pytest.raises(FoundError) as found:
        script.main(script.Args(preset="smoke", run_dir=str(tmp_path), **more))
    (parts,) = found.value.args
    for name, size in sizes.items():
        adam, state = Adam({"w": np.zeros(2)}), parts[name].init({"w": jnp.zeros(2)})
        for gradient in ([3e-8, -2.0], [-1e-8, 0.5]):
            step, state = parts[name].update({"w": jnp.array(gradient)}, state)
            compare(step["w"], size * adam.step({"w": np.array(gradient)})["w"], rtol=1e-4)


# --- Stage 1 ---

MEMBERS, BATCH = 3, 16
MEMBER = {"history": (6, 5), "goal": (4, 3), "backbone": (6, 5), "head": ()}


def guesses(params, norm, batch):
    """Predicted mean (B, A) and log variance (B, A) of one member, whether the latter is in bounds, and `pull`."""
    history = history_input(norm, batch["prop"], batch["past"])
    delta = scaled(norm, "delta", batch["delta"])
    out, pull = pidm(params, history, delta, "delta_encoder", "prediction_decoder", False)
    mean, log_var = np.split(out, 2, 1)
    return mean, np.clip(log_var, -8, 4), (log_var > -8) & (log_var < 4), pull


def member(tree, number):
    return jax.tree.map(lambda x: x[number], tree)


def fit_ensemble(args, params, buffer, filled, key):
    """Train every member on bootstrap samples of its own. Returns params, normalizer and mean loss."""
    k_norm, k_fit = jax.random.split(key)
    rows = np.asarray(jax.random.randint(k_norm, (4096,), 0, filled))
    arrays = {"prop": buffer["prop"][:, -1], "action": buffer["action"], "delta": buffer["delta"]}
    norm = {f"{name}_mean": x[rows].mean(0) for name, x in arrays.items()}
    norm |= {f"{name}_std": x[rows].std(0) + 1e-3 for name, x in arrays.items()}
    draws = np.asarray(jax.random.randint(k_fit, (args.ensemble_steps, MEMBERS, BATCH), 0, filled))
    members, losses = [], []
    for number in range(MEMBERS):
        weights = member(params, number)
        adam = Adam(weights)
        for draw in draws[:, number]:
            batch = {name: x[draw] for name, x in buffer.items()}
            mean, log_var, free, pull = guesses(weights, norm, batch)
            wrong, precision = batch["action"] - mean, np.exp(-log_var)
            losses.append(0.5 * np.mean(wrong**2 * precision + log_var))
            slopes = -wrong * precision, np.where(free, 0.5 - 0.5 * wrong**2 * precision, 0.0)
            step = adam.step(pull(np.concatenate(slopes, 1) / wrong.size))
            weights = jax.tree.map(lambda w, u: w - args.ensemble_lr * u, weights, step)
        members.append(weights)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *members), norm, np.mean(losses)


def first_ensemble(net, opt, rng):
    """Members that disagree, two of whose log variances lie beyond their bounds."""
    params = randomised(shapes_of_pidm(net), rng, MEMBERS)
    bias = params["prediction_decoder"]["Dense_0"]["bias"]
    params["prediction_decoder"]["Dense_0"]["bias"] = bias.at[:, A].set(6.0).at[1, A + 1].set(-10.0)
    return ppo_explore.Ensemble(params, jax.jit(opt.init)(params), random_normalizer(rng), jnp.float32(0.3))


@pytest.fixture(scope="module")
def stage_one():
    """iterate(number): args, recording, the state before this iteration, and its results."""
    env, rng, opt = Recording(2), np.random.default_rng(3), optax.scale_by_adam()
    args = ppo_explore.Args(members=MEMBERS, ensemble_batch=BATCH, ensemble_steps=4, buffer_rollouts=3, seed=4)
    args = dataclasses.replace(args, disagreement_coef=20.0, desired_kl=0.008, **STEPS, **PPO)
    net, small, small_opt = ppo_explore.ActorCritic((6, 5), A, 1.0), ppo_explore.PIDM(MEMBER, 2 * A), optax.adam(1e-3)
    start = env.start()
    params = randomised(jax.eval_shape(net.init, jax.random.key(0), net.inputs(start.obs, start.history)), rng)
    shapes = (K + 1, X), (K, A), (X,), (A,)
    buffer = ppo_explore.Transitions(*(jnp.float32(rng.normal(size=(3 * T * N, *shape))) for shape in shapes))
    first = jnp.asarray(rng.random(N) < 0.5)
    ensemble, lr = first_ensemble(small, small_opt, rng), jnp.float32(args.lr)
    run = jax.jit(lambda state: ppo_explore.iteration(args, env, net, opt, small, small_opt, state))

    def iterate(number):
        state = ppo_explore.TrainState(
            params, jax.jit(opt.init)(params), lr, start, first, ensemble, buffer, jnp.int32(number)
        )
        return args, env, state, *run(state)

    return iterate


@pytest.mark.parametrize("number", [1, 5])
def test_iteration_of_stage_one(stage_one, number):
    """As in stage 3, with disagreement in the reward. Then the ensemble learns; its ring buffer is not always full."""
    args, env, before, after, (report, data) = stage_one(number)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), number), 3)
    params, ensemble, frames = float64(before.params), float64(before.ensemble), float64(env.frames)

    # the ensemble judges the rollout before it learns from it
    roll, *_ = roll_out(args, params, env, keys[0])
    prop, past = roll["inputs"]["prop"], roll["inputs"]["action"]
    delta = frames.final_history["prop"][1:, :, -1].reshape(-1, X) - prop[:, -1]
    seen = {"prop": prop, "past": past, "delta": delta, "action": roll["action"]}
    means = np.stack([guesses(member(ensemble.params, i), ensemble.norm, seen)[0] for i in range(MEMBERS)])
    novelty = ((means - means.mean(0)) ** 2).mean((0, 2))
    scale = 0.8 * 0.3 + 0.2 * novelty.mean()
    extra = 20.0 * env.dt * novelty.reshape(T, N) / scale
    want = train(ppo_explore, args, env, params, args.lr, keys[:2], extra)
    compare_training(args, after, report, want)
    compare(after.ensemble.scale, scale)
    compare(report["disagreement"], novelty.mean())
    compare(report["ensemble_error"], np.abs(means.mean(0) - roll["action"]).mean())
    compare(report["action_size"], np.abs(roll["action"]).mean())

    # the rollout takes its place in the ring, then the ensemble trains
    place, filled = {1: (T * N, 2 * T * N), 5: (2 * T * N, 3 * T * N)}[number]
    buffer = float64({name: getattr(before.buffer, name) for name in seen})
    for name, x in seen.items():
        buffer[name][place : place + T * N] = x
        compare(getattr(after.buffer, name), buffer[name])
    weights, norm, loss = fit_ensemble(args, ensemble.params, buffer, filled, keys[2])
    compare(after.ensemble.params, weights)
    compare(after.ensemble.norm, norm)
    compare(report["ensemble_nll"], loss)

    # what is stored
    compare(data["x"], prop[:, -1].reshape(T, N, X))
    compare(data["action"], roll["action"].reshape(T, N, A))
    compare(data["lin_vel"], frames.physics[:T, :, None] * np.arange(3))
    np.testing.assert_array_equal(data["rough"], frames.physics[:T] > 0)
    done = (frames.terminated | frames.truncated)[1:]
    np.testing.assert_array_equal(data["first"], np.concatenate([before.first[None], done[:-1]]))
    np.testing.assert_array_equal(after.first, done[-1])
    assert after.iteration == number + 1


# --- Stage 2 ---

WIDTH = np.array([0.2] * 3 + [0.05] * 3 + [0.01] * 2 + [1.5] * 2)  # of sensor noise, for each entry of x


def disturbed(args, env, batch, key):
    """Windows with noise, half of them mirrored by each mirror."""
    k_noise, k_mirror = jax.random.split(key)
    noise = [
        float64(jax.random.uniform(k, batch[name].shape, minval=-1.0))
        for k, name in zip(jax.random.split(k_noise), ("prop", "next_x"), strict=True)
    ]
    clean = float64(batch)
    image = clean | {"prop": clean["prop"].copy(), "next_x": clean["next_x"] + args.noise * WIDTH * noise[1]}
    for b, pad in enumerate(batch["pad"]):
        for k in range(K + 1):  # a padded state is the first one again, with the same noise
            read = max(k, pad)
            image["prop"][b, k] = clean["prop"][b, read] + args.noise * WIDTH * noise[0][b, read]
    for tables, k in zip(env.mirrors.values(), jax.random.split(k_mirror, len(env.mirrors)), strict=True):
        for b in np.flatnonzero(jax.random.bernoulli(k, 0.5, (len(batch["pad"]),))):
            for name, kind in (("prop", "prop"), ("past", "action"), ("next_x", "prop"), ("action", "action")):
                image[name][b] = tables[kind][1] * image[name][b][..., tables[kind][0]]
    return image


def test_steps_of_stage_two():
    """Loss, gradients and weights of three Adam steps, noise and mirrors switched on."""
    env, rng, opt = Recording(5), np.random.default_rng(6), optax.scale_by_adam()
    args, net = pretrain_pidm.Args(noise=0.7), pretrain_pidm.PIDM(TINY, A)
    variables = {"params": randomised(shapes_of_pidm(net), rng), "normalizer": random_normalizer(rng)}
    step, state = pretrain_pidm.make_step(args, env, net, opt), opt.init(variables["params"])
    want = float64(variables)
    adam = Adam(want["params"])
    for number in range(3):
        shapes = {"prop": (K + 1, X), "past": (K, A), "next_x": (X,), "action": (A,)}
        batch = {name: rng.normal(size=(20, *shape)).astype(np.float32) for name, shape in shapes.items()}
        batch["pad"] = rng.integers(0, K + 1, 20)
        key = jax.random.key(number)
        variables, state, loss = step(variables, state, batch, key, 0.01)

        seen = disturbed(args, env, batch, key)
        history = history_input(want["normalizer"], seen["prop"], seen["past"])
        delta = scaled(want["normalizer"], "delta", seen["next_x"] - seen["prop"][:, -1])
        out, pull = pidm(want["params"], history, delta, "delta_encoder", "prediction_decoder", False)
        update = adam.step(pull(np.sign(out - seen["action"]) / out.size))
        want["params"] = jax.tree.map(lambda w, u: w - 0.01 * u, want["params"], update)
        compare(loss, np.mean(np.abs(out - seen["action"])))
        compare(variables, want)
        compare(state.mu, adam.first)
        compare(state.nu, adam.second)
