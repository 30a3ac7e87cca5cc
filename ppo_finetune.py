"""Train a robot task with PPO (paper Sec. V-A).

    python ppo_finetune.py --task go1_loco
    python ppo_finetune.py --task go1_loco --eval runs/go1_loco/mlp/seed0/policy.msgpack

Reads top to bottom: arguments, network, rollout, objective, update, evaluation, records, main.
The algorithm is that of rsl_rl, which the paper used; where we differ stands `Deviation:`.
Shapes in comments: T rollout steps, N environments, B minibatch, O observation, A action.
"""

import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import flax
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro

import envs
from envs import records

jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """Values left at None come from the preset or the task; the merged set is printed and stored in args.json."""

    # --- Run ---
    task: str = "go1_loco"  # a name in envs.TASKS
    network: Literal["mlp"] = "mlp"  # actor and critic: a plain MLP
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale: smoke 4 environments, cpu 256, gpu 4096
    seed: int = 0  # the only source of randomness
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), auto
    run_dir: str | None = None  # None: runs/<task>/<network>/seed<seed>
    force: bool = False  # overwrite the run in that folder
    log_every: int | None = None  # iterations per jitted chunk and CSV row
    # --- Evaluation ---
    eval: str | None = None  # a policy.msgpack: run it instead of training, write pictures beside it
    eval_envs: int = 64  # episodes of the evaluation
    # --- Environment ---
    num_envs: int | None = None  # N
    num_steps: int | None = None  # T, per iteration and environment
    total_steps: int | None = None  # environment steps of the whole run
    # --- Network (tasks' own tables) ---
    hidden: tuple[int, ...] | None = None  # widths of the hidden layers
    init_std: float | None = None  # initial action std, in action units
    # --- PPO (rsl_rl) ---
    num_epochs: int = 5  # passes over each rollout
    num_minibatches: int = 4  # B = N * T / num_minibatches
    lr: float = 1e-3  # Adam step size at the start; adapted to the KL
    desired_kl: float = 0.01  # the step size keeps the KL of a minibatch step within a factor 2 of this
    gamma: float = 0.99  # discount per control step
    gae_lambda: float = 0.95  # bias/variance trade-off of the advantage
    clip: float = 0.2  # of the probability ratio and of the value
    value_coef: float = 1.0  # weight of the value loss
    entropy_coef: float | None = None  # weight of the entropy bonus
    mirror_coef: float = 0.1  # weight of the mirror loss; ours, the paper gives no number
    max_grad_norm: float = 1.0  # of actor and critic, each


PRESETS = {
    "smoke": {"num_envs": 4, "num_steps": 4, "total_steps": 64, "log_every": 2},
    "cpu": {"num_envs": 256, "num_steps": 24, "log_every": 10},
    "gpu": {"num_envs": 4096, "num_steps": 24, "log_every": 10},
}


def merge(args, ppo):
    """Fill what is None in args from the preset, then from the task's own settings `ppo`; check the sizes."""
    values = PRESETS[args.preset] | ppo.get(args.preset, {})
    values |= {"hidden": ppo["hidden"], "init_std": ppo["init_std"], "entropy_coef": ppo["entropy"]}
    values |= {"run_dir": f"runs/{args.task}/{args.network}/seed{args.seed}"}
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    for name in ("num_envs", "num_steps", "total_steps", "log_every", "num_epochs", "num_minibatches", "eval_envs"):
        if getattr(args, name) < 1:
            raise records.UserError(f"--{name.replace('_', '-')} must be at least 1, not {getattr(args, name)}")
    if args.num_envs * args.num_steps % args.num_minibatches:
        raise records.UserError(
            f"{args.num_minibatches} minibatches do not divide a rollout of {args.num_envs} environments x "
            f"{args.num_steps} steps = {args.num_envs * args.num_steps}; change --num-minibatches or --num-envs"
        )
    return args


# --- Network ---


class MLP(nn.Module):
    """Dense layers with ELU between them; the last one is linear, its weights scaled by `gain`."""

    widths: tuple[int, ...]
    gain: float

    @nn.compact
    def __call__(self, x):
        for width in self.widths[:-1]:
            x = nn.elu(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
        return nn.Dense(self.widths[-1], kernel_init=nn.initializers.orthogonal(self.gain))(x)


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent std, and value function; separate networks of equal widths."""

    hidden: tuple[int, ...]
    action_dim: int
    init_std: float

    def setup(self):
        self.actor = MLP((*self.hidden, self.action_dim), gain=0.01)  # the first actions are ~0
        self.critic = MLP((*self.hidden, 1), gain=0.05)
        self.log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.init_std)), (self.action_dim,))

    def __call__(self, obs):
        """(..., O) -> mean (..., A), log_std (A,), value (...)."""
        return self.actor(obs), self.log_std, self.value(obs)

    def mean(self, obs):
        return self.actor(obs)

    def value(self, obs):
        return self.critic(obs).squeeze(-1)


# --- Rollout ---


@flax.struct.dataclass
class TrainState:
    params: dict
    opt_state: optax.OptState
    lr: jax.Array  # ()
    env: envs.base.State  # (N, ...)
    iteration: jax.Array  # () PPO iterations done


@flax.struct.dataclass
class Rollout:
    obs: jax.Array  # (T, N, O)
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


def rollout(args, env, net, params, env_state, key):
    """Act for T steps in N environments. Returns the last environment state, a Rollout and metrics (T,)."""

    def step(env_state, key):
        obs = env_state.obs
        mean, log_std, value = net.apply(params, obs)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        env_state = jax.vmap(env.step)(env_state, action)
        # Deviation: rsl_rl bootstraps time-outs with V of the observation before the step, which is not the last one.
        final_value = net.apply(params, env_state.final_obs, method=net.value)
        bootstrap = args.gamma * final_value * (env_state.truncated if env.bootstrap_time_outs else 0.0)
        done = env_state.terminated | env_state.truncated
        logp = log_prob(mean, log_std, action)
        return env_state, (
            Rollout(obs, action, mean, logp, value, env_state.reward, bootstrap, done),
            step_metrics(env_state, done),
        )

    env_state, (roll, metrics) = jax.lax.scan(step, env_state, jax.random.split(key, args.num_steps))
    return env_state, roll, metrics


def step_metrics(env_state, done):
    """Means over environments, and sums over the episodes that ended in this step."""
    metrics = dict(env_state.metrics)
    ended = {f"sum/{name}": jnp.sum(metrics.pop(name) * done) for name in ("episode_return", "episode_seconds")}
    ended |= {"sum/falls": env_state.terminated.sum(), "sum/episodes": done.sum()}
    return {name: value.mean() for name, value in metrics.items()} | {"reward": env_state.reward.mean()} | ended


# --- Objective ---


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
    mean, log_std, value = net.apply(params, roll.obs)
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


def mirror_loss(env, net, params, obs, mean, key):
    """Squared difference of mean(mirrored obs) and the mirrored mean(obs), for one mirror drawn of the robot's.

    The target carries no gradient (Mittal et al. 2024). obs (B, O), mean (B, A). A quarter of the minibatch, which is
    shuffled already, gives the same expectation for a quarter of the work.
    """
    obs, mean = obs[: -(-len(obs) // 4)], mean[: -(-len(mean) // 4)]
    tables = [(*tables["obs"], *tables["action"]) for tables in env.mirrors.values()]
    stacked = [jnp.stack(column) for column in zip(*tables, strict=True)]
    which = jax.random.randint(key, (), 0, len(tables))
    obs_perm, obs_sign, act_perm, act_sign = (column[which] for column in stacked)
    mirrored = net.apply(params, obs[:, obs_perm] * obs_sign, method=net.mean)
    return jnp.mean((mirrored - jax.lax.stop_gradient(mean)[:, act_perm] * act_sign) ** 2)


def loss_with_mirror(args, env, net, params, log_std_old, batch, key):
    """What a minibatch step descends: PPO's loss, plus the mirror loss where the robot has a symmetry."""
    loss, mean, metrics = ppo_loss(args, net, params, log_std_old, *batch)
    if args.mirror_coef and env.mirrors:
        metrics["mirror_loss"] = mirror_loss(env, net, params, batch[0].obs, mean, key)
        loss += args.mirror_coef * metrics["mirror_loss"]
    return loss, metrics


# --- Update ---


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
    return {"params": parts[0] | parts[1]}, jnp.stack(norms)


def update(args, env, net, opt, state, roll, advantage, ret, key):
    """E epochs of minibatch steps on one rollout. Returns params, opt_state, lr and mean metrics."""
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (roll, advantage, ret))  # (T * N, ...)
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
        perm = jax.random.permutation(k_perm, args.num_envs * args.num_steps)
        batches = jax.tree.map(lambda x: x[perm].reshape(args.num_minibatches, -1, *x.shape[1:]), flat)
        return jax.lax.scan(minibatch, carry, (batches, jax.random.split(k_mirror, args.num_minibatches)))

    carry = state.params, state.opt_state, state.lr
    carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, args.num_epochs))
    return *carry, jax.tree.map(jnp.mean, metrics)


def iteration(args, env, net, opt, state):
    """One PPO iteration: rollout, advantages, update. Its randomness depends on (seed, iteration) alone."""
    k_roll, k_update = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), state.iteration))
    env_state, roll, metrics = rollout(args, env, net, state.params, state.env, k_roll)
    last_value = net.apply(state.params, env_state.obs, method=net.value)
    advantage, ret = gae(args, roll.reward + roll.bootstrap, roll.done, roll.value, last_value)
    params, opt_state, lr, losses = update(args, env, net, opt, state, roll, advantage, ret, k_update)
    metrics = {k: v.sum() if k.startswith("sum/") else v.mean() for k, v in metrics.items()} | losses
    metrics |= {
        "explained_variance": 1 - jnp.var(ret - roll.value) / (jnp.var(ret) + 1e-8),
        "lr": lr,
        "action_std": jnp.exp(params["params"]["log_std"]).mean(),
    }
    return TrainState(params, opt_state, lr, env_state, state.iteration + 1), metrics


def init_state(args, env, net, opt):
    """Fresh networks, and N environments whose episode clocks start anywhere, so that time-outs spread out."""
    k_net, k_env, k_clock = jax.random.split(jax.random.key(args.seed), 3)
    params = net.init(k_net, jnp.zeros(env.obs_dim))
    clocks = jax.random.randint(k_clock, (args.num_envs,), 0, env.episode_steps)
    env_state = jax.jit(jax.vmap(env.reset))(jax.random.split(k_env, args.num_envs), clocks)
    return TrainState(params, opt.init(params), jnp.float32(args.lr), env_state, jnp.zeros((), jnp.int32))


# --- Evaluation ---


def evaluate(env, net, params, num_envs):
    """One episode per environment with the mean action, fixed seed. Metrics, and the first one's qpos (steps, nq)."""

    def step(carry, _):
        env_state, alive = carry
        action = net.apply(params, env_state.obs, method=net.mean)
        env_state = jax.vmap(env.step)(env_state, action)
        done = env_state.terminated | env_state.truncated
        out = (env_state.metrics, env_state.reward), alive, env_state.terminated & alive, env_state.physics.qpos[0]
        return (env_state, alive & ~done), out

    env_state = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), num_envs))
    carry = env_state, jnp.ones(num_envs, bool)
    _, ((metrics, reward), alive, fell, qpos) = jax.lax.scan(step, carry, None, env.episode_steps)
    metrics = {name: v for name, v in metrics.items() if not name.startswith(("episode", "reward/"))}
    result = {name: (v * alive).sum() / alive.sum() for name, v in metrics.items()}
    result |= {
        "episode_return": (reward * alive).sum(0).mean(),
        "episode_seconds": alive.sum(0).mean() * env.dt,
        "falls": fell.any(0).mean(),
    }
    return result, qpos


def run_eval(args):
    """--eval: print the task's metrics of a saved policy, on its own commands and in the showcase; write pictures."""
    from envs import render  # matplotlib and OpenGL are slow to load and not needed for training

    path = Path(args.eval)
    params, meta = records.load(path)
    if meta["task"] != args.task:
        raise records.UserError(
            f"{path} is a policy for {meta['task']}, not for {args.task}; pass --task {meta['task']}"
        )
    env, show = make_env(args), make_env(args, **envs.TASKS[args.task][0].SHOWCASE)
    net = ActorCritic(tuple(meta["args"]["hidden"]), env.action_dim, meta["args"]["init_std"])
    like = jax.eval_shape(net.init, jax.random.key(0), jnp.zeros(env.obs_dim))
    records.check_shapes(path, params, like)
    result, _ = jax.jit(lambda p: evaluate(env, net, p, args.eval_envs))(params)
    showcase, qpos = jax.jit(lambda p: evaluate(show, net, p, min(args.eval_envs, 16)))(params)
    print(f"{args.eval_envs} episodes of {args.task}, mean action:", records.line(result))
    print(f"showcase {show.SHOWCASE}:", records.line(showcase))
    report = {"task": result, "showcase": showcase | {"config": show.SHOWCASE}}
    report = jax.tree.map(lambda x: float(x) if isinstance(x, jax.Array) else x, report)
    records.replace_text(path.with_name("eval.json"), json.dumps(report, indent=1) + "\n")
    for picture in render.film(show, qpos, path.parent):
        print(f"wrote {picture}")


# --- Records ---


def make_env(args, **overrides):
    """The task's environment, or a UserError that lists the right names."""
    try:
        return envs.make(args.task, args.engine, **overrides)
    except (ValueError, ImportError) as error:
        raise records.UserError(str(error)) from None


def make_row(args, iterations, seconds, metrics):
    """One CSV row from a chunk's metrics (log_every,): means, and means over the episodes that ended."""
    metrics = {name: value.sum() if name.startswith("sum/") else value.mean() for name, value in metrics.items()}
    episodes = metrics.pop("sum/episodes")
    ended = {"fall_rate": "falls", "episode_return": "episode_return", "episode_seconds": "episode_seconds"}
    ended = {name: metrics.pop(f"sum/{key}") / episodes if episodes else float("nan") for name, key in ended.items()}
    steps = args.num_envs * args.num_steps
    row = {"iteration": iterations, "env_steps": iterations * steps, "seconds": seconds, **ended, **metrics}
    return {name: float(f"{float(value):.6g}") for name, value in row.items()}


# --- Main ---


def train(args):
    """Run PPO to the end, or to Ctrl-C; either way the folder holds a policy, the metrics and their curve."""
    env = make_env(args)
    args = merge(args, env.config.ppo)
    out = records.start_run(args, env.config, args.run_dir, args.force)
    print(f"{args.task}: observation {env.obs_dim}, action {env.action_dim}, engine {type(env.engine).__name__}")
    print("  ".join(f"{name}={value}" for name, value in dataclasses.asdict(args).items()), flush=True)
    net = ActorCritic(args.hidden, env.action_dim, args.init_std)
    opt = optax.scale_by_adam()
    state = init_state(args, env, net, opt)

    @jax.jit
    def train_chunk(state):
        return jax.lax.scan(lambda s, _: iteration(args, env, net, opt, s), state, None, args.log_every)

    iterations = -(-args.total_steps // (args.num_envs * args.num_steps))
    start = time.perf_counter()
    chunk = train_chunk.lower(state).compile()
    print(f"compiled in {time.perf_counter() - start:.1f} s", flush=True)
    start = last = time.perf_counter()
    with records.Reporter(iterations) as reporter:
        while int(state.iteration) < iterations and not reporter.stopped:
            state, metrics = chunk(state)
            metrics = jax.device_get(metrics)
            now = time.perf_counter()
            row = make_row(args, int(state.iteration), now - start, metrics)
            records.log_row(out / "metrics.csv", row)
            reporter.show(row, args.log_every * args.num_envs * args.num_steps / (now - last))
            last = now
            if not all(jnp.isfinite(x).all() for x in jax.tree.leaves(state.params)):
                raise records.UserError(f"weights are not finite after iteration {row['iteration']}; lower --lr")
            records.save(out / "policy.msgpack", state.params, args)
    if reporter.stopped:
        print("interrupted")
    records.plot_curve(out / "metrics.csv", out / "curve.png")
    print(f"wrote {out}/policy.msgpack, metrics.csv, curve.png")
    return state


def main(args):
    """Train, or evaluate with --eval. UserErrors end in one line and exit code 2."""
    try:
        return run_eval(args) if args.eval else train(args)
    except records.UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:  # before the first row: nothing to save yet
        sys.exit("interrupted")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
