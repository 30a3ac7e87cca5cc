"""Stage 2: train a robot's PIDM to predict the action between two states, on the data of stage 1 (paper Sec. IV-D).

    python pretrain_pidm.py --data runs/explore/g1/seed0
    python pretrain_pidm.py --data runs/explore/g1/random --eval runs/pidm/g1/seed0/pidm.msgpack

Writes pidm.msgpack, which `ppo_finetune.py --pretrained` reads, with its validation error and figures beside it.
Reads top to bottom: arguments, networks, dataset, augmentation, loss, training, evaluation.
Shapes in comments: B batch, X proprioception x_t, A action, K history, S control steps of N environments.
"""

import dataclasses
import json
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

from envs import base, label
from experiment import arguments, checkpoints, dataset, devices, figures, metrics, records
from experiment.run import Run

jax.config.update("jax_default_matmul_precision", "highest")  # TF32 of recent GPUs changes what is learned


@dataclass(frozen=True)
class Args:
    """A field left at None is filled in from the preset. The merged set is printed and saved."""

    # --- Experiment ---
    data: str = "runs/explore/go1/seed0"  # folder of a finished ppo_explore.py
    preset: Literal["smoke", "cpu", "gpu"] = "cpu"  # scale
    seed: int = 0  # the only source of randomness
    eval: str | None = None  # validate this pidm.msgpack instead; replaces validation.json and the figures beside it
    # --- Records ---
    run_dir: str | None = None  # None: runs/pidm/<robot>/seed<seed>
    force: bool = False  # overwrite the run in that folder
    resume: str | None = None  # continue the run in this folder after its last epoch, with its arguments
    tensorboard: bool = False  # write TensorBoard files into the run folder, too
    # --- Data ---
    num_samples: int | None = None  # train on this many transitions, drawn at random; None: all (paper: 7 M)
    noise: float = 1.0  # multiplies the tasks' sensor noise
    mirror: bool = True  # mirror half of the samples, for each symmetry of the robot
    # --- Training (ours; the paper gives the L1 loss and 100 epochs) ---
    epochs: int | None = None  # passes over the data; with --patience, at most this many
    batch: int | None = None  # B transitions in a gradient step
    lr: float = 1e-3  # initial Adam step size; falls to 0 along a cosine
    patience: int | None = None  # after so many epochs without a lower error, lr falls over as many; None: throughout
    # --- Devices ---
    distributed: bool = False  # this is one of several processes, see docs/speed.md; process 0 writes the files


PRESETS = {
    "smoke": {"epochs": 2, "batch": 64},
    "cpu": {"epochs": 20, "batch": 1024},
    "gpu": {"epochs": 100, "batch": 8192},
}
SHOWN = ("train_error", "error", "normalized_error", "last_action_error")  # columns printed


def merge(args, robot):
    """Fill the fields left at None from the preset, and check the result."""
    args = arguments.filled(args, PRESETS[args.preset] | {"run_dir": f"runs/pidm/{robot}/seed{args.seed}"})
    if args.batch % jax.device_count():
        raise records.UserError(f"--batch {args.batch} cannot be split over {jax.device_count()} devices")
    if args.patience and args.patience >= args.epochs:
        raise records.UserError(f"--patience {args.patience} needs more --epochs than {args.epochs}")
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


# >>> copy: sizes (owner: pretrain_pidm.py)
SIZES = {  # layer widths, our choice; goal: delta or intention encoder; head: decoder or synthesizer, without its last
    "anymal_d": {"history": (128, 64), "goal": (64, 32), "backbone": (192, 192, 192, 64), "head": (64,)},
    "go1": {"history": (128, 64), "goal": (64, 32), "backbone": (192, 192, 192, 64), "head": (64,)},
    "g1": {"history": (224, 96), "goal": (96, 32), "backbone": (224, 224, 224, 64), "head": (64,)},
}
# <<< copy: sizes


# --- Dataset ---


class Dataset:
    """Windows of a finished collection, gathered from memory-mapped files; x (S, N, X), action (S, N, A).

    Environments run on from one rollout to the next. A window is one transition with its history. Before an episode's
    start it is padded as `Env.reset` does: the first x repeated, actions zero.
    """

    def __init__(self, folder):
        """UserError if the collection is missing, unfinished, damaged or of an unknown robot."""
        self.meta = m = dataset.read_meta(folder)
        lead = m["iterations"] * m["num_steps"], m["num_envs"]
        self.x, self.action = (dataset.read_array(folder, name, m).reshape(*lead, -1) for name in ("x", "action"))
        first = np.array(dataset.read_array(folder, "first", m)).reshape(lead)
        self.rough = dataset.read_array(folder, "rough", m).reshape(lead)
        step = np.arange(lead[0], dtype=np.int32)[:, None]
        self.age = step - np.maximum.accumulate(np.where(first, step, 0))  # (S, N) steps since the episode's start
        usable = np.zeros(lead, bool)
        usable[:-1] = self.age[1:] >= 1  # x_{t+1} of an episode's last step is not stored
        held_out = np.zeros(lead[1], bool)
        held_out[m["validation_envs"]] = True
        self.train, self.validation = (np.flatnonzero(usable & one) for one in (~held_out, held_out))  # flat indices
        for name in ("train", "validation"):
            if not len(getattr(self, name)):
                raise records.UserError(f"{folder} has no usable transition in its {name} split; collect more data")

    def windows(self, index):
        """Transitions by flat index (B,): prop (B, K+1, X), past (B, K, A), next_x (B, X), action (B, A), pad (B,)."""
        steps, column = np.divmod(index, self.x.shape[1])
        start = steps - self.age[steps, column]
        rows = steps[:, None] + np.arange(-self.meta["history"], 1)
        past = self.action[np.maximum(rows[:, :-1], 0), column[:, None]]
        return {
            "prop": self.x[np.maximum(rows, start[:, None]), column[:, None]],
            "past": past * (rows[:, :-1] >= start[:, None])[..., None],
            "next_x": self.x[steps + 1, column],
            "action": self.action[steps, column],
            "pad": np.maximum(start - rows[:, 0], 0),
        }


def batches(data, index, size):
    """Yield the windows of `index`, `size` at a time, sorted within each batch. A thread gathers the next ones."""

    def gather(start):
        return data.windows(np.sort(index[start : start + size]))  # sorted: neighbours share pages

    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(gather, 0)
        for start in range(size, len(index) + size, size):
            batch, upcoming = upcoming.result(), pool.submit(gather, start)
            yield batch


# --- Augmentation ---


def noise_width(env):
    """Half-width (X,) of the tasks' sensor noise, for every entry of x."""
    return jnp.concatenate([jnp.full(env.width(base.PROP[name]), base.NOISE[name]) for name in env.prop_layout])


def add_noise(key, width, batch):
    """Add sensor noise to every x of the windows, drawn once per state: padding repeats the first state's noise."""
    k_history, k_next = jax.random.split(key)
    prop = batch["prop"] + width * jax.random.uniform(k_history, batch["prop"].shape, minval=-1.0)
    kept = jnp.maximum(jnp.arange(prop.shape[1]), batch["pad"][:, None])
    prop = jnp.take_along_axis(prop, kept[..., None], 1)
    next_x = batch["next_x"] + width * jax.random.uniform(k_next, batch["next_x"].shape, minval=-1.0)
    return batch | {"prop": prop, "next_x": next_x}


def mirror_windows(tables, batch):
    """Mirror images of all windows (paper Sec. IV-D); tables is an entry of `Env.mirrors`."""
    kinds = {"prop": "prop", "past": "action", "next_x": "prop", "action": "action"}
    return batch | {name: batch[name][..., tables[kind][0]] * tables[kind][1] for name, kind in kinds.items()}


def mirror_half(key, mirrors, batch):
    """Apply each mirror to half of the windows, drawn independently."""
    for tables, k_one in zip(mirrors.values(), jax.random.split(key, len(mirrors)), strict=True):
        chosen = jax.random.bernoulli(k_one, 0.5, batch["pad"].shape)
        image = mirror_windows(tables, batch)
        batch = {name: jnp.where(chosen.reshape(-1, *[1] * (x.ndim - 1)), image[name], x) for name, x in batch.items()}
    return batch


def augment(args, env, key, batch):
    """Add noise, then mirror."""
    k_noise, k_mirror = jax.random.split(key)
    batch = add_noise(k_noise, args.noise * noise_width(env), batch)
    return mirror_half(k_mirror, env.mirrors, batch) if args.mirror else batch


def make_normalizer(args, env, key, batch):
    """Mean and std of x, action and delta_x over windows and their mirror images: mirroring and scaling commute."""
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
    """Predict the action (B, A) behind the change of x in each window."""
    norm = variables["normalizer"]
    delta = batch["next_x"] - batch["prop"][:, -1]
    history = flat_history(norm, batch["prop"], batch["past"])
    return net.apply({"params": variables["params"]}, history, standardise(norm, "delta", delta))


def l1_loss(net, variables, batch):
    """Mean absolute error of the action [action units] (paper Sec. IV-D)."""
    return jnp.abs(predict(net, variables, batch) - batch["action"]).mean()


# --- Training ---


def decay(args, val_errors):
    """Return the epochs at which the step size starts to fall and is 0, given the validation errors of past epochs.

    With --patience it starts once so many epochs brought no lower error, or when only so many are left; else at once.
    """
    if args.patience is None:
        return 0, args.epochs
    flat = (n for n in range(1, len(val_errors) + 1) if n - 1 - np.argmin(val_errors[:n]) >= args.patience)
    start = min(next(flat, args.epochs), args.epochs - args.patience)
    return start, start + args.patience


def make_step(args, env, net, opt):
    """Return a jitted Adam step: variables, opt_state, batch (to augment), key, lr -> the first two, loss ()."""

    @partial(jax.jit, out_shardings=devices.replicated())
    def step(variables, opt_state, batch, key, lr):
        batch = augment(args, env, key, batch)
        loss, grads = jax.value_and_grad(lambda p: l1_loss(net, variables | {"params": p}, batch))(variables["params"])
        updates, opt_state = opt.update(grads, opt_state)
        params = jax.tree.map(lambda p, u: p - lr * u, variables["params"], updates)
        return variables | {"params": params}, opt_state, loss

    return step


def run_epoch(args, data, index, step, state, val_errors):
    """One pass over the training transitions, in an order that (seed, epoch) alone decides. Also the mean loss."""
    (variables, opt_state), epoch = state, len(val_errors)
    start, end = decay(args, val_errors)
    order = np.random.default_rng((args.seed, epoch)).permutation(index)
    size = min(args.batch, len(order) // jax.device_count() * jax.device_count())
    whole = len(order) - len(order) % size  # no ragged last batch
    losses = []
    for number, batch in enumerate(batches(data, order[:whole], size)):
        batch = devices.place(batch, dict.fromkeys(batch, devices.split(0)))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(args.seed), epoch), number)
        share = max(epoch + number * size / whole - start, 0) / (end - start)
        lr = np.float32(args.lr * (1 + np.cos(np.pi * share)) / 2)
        variables, opt_state, loss = step(variables, opt_state, batch, key, lr)
        losses.append(loss)
    return (variables, opt_state), float(np.mean(jax.device_get(losses)))


def init_variables(args, env, net, windows):
    """Random params, and a normalizer measured on these windows."""
    k_init, k_norm = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), 2**31 - 1))  # epochs: 0, 1, ...
    history = (env.config.history + 1) * env.prop_dim + env.config.history * env.action_dim
    params = net.init(k_init, jnp.zeros(history), jnp.zeros(env.prop_dim))
    return params | {"normalizer": make_normalizer(args, env, k_norm, windows)}


def pretrain(args):
    """Train, keep the weights of the best epoch, and validate them."""
    data, env = open_data(args)
    args = merge(args, label(env.config.body or env.robot.name))
    count = len(data.train) if args.num_samples is None else args.num_samples
    if not (least := jax.device_count()) <= count <= len(data.train):
        raise records.UserError(f"--num-samples {count} is not from {least} to the {len(data.train)} in {args.data}")
    index = np.random.default_rng(args.seed).permutation(data.train)[:count]
    validated = np.sort(np.random.default_rng(args.seed).permutation(data.validation)[:50_000])
    print(f"{env.robot.name}: {count} transitions to train on, {len(data.validation)} to validate")
    net, opt = PIDM(SIZES[env.robot.like], env.action_dim), optax.scale_by_adam()

    def init(args):
        variables = init_variables(args, env, net, data.windows(np.sort(index[:100_000])))
        return variables, opt.init(variables["params"])

    run = Run(args, env.config, args.epochs, SHOWN, over="samples")
    (state,), (folder,) = run.start(init), run.folders
    state = devices.place(state, jax.tree.map(lambda _: devices.replicated(), state))
    step, predictor = make_step(args, env, net, opt), make_predictor(args, env, net)
    val_errors = [row["error"] for row in run.rows[0]]
    with run:
        while not run.done and run.iteration < decay(args, val_errors)[1]:
            epoch = run.iteration + 1
            state, loss = run_epoch(args, data, index, step, state, val_errors)
            row = {"iteration": epoch, "samples": count * epoch, "seconds": run.seconds(), "train_error": loss}
            row = metrics.rounded(row | errors(env, data, predict_all(predictor, env, state[0], data, validated)))
            run.add([row])
            val_errors.append(row["error"])
            if not np.isfinite(loss + row["error"]):
                raise records.UserError(f"the error is not finite after epoch {epoch}; lower --lr")
            if folder and row["error"] == min(val_errors):
                checkpoints.save(folder / "pidm.msgpack", state[0], checkpoint_meta(args, env, data, net.sizes, row))
            run.save([state])
    run.report_interrupt()
    if folder:
        panels = {"normalized_error": ["normalized_error"], "L1": ["train_error", "error"]}
        figures.plot_curves(run.rows[0], panels, folder / "curve.png", over="samples")
        print(f"wrote {folder}/pidm.msgpack, metrics.csv, curve.png")
        best, _ = checkpoints.load(folder / "pidm.msgpack", "PIDM checkpoint")
        validate(predictor, env, best, data, folder)


def open_data(args):
    """The collection args.data and its robot's environment. UserError if they do not fit together."""
    data = Dataset(args.data)
    env = dataset.env_of(args.data, data.meta)
    for name, width in (("x", env.prop_dim), ("action", env.action_dim)):
        found = getattr(data, name).shape[-1]
        if found != width:
            raise records.UserError(f"{args.data}/{name}.npy holds {found} numbers a step, the robot has {width}")
    return data, env


def checkpoint_meta(args, env, data, sizes, row):
    """Description of a PIDM checkpoint, stored in it."""
    meta = {name: data.meta[name] for name in ("robot", "layout", "history")}
    meta |= {"action_scale": list(env.robot.action_scale), "dt": env.dt}
    meta["dataset"] = {name: data.meta[name] for name in ("transitions", "args", "versions")}
    return meta | {"body": env.config.body, "sizes": dict(sizes), "args": dataclasses.asdict(args), "metrics": row}


# --- Evaluation ---


def commanded_change(env, x, action):
    """a_t - q_t [rad], joint target minus angle; its size is the paper's magnitude. x (..., X), action (..., A)."""
    # joint_pos is relative to the default pose, and so is the target
    return np.float32(env.robot.action_scale) * action - x[..., env.prop_slices()["joint_pos"]]


def make_predictor(args, env, net):
    """Return `predict` with the tasks' sensor noise, jitted: variables, batch, key -> action (B, A)."""
    width = args.noise * noise_width(env)
    return jax.jit(lambda variables, batch, key: predict(net, variables, add_noise(key, width, batch)))


def predict_all(predictor, env, variables, data, index):
    """Predictions on validation transitions, beside what they are compared with.

    Arrays (B, A) by name: predicted, action and last action [action units]; change [rad], see `commanded_change`.
    """
    parts = []
    for number, batch in enumerate(batches(data, index, 8192)):
        key = jax.random.fold_in(jax.random.key(1), number)
        predicted, action = np.asarray(predictor(variables, batch, key)), batch["action"]
        change = commanded_change(env, batch["prop"][:, -1], action)
        parts.append({"predicted": predicted, "action": action, "last": batch["past"][:, -1], "change": change})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def errors(env, data, outcome):
    """Mean absolute error in several units, and that of two baselines: the mean action and the last one."""
    action = outcome["action"]
    wrong = np.abs(outcome["predicted"] - action)
    error, error_rad = wrong.mean(), (wrong * np.float32(env.robot.action_scale)).mean()
    sample = data.action[np.divmod(data.train[:: max(len(data.train) // 20_000, 1)], data.x.shape[1])]
    return {
        "error": error,  # [action units]
        "error_rad": error_rad,
        "normalized_error": error / np.abs(action).mean(),
        "error_over_change": error_rad / np.abs(outcome["change"]).mean(),
        "mean_action_error": np.abs(action - sample.mean(0)).mean(),
        "last_action_error": np.abs(action - outcome["last"]).mean(),
    }


def validate(predictor, env, variables, data, folder):
    """Write validation.json, accuracy.png and distribution.png of these weights on a collection's validation split."""
    outcome = predict_all(predictor, env, variables, data, data.validation)
    result = {name: float(x) for name, x in errors(env, data, outcome).items()}
    records.replace_text(folder / "validation.json", json.dumps(result, indent=1) + "\n")
    wrong = np.float32(env.robot.action_scale) * (outcome["predicted"] - outcome["action"])
    figures.plot_accuracy(outcome["change"], wrong, folder / "accuracy.png")
    index = np.sort(np.concatenate([data.train, data.validation]))
    at = np.divmod(index[:: max(len(index) // 50_000, 1)], data.x.shape[1])
    size = np.abs(commanded_change(env, data.x[at], data.action[at]))
    figures.plot_distribution(size, data.rough[at], folder / "distribution.png")
    print(f"validation: {records.line(result)}\nwrote {folder}/validation.json, accuracy.png, distribution.png")


def run_validation(args):
    """Validate the PIDM of --eval on the collection --data. UserError if the two do not fit."""
    if args.run_dir or args.resume or args.distributed:
        raise records.UserError("--eval writes beside its PIDM; leave out --run-dir, --resume and --distributed")
    if not (path := Path(args.eval)).is_file():
        raise records.UserError(f"--eval {path}: there is no such file")
    data, env = open_data(args)
    net = PIDM(SIZES[env.robot.like], env.action_dim)
    like = jax.eval_shape(partial(init_variables, args, env, net), data.windows(data.validation[:1]))
    validate(make_predictor(args, env, net), env, checkpoints.load_pidm(path, env, like), data, path.parent)


def main(args):
    """Train a PIDM, or validate one. User errors print one line and exit with code 2."""
    with records.one_line_errors():
        devices.join(args.distributed)
        return run_validation(args) if args.eval else pretrain(arguments.resumed(args) if args.resume else args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
