"""Stage 1: collect exploration data of one robot, without a task (paper Sec. IV-C).

    python ppo_explore.py --robot g1
    python ppo_explore.py --robot go1 --preset gpu

PPO learns to visit transitions on which an ensemble of small PIDMs disagrees; the ensemble is retrained after every
rollout. All transitions go to memory-mapped files, which pretrain_pidm.py reads.
Reads top to bottom: arguments, networks, ensemble, rollout, objective, update, dataset, records, main.
Shapes in comments: T rollout steps, N environments, B minibatch, O observation, X proprioception x_t, A action,
K history, M ensemble members, R transitions in the ring buffer.
"""

import dataclasses
import json
import os
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import flax
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import envs
from envs import devices, records

jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """Values left at None come from the preset or the robot; the merged set is printed and stored."""

    # --- Run ---
    robot: str = "go1"  # a name in envs.EXPLORE
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale: smoke 4 environments, cpu 256, gpu 4096
    seed: int = 0  # the only source of randomness
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), warp (NVIDIA), auto
    run_dir: str | None = None  # None: runs/explore/<robot>/seed<seed>
    force: bool = False  # overwrite the data in that folder
    resume: str | None = None  # a run folder: go on where it stopped; all other arguments are those of that run
    tensorboard: bool = False  # every row goes to TensorBoard event files in the run folder as well
    save_minutes: float = 2.0  # what --resume needs is written this often, and when interrupted
    log_every: int | None = None  # iterations per jitted chunk and CSV row
    # --- Data ---
    num_envs: int | None = None  # N
    num_steps: int | None = None  # T, per iteration and environment
    total_steps: int | None = None  # transitions to collect
    validation: float = 0.08  # share of environments held out (paper: 600 k of 7.6 M samples)
    # --- Exploration ---
    policy: Literal["explore", "random"] = "explore"  # random: the fresh policy throughout, for comparison
    disagreement_coef: float = 2.0  # reward per second of the mean disagreement: more than the regularisers take
    calm: float = 1.0  # beyond the paper: episodes scale all actions by a number of their own between this and 1
    members: int = 5  # M
    buffer_rollouts: int = 8  # R = N * T * buffer_rollouts
    ensemble_steps: int = 8  # gradient steps per iteration
    ensemble_batch: int = 512  # bootstrap sample of each member and step
    ensemble_lr: float = 1e-3
    # --- Network ---
    hidden: tuple[int, ...] | None = None  # widths of the policy's hidden layers
    init_std: float | None = None  # initial action std, in action units
    # --- PPO (as in ppo_finetune.py) ---
    num_epochs: int = 5
    num_minibatches: int = 4
    lr: float = 1e-3
    desired_kl: float = 0.01
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_coef: float = 1.0
    entropy_coef: float | None = None
    mirror_coef: float = 0.1
    max_grad_norm: float = 1.0
    # --- Devices ---
    distributed: bool = False  # one of several processes, one a host; process 0 writes the files
    shuffle_blocks: int | None = None  # blocks of environments that samples are shuffled within; None: one a device


PRESETS = {
    "smoke": {"num_envs": 4, "num_steps": 8, "total_steps": 4_000, "log_every": 25},
    "cpu": {"num_envs": 256, "num_steps": 24, "total_steps": 1_500_000, "log_every": 5},
    "gpu": {"num_envs": 4096, "num_steps": 24, "total_steps": 7_600_000, "log_every": 2},
}


COUNTS = ("num_envs", "num_steps", "total_steps", "log_every", "num_epochs", "num_minibatches", "members")
COUNTS += ("buffer_rollouts", "ensemble_steps", "ensemble_batch", "shuffle_blocks")


def num_held_out(args):
    """Environments whose transitions are for validation alone: at least one."""
    return max(round(args.validation * args.num_envs), 1)


def merge(args, ppo):
    """Fill what is None in args from the preset, then from the robot's own settings `ppo`; check the sizes."""
    values = PRESETS[args.preset] | {"hidden": ppo["hidden"], "init_std": ppo["init_std"]}
    values |= {"shuffle_blocks": jax.device_count()}
    values |= {"entropy_coef": ppo["entropy"], "run_dir": f"runs/explore/{args.robot}/seed{args.seed}"}
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    records.check_positive(args, COUNTS)
    if not 0 < args.validation < 1 or num_held_out(args) == args.num_envs:
        raise records.UserError(
            f"--validation {args.validation} of {args.num_envs} environments leaves training or validation empty"
        )
    if not 0 < args.calm <= 1:
        raise records.UserError(f"--calm must be above 0 and at most 1, not {args.calm}")
    records.check_minibatches(args)
    return args


# --- Networks ---


# >>> copy: networks (owner: pretrain_pidm.py)
CORE = ("history_encoder", "backbone")  # what a pretrained PIDM hands to actor and critic


@dataclass(frozen=True)
class Sizes:
    """Widths of the PIDM's parts: all the layers of each, but for the head's output (ours; the paper gives counts)."""

    history: tuple[int, ...] = (128, 64)
    goal: tuple[int, ...] = (64, 32)
    backbone: tuple[int, ...] = (192, 192, 192, 64)
    head: tuple[int, ...] = (64,)


SIZES = {
    "anymal_d": Sizes(),
    "go1": Sizes(),
    "g1": Sizes(history=(224, 96), goal=(96, 32), backbone=(224, 224, 224, 64)),
}


def dense(width, fan_in, gain, fresh):
    """A linear layer: orthogonal weights times gain, no biases; or, as PyTorch does it, all within 1/sqrt(fan_in)."""

    def pytorch(key, shape, dtype):
        return jax.random.uniform(key, shape, dtype, -1.0, 1.0) / fan_in**0.5

    if fresh == "pytorch":
        return nn.Dense(width, kernel_init=pytorch, bias_init=pytorch)
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain))


class MLP(nn.Module):
    """Dense layers with ELU between them; the last one is linear, its weights scaled by `gain`."""

    widths: tuple[int, ...]
    gain: float = 2**0.5
    fresh: str = "orthogonal"

    @nn.compact
    def __call__(self, x):
        for width in self.widths[:-1]:
            x = nn.elu(dense(width, x.shape[-1], 2**0.5, self.fresh)(x))
        return dense(self.widths[-1], x.shape[-1], self.gain, self.fresh)(x)


class PIDM(nn.Module):
    """Proprioceptive inverse dynamics model (paper Sec. IV-D, Fig. 3): history and a goal to an action.

    In pretraining the goal is the wanted change of x and goes through a delta_encoder to a prediction_decoder. In
    actor and critic the two ends have other names, are fresh, and the head also sees the embedded goal.
    """

    sizes: Sizes
    out_dim: int
    goal: str = "delta_encoder"
    head: str = "prediction_decoder"
    goal_to_head: bool = False
    gain: float = 1.0  # of the last layer
    fresh: str = "orthogonal"

    @nn.compact
    def __call__(self, history, goal):
        """history (..., (K+1) X + K A) and goal (..., G), both of order one -> (..., out_dim)."""
        part = partial(MLP, fresh=self.fresh)
        z_history = nn.elu(part(self.sizes.history, name="history_encoder")(history))
        z_goal = nn.elu(part(self.sizes.goal, name=self.goal)(goal))
        z = nn.elu(part(self.sizes.backbone, name="backbone")(jnp.concatenate([z_history, z_goal], -1)))
        z = jnp.concatenate([z, z_goal], -1) if self.goal_to_head else z
        return part((*self.sizes.head, self.out_dim), self.gain, name=self.head)(z)


def standardise(norm, name, x):
    """(x - mean) / std, within 5; norm holds <name>_mean and <name>_std, fixed for a robot."""
    return jnp.clip((x - norm[f"{name}_mean"]) / norm[f"{name}_std"], -5.0, 5.0)


def flat_history(norm, prop, action):
    """prop (..., K+1, X) and action (..., K, A), oldest first -> the PIDM's history input (..., (K+1) X + K A)."""
    parts = standardise(norm, "prop", prop), standardise(norm, "action", action)
    return jnp.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], -1)


# <<< copy: networks


# >>> copy: actor_critic (owner: ppo_finetune.py)
class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent std, and value function; separate MLPs of equal widths."""

    hidden: tuple[int, ...]
    action_dim: int
    init_std: float
    fresh: str = "orthogonal"
    reads = ("obs",)  # its inputs

    def setup(self):
        self.actor = MLP((*self.hidden, self.action_dim), 0.01, self.fresh)  # the first actions are ~0
        self.critic = MLP((*self.hidden, 1), 0.05, self.fresh)
        self.log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.init_std)), (self.action_dim,))

    def __call__(self, inputs):
        """inputs["obs"] (..., O) -> mean (..., A), log_std (A,), value (...)."""
        return self.mean(inputs), self.log_std, self.value(inputs)

    def mean(self, inputs):
        return self.actor(inputs["obs"])

    def value(self, inputs):
        return self.critic(inputs["obs"]).squeeze(-1)


def net_inputs(net, obs, history):
    """What a network reads: obs, and the history (prop, action) if it has a PIDM."""
    return {name: array for name, array in ({"obs": obs} | history).items() if name in net.reads}


# <<< copy: actor_critic


# --- Ensemble ---

MEMBER = Sizes(history=(64, 32), goal=(32, 16), backbone=(64, 64, 64, 32), head=())  # small PIDMs


@flax.struct.dataclass
class Transitions:
    """What a PIDM learns from; leading axes (T, N), (R,) or (B,)."""

    prop: jax.Array  # (..., K+1, X) up to x_t
    past: jax.Array  # (..., K, A) up to a_{t-1}
    delta: jax.Array  # (..., X) x_{t+1} - x_t
    action: jax.Array  # (..., A) a_t


@flax.struct.dataclass
class Ensemble:
    params: dict  # leaves (M, ...)
    opt_state: optax.OptState
    norm: dict  # <prop|action|delta>_<mean|std>, of the ring buffer
    scale: jax.Array  # () running mean of the disagreement, in action units squared


def predict(member, params, norm, batch):
    """All members' Gaussian predictions of a_t: mean and log variance, (M, B, A) each."""
    inputs = flat_history(norm, batch.prop, batch.past), standardise(norm, "delta", batch.delta)
    mean, log_var = jnp.split(jax.vmap(member.apply, (0, None, None))({"params": params}, *inputs), 2, -1)
    return mean, jnp.clip(log_var, -8.0, 4.0)


def disagreement(mean):
    """Variance over members of the predicted means, averaged over actions. (M, B, A) -> (B,)"""
    return mean.var(0).mean(-1)


def statistics(batch):
    """Mean and std of every input over a batch, as `standardise` wants them."""
    arrays = {"prop": batch.prop[..., -1, :], "action": batch.action, "delta": batch.delta}
    mean = {f"{name}_mean": x.mean(0) for name, x in arrays.items()}
    return mean | {f"{name}_std": x.std(0) + 1e-3 for name, x in arrays.items()}


def nll(member, params, norm, batch):
    """Gaussian negative log-likelihood of each member on its own batch (M, B, ...), without the constant."""

    def of_one(params, batch):
        mean, log_var = predict(member, jax.tree.map(lambda x: x[None], params), norm, batch)
        return 0.5 * jnp.mean((batch.action - mean[0]) ** 2 * jnp.exp(-log_var[0]) + log_var[0])

    return jax.vmap(of_one)(params, batch).sum()


def bootstrap(key, shape, filled):
    """Indices into the ring buffer, drawn with replacement; every entry of `shape` (steps, M, B) its own draw."""
    return jax.random.randint(key, shape, 0, filled)


def retrain(args, member, opt, ensemble, buffer, filled, key):
    """Fit every member to its own bootstrap samples of the ring buffer, of which `filled` entries hold data."""
    k_norm, k_fit = jax.random.split(key)
    norm = statistics(jax.tree.map(lambda x: x[bootstrap(k_norm, (4096,), filled)], buffer))

    def fit(carry, index):
        params, opt_state = carry
        batch = jax.tree.map(lambda x: x[index], buffer)
        loss, grads = jax.value_and_grad(lambda p: nll(member, p, norm, batch))(params)
        updates, opt_state = opt.update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), loss / args.members

    draws = bootstrap(k_fit, (args.ensemble_steps, args.members, args.ensemble_batch), filled)
    (params, opt_state), loss = jax.lax.scan(fit, (ensemble.params, ensemble.opt_state), draws)
    return ensemble.replace(params=params, opt_state=opt_state, norm=norm), loss.mean()


def judge(member, ensemble, seen):
    """Disagreement on a rollout's Transitions (T, N) and its metrics, before the ensemble is trained on them."""
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
    mean, _ = predict(member, ensemble.params, ensemble.norm, flat)
    raw = disagreement(mean)
    # quick, for an untrained ensemble disagrees ten times as much: a slow mean pays nothing at first, and robots fall
    scale = jnp.where(ensemble.scale > 0, 0.8 * ensemble.scale + 0.2 * raw.mean(), raw.mean())
    error = jnp.abs(mean.mean(0) - flat.action).mean()  # [action units]
    metrics = {"disagreement": raw.mean(), "ensemble_error": error, "action_size": jnp.abs(flat.action).mean()}
    return raw.reshape(seen.action.shape[:2]), ensemble.replace(scale=scale), metrics


# --- Rollout ---


@flax.struct.dataclass
class TrainState:
    params: dict
    opt_state: optax.OptState
    lr: jax.Array  # ()
    env: envs.base.State  # (N, ...)
    first: jax.Array  # (N,) bool: the next transition is the first of an episode
    ensemble: Ensemble
    buffer: Transitions  # (R, ...) ring
    iteration: jax.Array  # () PPO iterations done


# >>> copy: rollout (owner: ppo_finetune.py)
@flax.struct.dataclass
class Rollout:
    inputs: dict  # what the network reads, name -> (T, N, ...)
    action: jax.Array  # (T, N, A)
    mean: jax.Array  # (T, N, A) of the policy that acted
    log_prob: jax.Array  # (T, N)
    value: jax.Array  # (T, N)
    reward: jax.Array  # (T, N) as the environment gave it
    bootstrap: jax.Array  # (T, N) gamma * V(final_obs) where the time limit struck, else 0
    done: jax.Array  # (T, N) terminated or truncated


def log_prob(mean, log_std, action):
    """Log density of a diagonal Gaussian, summed over actions. (..., A) -> (...)"""
    z = (action - mean) / jnp.exp(log_std)
    return -0.5 * jnp.sum(z**2 + 2 * log_std + jnp.log(2 * jnp.pi), -1)


def step_metrics(env_state, done):
    """Means over environments, and sums over the episodes that ended in this step."""
    metrics = dict(env_state.metrics)
    names = [name for name in metrics if name.startswith("episode_")]
    ended = {f"sum/{name}": jnp.sum(metrics.pop(name) * done) for name in names}
    ended |= {"sum/falls": env_state.terminated.sum(), "sum/episodes": done.sum()}
    return {name: value.mean() for name, value in metrics.items()} | {"reward": env_state.reward.mean()} | ended


# <<< copy: rollout


def collect(args, env, net, params, env_state, key):
    """Act for T steps in N environments. Returns the last state, Rollout, Transitions, extra data and metrics."""

    def step(env_state, key):
        before = env_state
        inputs = net_inputs(net, env_state.obs, env_state.history)
        mean, log_std, value = net.apply(params, inputs)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        env_state = jax.vmap(env.step)(env_state, action)
        final_inputs = net_inputs(net, env_state.final_obs, env_state.final_history)
        bootstrap = args.gamma * net.apply(params, final_inputs, method=net.value) * env_state.truncated
        done = env_state.terminated | env_state.truncated
        roll = Rollout(inputs, action, mean, log_prob(mean, log_std, action), value, env_state.reward, bootstrap, done)
        delta = env_state.final_history["prop"][:, -1] - before.history["prop"][:, -1]
        executed = jax.vmap(env.executed)(before, action)
        seen = Transitions(before.history["prop"], before.history["action"], delta, executed)
        extra = {"lin_vel": jax.vmap(env.motion)(before.physics).lin_vel, "rough": env.on_rough(before.physics)}
        return env_state, (roll, seen, extra, step_metrics(env_state, done))

    env_state, out = jax.lax.scan(step, env_state, jax.random.split(key, args.num_steps))
    return env_state, *out


# --- Objective ---


# >>> copy: objective (owner: ppo_finetune.py)
def gae(args, reward, done, value, last_value):
    """Generalised advantage estimation, Schulman et al. 2016 eq. 16. (T, N) in, advantage and return (T, N) out."""

    def backward(carry, step):
        advantage, next_value = carry
        reward, done, value = step
        delta = reward + args.gamma * next_value * (1 - done) - value
        advantage = delta + args.gamma * args.gae_lambda * (1 - done) * advantage
        return (advantage, value), advantage

    init = jnp.zeros_like(last_value), last_value
    _, advantage = jax.lax.scan(backward, init, (reward, done, value), reverse=True)
    return advantage, advantage + value


def gaussian_kl(mean_old, log_std_old, mean, log_std):
    """KL(old || new) of diagonal Gaussians, summed over actions. (..., A) -> (...)"""
    var_ratio = jnp.exp(2 * (log_std_old - log_std))
    return jnp.sum(log_std - log_std_old + 0.5 * (var_ratio + ((mean_old - mean) / jnp.exp(log_std)) ** 2 - 1), -1)


def ppo_loss(args, net, params, log_std_old, roll, advantage, ret):
    """Clipped surrogate, clipped value loss and entropy bonus of one minibatch (leading axis B)."""
    mean, log_std, value = net.apply(params, roll.inputs)
    ratio = jnp.exp(log_prob(mean, log_std, roll.action) - roll.log_prob)
    clipped = jnp.clip(ratio, 1 - args.clip, 1 + args.clip)
    policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
    value_clipped = roll.value + jnp.clip(value - roll.value, -args.clip, args.clip)
    value_loss = jnp.maximum((value - ret) ** 2, (value_clipped - ret) ** 2).mean()
    entropy = jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
    loss = policy_loss + args.value_coef * value_loss - args.entropy_coef * entropy
    return (
        loss,
        mean,
        {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "kl": gaussian_kl(roll.mean, log_std_old, mean, log_std).mean(),
            "clip_fraction": (jnp.abs(ratio - 1) > args.clip).mean(),
        },
    )


def mirror_loss(env, net, params, inputs, mean, key):
    """Squared difference of mean(mirrored inputs) and the mirrored mean(inputs), for one mirror drawn of the robot's.

    The target carries no gradient (Mittal et al. 2024). mean (B, A). A quarter of the minibatch, which is shuffled
    already, gives the same expectation for a quarter of the work.
    """
    inputs, mean = jax.tree.map(lambda x: x[::4], (inputs, mean))
    which = jax.random.randint(key, (), 0, len(env.mirrors))
    table = jax.tree.map(lambda *tables: jnp.stack(tables)[which], *env.mirrors.values())
    mirrored = {name: x[..., table[name][0]] * table[name][1] for name, x in inputs.items()}
    target = jax.lax.stop_gradient(mean)[:, table["action"][0]] * table["action"][1]
    return jnp.mean((net.apply(params, mirrored, method=net.mean) - target) ** 2)


def loss_with_mirror(args, env, net, params, log_std_old, batch, key):
    """What a minibatch step descends: PPO's loss, plus the mirror loss where the robot has a symmetry."""
    loss, mean, metrics = ppo_loss(args, net, params, log_std_old, *batch)
    if args.mirror_coef and env.mirrors:
        metrics["mirror_loss"] = mirror_loss(env, net, params, batch[0].inputs, mean, key)
        loss += args.mirror_coef * metrics["mirror_loss"]
    return loss, metrics


# <<< copy: objective


# --- Update ---


# >>> copy: update (owner: ppo_finetune.py)
def adapt_lr(args, lr, kl):
    """rsl_rl's rule: step size down by 1.5 where a minibatch's KL is over twice the target, up where below half."""
    lr = jnp.where(kl > 2 * args.desired_kl, jnp.maximum(lr / 1.5, 1e-5), lr)
    return jnp.where((kl < args.desired_kl / 2) & (kl > 0), jnp.minimum(lr * 1.5, 1e-2), lr)


def clip_gradients(args, grads):
    """Scale the gradients of actor (with std) and critic to a norm of at most max_grad_norm, each on its own."""
    critic = {"critic": grads["params"]["critic"]}
    actor = {name: g for name, g in grads["params"].items() if name != "critic"}
    norms = [optax.tree.norm(part) for part in (actor, critic)]
    scales = [jnp.minimum(1.0, args.max_grad_norm / (norm + 1e-6)) for norm in norms]
    parts = [jax.tree.map(lambda g: g * scale, part) for part, scale in zip((actor, critic), scales, strict=True)]
    return grads | {"params": parts[0] | parts[1]}, jnp.stack(norms)


def minibatches(args, key, samples):
    """Arrays (T, N, ...) -> (M, B, ...): M minibatches, samples shuffled within blocks of environments.

    Every minibatch takes as much of each block, so that a device which holds a block need not send samples about.
    """
    blocks, size = args.shuffle_blocks, args.num_envs * args.num_steps
    perm = jax.vmap(lambda k: jax.random.permutation(k, size // blocks))(jax.random.split(key, blocks))

    def arrange(x):
        x = jnp.moveaxis(x.reshape(args.num_steps, blocks, -1, *x.shape[2:]), 1, 0)  # (blocks, T, N / blocks, ...)
        x = jax.vmap(lambda block, p: block[p])(x.reshape(blocks, -1, *x.shape[3:]), perm)
        x = jnp.moveaxis(x.reshape(blocks, args.num_minibatches, -1, *x.shape[2:]), 1, 0)
        return x.reshape(args.num_minibatches, -1, *x.shape[3:])

    return jax.tree.map(arrange, samples)


def update(args, env, net, opt, state, roll, advantage, ret, key):
    """E epochs of minibatch steps on one rollout. Returns params, opt_state, lr and mean metrics."""
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    log_std_old = state.params["params"]["log_std"]

    def minibatch(carry, inputs):
        params, opt_state, lr = carry
        batch, key = inputs

        objective = partial(loss_with_mirror, args, env, net, log_std_old=log_std_old, batch=batch, key=key)
        grads, metrics = jax.grad(objective, has_aux=True)(params)
        lr = adapt_lr(args, lr, metrics["kl"])
        grads, (metrics["actor_grad_norm"], metrics["critic_grad_norm"]) = clip_gradients(args, grads)
        updates, opt_state = opt.update(grads, opt_state, params)
        params = jax.tree.map(lambda p, u: p - lr * u, params, updates)
        return (params, opt_state, lr), metrics

    def epoch(carry, key):
        k_perm, k_mirror = jax.random.split(key)
        batches = minibatches(args, k_perm, (roll, advantage, ret))
        return jax.lax.scan(minibatch, carry, (batches, jax.random.split(k_mirror, args.num_minibatches)))

    carry = state.params, state.opt_state, state.lr
    carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, args.num_epochs))
    return *carry, jax.tree.map(jnp.mean, metrics)


# <<< copy: update


def iteration(args, env, net, opt, member, member_opt, state):
    """One iteration: rollout, disagreement as reward, PPO update, ensemble update. Also returns data (T, N, ...)."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), state.iteration), 3)
    env_state, roll, seen, extra, metrics = collect(args, env, net, state.params, state.env, keys[0])
    raw, ensemble, judged = judge(member, state.ensemble, seen)
    reward = roll.reward + args.disagreement_coef * env.dt * raw / ensemble.scale

    if args.policy == "explore":
        last_value = net.apply(state.params, net_inputs(net, env_state.obs, env_state.history), method=net.value)
        advantage, ret = gae(args, reward + roll.bootstrap, roll.done, roll.value, last_value)
        params, opt_state, lr, losses = update(args, env, net, opt, state, roll, advantage, ret, keys[1])
    else:
        params, opt_state, lr, losses = state.params, state.opt_state, state.lr, {}

    size = args.num_steps * args.num_envs
    start = state.iteration % args.buffer_rollouts * size
    flat = jax.tree.map(lambda x: x.reshape(size, *x.shape[2:]), seen)
    buffer = jax.tree.map(lambda b, x: jax.lax.dynamic_update_slice_in_dim(b, x, start, 0), state.buffer, flat)
    filled = jnp.minimum(state.iteration + 1, args.buffer_rollouts) * size
    ensemble, loss = retrain(args, member, member_opt, ensemble, buffer, filled, keys[2])

    ended = jnp.concatenate([state.first[None], roll.done])
    data = extra | {"x": seen.prop[:, :, -1], "action": seen.action, "first": ended[:-1]}
    metrics = {k: v.sum() if k.startswith("sum/") else v.mean() for k, v in metrics.items()} | losses | judged
    metrics |= {"ensemble_nll": loss, "action_std": jnp.exp(params["params"]["log_std"]).mean()}
    state = TrainState(params, opt_state, lr, env_state, ended[-1], ensemble, buffer, state.iteration + 1)
    return state, (metrics, data)


def init_ensemble(args, member, opt, norm, batch, key):
    """Fresh members, each from its own key; `batch` gives the shapes."""
    one = jax.tree.map(lambda x: x[0], batch)
    inputs = flat_history(norm, one.prop, one.past), one.delta
    params = jax.vmap(lambda k: member.init(k, *inputs)["params"])(jax.random.split(key, args.members))
    return Ensemble(params, opt.init(params), norm, jnp.zeros(()))


def init_state(args, env, net, opt, member, member_opt):
    """Fresh networks, an empty ring buffer, and N environments whose episode clocks start anywhere."""
    k_net, k_env, k_clock, k_members = jax.random.split(jax.random.key(args.seed), 4)
    params = net.init(k_net, {"obs": jnp.zeros(env.obs_dim)})
    clocks = jax.random.randint(k_clock, (args.num_envs,), 0, env.episode_steps)
    env_state = jax.jit(jax.vmap(env.reset))(jax.random.split(k_env, args.num_envs), clocks)
    history, rows = env_state.history, args.num_envs * args.num_steps * args.buffer_rollouts
    empty = Transitions(
        *(
            jnp.zeros((rows, *shape))
            for shape in (history["prop"].shape[1:], history["action"].shape[1:], (env.prop_dim,), (env.action_dim,))
        )
    )
    norm = statistics(jax.tree.map(lambda x: x[:1], empty))
    norm = {name: jnp.ones_like(x) if name.endswith("std") else x for name, x in norm.items()}
    ensemble = init_ensemble(args, member, member_opt, norm, empty, k_members)
    first = jnp.ones(args.num_envs, bool)
    return TrainState(
        params, opt.init(params), jnp.float32(args.lr), env_state, first, ensemble, empty, jnp.zeros((), jnp.int32)
    )


# --- Dataset ---


def file_shapes(args, env, iterations):
    """Shape and type of each array of the dataset, by name."""
    lead = (iterations, args.num_steps, args.num_envs)
    return {
        "x": ((*lead, env.prop_dim), np.float32),
        "lin_vel": ((*lead, 3), np.float32),
        "action": ((*lead, env.action_dim), np.float32),
        "first": (lead, np.bool_),  # x_t opens an episode
        "rough": (lead, np.bool_),  # on rough ground
    }


def open_files(out, args, env, iterations):
    """The arrays of an interrupted collection, to go on writing. UserError if they are not as they were."""
    files = {}
    for name, (shape, dtype) in file_shapes(args, env, iterations).items():
        try:
            files[name] = np.load(out / f"{name}.npy", mmap_mode="r+", allow_pickle=False)
            sane = files[name].shape == shape and files[name].dtype == dtype
        except (OSError, ValueError, EOFError):
            sane = False
        if not sane:
            raise records.UserError(f"{out}/{name}.npy is missing or damaged; start the collection again with --force")
    return files


def create_files(out, args, env, iterations):
    """Memory-mapped arrays (iterations, T, N, ...), their disk space reserved. UserError if the disk is too small."""
    shapes = file_shapes(args, env, iterations)
    (out / "meta.json").unlink(missing_ok=True)  # from here on the folder is an unfinished collection
    need = sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())
    try:
        files = {}
        for name, (shape, dtype) in shapes.items():
            files[name] = np.lib.format.open_memmap(out / f"{name}.npy", "w+", dtype, shape)
            if hasattr(os, "posix_fallocate"):  # writing to a mapped file on a full disk is fatal; macOS cannot reserve
                with (out / f"{name}.npy").open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
    except OSError as error:
        for name in shapes:
            (out / f"{name}.npy").unlink(missing_ok=True)
        raise records.UserError(f"cannot reserve {need / 1e6:.0f} MB in {out}: {error.strerror}") from None
    return files


def write_meta(out, args, env, iterations):
    """meta.json, written last: what the arrays hold, and what made them."""
    meta = {
        "robot": args.robot,
        "layout": list(env.prop_layout),
        "iterations": iterations,
        "num_steps": args.num_steps,
        "num_envs": args.num_envs,
        "transitions": iterations * args.num_steps * args.num_envs,
        "validation_envs": list(range(args.num_envs - num_held_out(args), args.num_envs)),
        "history": env.config.history,
        "action_scale": env.robot.action_scale,
        "dt": env.dt,
        "args": dataclasses.asdict(args),
        "config": dataclasses.asdict(env.config),
        "versions": records.versions(),
    }
    records.replace_text(out / "meta.json", json.dumps(meta, indent=1) + "\n")


# --- Main ---


SHOWN = ("disagreement", "ensemble_error", "fall_rate", "kl", "action_std")  # in the printed line


def make_env(args):
    """The robot's exploration environment, or a UserError that lists the right names."""
    try:
        env = envs.make_explore(args.robot, args.engine, calm=args.calm)
        devices.check_engine(env.engine)
        return env
    except (ValueError, ImportError) as error:
        raise records.UserError(str(error)) from None


def explore(args):
    """Collect until the dataset is full. After Ctrl-C the folder has no meta.json: an unfinished collection."""
    env = make_env(args)
    args = merge(args, env.config.ppo)
    chunks = -(-args.total_steps // (args.num_envs * args.num_steps * args.log_every))
    iterations = chunks * args.log_every
    print(f"{args.robot}: x {env.prop_dim}, action {env.action_dim}, engine {type(env.engine).__name__}")
    net = ActorCritic(args.hidden, env.action_dim, args.init_std)
    member = PIDM(MEMBER, 2 * env.action_dim)
    opt, member_opt = optax.scale_by_adam(), optax.adam(args.ensemble_lr)
    fresh = partial(init_state, args, env, net, opt, member, member_opt)
    state, rows, out, files = open_run(args, env, iterations, fresh)
    print("  ".join(f"{name}={value}" for name, value in dataclasses.asdict(args).items()), flush=True)
    shardings = devices.of_state(state, axis=0)
    state = devices.place(state, shardings)

    @partial(jax.jit, donate_argnums=0, out_shardings=(shardings, devices.same()))
    def collect_chunk(state):
        step = partial(iteration, args, env, net, opt, member, member_opt)
        return jax.lax.scan(lambda s, _: step(s), state, None, args.log_every)

    start = time.perf_counter()
    chunk = collect_chunk.lower(state).compile()
    print(f"compiled in {time.perf_counter() - start:.1f} s", flush=True)
    state = fill(args, chunk, state, rows, out, files)
    if int(state.iteration) < iterations:
        print(f"interrupted: {args.run_dir} is an unfinished collection; --resume {args.run_dir} goes on with it")
        return None
    if out:
        finish(out, args, env, iterations, files, rows)
    return state


def open_run(args, env, iterations, fresh):
    """State to start from (`fresh()` makes one), rows so far, the run's folder and its arrays.

    On hosts other than the first there is no folder.
    """
    if args.resume:
        state, rows = records.load_state(args.resume, jax.eval_shape(fresh))
        out = Path(args.resume)
        return state, rows, out, open_files(out, args, env, iterations)
    state = fresh()
    if not devices.is_first():
        return state, [], None, {}
    out = records.start_run(args, env.config, args.run_dir, args.force)
    return state, [], out, create_files(out, args, env, iterations)


def fill(args, chunk, state, rows, out, files):
    """Run chunks until the arrays are full or the user stops it; write data, rows and what --resume needs."""
    last = saved = time.perf_counter()
    start = last - (rows[-1]["seconds"] if rows else 0.0)
    iterations = args.total_steps / (args.num_envs * args.num_steps)
    with records.Reporter(iterations, SHOWN, board=out if args.tensorboard else None) as reporter:
        while int(state.iteration) < iterations and not reporter.stopped:
            done = int(state.iteration)
            state, (metrics, data) = chunk(state)
            for name, file in files.items():
                file[done : done + args.log_every] = data[name]
            now = time.perf_counter()
            row = records.make_row(args, int(state.iteration), now - start, jax.device_get(metrics))
            rows.append(row)
            if out:
                records.save_rows(out / "metrics.csv", rows)
            reporter.show(row, args.log_every * args.num_envs * args.num_steps / (now - last))
            last = now
            if not records.finite((state.params, state.ensemble)):
                raise records.UserError(
                    f"weights are not finite after iteration {state.iteration}; lower --lr or --ensemble-lr"
                )
            if now - saved >= 60 * args.save_minutes or reporter.stopped:
                save(out, files, state, rows)
                saved = now
    return state


def finish(out, args, env, iterations, files, rows):
    """The dataset is full: flush its arrays, write meta.json last, draw the curves."""
    for file in files.values():
        file.flush()
    write_meta(out, args, env, iterations)
    (out / records.STATE).unlink(missing_ok=True)  # as large as the ring buffer, and of no more use
    plot(rows, out / "curve.png")
    print(f"wrote {iterations * args.num_envs * args.num_steps} transitions to {out}")


def save(out, files, state, rows):
    """What --resume needs: the data first, then the state that knows how far they go. On several hosts nothing."""
    if jax.process_count() == 1:
        for file in files.values():
            file.flush()
        records.save_state(out, state, rows)


def plot(rows, path):
    """Curves of what the collection did, over transitions."""
    names = ("disagreement", "ensemble_error", "ensemble_nll", "action_size", "fall_rate", "action_std")
    terms = [name for name in rows[0] if name.startswith("reward/")]
    records.plot_curves(rows, names, {"reward terms per step": terms}, path)


def main(args):
    """Collect data. What a user can mend ends in one line and exit code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        return explore(records.resumed(args) if args.resume else args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
