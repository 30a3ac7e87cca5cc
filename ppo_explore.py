"""Stage 1: collect exploration data of one robot, without a task (paper Sec. IV-C).

    python ppo_explore.py --robot g1
    python ppo_explore.py --robot go1 --preset gpu

PPO learns to visit transitions on which an ensemble of small PIDMs disagrees. The ensemble is retrained after every
rollout. All transitions go to memory-mapped files, which pretrain_pidm.py reads.
Reads top to bottom: arguments, networks, ensemble, rollout, losses, update, exploration.
Shapes in comments: T rollout steps, N environments, B minibatch, O observation, X proprioception x_t, A action,
K history, M ensemble members, R transitions in the ring buffer.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import flax
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro

import envs
from experiment import arguments, checkpoints, dataset, devices, figures, metrics, records
from experiment.run import Run, make_env

jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """A field left at None is filled in from the preset or the robot. The merged set is printed and saved."""

    # --- Experiment ---
    robot: str = "go1"  # a name in envs.EXPLORE, an MJCF, URDF or .toml file, or a run's args.json
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale: 4, 256 or 4096 environments
    seed: int = 0  # the only source of randomness
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), warp (NVIDIA)
    set: tuple[str, ...] = ()  # NAME=VALUE of the environment's config, e.g. friction=0.3,1.2 rough=0.0
    # --- Records ---
    run_dir: str | None = None  # None: runs/explore/<robot>/seed<seed>
    force: bool = False  # overwrite the data in that folder
    resume: str | None = None  # continue the collection in this folder, with its arguments
    save_minutes: float = 2.0  # how often the state for --resume is saved
    log_every: int | None = None  # iterations per jitted chunk and CSV row
    tensorboard: bool = False  # write TensorBoard files into the run folder, too
    # --- Data ---
    num_envs: int | None = None  # N environments at once
    num_steps: int | None = None  # T steps of each in an iteration
    total_steps: int | None = None  # transitions to collect
    validation: float = 0.08  # share of environments held out (paper: 7 M to train, 600 k to validate)
    # --- Exploration ---
    policy: Literal["explore", "random"] = "explore"  # random: the initial policy throughout, for comparison
    disagreement_coef: float = 2.0  # reward per second at the mean disagreement; must exceed the regularisers' cost
    members: int = 5  # M networks in the ensemble
    buffer_rollouts: int = 8  # rollouts in the ring buffer, which holds R = N * T * buffer_rollouts transitions
    ensemble_steps: int = 8  # gradient steps per iteration
    ensemble_batch: int = 512  # bootstrap sample of each member and step
    ensemble_lr: float = 1e-3  # Adam step size of the ensemble
    # --- Network (defaults: the robot's) ---
    hidden: tuple[int, ...] | None = None  # widths of the policy's hidden layers
    init_std: float | None = None  # initial action std [action units]
    # --- PPO (see ppo_finetune.py) ---
    num_epochs: int = 5  # passes over each rollout
    num_minibatches: int = 4  # minibatches of a pass, each of B = N * T / num_minibatches samples
    lr: float = 1e-3  # initial Adam step size, adapted to the KL
    desired_kl: float = 0.01  # the step size keeps the KL from the rollout's policy within a factor 2 of this
    max_lr: float = 1e-2  # largest step size
    gamma: float = 0.99  # discount per control step
    gae_lambda: float = 0.95  # bias/variance trade-off of the advantage
    clip: float = 0.2  # bound on the change of the probability ratio and of the value
    value_coef: float = 1.0  # weight of the value loss
    entropy_coef: float | None = None  # weight of the entropy bonus
    mirror_coef: float = 0.1  # weight of the mirror loss
    max_grad_norm: float = 1.0  # norm to which the gradients of actor and critic are clipped, each on its own
    # --- Devices ---
    distributed: bool = False  # this is one of several processes, see docs/speed.md; process 0 writes the files
    shuffle_blocks: int | None = None  # shuffle samples within this many groups of environments; None: 1 per device


PRESETS = {
    "smoke": {"num_envs": 4, "num_steps": 8, "total_steps": 4_000, "log_every": 25},
    "cpu": {"num_envs": 256, "num_steps": 24, "total_steps": 1_500_000, "log_every": 5},
    "gpu": {"num_envs": 4096, "num_steps": 24, "total_steps": 7_600_000, "log_every": 2},
}
SHOWN = ("disagreement", "ensemble_error", "fall_rate", "kl", "action_std")  # columns printed


def num_held_out(args):
    """Environments whose transitions are for validation alone: at least one."""
    return max(round(args.validation * args.num_envs), 1)


def merge(args, ppo):
    """Fill the fields left at None from the preset and the robot's settings `ppo`, and check the result."""
    values = PRESETS[args.preset] | {"hidden": ppo["hidden"], "init_std": ppo["init_std"]}
    values |= {"entropy_coef": ppo["entropy"], "shuffle_blocks": jax.device_count()}
    values |= {"run_dir": f"runs/explore/{envs.label(args.robot)}/seed{args.seed}"}
    args = arguments.check_minibatches(arguments.filled(args, values))
    if not 0 < args.validation < 1 or num_held_out(args) == args.num_envs:
        raise records.UserError(f"--validation {args.validation} of {args.num_envs} environments leaves a split empty")
    if args.members == 1 and args.policy == "explore":
        raise records.UserError("--members 1 cannot disagree; choose 2 or more, or --policy random")
    return args


# --- Networks ---


# >>> copy: mlp (owner: pretrain_pidm.py)
def dense(width, fan_in, gain, weight_init):
    """A linear layer: orthogonal weights times gain, zero biases; or, as in PyTorch, uniform within 1/sqrt(fan_in)."""

    def pytorch(key, shape, dtype):
        return jax.random.uniform(key, shape, dtype, -1.0, 1.0) / fan_in**0.5

    if weight_init != "orthogonal":
        return nn.Dense(width, kernel_init=pytorch, bias_init=pytorch)
    return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain))


class MLP(nn.Module):
    """Dense layers with ELU between them; the last one is linear. Its weights are scaled by `gain` if orthogonal."""

    widths: tuple[int, ...]
    gain: float = 2**0.5
    weight_init: str = "orthogonal"

    @nn.compact
    def __call__(self, x):
        for width in self.widths[:-1]:
            x = nn.elu(dense(width, x.shape[-1], 2**0.5, self.weight_init)(x))
        return dense(self.widths[-1], x.shape[-1], self.gain, self.weight_init)(x)


def standardise(norm, name, x):
    """(x - mean) / std, clipped to +-5; norm holds <name>_mean and <name>_std."""
    return jnp.clip((x - norm[f"{name}_mean"]) / norm[f"{name}_std"], -5.0, 5.0)


def flat_history(norm, prop, action):
    """prop (..., K+1, X) and action (..., K, A), oldest first -> the PIDM's history input (..., (K+1) X + K A)."""
    parts = standardise(norm, "prop", prop), standardise(norm, "action", action)
    return jnp.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], -1)


# <<< copy: mlp


# >>> copy: pidm (owner: pretrain_pidm.py)
class PIDM(nn.Module):
    """Proprioceptive inverse dynamics model (paper Sec. IV-D, Fig. 3): the action between two states."""

    sizes: dict
    out_dim: int

    @nn.compact
    def __call__(self, history, delta):
        """history (..., (K+1) X + K A) and wanted change of x (..., X), both standardised -> (..., out_dim)."""
        z_history = nn.elu(MLP(self.sizes["history"], name="history_encoder")(history))
        z_delta = nn.elu(MLP(self.sizes["goal"], name="delta_encoder")(delta))
        z = nn.elu(MLP(self.sizes["backbone"], name="backbone")(jnp.concatenate([z_history, z_delta], -1)))
        return MLP((*self.sizes["head"], self.out_dim), gain=1.0, name="prediction_decoder")(z)


# <<< copy: pidm


# >>> copy: actor_critic (owner: ppo_finetune.py)
class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent std, and value function: two MLPs of equal widths."""

    hidden: tuple[int, ...]
    action_dim: int
    init_std: float
    weight_init: str = "orthogonal"

    def setup(self):
        self.actor = MLP((*self.hidden, self.action_dim), 0.01, self.weight_init)  # the first mean actions are ~0
        self.critic = MLP((*self.hidden, 1), 0.05, self.weight_init)
        # Deviation (log std): rsl_rl learns the std itself.
        self.log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.init_std)), (self.action_dim,))

    @staticmethod
    def inputs(obs, history):
        """The arrays that this network reads, of an observation and a history."""
        return {"obs": obs}

    def __call__(self, inputs):
        """obs (..., O) -> mean (..., A), log_std (A,), value (...)."""
        return self.mean(inputs), self.log_std, self.value(inputs)

    def mean(self, inputs):
        return self.actor(inputs["obs"])

    def value(self, inputs):
        return self.critic(inputs["obs"]).squeeze(-1)


# <<< copy: actor_critic


# --- Ensemble ---

MEMBER = {"history": (64, 32), "goal": (32, 16), "backbone": (64, 64, 64, 32), "head": ()}  # widths of a small PIDM


@flax.struct.dataclass
class Transitions:
    """Samples for a PIDM; leading axes (T, N), (R,) or (B,)."""

    prop: jax.Array  # (..., K+1, X) up to x_t
    past: jax.Array  # (..., K, A) up to a_{t-1}
    delta: jax.Array  # (..., X) x_{t+1} - x_t
    action: jax.Array  # (..., A) a_t


@flax.struct.dataclass
class Ensemble:
    params: dict  # leaves (M, ...)
    opt_state: optax.OptState
    norm: dict  # <prop|action|delta>_<mean|std>, of the ring buffer
    scale: jax.Array  # () running mean of the disagreement [action units squared]; 0 before the first rollout


def predict(member, params, norm, batch):
    """Gaussian prediction of a_t by one member: mean and log variance, (B, A) each."""
    inputs = flat_history(norm, batch.prop, batch.past), standardise(norm, "delta", batch.delta)
    mean, log_var = jnp.split(member.apply({"params": params}, *inputs), 2, -1)
    return mean, jnp.clip(log_var, -8.0, 4.0)


def disagreement(mean):
    """Variance over members of the predicted means, averaged over actions. (M, B, A) -> (B,)"""
    return mean.var(0).mean(-1)


def statistics(batch):
    """Mean and std of x_t, a_t and the change over a batch; past states and actions are scaled by them, too."""
    arrays = {"prop": batch.prop[..., -1, :], "action": batch.action, "delta": batch.delta}
    mean = {f"{name}_mean": x.mean(0) for name, x in arrays.items()}
    return mean | {f"{name}_std": x.std(0) + 1e-3 for name, x in arrays.items()}


def nll(member, params, norm, batch):
    """Gaussian negative log-likelihood without its constant: (M, B, ...) -> (), mean over a batch, sum over members."""
    mean, log_var = jax.vmap(partial(predict, member), (0, None, 0))(params, norm, batch)
    return 0.5 * jnp.mean((batch.action - mean) ** 2 * jnp.exp(-log_var) + log_var, (1, 2)).sum()


def init_ensemble(args, member, opt, norm, batch, key):
    """New members, each from a key of its own; `batch` gives the shapes."""
    one = jax.tree.map(lambda x: x[0], batch)
    inputs = flat_history(norm, one.prop, one.past), one.delta
    params = jax.vmap(lambda k: member.init(k, *inputs)["params"])(jax.random.split(key, args.members))
    return Ensemble(params, opt.init(params), norm, jnp.zeros(()))


def draw_indices(key, shape, filled):
    """Draw indices into the ring buffer with replacement, independently for every entry of `shape` (steps, M, B)."""
    return jax.random.randint(key, shape, 0, filled)


def retrain(args, member, opt, ensemble, buffer, filled, key):
    """Fit every member to bootstrap samples of the buffer, whose first `filled` rows hold data. Also the mean loss."""
    k_norm, k_fit = jax.random.split(key)
    norm = statistics(jax.tree.map(lambda x: x[draw_indices(k_norm, (4096,), filled)], buffer))

    def fit(carry, index):
        params, opt_state = carry
        batch = jax.tree.map(lambda x: x[index], buffer)
        loss, grads = jax.value_and_grad(lambda p: nll(member, p, norm, batch))(params)
        updates, opt_state = opt.update(grads, opt_state)
        return (optax.apply_updates(params, updates), opt_state), loss / args.members

    indices = draw_indices(k_fit, (args.ensemble_steps, args.members, args.ensemble_batch), filled)
    (params, opt_state), loss = jax.lax.scan(fit, (ensemble.params, ensemble.opt_state), indices)
    return ensemble.replace(params=params, opt_state=opt_state, norm=norm), loss.mean()


def measure_novelty(member, ensemble, transitions):
    """Disagreement on the Transitions (T, N) of a rollout, the ensemble with its new scale, and metrics.

    The ensemble must not have been trained on this rollout yet.
    """
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), transitions)
    mean, _ = jax.vmap(partial(predict, member), (0, None, None))(ensemble.params, ensemble.norm, flat)
    novelty = disagreement(mean)
    # Fast mean: disagreement drops tenfold early. With a slow mean the reward would vanish, and robots learn to fall.
    scale = jnp.where(ensemble.scale > 0, 0.8 * ensemble.scale + 0.2 * novelty.mean(), novelty.mean())
    error = jnp.abs(mean.mean(0) - flat.action).mean()  # [action units]
    report = {"disagreement": novelty.mean(), "ensemble_error": error, "action_size": jnp.abs(flat.action).mean()}
    return novelty.reshape(transitions.action.shape[:2]), ensemble.replace(scale=scale), report


# --- Rollout ---


@flax.struct.dataclass
class TrainState:
    params: dict
    opt_state: optax.OptState
    lr: jax.Array  # ()
    env_state: envs.base.State  # (N, ...)
    first: jax.Array  # (N,) bool: the next transition opens an episode
    ensemble: Ensemble
    buffer: Transitions  # (R, ...) ring
    iteration: jax.Array  # () PPO iterations done


# >>> copy: rollout (owner: ppo_finetune.py)
@flax.struct.dataclass
class Rollout:
    inputs: dict  # of the network: obs (T, N, O), prop (T, N, K+1, X), past action (T, N, K, A)
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


# <<< copy: rollout


def rollout(args, env, net, params, env_state, key):
    """Act for T steps in N environments. Returns the last state, Rollout, Transitions, data to store and metrics."""

    def step(before, key):
        inputs = net.inputs(before.obs, before.history)
        mean, log_std, value = net.apply(params, inputs)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)

        # step the environments, which reset themselves
        after = jax.vmap(env.step)(before, action)
        done = after.terminated | after.truncated
        final_inputs = net.inputs(after.final_obs, after.final_history)
        bootstrap = args.gamma * net.apply(params, final_inputs, method=net.value) * after.truncated
        logp = log_prob(mean, log_std, action)
        roll = Rollout(inputs, action, mean, logp, value, after.reward, bootstrap, done)

        # the transition, from noise-free readings; after.history already shows the next episode where this one ended
        delta = after.final_history["prop"][:, -1] - before.history["prop"][:, -1]
        transition = Transitions(before.history["prop"], before.history["action"], delta, action)
        data = {"lin_vel": jax.vmap(env.motion)(before.physics).lin_vel, "rough": env.on_rough(before.physics)}
        return after, (roll, transition, data, metrics.step_metrics(after))

    env_state, out = jax.lax.scan(step, env_state, jax.random.split(key, args.num_steps))
    return env_state, *out


# --- Losses ---


# >>> copy: gae (owner: ppo_finetune.py)
def gae(args, reward, done, value, last_value):
    """Generalised advantage estimation, Schulman et al. 2016 eq. 16. (T, N) in, advantage and return (T, N) out."""

    def backward(carry, step):
        advantage, next_value = carry
        reward, done, value = step
        # delta_t = r_t + gamma V(s_t+1) - V(s_t);  A_t = delta_t + gamma lambda A_t+1
        delta = reward + args.gamma * next_value * (1 - done) - value
        advantage = delta + args.gamma * args.gae_lambda * (1 - done) * advantage
        return (advantage, value), advantage

    _, advantage = jax.lax.scan(backward, (jnp.zeros_like(last_value), last_value), (reward, done, value), reverse=True)
    return advantage, advantage + value


def gaussian_kl(mean_old, log_std_old, mean, log_std):
    """KL(old || new) of diagonal Gaussians, summed over actions. (..., A) -> (...)"""
    var_ratio = jnp.exp(2 * (log_std_old - log_std))
    return jnp.sum(log_std - log_std_old + 0.5 * (var_ratio + ((mean_old - mean) / jnp.exp(log_std)) ** 2 - 1), -1)


def mirror_loss(env, net, params, inputs, mean, key):
    """Squared difference of mean(mirrored inputs) and the mirrored mean(inputs), for one of the robot's mirrors.

    mean (B, A). The target carries no gradient (Mittal et al. 2024). A quarter of the minibatch is enough.
    """
    inputs, mean = jax.tree.map(lambda x: x[::4], (inputs, mean))
    which = jax.random.randint(key, (), 0, len(env.mirrors))
    table = jax.tree.map(lambda *tables: jnp.stack(tables)[which], *env.mirrors.values())  # perm, sign
    mirrored = {name: x[..., table[name][0]] * table[name][1] for name, x in inputs.items()}
    target = jax.lax.stop_gradient(mean)[:, table["action"][0]] * table["action"][1]
    return jnp.mean((net.apply(params, mirrored, method=net.mean) - target) ** 2)


# <<< copy: gae


def ppo_loss(args, env, net, params, log_std_old, batch, key):
    """Total loss of one minibatch (leading axis B), and its parts for the log."""
    roll, advantage, ret = batch
    mean, log_std, value = net.apply(params, roll.inputs)
    # clipped surrogate, Schulman et al. 2017 eq. 7
    ratio = jnp.exp(log_prob(mean, log_std, roll.action) - roll.log_prob)
    clipped = jnp.clip(ratio, 1 - args.clip, 1 + args.clip)
    policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
    # clipped value loss
    value_clipped = roll.value + jnp.clip(value - roll.value, -args.clip, args.clip)
    value_loss = jnp.maximum((value - ret) ** 2, (value_clipped - ret) ** 2).mean()
    entropy = jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
    loss = policy_loss + args.value_coef * value_loss - args.entropy_coef * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    parts["kl"] = gaussian_kl(roll.mean, log_std_old, mean, log_std).mean()
    parts["clip_fraction"] = (jnp.abs(ratio - 1) > args.clip).mean()
    if args.mirror_coef and env.mirrors:  # only tasks with a symmetry
        parts["mirror_loss"] = mirror_loss(env, net, params, roll.inputs, mean, key)
        loss += args.mirror_coef * parts["mirror_loss"]
    return loss, parts


# --- Update ---


# >>> copy: update (owner: ppo_finetune.py)
def adapt_lr(args, lr, kl):
    """rsl_rl's rule: divide the step size by 1.5 where the KL is above twice the target, multiply where below half."""
    lr = jnp.where(kl > 2 * args.desired_kl, jnp.maximum(lr / 1.5, 1e-5), lr)
    return jnp.where((kl < args.desired_kl / 2) & (kl > 0), jnp.minimum(lr * 1.5, args.max_lr), lr)


def clip_gradients(args, grads):
    """Scale the gradients of actor (with std) and critic to a norm of at most max_grad_norm, each on its own."""
    critic = {"critic": grads["params"]["critic"]}
    actor = {name: g for name, g in grads["params"].items() if name != "critic"}
    norms = [optax.tree.norm(part) for part in (actor, critic)]
    scales = [jnp.minimum(1.0, args.max_grad_norm / (norm + 1e-6)) for norm in norms]
    parts = [jax.tree.map(lambda g: g * scale, part) for part, scale in zip((actor, critic), scales, strict=True)]
    return grads | {"params": parts[0] | parts[1]}, jnp.stack(norms)


def minibatches(args, key, samples):
    """Arrays (T, N, ...) -> (num_minibatches, B, ...), samples shuffled within blocks of environments.

    Each minibatch takes an equal share of every block, so that samples stay on the device that collected them.
    """
    blocks, size = args.shuffle_blocks, args.num_envs * args.num_steps
    perm = jax.vmap(lambda k: jax.random.permutation(k, size // blocks))(jax.random.split(key, blocks))

    def arrange(x):
        x = jnp.moveaxis(x.reshape(args.num_steps, blocks, -1, *x.shape[2:]), 1, 0)  # (blocks, T, N / blocks, ...)
        x = jax.vmap(lambda block, p: block[p])(x.reshape(blocks, -1, *x.shape[3:]), perm)
        x = jnp.moveaxis(x.reshape(blocks, args.num_minibatches, -1, *x.shape[2:]), 1, 0)
        return x.reshape(args.num_minibatches, -1, *x.shape[3:])

    return jax.tree.map(arrange, samples)


# <<< copy: update


def update(args, env, net, opt, state, batch, key):
    """Take num_epochs passes over one rollout (Rollout, advantage, return). Returns the state and mean losses."""
    roll, advantage, ret = batch
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    log_std_old = state.params["params"]["log_std"]

    def minibatch(carry, xs):
        params, opt_state, lr = carry
        batch, key = xs
        gradient = jax.grad(partial(ppo_loss, args, env, net, log_std_old=log_std_old, key=key), has_aux=True)
        grads, losses = devices.mean_in_pieces(lambda piece: gradient(params, batch=piece), batch)
        lr = adapt_lr(args, lr, losses["kl"])
        grads, (losses["actor_grad_norm"], losses["critic_grad_norm"]) = clip_gradients(args, grads)
        updates, opt_state = opt.update(grads, opt_state)
        params = jax.tree.map(lambda p, u: p - lr * u, params, updates)
        return (params, opt_state, lr), losses

    def epoch(carry, key):
        k_perm, k_mirror = jax.random.split(key)
        batches = minibatches(args, k_perm, (roll, advantage, ret))
        return jax.lax.scan(minibatch, carry, (batches, jax.random.split(k_mirror, args.num_minibatches)))

    carry = state.params, state.opt_state, state.lr
    (params, opt_state, lr), losses = jax.lax.scan(epoch, carry, jax.random.split(key, args.num_epochs))
    return state.replace(params=params, opt_state=opt_state, lr=lr), jax.tree.map(jnp.mean, losses)


# --- Exploration ---


def iteration(args, env, net, opt, member, member_opt, state):
    """One iteration: rollout, novelty as reward, PPO update, ensemble update. Returns the state, metrics and data."""
    k_roll, k_update, k_retrain = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), state.iteration), 3)
    env_state, roll, transitions, data, report = rollout(args, env, net, state.params, state.env_state, k_roll)
    novelty, ensemble, novelty_report = measure_novelty(member, state.ensemble, transitions)

    if args.policy == "explore":
        reward = roll.reward + args.disagreement_coef * env.dt * novelty / ensemble.scale
        last_value = net.apply(state.params, net.inputs(env_state.obs, env_state.history), method=net.value)
        advantage, ret = gae(args, reward + roll.bootstrap, roll.done, roll.value, last_value)
        state, losses = update(args, env, net, opt, state, (roll, advantage, ret), k_update)
    else:
        losses = {}

    # the ring buffer takes the rollout, then the ensemble trains on draws from all of it
    size = args.num_steps * args.num_envs
    start = state.iteration % args.buffer_rollouts * size
    flat = jax.tree.map(lambda x: x.reshape(size, *x.shape[2:]), transitions)
    buffer = jax.tree.map(lambda b, x: jax.lax.dynamic_update_slice_in_dim(b, x, start, 0), state.buffer, flat)
    filled = jnp.minimum(state.iteration + 1, args.buffer_rollouts) * size
    ensemble, loss = retrain(args, member, member_opt, ensemble, buffer, filled, k_retrain)

    first = jnp.concatenate([state.first[None], roll.done])  # (T+1, N): the step after a done opens an episode
    data |= {"x": transitions.prop[:, :, -1], "action": transitions.action, "first": first[:-1]}
    report = metrics.over_time(report) | losses | novelty_report
    report |= {"lr": state.lr, "ensemble_nll": loss, "action_std": jnp.exp(state.params["params"]["log_std"]).mean()}
    state = state.replace(env_state=env_state, first=first[-1], ensemble=ensemble, buffer=buffer)
    return state.replace(iteration=state.iteration + 1), (report, data)


def init_state(args, env, net, opt, member, member_opt):
    """New networks, an empty ring buffer, and N environments whose episode clocks start anywhere.

    Inputs of the ensemble have a mean of 0 and a std of 1 until `retrain` measures them.
    """
    key = jax.random.fold_in(jax.random.key(args.seed), 2**31 - 1)  # iterations fold in their numbers
    k_net, k_env, k_clock, k_members = jax.random.split(key, 4)
    clocks = jax.random.randint(k_clock, (args.num_envs,), 0, env.episode_steps)
    env_state = jax.jit(jax.vmap(env.reset))(jax.random.split(k_env, args.num_envs), clocks)
    params = net.init(k_net, net.inputs(env_state.obs, env_state.history))
    rows, history = args.num_envs * args.num_steps * args.buffer_rollouts, env.config.history
    prop, past = jnp.zeros((rows, history + 1, env.prop_dim)), jnp.zeros((rows, history, env.action_dim))
    buffer = Transitions(prop, past, delta=jnp.zeros((rows, env.prop_dim)), action=jnp.zeros((rows, env.action_dim)))
    norm = {name: jnp.ones_like(x) if name.endswith("std") else x for name, x in statistics(buffer).items()}
    ensemble = init_ensemble(args, member, member_opt, norm, buffer, k_members)
    lr, first, zero = jnp.float32(min(args.lr, args.max_lr)), jnp.ones(args.num_envs, bool), jnp.zeros((), jnp.int32)
    return TrainState(params, opt.init(params), lr, env_state, first, ensemble, buffer, zero)


def explore(args):
    """Collect until the dataset is full. After Ctrl-C the folder has no meta.json: an unfinished collection."""
    env = make_env(envs.make_explore, args.robot, args)
    args = merge(args, env.config.ppo)
    net = ActorCritic(args.hidden, env.action_dim, args.init_std)
    member = PIDM(MEMBER, 2 * env.action_dim)  # mean and log variance
    opt, member_opt = optax.scale_by_adam(), optax.adam(args.ensemble_lr)
    parts = {"env": env, "net": net, "opt": opt, "member": member, "member_opt": member_opt}
    iterations = arguments.planned_iterations(args)
    run = Run(args, env.config, iterations, SHOWN)
    (state,) = run.start(partial(init_state, **parts))
    print(f"{args.robot}: x {env.prop_dim}, action {env.action_dim}, engine {type(env.engine).__name__}")
    (folder,) = run.folders
    open_arrays = dataset.open_arrays if args.resume else dataset.create_arrays
    arrays = open_arrays(folder, args, env, iterations) if folder else {}
    shardings = devices.of_state(state, axis=0)
    state = devices.place(state, shardings)

    @partial(jax.jit, donate_argnums=0, out_shardings=(shardings, devices.replicated()))  # in place: the ring is large
    def collect_chunk(state):
        return jax.lax.scan(lambda s, _: iteration(args, state=s, **parts), state, None, args.log_every)

    collect_chunk = run.compile(collect_chunk, state)
    with run:
        while not run.done:
            state, (report, data) = collect_chunk(state)
            for name, array in arrays.items():
                array[run.iteration : run.iteration + args.log_every] = data[name]
            run.log(state.iteration, [report])
            if not checkpoints.finite((state.params, state.ensemble)):
                raise records.UserError(
                    f"weights are not finite after iteration {run.iteration}; lower --max-lr, --lr or --ensemble-lr"
                )
            if run.due or run.stopped:
                dataset.flush(arrays)  # before the state that records how far they are filled
                run.save([state])
    if run.iteration < iterations:
        print(f"{args.run_dir} is an unfinished collection")
        return run.report_interrupt()
    if folder:
        dataset.finish(folder, arrays, args, env, iterations, num_held_out(args))
        figures.plot_training(run.rows[0], folder / "curve.png")
        print(f"wrote {iterations * args.num_envs * args.num_steps} transitions to {folder}")
    return state


def main(args):
    """Collect data. User errors print one line and exit with code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        return explore(arguments.resumed(args) if args.resume else args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
