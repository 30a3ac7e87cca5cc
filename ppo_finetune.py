"""Stage 3: train a robot task with PPO, starting from a pretrained PIDM or from scratch (paper Sec. IV-E and V).

    python ppo_finetune.py --task g1_loco --pretrained assets/pidm/g1.msgpack
    python ppo_finetune.py --task go1_loco

Evaluate, film, steer or export the policy with play.py. docs/deviations.md lists what differs from rsl_rl.
Reads top to bottom: arguments, networks, warm start, rollout, losses, update, training.
Shapes: T rollout steps, N environments, B minibatch, O observation, X proprioception x_t, A action, K history, S seeds.
"""

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
from experiment import arguments, checkpoints, devices, metrics, records
from experiment.run import Run, make_env, stack, unstack

SHIPPED = Path(__file__).parent / "assets/pidm"  # <robot>.msgpack: pretrained weights and input normalisation
jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """A field left at None is filled in from the preset or the task. The merged set is printed and saved."""

    # --- Experiment ---
    task: str = "go1_loco"  # a name in envs.TASKS or envs.OWN, or loco with --robot
    robot: str | None = None  # for --task loco: an MJCF, URDF or .toml file, or a run's args.json
    network: Literal["mlp", "pidm"] | None = None  # of actor and critic; None: pidm with --pretrained, else mlp
    pretrained: str | None = None  # PIDM checkpoint written by pretrain_pidm.py
    policy: str | None = None  # start from the networks of this policy.msgpack (not its std); same network and obs
    # where the weights of --pretrained go; shuffled: into both, permuted; none: its input normalisation alone
    load_into: Literal["both", "actor", "critic", "history_encoder", "shuffled", "none"] = "both"
    # Deviation (weight init): rsl_rl has PyTorch's, pytorch_unscaled; pytorch: the actor's last layer a hundredth.
    weight_init: Literal["orthogonal", "pytorch", "pytorch_unscaled"] = "orthogonal"  # of layers that are not loaded
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale: 4, 256 (parkour 512) or 4096 environments
    seed: int = 0  # the only source of randomness
    num_seeds: int = 1  # train seed, seed + 1, ... in one program, each in its own run folder
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), warp (NVIDIA)
    distributed: bool = False  # this is one of several processes, see docs/speed.md; process 0 writes the files
    robust: bool = False  # train for use on a robot: delays, pushes, masses, friction, commands as people give them
    set: tuple[str, ...] = ()  # NAME=VALUE of the task's config, e.g. friction=0.3,1.2 weights.slip=-0.2
    # --- Records ---
    run_dir: str | None = None  # None: runs/<task>/<method>/seed<seed>
    force: bool = False  # overwrite the run in that folder
    resume: str | None = None  # continue the run in this folder, with its arguments; --total-steps extends it
    save_minutes: float = 2.0  # how often the state for --resume is saved
    log_every: int | None = None  # iterations per jitted chunk and CSV row
    tensorboard: bool = False  # write TensorBoard files into the run folder, too
    # --- Environment ---
    num_envs: int | None = None  # N environments at once
    num_steps: int | None = None  # T steps of each in an iteration
    total_steps: int | None = None  # environment steps of the whole run
    # --- Network (defaults: the task's) ---
    hidden: tuple[int, ...] | None = None  # widths of the MLP's hidden layers
    intention: tuple[int, ...] | None = None  # widths of a PIDM's intention encoder, without its last layer
    init_std: float | None = None  # initial action std [action units]
    # --- PPO, as in rsl_rl, a fork of which the paper used ---
    num_epochs: int = 5  # passes over each rollout
    num_minibatches: int = 4  # minibatches of a pass, each of B = N * T / num_minibatches samples
    lr: float | None = None  # initial Adam step size, adapted to the KL; None: 1e-3, with --policy 1e-4
    desired_kl: float | None = None  # the step size keeps the KL from the rollout's policy within a factor 2 of this
    max_lr: float = 1e-2  # largest step size; at large batches a deep critic may want less
    gamma: float = 0.99  # discount per control step
    gae_lambda: float = 0.95  # bias/variance trade-off of the advantage
    clip: float = 0.2  # bound on the change of the probability ratio and of the value
    value_coef: float = 1.0  # weight of the value loss
    entropy_coef: float | None = None  # weight of the entropy bonus
    mirror_coef: float = 0.1  # weight of the mirror loss; ours, the paper gives no number
    max_grad_norm: float = 1.0  # norm to which the gradients of actor and critic are clipped, each on its own
    shuffle_blocks: int | None = None  # shuffle samples within this many groups of environments; None: 1 per device


PRESETS = {
    "smoke": {"num_envs": 4, "num_steps": 4, "total_steps": 64, "log_every": 2},
    "cpu": {"num_envs": 256, "num_steps": 24, "log_every": 10},
    "gpu": {"num_envs": 4096, "num_steps": 24, "log_every": 10},
}
SHOWN = ("episode_return", "fall_rate", "lin_vel_error", "foot_error", "progress_reached", "kl", "action_std")


def merge(args, ppo):
    """Fill the fields left at None from the preset and the task's settings `ppo`, and check the result."""
    if args.pretrained and (args.policy or args.network == "mlp"):
        raise records.UserError("--pretrained loads a PIDM into new networks; leave out --policy and --network mlp")
    if args.load_into != "both" and not args.pretrained:
        raise records.UserError(f"--load-into {args.load_into} needs --pretrained CHECKPOINT")
    network = args.network or ("pidm" if args.pretrained else "mlp")
    loaded = {"both": "pretrained", "none": "random"}.get(args.load_into, args.load_into)
    method = network if args.policy or network == "mlp" else f"pidm_{loaded if args.pretrained else 'random'}"
    seed = f"/seed{args.seed}" if args.num_seeds == 1 else ""  # several add their own
    values = {"network": network, "run_dir": f"runs/{envs.label(args.task, args.robot)}/{method}{seed}"}
    values |= {"hidden": ppo["hidden"], "intention": ppo.get("intention"), "lr": 1e-4 if args.policy else 1e-3}
    values |= {"init_std": ppo["init_std"], "entropy_coef": ppo["entropy"], "desired_kl": ppo.get("desired_kl", 0.01)}
    values |= {"shuffle_blocks": jax.device_count()} | PRESETS[args.preset] | ppo.get(args.preset, {})
    return arguments.check_minibatches(arguments.filled(args, values))


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


# >>> copy: sizes (owner: pretrain_pidm.py)
SIZES = {  # layer widths, our choice; goal: delta or intention encoder; head: decoder or synthesizer, without its last
    "anymal_d": {"history": (128, 64), "goal": (64, 32), "backbone": (192, 192, 192, 64), "head": (64,)},
    "go1": {"history": (128, 64), "goal": (64, 32), "backbone": (192, 192, 192, 64), "head": (64,)},
    "g1": {"history": (224, 96), "goal": (96, 32), "backbone": (224, 224, 224, 64), "head": (64,)},
}
# <<< copy: sizes


class PIDMBranch(nn.Module):
    """Actor or critic around a PIDM (paper Sec. IV-E, Fig. 3).

    An intention encoder, which reads the observation, replaces the delta encoder. A synthesizer, which also sees the
    encoded intention, replaces the prediction decoder.
    """

    sizes: dict
    out_dim: int
    synthesizer: str  # its name
    gain: float  # of the last layer
    weight_init: str

    @nn.compact
    def __call__(self, history, obs):
        """history (..., (K+1) X + K A) and obs (..., O) -> (..., out_dim)."""
        mlp = partial(MLP, weight_init=self.weight_init)
        z_history = nn.elu(mlp(self.sizes["history"], name="history_encoder")(history))
        z_intention = nn.elu(mlp(self.sizes["goal"], name="intention_encoder")(obs))
        z = nn.elu(mlp(self.sizes["backbone"], name="backbone")(jnp.concatenate([z_history, z_intention], -1)))
        synthesizer = mlp((*self.sizes["head"], self.out_dim), self.gain, name=self.synthesizer)
        return synthesizer(jnp.concatenate([z, z_intention], -1))


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


class PIDMActorCritic(nn.Module):
    """Gaussian policy and value function, each around a PIDM: its history_encoder and backbone may be pretrained."""

    sizes: dict
    prop_dim: int
    action_dim: int
    init_std: float
    weight_init: str

    def setup(self):
        branch = partial(PIDMBranch, self.sizes, weight_init=self.weight_init)
        self.actor = branch(self.action_dim, "action_synthesizer", gain=0.003)  # < 0.02 behind loaded weights, too
        self.critic = branch(1, "value_synthesizer", gain=0.05)
        self.log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.init_std)), (self.action_dim,))
        for name, width in (("prop", self.prop_dim), ("action", self.action_dim)):
            setattr(self, f"{name}_mean", self.variable("normalizer", f"{name}_mean", jnp.zeros, width))
            setattr(self, f"{name}_std", self.variable("normalizer", f"{name}_std", jnp.ones, width))

    @staticmethod
    def inputs(obs, history):
        return {"obs": obs, **history}

    def __call__(self, inputs):
        """obs (..., O), prop (..., K+1, X), action (..., K, A) -> mean (..., A), log_std (A,), value (...)."""
        return self.mean(inputs), self.log_std, self.value(inputs)

    def mean(self, inputs):
        return self.actor(self.history(inputs), inputs["obs"])

    def value(self, inputs):
        return self.critic(self.history(inputs), inputs["obs"]).squeeze(-1)

    def history(self, inputs):
        """prop (..., K+1, X) and action (..., K, A), standardised and flattened."""
        names = ("prop_mean", "prop_std", "action_mean", "action_std")
        norm = {name: jax.lax.stop_gradient(getattr(self, name).value) for name in names}
        return flat_history(norm, inputs["prop"], inputs["action"])


def make_net(args, env):
    """The actor-critic that the arguments ask for."""
    if args.network == "mlp":
        return ActorCritic(args.hidden, env.action_dim, args.init_std, args.weight_init)
    sizes = SIZES[env.robot.like]
    goal = (*(args.intention or sizes["goal"][:-1]), sizes["goal"][-1])  # perceptive tasks need a wider one
    return PIDMActorCritic(sizes | {"goal": goal}, env.prop_dim, env.action_dim, args.init_std, args.weight_init)


# --- Warm start ---


def shrink_first_actions(params):
    """Scale the actor's last layer, in place, so that the first mean actions are almost 0 (paper Sec. IV-E)."""
    actor = params["params"]["actor"]
    *_, last = actor.get("action_synthesizer", actor).values()  # layers of a PIDM's synthesizer, or of the MLP
    last.update({name: 0.01 * x for name, x in last.items()})


def shuffle_weights(tree, key):
    """Permute the entries of each kernel and bias: a control beyond the paper, which destroys what they know."""
    leaves, structure = jax.tree.flatten(tree)
    keys = structure.unflatten([*jax.random.split(key, len(leaves))])
    return jax.tree.map(lambda x, k: jax.random.permutation(k, x.ravel()).reshape(x.shape), tree, keys)


def warm_start(args, env, params, key):
    """Set a PIDM's input normalisation and, with --pretrained, load history_encoder and backbone (paper Sec. IV-E).

    --load-into names what to load. Without --pretrained the normalisation is the shipped PIDM's; beside a PIDM of your
    own give it with --load-into none. UserError if the file is missing or of another robot, action scale, dt, x or K.
    """
    path = Path(args.pretrained or SHIPPED / f"{env.robot.name}.msgpack")
    core = {name: params["params"]["actor"][name] for name in ("history_encoder", "backbone")}
    pidm = checkpoints.load_pidm(path, env, {"params": core, "normalizer": params["normalizer"]})
    core = jax.tree.map(jnp.asarray, pidm["params"])
    if args.load_into == "shuffled":
        core = shuffle_weights(core, key)
    if args.load_into == "history_encoder":
        core = {"history_encoder": core["history_encoder"]}
    branches = {"actor": ["actor"], "critic": ["critic"], "none": []}.get(args.load_into, ["actor", "critic"])
    loaded = {branch: params["params"][branch] | core for branch in (branches if args.pretrained else [])}
    for branch in loaded:
        print(f"{branch}: {'shuffled' if args.load_into == 'shuffled' else 'loaded'} {' and '.join(core)} from {path}")
    return {"params": params["params"] | loaded, "normalizer": jax.tree.map(jnp.asarray, pidm["normalizer"])}


# --- Rollout ---


@flax.struct.dataclass
class TrainState:
    params: dict  # as Flax has it: "params", the weights, and "normalizer" of a PIDM, which gets no gradient
    opt_state: optax.OptState
    lr: jax.Array  # ()
    env_state: envs.base.State  # (N, ...)
    key: jax.Array  # of this seed, since several train at once: each iteration folds in its number
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
    """Act for T steps in N environments. Returns the last environment state, and a Rollout with metrics (T,)."""

    def step(env_state, key):
        inputs = net.inputs(env_state.obs, env_state.history)
        mean, log_std, value = net.apply(params, inputs)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        env_state = jax.vmap(env.step)(env_state, action)  # environments reset themselves
        done = env_state.terminated | env_state.truncated
        # Deviation (time limits): rsl_rl bootstraps with V of the observation before the last step, not after it.
        final_value = net.apply(params, net.inputs(env_state.final_obs, env_state.final_history), method=net.value)
        bootstrap = args.gamma * final_value * (env_state.truncated if env.bootstrap_time_outs else 0.0)
        roll = Rollout(inputs, action, mean, log_prob(mean, log_std, action), value, env_state.reward, bootstrap, done)
        return env_state, (roll, metrics.step_metrics(env_state))

    return jax.lax.scan(step, env_state, jax.random.split(key, args.num_steps))


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


# --- Training ---


def iteration(args, env, net, opt, state):
    """One PPO iteration: rollout, advantages, update. Noise and shuffles come from (seed, iteration) alone."""
    k_roll, k_update = jax.random.split(jax.random.fold_in(state.key, state.iteration))
    env_state, (roll, report) = rollout(args, env, net, state.params, state.env_state, k_roll)
    last_value = net.apply(state.params, net.inputs(env_state.obs, env_state.history), method=net.value)
    # a time limit is no end of the task: the value of what would follow is added to the reward
    advantage, ret = gae(args, roll.reward + roll.bootstrap, roll.done, roll.value, last_value)
    new, losses = update(args, env, net, opt, state, (roll, advantage, ret), k_update)
    report = metrics.over_time(report) | losses
    report |= metrics.update_magnitude(state.params, new.params) if args.network == "pidm" else {}
    report["explained_variance"] = 1 - jnp.var(ret - roll.value) / (jnp.var(ret) + 1e-8)
    report |= {"lr": new.lr, "action_std": jnp.exp(new.params["params"]["log_std"]).mean()}
    return new.replace(env_state=env_state, iteration=state.iteration + 1), report


def init_state(args, env, net, opt):
    """New or loaded networks, and N environments at random episode clocks, so that time-outs spread out."""
    key, k_net, k_env, k_clock, k_load = jax.random.split(jax.random.key(args.seed), 5)
    clocks = jax.random.randint(k_clock, (args.num_envs,), 0, env.episode_steps)
    env_state = jax.jit(jax.vmap(env.reset))(jax.random.split(k_env, args.num_envs), clocks)
    params = net.init(k_net, net.inputs(env_state.obs, env_state.history))
    if args.weight_init == "pytorch":  # orthogonal last layers are small already, pytorch_unscaled keeps PyTorch's
        shrink_first_actions(params)
    if args.policy and not args.resume:  # a saved state replaces the weights
        params = checkpoints.load_networks(args.policy, params, env)
    elif args.network == "pidm" and not args.resume:
        params = warm_start(args, env, params, k_load)
    return TrainState(params, opt.init(params), jnp.float32(min(args.lr, args.max_lr)), env_state, key, jnp.int32(0))


def make_chunk(args, env, net, opt, states):
    """Return log_every iterations of all seeds, jitted: states (S, ...) -> the same, and metrics (S, log_every)."""

    def one_seed(state):
        return jax.lax.scan(lambda s, _: iteration(args, env, net, opt, s), state, None, args.log_every)

    def all_seeds(states):  # one seed fills a CPU, so there they run one after the other
        return jax.lax.map(one_seed, states) if jax.default_backend() == "cpu" else jax.vmap(one_seed)(states)

    return jax.jit(all_seeds, out_shardings=(devices.of_state(states, axis=1), devices.replicated()))


def train(args):
    """Run PPO to the end, or to Ctrl-C or SIGTERM. Either way each seed's folder holds a policy, metrics and curve."""
    env = make_env(partial(envs.make, robust=args.robust, robot=args.robot), args.task, args)
    args = merge(args, env.config.ppo)
    net, opt = make_net(args, env), optax.scale_by_adam()  # `update` multiplies by the adapted step size
    run = Run(args, env.config, arguments.planned_iterations(args), SHOWN)
    states = stack(run.start(partial(init_state, env=env, net=net, opt=opt)))  # leaves (S, ...)
    print(f"{args.task}: observation {env.obs_dim}, action {env.action_dim}, engine {type(env.engine).__name__}")
    states = devices.place(states, devices.of_state(states, axis=1))
    train_chunk = run.compile(make_chunk(args, env, net, opt, states), states)
    with run:
        while not run.done:
            before = states
            states, report = train_chunk(states)
            run.log(states.iteration[0], unstack(report))  # metrics.csv, progress
            run.save_policies(before, states)  # and state.msgpack; weights that are not finite end the run here
    run.finish(states)
    return states


def main(args):
    """Train. User errors print one line and exit with code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        return train(arguments.resumed(args, "total_steps") if args.resume else args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
