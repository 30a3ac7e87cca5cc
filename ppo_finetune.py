"""Stage 3: learn a robot task with PPO, from a pretrained PIDM or from nothing (paper Sec. IV-E and V).

    python ppo_finetune.py --task g1_loco --pretrained assets/pidm/g1.msgpack
    python ppo_finetune.py --task go1_loco
    python ppo_finetune.py --task go1_loco --eval runs/go1_loco/mlp/seed0/policy.msgpack

Reads top to bottom: arguments, networks, warm start, rollout, objective, update, evaluation, records, main.
The algorithm is that of rsl_rl, which the paper used; where we differ stands `Deviation:`.
Shapes in comments: T rollout steps, N environments, B minibatch, O observation, X proprioception x_t, A action,
K history.
"""

import dataclasses
import json
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

SHIPPED = Path(__file__).parent / "assets/pidm"  # <robot>.msgpack: pretrained weights and input scaling
jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """Values left at None come from the preset or the task; the merged set is printed and stored in args.json."""

    # --- Run ---
    task: str = "go1_loco"  # a name in envs.TASKS
    network: Literal["mlp", "pidm"] | None = None  # of actor and critic; None: pidm with --pretrained, else mlp
    pretrained: str | None = None  # PIDM checkpoint of pretrain_pidm.py; None: a PIDM starts from random weights
    init: Literal["both", "actor", "critic", "shuffled"] = "both"  # what is loaded; shuffled: see `shuffle`
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale: smoke 4 environments, cpu 256, gpu 4096
    seed: int = 0  # the only source of randomness
    num_seeds: int = 1  # trainings in one program, with seed, seed + 1, ...; each with a run folder of its own
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), warp (NVIDIA), auto
    run_dir: str | None = None  # None: runs/<task>/<method>/seed<seed>
    force: bool = False  # overwrite the run in that folder
    resume: str | None = None  # a run folder: go on where it stopped; all other arguments are those of that run
    save_minutes: float = 2.0  # what --resume needs is written this often, and at the end
    log_every: int | None = None  # iterations per jitted chunk and CSV row
    tensorboard: bool = False  # every row goes to TensorBoard event files in the run folder as well
    # --- Evaluation ---
    eval: str | None = None  # a policy.msgpack: run it instead of training, write pictures beside it
    eval_envs: int = 64  # episodes of the evaluation, of each level where a task has levels
    level: int | None = None  # level of the evaluation and its pictures; None: all levels, pictures of level 4
    export: str | None = None  # with --eval: write that policy as an ONNX file here instead; see `export_onnx`
    video: str | None = None  # with --eval: film the showcase, whole, as this .gif or .mp4 instead
    viewer: bool = False  # with --eval: watch and steer the robot in a window instead; see envs/watch.py
    web: bool = False  # the same in a browser
    # --- Environment ---
    num_envs: int | None = None  # N
    num_steps: int | None = None  # T, per iteration and environment
    total_steps: int | None = None  # environment steps of the whole run
    # --- Network (tasks' own tables) ---
    hidden: tuple[int, ...] | None = None  # widths of the MLP's hidden layers
    intention: tuple[int, ...] | None = None  # of the PIDM's intention encoder but the last; None: as in pretraining
    # Deviation: rsl_rl learns the std itself, we its log.
    init_std: float | None = None  # initial action std, in action units
    # Deviation: rsl_rl's fresh layers are as PyTorch makes them; with orthogonal ones Go1 learns faster, see README.
    fresh: Literal["orthogonal", "pytorch"] = "orthogonal"  # first weights of all that is not loaded
    # --- Warm start, beyond the paper ---
    core: tuple[Literal["history_encoder", "backbone"], ...] = ("history_encoder", "backbone")  # parts that are loaded
    core_scale: float = 1.0  # multiplies the last layer of a loaded backbone, whose features are larger than fresh ones
    warm_iterations: int = 0  # iterations in which the step size of loaded parts grows from 0
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
    # --- Devices ---
    distributed: bool = False  # one of several processes, one a host; process 0 writes the files
    shuffle_blocks: int | None = None  # blocks of environments that samples are shuffled within; None: one a device


PRESETS = {
    "smoke": {"num_envs": 4, "num_steps": 4, "total_steps": 64, "log_every": 2},
    "cpu": {"num_envs": 256, "num_steps": 24, "log_every": 10},
    "gpu": {"num_envs": 4096, "num_steps": 24, "log_every": 10},
}


COUNTS = ("num_seeds", "num_envs", "num_steps", "total_steps", "log_every", "num_epochs", "num_minibatches")
COUNTS += ("eval_envs", "shuffle_blocks")


def method_name(args):
    """mlp, pidm_random, pidm_pretrained, or pidm_<what is loaded>."""
    if args.network == "mlp":
        return "mlp"
    loaded = "pretrained" if args.init == "both" else args.init
    return f"pidm_{loaded if args.pretrained else 'random'}"


def merge(args, ppo):
    """Fill what is None in args from the preset, then from the task's own settings `ppo`; check them."""
    if args.network is None:
        args = dataclasses.replace(args, network="pidm" if args.pretrained else "mlp")
    if args.pretrained and args.network == "mlp":
        raise records.UserError("--pretrained loads a PIDM; leave out --network mlp")
    if args.init != "both" and not args.pretrained:
        raise records.UserError(f"--init {args.init} needs --pretrained CHECKPOINT")
    if not args.core:
        raise records.UserError("--core names no part; to load nothing leave out --pretrained")
    if args.core != CORE and not args.pretrained:
        raise records.UserError("--core chooses what is loaded from a checkpoint; name one with --pretrained")
    values = {"hidden": ppo["hidden"], "init_std": ppo["init_std"], "entropy_coef": ppo["entropy"]}
    values |= {"intention": ppo.get("intention")} | PRESETS[args.preset] | ppo.get(args.preset, {})
    folder = f"runs/{args.task}/{method_name(args)}"
    values |= {"shuffle_blocks": jax.device_count()}
    values |= {"run_dir": folder if args.num_seeds > 1 else f"{folder}/seed{args.seed}"}
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    records.check_positive(args, COUNTS)
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


class PIDMActorCritic(nn.Module):
    """Actor and critic each around a PIDM core of their own (paper Sec. IV-E, Fig. 3).

    The intention encoder reads the task's observation in place of the wanted change of x, and a synthesizer replaces
    the prediction decoder. Both are fresh in every run; history_encoder and backbone may be loaded by `warm_start`.
    """

    sizes: Sizes
    prop_dim: int
    action_dim: int
    init_std: float
    fresh: str
    reads = ("obs", "prop", "action")

    def setup(self):
        ends = {"goal": "intention_encoder", "goal_to_head": True, "fresh": self.fresh}
        self.actor = PIDM(self.sizes, self.action_dim, head="action_synthesizer", gain=0.003, **ends)  # actions ~0
        self.critic = PIDM(self.sizes, 1, head="value_synthesizer", gain=0.05, **ends)
        self.log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.init_std)), (self.action_dim,))
        for name, width in (("prop", self.prop_dim), ("action", self.action_dim)):
            setattr(self, f"{name}_mean", self.variable("normalizer", f"{name}_mean", jnp.zeros, width))
            setattr(self, f"{name}_std", self.variable("normalizer", f"{name}_std", jnp.ones, width))

    def __call__(self, inputs):
        """inputs obs (..., O), prop (..., K+1, X), action (..., K, A) -> mean (..., A), log_std (A,), value (...)."""
        return self.mean(inputs), self.log_std, self.value(inputs)

    def mean(self, inputs):
        return self.actor(self.history(inputs), inputs["obs"])

    def value(self, inputs):
        return self.critic(self.history(inputs), inputs["obs"]).squeeze(-1)

    def history(self, inputs):
        """Both histories standardised and flattened (..., (K+1) X + K A)."""
        names = "prop_mean", "prop_std", "action_mean", "action_std"
        norm = {name: jax.lax.stop_gradient(getattr(self, name).value) for name in names}
        return flat_history(norm, inputs["prop"], inputs["action"])


def make_net(args, env):
    """The network that the arguments name, for this environment."""
    if args.network == "mlp":
        return ActorCritic(args.hidden, env.action_dim, args.init_std, args.fresh)
    sizes = SIZES[env.robot.name]
    wide = args.intention or sizes.goal[:-1]  # perceptive tasks need more to see with
    sizes = dataclasses.replace(sizes, goal=(*wide, sizes.goal[-1]))
    return PIDMActorCritic(sizes, env.prop_dim, env.action_dim, args.init_std, args.fresh)


# --- Warm start ---


def load_pidm(path, env):
    """Params and normalizer of a PIDM checkpoint; UserError if it was made for another robot, layout of x or K."""
    pidm, meta = records.load(path, "PIDM checkpoint")
    for name, ours in (("robot", env.robot.name), ("layout", list(env.prop_layout)), ("history", env.config.history)):
        if meta[name] != ours:
            raise records.UserError(f"{path} was made for {name} {meta[name]}, this task has {name} {ours}")
    return pidm


def shuffle(tree, key):
    """A control beyond the paper: permute the numbers of each kernel and bias. Keeps scales, destroys knowledge."""
    leaves, structure = jax.tree.flatten(tree)
    keys = jax.random.split(key, len(leaves))
    mixed = [jax.random.permutation(k, leaf.ravel()).reshape(leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
    return structure.unflatten(mixed)


def loaded_branches(args):
    """Which of actor and critic start from the PIDM."""
    if not args.pretrained:
        return ()
    return (args.init,) if args.init in ("actor", "critic") else ("actor", "critic")


def warm_start(args, params, weights):
    """Copy the PIDM's history_encoder and backbone, or args.core of them, into the branches that args.init names."""
    params = jax.tree.map(lambda x: x, params)  # new dicts, so that the caller's stay as they are
    if args.init == "shuffled":
        weights = shuffle(weights, jax.random.fold_in(jax.random.key(args.seed), 1))
    weights = jax.tree.map(jnp.asarray, weights)
    layers = weights["backbone"]
    last = max(layers)  # Dense_0, Dense_1, ...
    weights |= {"backbone": layers | {last: jax.tree.map(lambda x: args.core_scale * x, layers[last])}}
    for branch in loaded_branches(args):
        params["params"][branch] |= {name: weights[name] for name in args.core}
    return params


def make_optimizer(args):
    """Adam, whose updates `update` multiplies by the step size; loaded parts may start slowly."""
    steps = args.warm_iterations * args.num_epochs * args.num_minibatches
    if not steps or not loaded_branches(args):
        return optax.scale_by_adam()

    def loaded(params):
        branches = loaded_branches(args)
        return jax.tree_util.tree_map_with_path(lambda p, _: p[1].key in branches and p[2].key in args.core, params)

    slow = optax.scale_by_schedule(optax.linear_schedule(0.0, 1.0, steps))
    return optax.chain(optax.scale_by_adam(), optax.masked(slow, loaded))


def zero_inputs(env, net):
    """Inputs of the right shapes."""
    steps = env.config.history
    history = {"prop": jnp.zeros((steps + 1, env.prop_dim)), "action": jnp.zeros((steps, env.action_dim))}
    return net_inputs(net, jnp.zeros(env.obs_dim), history)


def init_params(args, env, net, key):
    """Fresh networks; a PIDM gets its robot's normalizer, and the pretrained weights where they are asked for."""
    params = net.init(key, zero_inputs(env, net))
    if args.network == "mlp":
        return params
    # every arm has the same input scaling, so that they differ in nothing but the weights
    path = Path(args.pretrained or SHIPPED / f"{env.robot.name}.msgpack")
    pidm = load_pidm(path, env)
    core = {name: params["params"]["actor"][name] for name in CORE}
    for part, wanted in (("params", core), ("normalizer", params["normalizer"])):
        pidm[part] = {name: x for name, x in pidm.get(part, {}).items() if name in wanted}
        records.check_shapes(path, pidm[part], wanted)
    params = params | {"normalizer": jax.tree.map(jnp.asarray, pidm["normalizer"])}
    return warm_start(args, params, pidm["params"])


def describe(args, params):
    """One line a submodule of actor and critic: its layers, and whether it was loaded."""
    for branch in ("actor", "critic"):
        for name, part in params["params"][branch].items():
            shapes = [layer["kernel"].shape for layer in part.values()]
            loaded = branch in loaded_branches(args) and name in args.core
            widths = "-".join(str(width) for width in (shapes[0][0], *(shape[1] for shape in shapes)))
            print(f"  {branch:6} {name:18} {'loaded' if loaded else 'fresh ':6}  {widths}")


# --- Rollout ---


@flax.struct.dataclass
class TrainState:
    params: dict
    opt_state: optax.OptState
    lr: jax.Array  # ()
    env: envs.base.State  # (N, ...)
    key: jax.Array  # of the seed; stays, for an iteration folds in its number
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


def rollout(args, env, net, params, env_state, key):
    """Act for T steps in N environments. Returns the last environment state, a Rollout and metrics (T,)."""

    def step(env_state, key):
        inputs = net_inputs(net, env_state.obs, env_state.history)
        mean, log_std, value = net.apply(params, inputs)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        env_state = jax.vmap(env.step)(env_state, action)
        # Deviation: rsl_rl bootstraps time-outs with V of the observation before the step, which is not the last one.
        final_inputs = net_inputs(net, env_state.final_obs, env_state.final_history)
        final_value = net.apply(params, final_inputs, method=net.value)
        bootstrap = args.gamma * final_value * (env_state.truncated if env.bootstrap_time_outs else 0.0)
        done = env_state.terminated | env_state.truncated
        logp = log_prob(mean, log_std, action)
        return env_state, (
            Rollout(inputs, action, mean, logp, value, env_state.reward, bootstrap, done),
            step_metrics(env_state, done),
        )

    env_state, (roll, metrics) = jax.lax.scan(step, env_state, jax.random.split(key, args.num_steps))
    return env_state, roll, metrics


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


def update_magnitude(before, after):
    """Mean absolute change of each submodule's weights, averaged over its layers (paper Sec. V-E)."""
    changes = {}
    for branch in ("actor", "critic"):
        for name, part in before["params"][branch].items():
            new = after["params"][branch][name]
            layers = [jnp.abs(new[layer]["kernel"] - part[layer]["kernel"]).mean() for layer in part]
            changes[f"update/{branch}/{name}"] = jnp.stack(layers).mean()
    return changes


def iteration(args, env, net, opt, state):
    """One PPO iteration: rollout, advantages, update. Its randomness depends on (seed, iteration) alone."""
    k_roll, k_update = jax.random.split(jax.random.fold_in(state.key, state.iteration))
    env_state, roll, metrics = rollout(args, env, net, state.params, state.env, k_roll)
    last_value = net.apply(state.params, net_inputs(net, env_state.obs, env_state.history), method=net.value)
    advantage, ret = gae(args, roll.reward + roll.bootstrap, roll.done, roll.value, last_value)
    params, opt_state, lr, losses = update(args, env, net, opt, state, roll, advantage, ret, k_update)
    metrics = {k: v.sum() if k.startswith("sum/") else v.mean() for k, v in metrics.items()} | losses
    metrics |= update_magnitude(state.params, params) if args.network == "pidm" else {}
    metrics |= {
        "explained_variance": 1 - jnp.var(ret - roll.value) / (jnp.var(ret) + 1e-8),
        "lr": lr,
        "action_std": jnp.exp(params["params"]["log_std"]).mean(),
    }
    return TrainState(params, opt_state, lr, env_state, state.key, state.iteration + 1), metrics


def init_state(args, env, net, opt):
    """Fresh networks, and N environments whose episode clocks start anywhere, so that time-outs spread out."""
    key = jax.random.key(args.seed)
    k_net, k_env, k_clock = jax.random.split(key, 3)
    params = init_params(args, env, net, k_net)
    clocks = jax.random.randint(k_clock, (args.num_envs,), 0, env.episode_steps)
    env_state = jax.jit(jax.vmap(env.reset))(jax.random.split(k_env, args.num_envs), clocks)
    return TrainState(params, opt.init(params), jnp.float32(args.lr), env_state, key, jnp.zeros((), jnp.int32))


def one_for_each_seed(args):
    """The arguments of every training of this run: with --num-seeds their folders are `run_dir`/seed<k>."""
    seeds = range(args.seed, args.seed + args.num_seeds)
    folders = [args.run_dir if args.num_seeds == 1 else f"{args.run_dir}/seed{seed}" for seed in seeds]
    return [dataclasses.replace(args, seed=s, run_dir=f, num_seeds=1) for s, f in zip(seeds, folders, strict=True)]


def make_chunk(args, env, net, opt, states):
    """log_every iterations of all seeds' TrainStates (S, ...), which also returns their metrics (S, log_every)."""

    def one_seed(state):
        return jax.lax.scan(lambda s, _: iteration(args, env, net, opt, s), state, None, args.log_every)

    # one after the other on a CPU, which a single seed fills; side by side on an accelerator
    in_turn = jax.default_backend() == "cpu"

    def all_seeds(states):
        return jax.lax.map(one_seed, states) if in_turn else jax.vmap(one_seed)(states)

    return jax.jit(all_seeds, out_shardings=(devices.of_state(states, axis=1), devices.same()))


# --- Evaluation ---


def evaluate(env, net, params, num_envs, level=None):
    """One episode per environment with the mean action, fixed seed. Metrics, first physics, its qpos (steps, nq)."""

    def step(carry, _):
        env_state, alive = carry
        action = net.apply(params, net_inputs(net, env_state.obs, env_state.history), method=net.mean)
        env_state = jax.vmap(env.step)(env_state, action)
        done = env_state.terminated | env_state.truncated
        out = env_state.metrics, alive, done & alive, env_state.terminated & alive, env_state.physics.qpos[0]
        return (env_state, alive & ~done), out

    start = {} if level is None else {"curriculum": env.at_level(level)}
    env_state = jax.vmap(partial(env.reset, **start))(jax.random.split(jax.random.key(1), num_envs))
    carry = env_state, jnp.ones(num_envs, bool)
    _, (metrics, alive, ended, fell, qpos) = jax.lax.scan(step, carry, None, env.episode_steps)
    result = {}
    for name, v in metrics.items():
        if name.startswith("episode_"):
            result[name] = (v * ended).sum() / ended.sum()
        elif "/" not in name and name != "progress":  # not the parts of a total, nor what is of a whole training
            result[name] = (v * alive).sum() / alive.sum()
    result["falls"] = fell.any(0).mean()
    return result, jax.tree.map(lambda x: x[0], env_state.physics), qpos


def load_policy(args, env):
    """The network and parameters of the policy file args.eval; UserError if it is not one for this task."""
    path = Path(args.eval)
    params, meta = records.load(path, "policy")
    if meta["task"] != args.task:
        raise records.UserError(
            f"{path} is a policy for {meta['task']}, not for {args.task}; pass --task {meta['task']}"
        )
    trained = {name: meta["args"].get(name) for name in ("network", "init_std", "hidden", "intention")}
    net = make_net(dataclasses.replace(args, **trained), env)
    like = jax.eval_shape(net.init, jax.random.key(0), zero_inputs(env, net))
    records.check_shapes(path, params, like)
    return net, params


def run_eval(args):
    """--eval: print the task's metrics of a saved policy, on its own commands and in the showcase; write pictures."""
    from envs import render  # matplotlib and OpenGL are slow to load and not needed for training

    env, show = (make_env(args, **fields) for fields in (envs.TASKS[args.task][0].EVALUATION, showcase(args)))
    path = Path(args.eval)
    net, params = load_policy(args, env)
    report = {}
    run = jax.jit(lambda params, level: evaluate(env, net, params, args.eval_envs, level)[0])
    for level in levels(args, env):
        name = "task" if level is None else f"level {level}"
        report[name] = run(params, level)
        print(f"{args.eval_envs} episodes of {args.task}, {name}, mean action:", records.line(report[name]))
    shown, start, qpos = jax.jit(lambda p: evaluate(show, net, p, min(args.eval_envs, 16)))(params)
    print(f"showcase {showcase(args)}:", records.line(shown))
    report = jax.tree.map(float, report | {"showcase": shown}) | {"showcase_config": showcase(args)}
    records.replace_text(path.with_name("eval.json"), json.dumps(report, indent=1) + "\n")
    for picture in render.film(show, qpos, start, path.parent, **show.FILM):
        print(f"wrote {picture}")


def film(args):
    """--eval POLICY --video FILE: the showcase from its first step to its last."""
    from envs import render

    env, path = make_env(args, **showcase(args)), Path(args.video)
    net, params = load_policy(args, env)
    try:
        render.check_video(path)
        _, start, qpos = jax.jit(lambda p: evaluate(env, net, p, 1))(params)
        render.video(env, qpos, start, path)
    except ValueError as error:
        raise records.UserError(str(error)) from None
    print(f"wrote {path}")


def watch_live(args):
    """--eval POLICY --viewer or --web: a person commands, pushes and picks the level; see envs/watch.py."""
    from envs import watch

    env = make_env(args, **envs.TASKS[args.task][0].EVALUATION)
    if "time_left" not in env.OBS:
        env = make_env(args, episode_seconds=3600.0)  # no need to start again after 20 s
    net, params = load_policy(args, env)
    levels(args, env)  # refuses a level where there is none

    def act(state):
        return net.apply(params, net_inputs(net, state.obs, state.history), method=net.mean)

    robot = watch.Watched(env, act, args.level)
    return watch.window(robot) if args.viewer else watch.browser(robot)


def levels(args, env):
    """Levels to evaluate; None for a task that has none."""
    if not hasattr(env, "at_level"):
        if args.level is not None:
            raise records.UserError(f"{args.task} has no levels; leave out --level")
        return [None]
    return range(env.LEVELS) if args.level is None else [args.level]


def showcase(args):
    """Config fields of the pictured episode."""
    fields = envs.TASKS[args.task][0].SHOWCASE
    return fields | {"level": args.level} if "level" in fields and args.level is not None else fields


# --- Deployment ---


def onboard(env, net, params):
    """What a robot computes every control step, as a function of arrays without a leading axis, and their widths.

    In: the observation's blocks in SI units (joint_pos [rad] is absolute; no `action`), prop_history (K, X) and
    action_history (K, A), oldest first. Out: action (A,), joint_target (A,) [rad] for the PD loops, and both
    histories for the next step. An episode starts with K copies of its first x_t and with actions of 0.
    """
    dummy = jax.eval_shape(env.reset, jax.random.key(0))
    shapes = {name: (env.width(kind),) for name, (kind, _) in env.OBS.items() if name != "action"}
    shapes |= {"prop_history": (env.config.history, env.prop_dim), "action_history": dummy.history["action"].shape}

    def policy(*arrays):
        given = dict(zip(shapes, arrays, strict=True))
        past = given["action_history"]
        given |= {"joint_pos": given["joint_pos"] - env.default_pose, "action": past[-1]}
        prop = jnp.concatenate([given[name] for name in env.prop_layout])
        history = {"prop": jnp.concatenate([given["prop_history"], prop[None]]), "action": past}
        inputs = net_inputs(net, env.pack(given), history)
        action = net.apply(params, jax.tree.map(lambda x: x[None], inputs), method=net.mean)[0]
        target = env.default_pose + env.robot.action_scale * action
        return action, target, history["prop"][1:], jnp.concatenate([past, action[None]])[1:]

    return policy, shapes


def export_onnx(args):
    """--eval POLICY --export FILE: write the policy's mean action as an ONNX graph for one robot, batch 1.

    Inputs and outputs are those of `onboard`. Metadata: task, robot, joints, default_pose, action_scale, dt, history,
    and versions, each as JSON. Needs requirements-export.txt.
    """
    try:
        import jax2onnx
        import onnx
    except ImportError:
        raise records.UserError("--export needs jax2onnx: pip install -r requirements-export.txt") from None
    env = make_env(args)
    policy, shapes = onboard(env, *load_policy(args, env))
    inputs = [jax.ShapeDtypeStruct((1, *shape), jnp.float32) for shape in shapes.values()]
    outputs = ["action", "joint_target", "next_prop_history", "next_action_history"]

    def batch_of_one(*arrays):  # jax2onnx 0.17 cannot export a vmapped flax layer
        return [x[None] for x in policy(*(x[0] for x in arrays))]

    model = jax2onnx.to_onnx(batch_of_one, inputs, input_names=[*shapes], output_names=outputs)
    facts = {
        "task": args.task,
        "robot": env.robot.name,
        "joints": list(env.robot.joints),
        "default_pose": np.asarray(env.default_pose).tolist(),
        "action_scale": env.robot.action_scale,
        "dt": env.dt,
        "history": env.config.history,
        "prop": list(env.prop_layout),
        "versions": records.versions(),
    }
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in facts.items()})
    Path(args.export).parent.mkdir(parents=True, exist_ok=True)
    records.replace_bytes(Path(args.export), model.SerializeToString())
    print(f"wrote {args.export}")


# --- Records ---


def make_env(args, **overrides):
    """The task's environment, or a UserError that lists the right names."""
    try:
        env = envs.make(args.task, args.engine, **overrides)
        devices.check_engine(env.engine)
        return env
    except (ValueError, ImportError) as error:
        raise records.UserError(str(error)) from None


SHOWN = ("episode_return", "fall_rate", "lin_vel_error", "foot_error", "progress", "kl", "action_std")  # if there


def plot(rows, path):
    """Return, fall rate, task metrics, action std and reward terms over environment steps."""
    errors = [name for name in rows[0] if name.endswith("_error") or name in ("progress", "episode_success")]
    terms = [name for name in rows[0] if name.startswith("reward/")]
    names = ("episode_return", "fall_rate", *errors, "action_std")
    records.plot_curves(rows, names, {"reward terms per step": terms}, path)


# --- Main ---


def train(args):
    """Run PPO to the end, or to Ctrl-C or SIGTERM; either way each seed's folder holds a policy, metrics and curve."""
    env = make_env(args)
    args = merge(args, env.config.ppo)
    net, opt, seeds = make_net(args, env), make_optimizer(args), one_for_each_seed(args)
    if args.resume:
        like = jax.eval_shape(partial(init_state, args, env, net, opt))
        states, rows = ([one] for one in records.load_state(args.resume, like))
        outs = [Path(args.resume)]
    else:
        states, rows = [init_state(a, env, net, opt) for a in seeds], [[] for _ in seeds]
        # only now, for the checkpoint may have been refused
        outs = records.start_runs(seeds, env.config, args.force) if devices.is_first() else [None] * len(seeds)
    print(f"{args.task}: observation {env.obs_dim}, action {env.action_dim}, engine {type(env.engine).__name__}")
    print("  ".join(f"{name}={value}" for name, value in dataclasses.asdict(args).items()), flush=True)
    if args.network == "pidm":
        describe(args, states[0].params)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    states = devices.place(states, devices.of_state(states, axis=1))

    iterations = -(-args.total_steps // (args.num_envs * args.num_steps))
    start = time.perf_counter()
    chunk = make_chunk(args, env, net, opt, states).lower(states).compile()
    print(f"compiled in {time.perf_counter() - start:.1f} s", flush=True)
    last = saved = time.perf_counter()
    start = last - (rows[0][-1]["seconds"] if rows[0] else 0.0)
    board = args.run_dir if args.tensorboard and devices.is_first() else None
    with records.Reporter(iterations, SHOWN, board=board) as reporter:
        while int(states.iteration[0]) < iterations and not reporter.stopped:
            before, (states, metrics) = states, chunk(states)
            now = time.perf_counter()
            keep(seeds, outs, before, states, jax.device_get(metrics), rows, now - start)
            speed = args.num_seeds * args.log_every * args.num_envs * args.num_steps / (now - last)
            reporter.show(records.mean_row([own[-1] for own in rows]), speed)
            last = now
            if now - saved >= 60 * args.save_minutes:
                save_states(outs, states, rows)
                saved = now
    save_states(outs, states, rows)
    if reporter.stopped:
        print(f"interrupted; --resume {' or '.join(a.run_dir for a in seeds)} goes on from here")
    for out, own in zip(outs, rows, strict=True) if devices.is_first() else ():
        plot(own, out / "curve.png")
        print(f"wrote {out}/policy.msgpack, metrics.csv, curve.png")
    return states


def keep(seeds, outs, before, states, metrics, rows, seconds):
    """A chunk is done: add a row to each seed's metrics.csv, and replace its policy if its weights are sound.

    If they are not, the state from before the chunk is kept and UserError raised. On hosts other than the first, whose
    `outs` are None, rows are made but not written.
    """
    for i, (args, out) in enumerate(zip(seeds, outs, strict=True)):
        params, own = jax.tree.map(lambda x, i=i: x[i], (states.params, metrics))
        rows[i].append(records.make_row(args, int(states.iteration[i]), seconds, own))
        if out:
            records.save_rows(out / "metrics.csv", rows[i])
        if not records.finite(params):
            save_states(outs, before, [own[: len(rows[0]) - 1] for own in rows])
            raise records.UserError(
                f"weights are not finite after iteration {states.iteration[i]}; lower --lr. To see what happened: "
                f"python results/replay.py {args.run_dir}"
            )
        if out:
            records.save(out / "policy.msgpack", params, {"task": args.task, "args": dataclasses.asdict(args)})


def save_states(outs, states, rows):
    """What --resume needs, into each seed's folder; on several hosts nobody has all of it, and none is written."""
    for i, (out, own) in enumerate(zip(outs, rows, strict=True)) if jax.process_count() == 1 else ():
        records.save_state(out, jax.tree.map(lambda x, i=i: x[i], states), own)


def use_of(args):
    """Which of the functions above the arguments ask for. UserError if they ask for several."""
    uses = {
        "export": (args.export, export_onnx),
        "video": (args.video, film),
        "viewer": (args.viewer, watch_live),
        "web": (args.web, watch_live),
    }
    asked = [name for name, (wanted, _) in uses.items() if wanted]
    if asked and not args.eval:
        raise records.UserError(f"--{asked[0]} is for a trained policy; say which with --eval POLICY")
    if len(asked) > 1:
        raise records.UserError(f"--{asked[0]} and --{asked[1]} are two things; ask for one")
    return uses[asked[0]][1] if asked else run_eval if args.eval else train


def main(args):
    """Train, or evaluate with --eval. What a user can mend ends in one line and exit code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        args = records.resumed(args) if args.resume else args
        return use_of(args)(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
