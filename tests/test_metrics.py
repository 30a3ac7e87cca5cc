"""From what robots report in a step to rows, curves and lines: against plain loops over made-up numbers."""

import csv
import sys
import time
import types

import flax
import jax.numpy as jnp
import numpy as np
import pytest

import ppo_finetune
from experiment import checkpoints, figures, metrics, records
from experiment.progress import Progress
from experiment.run import Run

CHUNKS, T, N = 3, 5, 4  # iterations per row, control steps, environments


@flax.struct.dataclass
class Step:
    """The part of an environment's state that `step_metrics` reads."""

    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    metrics: dict


def made_up(seed, likely=0.15):
    """Metrics of CHUNKS iterations of T steps of N robots, each array (CHUNKS, T, N)."""
    rng = np.random.default_rng(seed)
    names = ("episode_return", "episode_success", "reward/slip", "lin_vel_error")
    numbers = {name: rng.normal(size=(CHUNKS, T, N)) for name in names}
    ends = rng.choice(3, (CHUNKS, T, N), p=(1 - 2 * likely, likely, likely))
    return Step(rng.normal(size=(CHUNKS, T, N)), ends == 1, ends == 2, numbers)


def chunk(steps):
    """Metrics of a chunk (CHUNKS,), as the scripts' scans make them."""
    iterations = []
    for c in range(CHUNKS):
        report = []
        for t in range(T):
            cut = {name: jnp.asarray(x[c, t]) for name, x in steps.metrics.items()}
            fields = (jnp.asarray(x[c, t]) for x in (steps.reward, steps.terminated, steps.truncated))
            report.append(metrics.step_metrics(Step(*fields, cut)))
        iterations.append(metrics.over_time({name: jnp.stack([one[name] for one in report]) for name in report[0]}))
    return {name: jnp.stack([one[name] for one in iterations]) for name in iterations[0]}


@pytest.mark.parametrize("likely", [0.15, 0.02])
def test_a_row_is_the_mean_over_its_steps_and_over_its_episodes(likely):
    """However few episodes end, each counts once."""
    args, steps = types.SimpleNamespace(num_envs=N, num_steps=T), made_up(16, likely)
    row = metrics.make_row(args, 12, 3.25, chunk(steps))
    done = steps.terminated | steps.truncated
    assert 0 < steps.terminated.sum() < done.sum() < done.size
    want = {"iteration": 12, "env_steps": 12 * N * T, "seconds": 3.25, "reward": steps.reward.mean()}
    want |= {name: steps.metrics[name].mean() for name in ("reward/slip", "lin_vel_error")}
    want |= {name: steps.metrics[name][done].mean() for name in ("episode_return", "episode_success")}
    want["fall_rate"] = steps.terminated.sum() / done.sum()
    assert row == pytest.approx(want, rel=1e-5)
    counts = [row.pop(name) for name in ("iteration", "env_steps")]
    assert [type(x) for x in counts] == [int, int], "beyond a million, too"
    assert all(type(x) is float and float(f"{x:.6g}") == x for x in row.values())


def test_without_an_episode_that_ended_its_numbers_are_unknown():
    row = metrics.make_row(types.SimpleNamespace(num_envs=N, num_steps=T), 3, 1.0, chunk(made_up(1, likely=0.0)))
    assert {name for name, x in row.items() if np.isnan(x)} == {"episode_return", "episode_success", "fall_rate"}


def test_mean_of_rows():
    assert metrics.mean_row([{"a": 1.0, "b": 2.0}, {"a": 2.0, "b": 6.0}]) == {"a": 1.5, "b": 4.0}


def test_first_episodes_alone_count_in_an_evaluation():
    """Steps after a robot's first end have no influence; an episode's own numbers are those of its last step."""
    rng = np.random.default_rng(2)
    names = ("episode_return", "episode_success", "lin_vel_error", "reward/slip", "progress")
    report = {name: rng.normal(size=(T, N)) for name in names}
    last = np.array([0, 2, 4, 4])  # step at which each first episode ends
    alive, ended = np.arange(T)[:, None] <= last, np.arange(T)[:, None] == last
    got = metrics.of_first_episodes(report, jnp.asarray(alive), jnp.asarray(ended))
    errors = [report["lin_vel_error"][t, n] for n in range(N) for t in range(last[n] + 1)]
    want = {name: np.mean([report[name][last[n], n] for n in range(N)]) for name in names[:2]}
    assert got == pytest.approx(want | {"lin_vel_error": np.mean(errors)}, rel=1e-5)


def test_curves_show_what_a_row_has(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(figures, "plot_curves", lambda rows, panels, path: drawn.append(panels))
    names = ("env_steps", "fall_rate", "episode_return", "reward/slip", "reward/alive", "foot_error", "kl", "update/x")
    figures.plot_training([dict.fromkeys(names, 0.0)], tmp_path / "curve.png")
    (panels,) = drawn
    assert sorted(panels) == ["episode_return", "fall_rate", "foot_error", "reward terms per step"]
    assert panels.pop("reward terms per step") == ["reward/slip", "reward/alive"]
    assert all(columns == [title] for title, columns in panels.items())


@flax.struct.dataclass
class Policy:
    """The part of a stacked TrainState that `Run` reads."""

    params: dict


def test_flat_and_rough_ground_have_their_own_line(monkeypatch, tmp_path):
    drawn = {}
    monkeypatch.setattr(
        figures, "save", lambda fig, path: drawn.update({p.get_label(): p.get_data() for p in fig.axes[0].patches})
    )
    magnitude, rough = np.repeat([0.1, 0.9], [60, 20]).reshape(40, 2), np.arange(40) >= 30
    figures.plot_distribution(magnitude, rough, tmp_path / "x.png")
    modes = {name: line.edges[np.argmax(line.values)] for name, line in drawn.items()}
    assert modes["flat"] < 0.2 < 0.8 < modes["rough"]


def test_a_run_of_two_seeds_on_disk_and_on_the_screen(tmp_path, monkeypatch, capsys):
    """Each seed's rows in its own folder, their mean and the speed of both in the line. It is done at the last row."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    args = ppo_finetune.Args(num_envs=N, num_steps=T, num_seeds=2, run_dir=str(tmp_path), save_minutes=1.0)
    run = Run(args, args, 2 * CHUNKS, ("lin_vel_error",))
    assert [one["weights"] for one in run.start(lambda one: {"weights": one.seed})] == [0, 1]
    with run:
        for number, seconds in ((1, 30.0), (2, 50.0)):
            assert not run.done
            now[0] += seconds
            reports = [chunk(made_up(10 * number + seed)) for seed in range(2)]
            capsys.readouterr()
            run.log(number * CHUNKS, reports)
            line = capsys.readouterr().out
            error = np.mean([made_up(10 * number + seed).metrics["lin_vel_error"].mean() for seed in range(2)])
            assert f"{2 * CHUNKS * N * T / seconds:,.0f}/s" in line and f"lin_vel_error {error:.4g}" in line
            assert run.due == (number == 2)
    assert run.done and not run.stopped
    for seed in range(2):
        rows = list(csv.DictReader((tmp_path / f"seed{seed}/metrics.csv").open()))
        assert [float(row["seconds"]) for row in rows] == [30.0, 80.0]
        want = [made_up(10 * number + seed).metrics["lin_vel_error"].mean() for number in (1, 2)]
        np.testing.assert_allclose([float(row["lin_vel_error"]) for row in rows], want, rtol=1e-5)


def test_on_a_terminal_there_is_a_bar(monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    with Progress(10, ("kl",)) as progress:
        progress.show({"env_steps": 2e6, "iteration": 4, "seconds": 1.0, "kl": 0.5}, 100.0)
        (task,) = progress.bar.tasks
    assert (task.completed, task.total) == (4, 10) and "2.00M steps  100/s  kl 0.5" in task.description


def test_weights_that_are_not_finite_are_never_saved(tmp_path):
    """The policy and the rows of the chunk before stay, and the state before it is there to be replayed."""
    args = ppo_finetune.Args(num_envs=N, num_steps=T, run_dir=str(tmp_path))
    run = Run(args, args, 9, ())
    good, bad = (Policy({"w": jnp.full((1, 2), x, jnp.float32)}) for x in (1.0, np.nan))
    run.start(lambda one: good)
    with run:
        run.log(3, [chunk(made_up(0))])
        run.save_policies(good, good)
        run.log(6, [chunk(made_up(1))])
        with pytest.raises(records.UserError, match="weights are not finite after iteration 6"):
            run.save_policies(good, bad)
    params, _ = checkpoints.load(tmp_path / "policy.msgpack", "policy")
    np.testing.assert_array_equal(params["w"], [1.0, 1.0])
    state, rows = checkpoints.load_state(tmp_path, jnp.zeros(2))
    np.testing.assert_array_equal(state, [1.0, 1.0])
    assert [row["iteration"] for row in rows] == [3.0]
