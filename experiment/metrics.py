"""Names and averages of logged numbers, from one control step of one robot to a row of metrics.csv.

An environment reports metrics by name (see `Env.metrics`). Names that start with `episode_` hold for an episode and
count where it ends. All others hold for a step. Names with a slash (`reward/slip`, `level/3`) are parts of a whole.
"""

import jax.numpy as jnp

EPISODE, SUM = "episode_", "sum/"  # SUM marks, on the way to a row, what is summed instead of averaged


def step_metrics(env_state):
    """Means over environments (N,), and sums over the episodes that ended in this step."""
    done = env_state.terminated | env_state.truncated
    metrics = dict(env_state.metrics)
    names = [name for name in metrics if name.startswith(EPISODE)]
    ended = {SUM + name: jnp.sum(metrics.pop(name) * done) for name in names}
    ended |= {f"{SUM}falls": env_state.terminated.sum(), f"{SUM}episodes": done.sum()}
    return {name: value.mean() for name, value in metrics.items()} | {"reward": env_state.reward.mean()} | ended


def over_time(metrics):
    """Metrics with a leading time axis, averaged over it, or summed where they are sums."""
    return {name: value.sum() if name.startswith(SUM) else value.mean() for name, value in metrics.items()}


def update_magnitude(before, after):
    """Mean absolute change of each submodule's weights, averaged over its layers (paper Sec. V-E)."""
    changes = {}
    for branch in ("actor", "critic"):
        for name, part in before["params"][branch].items():
            new = after["params"][branch][name]
            layers = [jnp.abs(new[layer]["kernel"] - part[layer]["kernel"]).mean() for layer in part]
            changes[f"update/{branch}/{name}"] = jnp.stack(layers).mean()
    return changes


def make_row(args, iteration, seconds, metrics):
    """One row of metrics.csv from a chunk's metrics (log_every,). What is of episodes is NaN if none ended."""
    metrics = over_time(metrics)
    episodes, falls = metrics.pop(f"{SUM}episodes"), metrics.pop(f"{SUM}falls")
    ended = {name.removeprefix(SUM): metrics.pop(name) for name in list(metrics) if name.startswith(SUM)}
    ended = {name: value / max(episodes, 1) for name, value in ({"fall_rate": falls} | ended).items()}
    if not episodes:
        ended = dict.fromkeys(ended, float("nan"))
    env_steps = iteration * args.num_envs * args.num_steps
    return rounded({"iteration": iteration, "env_steps": env_steps, "seconds": seconds, **ended, **metrics})


def rounded(row):
    """A row of plain numbers: counts whole, others with six digits."""
    return {name: x if type(x) is int else float(f"{float(x):.6g}") for name, x in row.items()}


def mean_row(rows):
    """Mean of several rows, column by column."""
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def of_first_episodes(metrics, alive, ended):
    """Means over the first episode of each environment; arrays (T, N), `alive` until it ended, `ended` as it did."""
    result = {}
    for name, value in metrics.items():
        if name.startswith(EPISODE):
            result[name] = (value * ended).sum() / ended.sum()
        elif "/" not in name and not name.startswith("progress"):  # progress is of a whole training
            result[name] = (value * alive).sum() / alive.sum()
    return result
