"""Make the shipped PIDM of a robot: collect data, pretrain on it, examine both, and keep the small files.

    python results/pidm.py --robots go1 anymal_d g1
    python results/pidm.py --robots go1 --stages look
    python results/pidm.py --robots anymal_d --stages sizes
    python results/pidm.py --stages collect validate

It makes them from as many transitions as the paper, 7.6 M of which 0.6 M validate, in at most 100 epochs. Files take
1.4 GB (G1 2.9).
Weights go to assets/pidm/<robot>.msgpack, everything else to results/pidm/<robot>. Stage `sizes` also pretrains on
small random parts of the data of stage `collect` (paper Sec. V-D), into results/pidm/<robot>/sizes. Stage `validate`
measures the shipped weights again, on the data of stage `collect`.
"""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
import play
import ppo_explore
import ppo_finetune
import pretrain_pidm
from experiment import checkpoints, devices, figures, records
from results import recording

PART_SIZES = (7_000, 70_000, 700_000)  # transitions; the fourth of the paper's sizes, 7 M, is the whole collection
EXPLORE_FLAGS = ("--total-steps", "7600000")
PRETRAIN = ("--epochs", "100", "--patience", "10")
BLIND = tuple(name for name, (family, _) in envs.TASKS.items() if not family.LEVELS)  # tasks on flat ground
EARLY = 100  # iterations of a task's training whose states the coverage figure shows (paper Fig. 4a)


@dataclass(frozen=True)
class Args:
    robots: tuple[str, ...] = ("go1", "anymal_d", "g1")
    stages: tuple[Literal["collect", "pretrain", "validate", "look", "features", "sizes"], ...] = (
        "collect",
        "pretrain",
        "look",
        "features",
    )


def copy(source, target):
    """Copy a file, making its folder."""
    records.write(target, source.read_bytes())


def keep(robot):
    """Copy the small files of both stages, and the weights. UserError if the training was stopped before its end."""
    folder, explored, trained = (
        ROOT / path for path in (f"results/pidm/{robot}", f"runs/explore/{robot}/seed0", f"runs/pidm/{robot}/seed0")
    )
    errors = [row["error"] for row in records.read_rows(trained / "metrics.csv")]
    settings = SimpleNamespace(**json.loads((trained / "args.json").read_text()))
    if len(errors) < pretrain_pidm.decay(settings, errors)[1]:
        raise records.UserError(f"{trained} was stopped after {len(errors)} epochs; the shipped PIDM stays as it is")
    for name in ("meta.json", "metrics.csv", "curve.png"):
        copy(explored / name, folder / "explore" / name)
    for name in ("args.json", "metrics.csv", "validation.json", "curve.png", "accuracy.png", "distribution.png"):
        copy(trained / name, folder / name)
    copy(trained / "pidm.msgpack", ROOT / f"assets/pidm/{robot}.msgpack")


def validate(robot):
    """Measure and draw the shipped weights, without training them again."""
    folder = ROOT / f"runs/pidm/{robot}/shipped"
    copy(ROOT / f"assets/pidm/{robot}.msgpack", folder / "pidm.msgpack")
    words = ("--data", f"runs/explore/{robot}/seed0", "--eval", str(folder / "pidm.msgpack"))
    recording.run_script(["pretrain_pidm.py", *words])
    for name in ("validation.json", "accuracy.png", "distribution.png"):
        copy(folder / name, ROOT / f"results/pidm/{robot}" / name)


def pretrain_on_parts(robot):
    """Pretrain on each of PART_SIZES. Weights and validation error go to files of that name."""
    for size in PART_SIZES:
        folder = f"runs/pidm/{robot}/{size}"
        words = ("--data", f"runs/explore/{robot}/seed0", "--num-samples", str(size), "--run-dir", folder)
        recording.run_script(["pretrain_pidm.py", *words, "--force", *PRETRAIN])
        for name, suffix in (("pidm", "msgpack"), ("validation", "json"), ("metrics", "csv"), ("args", "json")):
            stem = str(size) if name == "pidm" else f"{size}_{name}"
            copy(ROOT / folder / f"{name}.{suffix}", ROOT / f"results/pidm/{robot}/sizes/{stem}.{suffix}")


def sample(folder, count=20_000):
    """x_t of evenly spread transitions of a collection, (count, X)."""
    dataset = pretrain_pidm.Dataset(folder)
    flat = dataset.x.reshape(-1, dataset.x.shape[-1])
    return np.asarray(flat[np.linspace(0, len(flat) - 1, count).astype(int)])


def make_training(args, env):
    """Arguments, network, optimizer and initial state of a training of stage 3."""
    args = ppo_finetune.merge(args, env.config.ppo)
    net, opt = ppo_finetune.make_net(args, env), optax.scale_by_adam()
    return args, net, opt, ppo_finetune.init_state(args, env, net, opt)


def early_states(task, count=20_000):
    """x_t from the first iterations of a task's training with an MLP, (count, X), without sensor noise."""
    env = envs.make(task, noise=0.0)
    args, net, opt, state = make_training(ppo_finetune.Args(task=task), env)
    step = jax.jit(lambda s: ppo_finetune.iteration(args, env, net, opt, s)[0])
    x = []
    for _ in range(EARLY):
        state = step(state)
        x.append(np.asarray(state.env_state.history["prop"][:, -1]))
    x = np.concatenate(x)
    return x[np.linspace(0, len(x) - 1, count).astype(int)]


def walking_error(robot, task, num_envs=256, steps=200):
    """Normalised error of the shipped PIDM on the recorded policy of `task`, with noise on actions and sensors."""
    env, net, params, _ = play.load_policy(ROOT / f"results/tasks/{task}/policy.msgpack", "c")
    pidm = pretrain_pidm.PIDM(pretrain_pidm.SIZES[robot], env.action_dim)
    weights, _ = checkpoints.load(ROOT / f"assets/pidm/{robot}.msgpack", "PIDM checkpoint")

    def step(state, key):
        mean, log_std, _ = net.apply(params, net.inputs(state.obs, state.history))
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        history, state = state.history, jax.vmap(env.step)(state, action)
        window = {"prop": history["prop"], "past": history["action"], "next_x": state.final_history["prop"][:, -1]}
        return state, (jnp.abs(pretrain_pidm.predict(pidm, weights, window) - action).mean(), jnp.abs(action).mean())

    @jax.jit
    def rollout(state):
        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), steps))[1]

    error, size = rollout(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs)))
    return float(error.mean() / size.mean())


def effective_rank(x):
    """Number of directions that x (S, F) fills: exp of the entropy of its spectrum (Roy and Vetterli 2007)."""
    share = np.linalg.svd(x - x.mean(0), compute_uv=False) ** 2
    share = share[share > 0] / share.sum()
    return float(np.exp(-np.sum(share * np.log(share))))


def first_features(task, **choice):
    """Size and rank of the actor's backbone output in the first rollout of a task, and size of the mean action."""
    env = envs.make(task, "c")
    args, net, _, state = make_training(ppo_finetune.Args(task=task, network="pidm", **choice), env)

    @jax.jit
    def features(state):
        _, (roll, _) = ppo_finetune.rollout(args, env, net, state.params, state.env_state, state.key)
        _, outputs = net.apply(state.params, roll.inputs, capture_intermediates=True, mutable=["intermediates"])
        return nn.elu(outputs["intermediates"]["actor"]["backbone"]["__call__"][0]), roll.mean

    z, action = map(np.asarray, features(state))
    return {
        "root mean square": float(np.sqrt((z**2).mean())),
        "effective rank": effective_rank(z.reshape(-1, z.shape[-1])),
        "mean action's root mean square": float(np.sqrt((action**2).mean())),
    }


def compare_features(robot, task):
    """`first_features` of a new, a loaded and a shuffled PIDM."""
    loaded = {"pretrained": str(ROOT / f"assets/pidm/{robot}.msgpack")}
    choices = {"fresh, orthogonal": {}, "fresh, as PyTorch's": {"weight_init": "pytorch_unscaled"}}
    choices |= {"loaded": loaded, "loaded and shuffled": loaded | {"load_into": "shuffled"}}
    choices |= {"loaded, the rest as PyTorch's": loaded | {"weight_init": "pytorch_unscaled"}}
    found = {name: first_features(task, **choice) for name, choice in choices.items()}
    return {f"features in {task}, {what}, {name}": x for name, facts in found.items() for what, x in facts.items()}


def occupied(env, x, bins=20):
    """Share of a grid over each pair of joints of a limb that x (S, X) visits, mean over pairs."""
    low, high = env.model.jnt_range[1:].T
    q = x[:, env.prop_slices()["joint_pos"]] + np.asarray(env.default_pose)
    cells = np.clip(((q - low) / (high - low) * bins).astype(int), 0, bins - 1)
    pairs = [(i, i + 1) for i in range(env.action_dim - 1) if env.robot.joints[i][:2] == env.robot.joints[i + 1][:2]]
    return float(np.mean([len(np.unique(cells[:, i] * bins + cells[:, j])) / bins**2 for i, j in pairs]))


def transitions(dataset, index):
    """Windows of a dataset as the Transitions that the ensemble of stage 1 reads."""
    w = dataset.windows(np.sort(index))
    arrays = w["prop"], w["past"], w["next_x"] - w["prop"][:, -1], w["action"]
    return ppo_explore.Transitions(*map(jnp.asarray, arrays))


def draw_novelty(env, dataset, path):
    """Draw the disagreement of an ensemble that is trained on the first tenth of a collection, there and on the last.

    Returns both at the end, by name.
    """
    rng, tenth = np.random.default_rng(0), len(dataset.train) // 10
    index = {"seen": rng.permutation(dataset.train[:tenth])[:50_000], "novel": dataset.train[-tenth:]}
    known = transitions(dataset, index["seen"])
    probes = {name: transitions(dataset, rng.choice(chosen, 4096, replace=False)) for name, chosen in index.items()}
    args, member, opt = ppo_explore.Args(), ppo_explore.PIDM(ppo_explore.MEMBER, 2 * env.action_dim), optax.adam(1e-3)
    ensemble = ppo_explore.init_ensemble(args, member, opt, ppo_explore.statistics(known), known, jax.random.key(0))
    fit = jax.jit(lambda e, k: ppo_explore.retrain(args, member, opt, e, known, len(known.action), k)[0])

    @jax.jit
    def mean_disagreement(ensemble, batch):
        each = jax.vmap(partial(ppo_explore.predict, member), (0, None, None))
        return ppo_explore.disagreement(each(ensemble.params, ensemble.norm, batch)[0]).mean()

    curves = {name: [] for name in probes}
    for i in range(200):
        for name, batch in probes.items():
            curves[name].append(float(mean_disagreement(ensemble, batch)))
        ensemble = fit(ensemble, jax.random.key(i))
    fig, ax = figures.pyplot().subplots(figsize=(4.5, 3), constrained_layout=True)
    for name, label in (("seen", "trained on (first tenth)"), ("novel", "novel (last tenth)")):
        ax.semilogy(curves[name], label=label)
    ax.set(xlabel="retrainings of the ensemble", title="disagreement [action units squared]")
    ax.legend()
    ax.grid(alpha=0.3)
    figures.save(fig, path)
    return {f"disagreement, {name}": values[-1] for name, values in curves.items()}


def project(sets):
    """Project sets of x_t to two dimensions by UMAP, or PCA if umap-learn is not installed. Name and points."""
    everything = np.concatenate(sets)
    scaled = (everything - everything.mean(0)) / everything.std(0)
    try:
        import umap

        name, flat = "UMAP", umap.UMAP(random_state=0).fit_transform(scaled)
    except ImportError:
        name, flat = "PCA (umap-learn is not installed)", scaled @ np.linalg.svd(scaled, full_matrices=False)[2][:2].T
    return name, np.split(flat, np.cumsum([len(x) for x in sets])[:-1])


def look(robot):
    """Compare the coverage of exploration, random actions and first iterations of tasks: numbers and a figure."""
    tasks = [task for task in BLIND if envs.TASKS[task][1].robot == robot]
    random = f"runs/explore/{robot}/random"
    if not (ROOT / random / "meta.json").exists():
        words = ("--robot", robot, "--policy", "random", "--run-dir", random, "--force", "--total-steps", "300000")
        recording.run_script(["ppo_explore.py", *words])
    env = envs.make_explore(robot, "c")
    kinds = {
        "exploration": sample(ROOT / f"runs/explore/{robot}/seed0"),
        "random actions": sample(ROOT / random),
        **{f"first {EARLY} iterations of {task}": early_states(task) for task in tasks},
    }
    folder = ROOT / f"results/pidm/{robot}"
    coverage = {f"joint space, {name}": occupied(env, x) for name, x in kinds.items()}
    coverage |= draw_novelty(env, pretrain_pidm.Dataset(ROOT / f"runs/explore/{robot}/seed0"), folder / "novelty.png")
    for task in [task for task in tasks if (ROOT / f"results/tasks/{task}/policy.msgpack").exists()][:1]:
        coverage[f"normalized_error, recorded policy of {task}"] = walking_error(robot, task)
    name, points = project([x[::5] for x in kinds.values()])
    found = draw_coverage(dict(zip(kinds, points, strict=True)), f"{name} of x_t, {robot}", folder / "coverage.png")
    coverage |= {f"where exploration has been on the map, {kind}": share for kind, share in found.items()}
    print(robot, records.line(coverage))
    records.replace_text(folder / "coverage.json", json.dumps(coverage, indent=1) + "\n")


def draw_coverage(points, title, path, gridsize=30):
    """Draw a map of each set of states, name -> (S, 2), over the cells that the first one visits.

    Returns the share of the samples of each other set that is in these cells.
    """
    everything, (explored, *_) = np.concatenate([*points.values()]), points.values()
    pad = 0.02 * np.ptp(everything, axis=0)
    extent = np.stack([everything.min(0) - pad, everything.max(0) + pad], 1).ravel()
    cells = {"gridsize": gridsize, "extent": extent, "linewidths": 0.1}
    size = 3.2 * len(points), 3.4
    fig, axes = figures.pyplot().subplots(1, len(points), figsize=size, layout="constrained", sharex=True, sharey=True)
    share = {}
    for ax, (name, xy) in zip(axes, points.items(), strict=True):
        visited = ax.hexbin(*explored.T, mincnt=1, **cells)
        visited.set(array=None, facecolor="0.85")
        shown = ax.hexbin(*xy.T, mincnt=1, norm="log", vmin=1, vmax=100, cmap="viridis_r", **cells)
        ax.set(title=name.replace(" of ", " of\n"), xticks=[], yticks=[])
        if xy is not explored:
            known = {tuple(cell) for cell in visited.get_offsets()}
            inside = [tuple(cell) in known for cell in shown.get_offsets()]
            share[name] = float(shown.get_array()[inside].sum() / len(xy))
            ax.set_xlabel(f"{100 * share[name]:.0f}% in cells that exploration visits")
    axes[0].set_xlabel("grey in the others")
    fig.colorbar(shown, ax=axes, label="samples in a cell")
    fig.suptitle(title)
    figures.save(fig, path)
    return share


HEAD = """# Shipped PIDM checkpoints

The commands that stand below for each robot made them{dirty}. Now `python
results/pidm.py` collects 7.6 M transitions and trains until the error is flat, 100 epochs at most.

Errors are on held-out environments, with the tasks' sensor noise. error_over_change is error_rad over the mean action
magnitude |a_t - q_t|, joint target minus joint angle. The paper's, of the joint angle one step later, is 0.4 to 0.5.
normalized_error is over the mean action.

Joint space is the share of a 20 x 20 grid over each pair of neighbouring joints of a limb that 20,000 samples visit.
Maps have a panel for each set of states, 4,000 of each. Grey cells are those that exploration visits. Disagreement is
that of an ensemble trained on the first tenth of the collection, on what it was trained on (seen) and on the last tenth
(novel). The recorded policy is that of results/tasks, with its noise: a gait that the PIDM never saw. Features are the
outputs of the actor's backbone in the first rollout of a task. Their effective rank (Roy and Vetterli 2007) is the
number of directions, of 64, that they fill. The study's pretrained arm is "loaded, the rest as PyTorch's"; at
scales batch and 256 its mean actions are a hundredth.

"""
FIRST = """Of {robots}: errors were measured (`--stages collect validate`) on a collection that these commands made
later, on another machine or with other random numbers. So the weights have seen nothing of it. The last row of
metrics.csv is on the collection of the training.

"""


def commands(robot, explored, trained):
    """Lines that say how a PIDM was made, from the arguments of both stages."""
    lines = [f"    python ppo_explore.py --robot {robot} --total-steps {explored['total_steps']}"]
    words = [f"--{name} {trained[name]}" for name in ("epochs", "patience") if trained.get(name)]
    return [*lines, f"    python pretrain_pidm.py --data runs/explore/{robot}/seed0 {' '.join(words)}"]


def write_readme():
    """Write results/pidm/README.md from the kept files of all robots."""
    lines, first, dirty = [], [], []
    for folder in sorted(path.parent for path in (ROOT / "results/pidm").glob("*/validation.json")):
        meta, result = (json.loads((folder / name).read_text()) for name in ("explore/meta.json", "validation.json"))
        for extra in (folder / "coverage.json", folder / "features.json"):
            result |= json.loads(extra.read_text()) if extra.exists() else {}
        trained = json.loads((folder / "args.json").read_text())
        rows = records.read_rows(folder / "metrics.csv")
        lines += [f"## {folder.name}", "", f"{meta['transitions']:,} transitions, {len(rows)} epochs.", ""]
        lines += [*commands(folder.name, meta["args"], trained), ""]
        best = min(row["error"] for row in rows)  # on 50,000 transitions of the training's collection
        first += [folder.name] if abs(best - result["error"]) > 0.01 * result["error"] else []
        dirty += [folder.name] if trained["versions"]["commit"].endswith("-dirty") else []
        lines += [
            "| what | figure |",
            "|---|---|",
            *(f"| {name} | {value:.4g} |" for name, value in result.items()),
            "",
        ]
        pictures = ("curve", "accuracy", "distribution", "coverage", "novelty", "explore/curve")
        drawn = [name for name in pictures if (folder / f"{name}.png").exists()]
        lines += [*(f"![{name}]({folder.name}/{name}.png)" for name in drawn), ""]
    changed = f" ({', '.join(dirty)}'s with uncommitted changes)" if dirty else ""
    head = HEAD.format(dirty=changed) + (FIRST.format(robots=", ".join(first)) if first else "")
    records.replace_text(ROOT / "results/pidm/README.md", head + "\n".join(lines).rstrip() + "\n")


def make(robot, stages):
    """Run these stages for a robot."""
    if "collect" in stages:
        recording.run_script(["ppo_explore.py", "--robot", robot, "--force", *EXPLORE_FLAGS])
    if "pretrain" in stages:
        words = ("--data", f"runs/explore/{robot}/seed0", "--force", *PRETRAIN)
        recording.run_script(["pretrain_pidm.py", *words])
        keep(robot)
    if "validate" in stages:
        validate(robot)
    if "look" in stages:
        look(robot)
    if "features" in stages:
        found = compare_features(robot, robot.removesuffix("_d") + "_loco")
        records.replace_text(ROOT / f"results/pidm/{robot}/features.json", json.dumps(found, indent=1) + "\n")
    if "sizes" in stages:
        pretrain_on_parts(robot)


def main(args):
    """Run the stages for each robot, and write results/pidm/README.md. UserError for an unknown robot."""
    devices.find()
    if unknown := {*args.robots} - envs.EXPLORE.keys():
        raise records.UserError(f"unknown robot {unknown.pop()!r}; choose of {', '.join(envs.EXPLORE)}")
    for robot in args.robots:
        make(robot, args.stages)
    write_readme()


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
