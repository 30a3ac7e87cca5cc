"""Stage 2: train a robot's PIDM to name the action between two states, on the data of stage 1 (paper Sec. IV-D).

    python pretrain_pidm.py --data runs/explore/g1/seed0
    python pretrain_pidm.py --data runs/explore/g1/random --eval runs/pidm/g1/seed0/pidm.msgpack

Writes pidm.msgpack, which `ppo_finetune.py --pretrained` reads, with its validation error and figures beside it.
Reads top to bottom: arguments, networks, dataset, augmentation, loss, epochs, evaluation, figures, main.
Shapes in comments: B batch, X proprioception x_t, A action, K history.
"""

import dataclasses
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import envs
from envs import devices, records
from envs.base import NOISE

jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """Values left at None come from the preset; the merged set is printed and stored."""

    # --- Run ---
    data: str = "runs/explore/go1/seed0"  # folder of a finished ppo_explore.py
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale
    seed: int = 0  # the only source of randomness
    run_dir: str | None = None  # None: runs/pidm/<robot>/seed<seed>
    force: bool = False  # overwrite the run in that folder
    resume: str | None = None  # a run folder: go on after its last epoch; all other arguments are those of that run
    tensorboard: bool = False  # every row goes to TensorBoard event files in the run folder as well
    distributed: bool = False  # one of several processes, one a host; process 0 writes the files
    eval: str | None = None  # a pidm.msgpack: validate it on --data instead of training, write the figures beside it
    # --- Data ---
    num_samples: int | None = None  # train on this many transitions, drawn at random; None: all (paper: 7 M)
    noise: float = 1.0  # multiplies the tasks' sensor noise
    mirror: bool = True  # mirror half of the samples, for each symmetry of the robot
    delta_steps: int = 1  # the wanted change of x is over so many control steps (paper: 1)
    # --- Training (ours; the paper gives the L1 loss and 100 epochs) ---
    epochs: int | None = None  # passes over the data
    batch: int | None = None  # B
    lr: float = 1e-3  # Adam's at the start; falls to 0 along a cosine


PRESETS = {
    "smoke": {"epochs": 2, "batch": 64},
    "cpu": {"epochs": 20, "batch": 1024},
    "gpu": {"epochs": 100, "batch": 8192},
}


def merge(args, robot):
    """Fill what is None in args from the preset; check the numbers."""
    values = PRESETS[args.preset] | {"run_dir": f"runs/pidm/{robot}/seed{args.seed}"}
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    records.check_positive(args, ("epochs", "batch", "delta_steps"))
    if args.batch % jax.device_count():
        raise records.UserError(f"--batch {args.batch} cannot be split over {jax.device_count()} devices")
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


# --- Dataset ---


class Dataset:
    """Windows of a finished collection, gathered from memory-mapped files; x (S, N, X), action (S, N, A).

    S = iterations * T steps of N environments that run on from one rollout to the next. A window is one transition with
    its history; before an episode's start it is padded as `Env.reset` does: the first x repeated, actions zero.
    """

    def __init__(self, folder, delta_steps=1):
        """UserError if the collection is missing, unfinished, damaged or of an unknown robot."""
        self.meta, self.delta_steps = read_meta(folder), delta_steps
        m = self.meta
        lead = m["iterations"] * m["num_steps"], m["num_envs"]
        self.x, self.action = (read_array(folder, name, m).reshape(*lead, -1) for name in ("x", "action"))
        first = np.array(read_array(folder, "first", m)).reshape(lead)
        self.rough = read_array(folder, "rough", m).reshape(lead)
        step = np.arange(lead[0], dtype=np.int32)[:, None]
        self.age = step - np.maximum.accumulate(np.where(first, step, 0))  # (S, N) steps since the episode's start
        usable = np.zeros(lead, bool)
        usable[:-delta_steps] = self.age[delta_steps:] >= delta_steps  # x_{t+1} of an episode's last step is not stored
        held_out = np.zeros(lead[1], bool)
        held_out[m["validation_envs"]] = True
        self.train, self.validation = (np.flatnonzero(usable & envs) for envs in (~held_out, held_out))  # flat indices
        for name in ("train", "validation"):
            if not len(getattr(self, name)):
                raise records.UserError(f"{folder} has no usable transition in its {name} split; collect more data")

    def windows(self, index):
        """Transitions by flat index (B,): prop (B, K+1, X), past (B, K, A), next_x (B, X), action (B, A), pad (B,)."""
        steps, env = np.divmod(index, self.x.shape[1])
        back = np.arange(-self.meta["history"], 1)
        start = steps - self.age[steps, env]
        rows = steps[:, None] + back
        pad = np.maximum(start - rows[:, 0], 0)
        past = self.action[np.maximum(rows[:, :-1], 0), env[:, None]]
        return {
            "prop": self.x[np.maximum(rows, start[:, None]), env[:, None]],
            "past": past * (rows[:, :-1] >= start[:, None])[..., None],
            "next_x": self.x[steps + self.delta_steps, env],
            "action": self.action[steps, env],
            "pad": pad,
        }


def read_meta(folder):
    """meta.json of a collection, or a UserError."""
    path = Path(folder) / "meta.json"
    try:
        meta = json.loads(path.read_text())
        sizes = [meta[name] for name in ("iterations", "num_steps", "num_envs", "history")]
        held_out = meta["validation_envs"]
        sane = isinstance(held_out, list) and all(type(size) is int and 0 < size < 10**9 for size in sizes)
        sane = sane and all(type(env) is int and 0 <= env < meta["num_envs"] for env in held_out)
        sane = sane and {"layout", "transitions", "args", "versions"} <= meta.keys() and isinstance(meta["robot"], str)
    except FileNotFoundError:
        what = "an unfinished collection (no meta.json)" if Path(folder).is_dir() else "not a folder"
        raise records.UserError(f"{folder} is {what}; run ppo_explore.py first") from None
    except (OSError, ValueError, KeyError, TypeError):
        sane = False
    if not sane:
        raise records.UserError(f"{path} is damaged; collect the data again")
    if meta["robot"] not in envs.EXPLORE:
        raise records.UserError(f"{folder} holds robot {meta['robot']!r}; known are {', '.join(envs.EXPLORE)}")
    return meta


def read_array(folder, name, meta):
    """One memory-mapped array (iterations, T, N, ...) of a collection, or a UserError."""
    path = Path(folder) / f"{name}.npy"
    dtype, dims = (np.bool_, 3) if name in ("first", "rough") else (np.float32, 4)
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses a header, and has no class for all that can be wrong with one
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise records.UserError(f"cannot read {path}: {why}; collect the data again") from None
    if array.shape[:3] != (meta["iterations"], meta["num_steps"], meta["num_envs"]):
        raise records.UserError(f"{path} has shape {array.shape}, which meta.json does not name; collect it again")
    if array.dtype != dtype or array.ndim != dims:
        raise records.UserError(f"{path} holds {array.dtype} in {array.ndim} dimensions; collect the data again")
    return array


def batches(dataset, index, size):
    """Yield windows of `size` transitions each, in the order of `index`; the next is gathered on another thread."""

    def gather(start):
        return dataset.windows(np.sort(index[start : start + size]))  # sorted: neighbours share pages

    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(gather, 0)
        for start in range(size, len(index) + size, size):
            batch, upcoming = upcoming.result(), pool.submit(gather, start)
            yield batch


# --- Augmentation ---


def noise_width(env):
    """Half-width (X,) of the sensor noise of the tasks, for every entry of x."""
    widths = {"ang_vel": 3, "gravity": 3, "joint_pos": env.action_dim, "joint_vel": env.action_dim}
    return jnp.concatenate([jnp.full(widths[name], NOISE[name]) for name in env.prop_layout])


def add_noise(key, width, batch):
    """Sensor noise on every x of the windows, drawn once for each state: padding repeats the first one's."""
    k_history, k_next = jax.random.split(key)
    prop = batch["prop"] + width * jax.random.uniform(k_history, batch["prop"].shape, minval=-1.0)
    kept = jnp.maximum(jnp.arange(prop.shape[1]), batch["pad"][:, None])
    prop = jnp.take_along_axis(prop, kept[..., None], 1)
    next_x = batch["next_x"] + width * jax.random.uniform(k_next, batch["next_x"].shape, minval=-1.0)
    return batch | {"prop": prop, "next_x": next_x}


def mirror_windows(tables, batch):
    """All windows as seen in one mirror (paper Sec. IV-D); tables is an entry of `Env.mirrors`."""
    kinds = {"prop": "prop", "past": "action", "next_x": "prop", "action": "action"}
    return batch | {name: batch[name][..., tables[kind][0]] * tables[kind][1] for name, kind in kinds.items()}


def mirror_half(key, mirrors, batch):
    """Apply each mirror to half of the windows, drawn anew for each."""
    for tables, k_one in zip(mirrors.values(), jax.random.split(key, len(mirrors)), strict=True):
        chosen = jax.random.bernoulli(k_one, 0.5, batch["pad"].shape)
        other = mirror_windows(tables, batch)
        batch = {name: jnp.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), other[name], x) for name, x in batch.items()}
    return batch


def augment(args, env, key, batch):
    """Noise, then mirrors."""
    k_noise, k_mirror = jax.random.split(key)
    batch = add_noise(k_noise, args.noise * noise_width(env), batch)
    return mirror_half(k_mirror, env.mirrors, batch) if args.mirror else batch


def make_normalizer(args, env, key, batch):
    """Mean and std of x, action and delta_x over windows and all their mirror images, so that mirrors commute."""
    batch = add_noise(key, args.noise * noise_width(env), batch)
    images = [batch]
    for tables in env.mirrors.values():
        images += [mirror_windows(tables, image) for image in images]
    x = jnp.concatenate([image["prop"][:, -1] for image in images])
    next_x = jnp.concatenate([image["next_x"] for image in images])
    arrays = {"prop": x, "action": jnp.concatenate([image["action"] for image in images]), "delta": next_x - x}
    mean = {f"{name}_mean": array.mean(0) for name, array in arrays.items()}
    return mean | {f"{name}_std": array.std(0) + 1e-6 for name, array in arrays.items()}


# --- Loss ---


def predict(net, variables, batch):
    """The PIDM's action (B, A) for the change of x that each window shows."""
    norm = variables["normalizer"]
    delta = batch["next_x"] - batch["prop"][:, -1]
    history = flat_history(norm, batch["prop"], batch["past"])
    return net.apply({"params": variables["params"]}, history, standardise(norm, "delta", delta))


def l1_loss(net, variables, batch):
    """Mean absolute error of the action [action units] (paper Sec. IV-D)."""
    return jnp.abs(predict(net, variables, batch) - batch["action"]).mean()


# --- Epochs ---


def make_step(args, env, net, opt):
    """One Adam step on an augmented batch, compiled."""

    @partial(jax.jit, out_shardings=devices.same())
    def step(variables, opt_state, batch, key):
        batch = augment(args, env, key, batch)
        loss, grads = jax.value_and_grad(lambda p: l1_loss(net, variables | {"params": p}, batch))(variables["params"])
        updates, opt_state = opt.update(grads, opt_state)
        return variables | {"params": optax.apply_updates(variables["params"], updates)}, opt_state, loss

    return step


def run_epoch(args, dataset, index, step, carry, epoch):
    """One pass over the training transitions in an order that (seed, epoch) alone decides. Mean loss."""
    variables, opt_state = carry
    order = np.random.default_rng((args.seed, epoch)).permutation(index)
    size = min(args.batch, len(order) // jax.device_count() * jax.device_count())
    whole = len(order) - len(order) % size  # no ragged last batch
    losses = []
    for number, batch in enumerate(batches(dataset, order[:whole], size)):
        batch = devices.place(batch, dict.fromkeys(batch, devices.split(0)))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(args.seed), epoch), number)
        variables, opt_state, loss = step(variables, opt_state, batch, key)
        losses.append(loss)
    return (variables, opt_state), float(jnp.stack(losses).mean())


# --- Evaluation ---


def commanded_change(env, x, action):
    """By how much joint targets differ from where the joints are: a_t - q_t [rad]. x (..., X), action (..., A)."""
    angles = slice(6, 6 + env.action_dim)  # after ang_vel and gravity; minus the default pose, as targets are
    return env.robot.action_scale * action - x[..., angles]


def evaluate(args, env, net, variables, dataset, index):
    """The PIDM on validation transitions with the tasks' sensor noise, and what it is measured against.

    Arrays (B, A) by name: predicted, action and last action [action units]; change [rad], by which the joint targets
    differ from where the joints are (the paper's action magnitude |a_t - q_t|, Fig. 4b).
    """
    width, parts = args.noise * noise_width(env), []

    @jax.jit
    def one(variables, batch, key):
        return predict(net, variables, add_noise(key, width, batch))

    for number, batch in enumerate(batches(dataset, index, 8192)):
        key = jax.random.fold_in(jax.random.key(1), number)
        parts.append(
            {
                "predicted": np.asarray(one(variables, batch, key)),
                "action": batch["action"],
                "last": batch["past"][:, -1],
                "change": commanded_change(env, batch["prop"][:, -1], batch["action"]),
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def errors(env, dataset, outcome):
    """Validation error in action units, in rad, over mean action and mean commanded change, and two baselines."""
    action = outcome["action"]
    error = np.abs(outcome["predicted"] - action).mean()
    sample = dataset.windows(np.sort(dataset.train[:: max(len(dataset.train) // 20_000, 1)]))["action"]
    return {
        "error": error,
        "error_rad": error * env.robot.action_scale,
        "normalized_error": error / np.abs(action).mean(),
        "error_over_change": error * env.robot.action_scale / np.abs(outcome["change"]).mean(),
        "mean_action_error": np.abs(action - sample.mean(0)).mean(),
        "last_action_error": np.abs(action - outcome["last"]).mean(),
    }


# --- Figures ---


def plot_accuracy(env, outcome, path):
    """Absolute and normalised error over action magnitude, every joint a sample (paper Fig. 4c)."""
    plt = records.pyplot()
    wrong = env.robot.action_scale * (outcome["predicted"] - outcome["action"])
    size, error = (np.abs(x).ravel() for x in (outcome["change"], wrong))
    edges = np.linspace(0, np.quantile(size, 0.995), 21)
    bins = np.digitize(size, edges)
    rows = [(size[bins == i].mean(), error[bins == i]) for i in range(1, len(edges)) if (bins == i).sum() > 20]
    fig, axes = plt.subplots(1, 2, figsize=(7.5, 3), constrained_layout=True)
    for ax, scale, title in (
        (axes[0], lambda magnitude: 1.0, "absolute error [rad]"),
        (axes[1], lambda magnitude: 1 / magnitude, "error / action magnitude"),
    ):
        quantiles = np.array([np.quantile(e, (0.25, 0.5, 0.75)) * scale(m) for m, e in rows])
        magnitude = [m for m, _ in rows]
        ax.plot(magnitude, [e.mean() * scale(m) for m, e in rows], label="mean")
        ax.fill_between(magnitude, quantiles[:, 0], quantiles[:, 2], alpha=0.25, label="25 % to 75 %")
        ax.set(xlabel="action magnitude |a - q| [rad]", title=title, ylim=(0, None))
        ax.grid(alpha=0.3)
    axes[0].legend()
    axes[1].set_ylim(0, 2)
    fig.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(fig)


def plot_distribution(env, dataset, path):
    """Distribution of the action magnitude on flat and rough ground (paper Fig. 4b)."""
    plt = records.pyplot()
    index = np.concatenate([dataset.train, dataset.validation])
    steps, column = np.divmod(np.sort(index[:: max(len(index) // 50_000, 1)]), dataset.x.shape[1])
    size = np.abs(commanded_change(env, dataset.x[steps, column], dataset.action[steps, column]))
    rough = dataset.rough[steps, column]
    fig, ax = plt.subplots(figsize=(4.5, 3), constrained_layout=True)
    for label, chosen in (("flat", ~rough), ("rough", rough)):
        if chosen.any():
            ax.hist(size[chosen].ravel(), bins=60, range=(0, size.max()), density=True, alpha=0.5, label=label)
    ax.set(xlabel="action magnitude |a - q| [rad]", ylabel="density")
    ax.legend()
    fig.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(fig)


# --- Main ---


def checkpoint_meta(args, dataset, sizes, metrics):
    """What a PIDM file says about itself."""
    meta = dataset.meta
    return {
        "robot": meta["robot"],
        "layout": meta["layout"],
        "history": meta["history"],
        "sizes": dataclasses.asdict(sizes),
        "args": dataclasses.asdict(args),
        "dataset": {name: meta[name] for name in ("transitions", "args", "versions")},
        "metrics": metrics,
    }


def open_data(args):
    """The collection args.data and its robot's environment. UserError if they do not fit together."""
    dataset = Dataset(args.data, args.delta_steps)
    robot = dataset.meta["robot"]
    env = envs.make_explore(robot, "c")
    if dataset.meta["layout"] != list(env.prop_layout):
        raise records.UserError(f"{args.data} has x = {dataset.meta['layout']}, not {list(env.prop_layout)}")
    for name, width in (("x", env.prop_dim), ("action", env.action_dim)):
        if getattr(dataset, name).shape[-1] != width:
            found = getattr(dataset, name).shape[-1]
            raise records.UserError(f"{args.data}/{name}.npy holds {found} numbers a step, {robot} has {width}")
    return dataset, env


def init_variables(args, env, net, windows):
    """Fresh params, and a normalizer measured on these windows."""
    k_init, k_norm = jax.random.split(jax.random.key(args.seed))
    history = (env.config.history + 1) * env.prop_dim + env.config.history * env.action_dim
    params = net.init(k_init, jnp.zeros(history), jnp.zeros(env.prop_dim))
    return params | {"normalizer": make_normalizer(args, env, k_norm, windows)}


def pretrain(args):
    """Train, keep the weights of the best epoch, report and draw."""
    dataset, env = open_data(args)
    robot = env.robot.name
    args = merge(args, robot)
    count = len(dataset.train) if args.num_samples is None else args.num_samples
    if not 1 <= count <= len(dataset.train):
        raise records.UserError(f"--num-samples {count} is not within 1 and the {len(dataset.train)} in {args.data}")
    order = np.random.default_rng(args.seed).permutation(dataset.train)[:count]
    print(f"{robot}: {count} transitions to train on, {len(dataset.validation)} to validate")
    print("  ".join(f"{name}={value}" for name, value in dataclasses.asdict(args).items()), flush=True)

    net = PIDM(SIZES[robot], env.action_dim)
    variables = init_variables(args, env, net, dataset.windows(np.sort(order[:100_000])))
    opt = optax.adam(optax.cosine_decay_schedule(args.lr, args.epochs * max(count // args.batch, 1)))
    step, carry = make_step(args, env, net, opt), (variables, opt.init(variables["params"]))
    rows, out = [], Path(args.run_dir) if devices.is_first() else None
    if args.resume:
        carry, rows = records.load_state(args.resume, carry)
    elif out:
        records.start_run(args, env.config, args.run_dir, args.force)
    carry = devices.place(carry, jax.tree.map(lambda _: devices.same(), carry))

    run_epochs(args, env, net, dataset, order, step, carry, out, rows)
    if out:
        report(args, env, net, dataset, rows, out)


def run_epochs(args, env, net, dataset, order, step, carry, out, rows):
    """All epochs that `rows` lacks. Keeps the weights with the least error on at most 50,000 validation transitions."""
    few = np.sort(np.random.default_rng(args.seed).permutation(dataset.validation)[:50_000])
    start = time.perf_counter() - (rows[-1]["seconds"] if rows else 0.0)
    names = ("train_error", "error", "normalized_error", "last_action_error")
    with records.Reporter(args.epochs, names, "samples", board=out if args.tensorboard else None) as reporter:
        while len(rows) < args.epochs and not reporter.stopped:
            last = time.perf_counter()
            carry, loss = run_epoch(args, dataset, order, step, carry, len(rows))
            speed = len(order) / (time.perf_counter() - last)
            metrics = errors(env, dataset, evaluate(args, env, net, carry[0], dataset, few))
            row = {"iteration": len(rows) + 1, "samples": len(order) * (len(rows) + 1)}
            row |= {"seconds": time.perf_counter() - start, "train_error": loss, **metrics}
            rows.append({name: float(f"{value:.6g}") for name, value in row.items()})
            if out:
                records.save_rows(out / "metrics.csv", rows)
            reporter.show(rows[-1], speed)
            if not np.isfinite(loss):
                raise records.UserError(f"the error is not finite after epoch {len(rows)}; lower --lr")
            if out and rows[-1]["error"] <= min(row["error"] for row in rows):
                records.save(out / "pidm.msgpack", carry[0], checkpoint_meta(args, dataset, net.sizes, rows[-1]))
            if out:
                records.save_state(out, carry, rows)
    if reporter.stopped:
        print(f"interrupted; --resume {args.run_dir} goes on from here")


def report(args, env, net, dataset, rows, out):
    """Errors of the kept weights on the whole validation split, and the figures."""
    variables, _ = records.load(out / "pidm.msgpack", "PIDM checkpoint")
    records.plot_curves(rows, ("normalized_error",), {"L1": ["train_error", "error"]}, out / "curve.png", "samples")
    print(f"wrote {out}/pidm.msgpack, metrics.csv, curve.png")
    validate(args, env, net, variables, dataset, out)


def validate(args, env, net, variables, dataset, out):
    """Write validation.json, accuracy.png and distribution.png of these weights on a collection's validation split."""
    outcome = evaluate(args, env, net, variables, dataset, dataset.validation)
    result = {name: float(x) for name, x in errors(env, dataset, outcome).items()}
    records.replace_text(out / "validation.json", json.dumps(result, indent=1) + "\n")
    plot_accuracy(env, outcome, out / "accuracy.png")
    plot_distribution(env, dataset, out / "distribution.png")
    print("validation:", records.line(result))
    print(f"wrote {out}/validation.json, accuracy.png, distribution.png")


def run_validation(args):
    """--eval: how well a PIDM that exists names the actions of a collection. UserError if it is not one for it."""
    path = Path(args.eval)
    variables, meta = records.load(path, "PIDM checkpoint")
    args = dataclasses.replace(args, delta_steps=meta.get("args", {}).get("delta_steps", 1))  # as it was trained
    dataset, env = open_data(args)
    for name in ("robot", "layout", "history"):
        if meta[name] != dataset.meta[name]:
            raise records.UserError(f"{path} was made for {name} {meta[name]}, {args.data} has {dataset.meta[name]}")
    net = PIDM(SIZES[env.robot.name], env.action_dim)
    like = jax.eval_shape(partial(init_variables, args, env, net), dataset.windows(dataset.validation[:1]))
    records.check_shapes(path, variables, like)
    validate(args, env, net, variables, dataset, path.parent)


def main(args):
    """Train a PIDM. What a user can mend ends in one line and exit code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        return run_validation(args) if args.eval else pretrain(records.resumed(args) if args.resume else args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
