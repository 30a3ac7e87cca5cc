"""The report's measures on curves with answers known by hand, and runs that it must leave out."""

import csv
import json
import re
import shutil
import statistics

import matplotlib.image
import numpy as np
import pytest
from scipy import stats

from experiment import records
from results import drawing, grid, measures, pidm, report, tables, tasks
from tools import bench


def curve(values, seed=0):
    rows = {"iteration": np.arange(1.0, len(values) + 1), "indicator": np.asarray(values, float)}
    return rows | {"seed": seed, "settings": {"num_envs": 256, "num_steps": 24}, "columns": {}}


def flat(*levels):
    """Runs of ten rows at these levels, seeds 0, 1, ..."""
    return [curve([level] * 10, seed) for seed, level in enumerate(levels)]


# --- Measures ---


def test_final_is_the_mean_of_the_last_twentieth():
    assert measures.final(curve([*[0.0] * 38, 4.0, 6.0])) == 5.0
    assert measures.final(curve([1.0, 2.0])) == 2.0


def test_a_row_in_which_no_episode_ended_does_not_count():
    assert measures.final(curve([*[0.0] * 38, 4.0, np.nan])) == 4.0
    assert measures.late_gain(curve([*[1.0] * 20, *[8.0] * 19, np.nan, *[10.0] * 20])) == pytest.approx(0.2)


def test_late_gain_is_what_the_last_third_brought():
    assert measures.late_gain(curve([*[1.0] * 20, *[8.0] * 20, *[10.0] * 20])) == pytest.approx(0.2)
    assert measures.late_gain(curve([3.0])) == 0.0


def test_iterations_to_a_level_are_of_raw_rows_or_of_a_trailing_mean():
    """A run rises 1 an iteration, with one noisy row of 30 at iteration 3: raw rows see it, means of five do later."""
    rising = curve(np.arange(1.0, 41.0))
    assert measures.iterations_to(rising, 10.0) == 10
    assert measures.iterations_to(rising, 10.0, rows=5) == 12  # the mean of five that ends at i is i - 2
    assert np.isnan(measures.iterations_to(rising, 100.0))
    rising["indicator"][2] = 30.0
    assert measures.iterations_to(rising, 10.0) == 3
    assert measures.iterations_to(rising, 10.0, rows=5) == 7
    rising["indicator"][0] = np.nan  # no episode had ended
    assert measures.iterations_to(rising, np.array([2.0, 31.0, 99.0])).tolist()[:2] == [2, 31]


def test_the_goal_is_of_the_runs_that_are_drawn():
    """PIDM random ends at 10 or 20, so that 90% is 9 or 18: a run that rises 1 an iteration is there at 9 or 18.

    Catches a goal of all seeds for every draw, which is 13.5 and gives 14 both times.
    """
    rising = [curve(np.arange(1.0, 41.0))] * 2
    steps = np.arange(1.0, 41.0)
    baseline = [curve(np.minimum(steps, 10.0)), curve(np.minimum(steps, 20.0))]
    both, first, second = (np.array([drawn]) for drawn in ([0, 1], [0, 0], [1, 1]))
    runs = rising + baseline
    for drawn, goal in ((first, 9), (second, 18)):
        assert measures.values("to 90%", runs, np.array([goal / 0.9]))[0, 0] == goal
        assert measures.change("to 90%", rising, baseline, both, drawn) == 0.0
    mixed = measures.change(
        "to 90%", rising, baseline, both, both
    )  # 14 against 14 and, for the one that ends at 10, 40
    assert mixed == pytest.approx(100 * (14 / 27 - 1))


def test_what_was_not_run_or_not_reached_is_said():
    runs = {"pidm_random": flat(10.0), "mlp": flat(10.0, 1.0)}
    assert str(measures.compare("t", runs, "mlp", "to 90%")) == "≥ +450.0"  # iteration 1, and 10 for never
    assert str(measures.compare("t", runs, "mlp", "final")) == "-45.0"
    assert tables.shown(measures.compare("t", runs, "pidm_pretrained", "final")) == "not run"
    assert tables.shown(measures.compare("t", {}, "mlp", "final")) == "not run"
    runs = {"pidm_random": flat(1.0, 9.0), "mlp": flat(10.0)}
    assert str(measures.compare("t", runs, "mlp", "to 90%")) == "≤ -81.8"  # 1 against 1 and 10
    assert str(measures.compare("t", runs | {"mlp": flat(2.0)}, "mlp", "to 90%")) == "~ +81.8"


# --- Intervals ---


def test_bca_interval_is_efrons(monkeypatch):
    """Against the formula of Efron (1987), with an independent bootstrap of a skewed sample at the same level.

    Catches a percentile interval, whose upper end is lower by a tenth of the width.
    """
    x = np.array([1.0, 1.1, 1.2, 1.3, 1.5, 1.7, 1.9, 2.1, 2.2, 3.0, 4.0, 6.0])
    monkeypatch.setattr(measures, "DRAWS", 200_000)
    low, high = measures.interval(lambda i, axis=-1: x[i].mean(-1), [np.arange(len(x))], "a task")
    draws = np.random.default_rng(5).choice(x, (200_000, len(x))).mean(1)
    normal = statistics.NormalDist()
    bias = normal.inv_cdf(((draws < x.mean()).mean() + (draws <= x.mean()).mean()) / 2)
    left = np.array([np.delete(x, k).mean() for k in range(len(x))])
    acceleration = np.sum((left.mean() - left) ** 3) / (6 * np.sum((left.mean() - left) ** 2) ** 1.5)
    tail = (1 - measures.level([len(x)])) / 2
    expected = []
    for z in (normal.inv_cdf(tail), normal.inv_cdf(1 - tail)):
        share = normal.cdf(bias + (bias + z) / (1 - acceleration * (bias + z)))
        expected.append(np.quantile(draws, share))
    plain = np.quantile(draws, (tail, 1 - tail))
    width = expected[1] - expected[0]
    assert [low, high] == pytest.approx(expected, abs=0.03 * width)
    assert plain[1] < expected[1] - 0.1 * width


def test_level_makes_normal_intervals_as_wide_as_students():
    """Five values: t with 4 degrees is 2.776; five and five: 2.306 with 8. A resample has 4/5 of the variance."""
    for sizes, t in (([5], 2.7764), ([5, 5], 2.3060)):
        z = statistics.NormalDist().inv_cdf((1 + measures.level(sizes)) / 2)
        assert z * np.sqrt(4 / 5) == pytest.approx(t, abs=1e-3)


@pytest.mark.parametrize(("seeds", "least", "most"), [(5, 0.925, 0.98), (3, 0.86, 0.93), (2, 0.62, 0.72)])
def test_intervals_cover_what_they_say(seeds, least, most, monkeypatch):
    """400 studies of as many seeds in two arms that are alike: zero is inside 95%, at most 90% and 67%.

    Plain bootstraps of five seeds cover 88%.
    """
    monkeypatch.setattr(measures, "DRAWS", 999)
    rng, inside = np.random.default_rng(3), 0
    for study in range(400):
        a, b = rng.normal(1.0, 0.05, (2, seeds))

        def statistic(i, j, axis=-1, a=a, b=b):
            return a[i].mean(-1) / b[j].mean(-1) - 1

        low, high = measures.interval(statistic, [np.arange(seeds)] * 2, str(study))
        inside += low <= 0 <= high
    assert least <= inside / 400 <= most


def test_intervals_begin_at_two_seeds():
    """One seed of a method has no interval, even beside five of PIDM random."""
    runs = {"pidm_random": flat(9.0, 10.0, 11.0, 9.5, 10.5), "mlp": flat(11.0)}
    assert str(measures.compare("t", runs, "mlp", "final")) == "+10.0"
    assert str(measures.compare("t", runs | {"mlp": flat(11.0, 11.5)}, "mlp", "final")).startswith("+12.5 [")
    same = {"pidm_random": flat(10.0, 10.0), "mlp": flat(11.0, 11.0)}
    assert str(measures.compare("t", same, "mlp", "final")) == "+10.0"  # nothing varies


def test_tasks_are_drawn_independently():
    """Two tasks with the same numbers: the mean's interval is narrower by the root of two than that of one.

    Catches the same seed indices for all tasks of a size, whose mean is as wide as each. Student's t is 2.306 with 8
    degrees of freedom and 2.120 with 16.
    """
    runs = {"pidm_random": flat(9.0, 10.0, 11.0, 9.5, 10.5), "mlp": flat(11.0, 11.5, 12.0, 10.0, 10.5)}
    one = measures.compare("a", runs, "mlp", "final").interval
    two = measures.mean_over_seeds({"a": runs, "b": runs}, "mlp", "final").interval
    assert np.ptp(two) / np.ptp(one) == pytest.approx(np.sqrt(0.5) * 2.120 / 2.306, rel=0.08)
    assert measures.compare("b", runs, "mlp", "final").interval != one


# --- Over tasks ---


def test_the_mean_action_is_of_evaluations():
    """11 and 13 against 10: 20% more. Tasks with levels have no such return."""
    runs = {"pidm_random": flat(5.0, 5.0), "mlp": flat(1.0, 9.0)}
    assert measures.compare("go1_loco", runs, "mlp", "mean action") is None
    for method, returns in {"pidm_random": (10.0, 10.0), "mlp": (11.0, 13.0)}.items():
        for run, value in zip(runs[method], returns, strict=True):
            run["errors"] = {"episode_return": value}
    assert np.isclose(measures.compare("go1_loco", runs, "mlp", "mean action").value, 20.0)


def test_means_over_tasks():
    """Tasks at +10 and -30 percent with two seeds, one at +890 with one; one has no baseline."""
    study = {
        "go1_loco": {"pidm_random": flat(10.0, 10.0), "mlp": flat(11.0, 11.0)},
        "g1_loco": {"pidm_random": flat(10.0, 10.0), "mlp": flat(7.0, 7.0)},
        "anymal_climb_up": {"pidm_random": flat(10.0), "mlp": flat(99.0)},
        "anymal_loco": {"mlp": flat(10.0, 10.0)},
    }
    assert str(measures.mean_over_seeds(study, "mlp", "final")) == "-10.0"
    assert measures.mean_over_tasks(study, "mlp", "final").value == pytest.approx(870 / 3)
    every, several = (line.split(" | ") for line in tables.table_1(study)[-2:])
    assert every[3].startswith("+290.0 [") and every[4] == "-1.1"  # the paper: +0.6, -0.2 and -3.7
    assert several[3:5] == ["-10.0", "+0.2"] and several[5:7] == ["not run", ""]


def test_mean_counts_a_run_that_never_got_there_by_its_length():
    """PIDM random is there at row 1, as are the MLPs of one task; the other's are not at row 10: +0, at least +900."""
    study = {
        "go1_loco": {"pidm_random": flat(10.0, 10.0), "mlp": flat(10.0, 10.0)},
        "g1_loco": {"pidm_random": flat(10.0, 10.0), "mlp": flat(1.0, 1.0)},
    }
    assert str(measures.mean_over_seeds(study, "mlp", "to 90%")) == "≥ +450.0"
    assert str(measures.mean_over_seeds({"go1_loco": study["go1_loco"]}, "mlp", "to 90%")) == "+0.0"
    assert str(measures.mean_over_tasks(study, "mlp", "to 90%")).startswith("≥ +450.0")


def test_interquartile_mean_is_of_the_middle_half_of_runs():
    """Runs at +0, +10, +20, +90%: the middle two. Then a task of one run at +40% beside one of +0 and +20%.

    It weighs as much as both: +0, +20, +40, +40, the middle two again. Catches a task that weighs by its seeds.
    """
    study = {
        "go1_loco": {"pidm_random": flat(10.0), "mlp": flat(10.0, 19.0)},
        "g1_loco": {"pidm_random": flat(100.0), "mlp": flat(110.0, 120.0)},
    }
    assert measures.interquartile_mean(study, "mlp", "final").value == pytest.approx(15.0)
    study = {
        "go1_loco": {"pidm_random": flat(10.0), "mlp": flat(14.0)},
        "g1_loco": {"pidm_random": flat(10.0), "mlp": flat(10.0, 12.0)},
    }
    assert measures.interquartile_mean(study, "mlp", "final").value == pytest.approx(30.0)


def test_improvement_pairs_runs_by_seed():
    """Seeds stand in another order and one has no partner: seed 0 loses, seed 1 ties, seed 2 wins.

    Catches pairs by position, of which none ties.
    """
    arm = [curve([3.0] * 10, 2), curve([1.0] * 10, 0), curve([5.0] * 10, 1), curve([99.0] * 10, 7)]
    runs = {"pidm_random": flat(2.0, 5.0, 1.0), "mlp": arm}
    assert sorted(measures.better("final", arm, runs["pidm_random"])) == [0.0, 0.5, 1.0]
    assert tables.wins(runs, "mlp", "final") == "1.5 of 3"
    strangers = {"pidm_random": [curve([1.0] * 10, 8)], "mlp": arm}  # no seed in common: no pair, and no part in a mean
    assert measures.improvement({"go1_loco": runs, "g1_loco": strangers}, "mlp", "final").value == 50.0
    assert measures.improvement({"g1_loco": strangers}, "mlp", "final") is None
    assert measures.improvement({"go1_loco": runs}, "mlp", "final").value == 50.0
    slow, fast = [curve([*[0.0] * 5, *[9.0] * 5])], [curve([9.0] * 10)]
    assert measures.better("to 90%", fast, slow) == [1.0]  # fewer iterations are better


def test_controls_compare_the_same_seeds():
    """Seed 2 of the baseline, which the control lacks, would make the change -45%."""
    runs = {"pidm_random": flat(10.0, 10.0, 40.0), "pidm_shuffled": flat(11.0, 11.0)}
    arms = measures.same_seeds(runs, "pidm_shuffled", "pidm_random")
    assert [len(arm) for arm in arms.values()] == [2, 2]
    line = tables.controls({"cpu": {"go1_loco": runs}})[-1].split(" | ")
    assert line[1:6] == ["256 x 24", "PIDM shuffled", "PIDM random", "0, 1", "+10.0"]
    assert measures.same_seeds(runs, "pidm_shuffled", "mlp") == {}
    for method, moves in {"pidm_shuffled": 3.0, "pidm_random": 2.0}.items():
        for run in runs[method]:
            run["columns"] = {"update/actor/backbone": np.full(10, moves)}
    runs["pidm_random"][2]["columns"]["update/actor/backbone"] += 99.0  # the seed without a partner
    assert tables.controls({"cpu": {"go1_loco": runs}})[-1].endswith("| +50 |")


# --- Tables ---


def test_spread_is_the_std_of_a_sample():
    """9 and 11: the std is the root of 2 with ddof 1; with ddof 0 it is 1."""
    assert tables.spread([12.5]) == "12.5"
    assert tables.spread([9.0, 11.0]) == "10 ± 1.4"


def test_counts_say_how_many_got_there():
    assert tables.counts([100.0, 300.0]) == "200"
    assert tables.counts([100.0, np.nan, 300.0]) == "200 (2 of 3)"
    assert tables.counts([np.nan]) == "not reached"


def test_updates_are_of_the_first_iterations_and_also_per_step_size():
    """Pretrained moves half as much at a quarter of the step size, so twice as much per unit; later rows differ."""

    def run(scale, step):
        iteration = np.array([50.0, 100.0, 150.0])
        columns = {f"update/actor/{module}": scale * np.array([1.0, 3.0, 99.0 / scale]) for module in grid.MODULES}
        return {"iteration": iteration, "columns": columns | {"lr": step * np.array([1.0, 1.0, 7.0 / step])}}

    table = tables.updates_table({"go1_loco": {"pidm_random": [run(1.0, 4.0)], "pidm_pretrained": [run(0.5, 1.0)]}})
    assert table[-1] == "| Go1 locomotion | 1 | -50 | -50 | -50 | -50 | -75 | +100 |"


def test_all_machines_of_a_task_are_named():
    runs = {}
    for method, device in {"mlp": "NVIDIA H200", "pidm_random": "cpu", "pidm_pretrained": "cpu"}.items():
        settings = {"num_envs": 2, "num_steps": 5, "total_steps": 3e6}
        runs[method] = [{"settings": settings, "versions": {"device": device, "machine": "m", "jax": "1"}}]
    (line,) = tables.sizes_and_machines({"go1_loco": runs})
    assert line == "- Go1 locomotion: `go1_loco`, 2 x 5, 3.0 M steps, NVIDIA H200, m, jax 1; cpu, m, jax 1"


def test_rows_of_earlier_tasks_are_marked():
    """Jumping was run before its task was changed; climbing up before and after."""
    titles = [
        grid.title(task, tables.load_task(report.ROOT / f"results/study/{scale}/{task}"))
        for scale, task in (("cpu", "anymal_jump"), ("cpu", "anymal_climb_up"), ("batch", "anymal_climb_up"))
    ]
    assert titles == ["Jump (earlier task)", "Climb up (earlier task)", "Climb up"]


# --- Pages ---


def test_the_paper_s_means_are_those_it_prints():
    assert np.isclose(np.mean(tables.PAPER["final"]["mlp"]), 1.0, atol=0.05)
    assert np.isclose(np.mean(tables.PAPER["final"]["pidm_pretrained"]), 4.3, atol=0.05)
    assert np.isclose(np.mean(tables.PAPER["to 90%"]["mlp"]), -9.5, atol=0.05)
    assert np.isclose(np.mean(tables.PAPER["to 90%"]["pidm_pretrained"]), -36.2, atol=0.1)


def test_pages_are_what_the_runs_give():
    report.main(report.Args(check=True))
    assert len((report.ROOT / "results/README.md").read_text().splitlines()) <= 250


def test_only_marked_places_are_filled():
    text = "a\n<!-- results/report.py writes table 1 from here -->\nold\n<!-- to here -->\nb\n"
    text += "<!-- results/report.py writes from here -->\n<!-- to here -->\n"
    page = report.filled(text, {"table 1": ["| x |"], "": ["| y |"]})
    assert re.sub(r"<!--.*?-->\n", "", page).split() == ["a", "|", "x", "|", "b", "|", "y", "|"]
    assert report.filled(page, {"table 1": ["| x |"], "": ["| y |"]}) == page


def recorded(task, method, scale=None):
    """Indicator (K, R) of recorded runs, read from their rows; a reference that shares nothing with the report."""
    curves = []
    study = report.ROOT / "results/study"
    scale = scale or ("batch" if all((study / "batch" / task / m).exists() for m in report.TABLE_1) else "cpu")
    for path in sorted((study / scale / task / method).glob("seed*/metrics.csv")):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        name = next(name for name in ("progress_reached", "progress", "episode_return") if name in rows[0])
        curves.append([float(row[name]) for row in rows])
    return np.array(curves)


def test_words_of_the_page_are_what_was_recorded():
    """Main numbers of the text, which is written by hand, from the rows alone."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    ends, there, random_ends = [], [], []
    before = ("anymal_climb_up", "anymal_climb_down", "anymal_crouch", "anymal_parkour_walk")
    small = [(task, "cpu") for task in ("anymal_loco", "go1_loco", *before)]
    for task, scale in [*((task, None) for task in report.TASKS), *small]:  # 256 environments; earlier tasks
        arms = [recorded(task, method, scale) for method in ("pidm_pretrained", "pidm_random")]
        final = [arm[:, -max(arm.shape[1] // 20, 1) :].mean() for arm in arms]
        first, half = (
            [np.mean([1 + np.flatnonzero(run >= share * final[1])[0] for run in arm]) for arm in arms]
            for share in (0.9, 0.5)
        )
        ends.append(100 * (final[0] / final[1] - 1))
        there.append(100 * (first[0] / first[1] - 1))
        random_ends.append(final[1])
        if task == "g1_loco":  # a row every four iterations
            assert f"reaches 50% after {4 * half[0]:.0f} iterations, PIDM random after {4 * half[1]:.0f}" in text
            assert f"and ends {ends[-1]:.1f}% higher, an interval of -4" in text
    means = [np.mean(every[1:7] + every[8:11]) for every in (ends, there)]  # without the rows of 4096
    assert "with both quadrupeds' rows of 256 the means are {:+.1f}% and {:+.1f}%".format(*means) in text
    means = [np.mean(every[:2] + every[6:9] + every[11:]) for every in (ends, there)]
    said = "climbing up ended {:.1f}% higher and climbing down took {:.0f}% fewer iterations; with their rows, "
    said += "crouching's and walking's the means were {:+.1f}% and {:+.1f}%."
    assert said.format(ends[11], -there[12], *means) in text
    ends, there = ends[:9], there[:9]
    parkour = ends[2:7]
    assert f"final progress is {-min(parkour):.0f}% lower (climbing up) to {max(parkour):.0f}% higher" in text
    *fewer, more = sorted(there[2:7])
    said = (
        f"iterations {-fewer[-1]:.0f} to {-fewer[0]:.0f}% fewer in four of five skills and {more:.0f}% more in climbing"
    )
    assert said in text and more == there[4]
    mlp = [recorded(task, "mlp")[:, -max(recorded(task, "mlp").shape[1] // 20, 1) :].mean() for task in report.TASKS]
    mlp = [100 * (own / base - 1) for own, base in zip(mlp, random_ends[:9], strict=True)]
    assert f"The MLP itself ends {np.mean(mlp):.1f}% above PIDM random" in text
    assert f"ends {np.mean(ends):.1f}% above the random one" in text
    assert f"needs {-np.mean(there):.1f}% fewer iterations to 90%" in text
    gains = np.array(tables.PAPER["to 90%"]["pidm_pretrained"]) < there
    assert gains.sum() == 9 and "All nine figures of iterations are worse" in text
    order = stats.spearmanr(there, tables.PAPER["to 90%"]["pidm_pretrained"]).statistic
    assert f"(rank correlation {order:.1f}," in text
    last = {m: recorded("anymal_loco", m, "cpu")[:, -4:].mean(1) for m in ("mlp", "pidm_random", "pidm_pretrained")}
    assert last["pidm_pretrained"].min() > max(last["mlp"].max(), last["pidm_random"].max())
    with_loaded, without = (
        recorded("go1_loco", f"pidm_{m}_orthogonal", "cpu")[:, -4:].mean() for m in ("pretrained", "random")
    )
    assert f"costs Go1 {100 * (1 - with_loaded / without):.1f}%" in text


def test_words_on_what_a_task_saves_are_what_was_recorded():
    """Environment steps to 90%, pretrained against random, beside the 1.5 M of the data."""
    results, readme = (
        " ".join((report.ROOT / name).read_text().split()) for name in ("results/README.md", "README.md")
    )
    saved = []
    for task in report.TASKS:
        random, loaded = (recorded(task, m) for m in ("pidm_random", "pidm_pretrained"))
        goal = 0.9 * random[:, -max(random.shape[1] // 20, 1) :].mean()
        first, later = (np.mean([np.flatnonzero(run >= goal)[0] for run in arm]) for arm in (loaded, random))
        scale = "batch" if (report.STUDY / "batch" / task / "mlp").exists() else "cpu"
        path = report.STUDY / scale / task / "pidm_random/seed0/metrics.csv"
        steps = [float(row["env_steps"]) for row in csv.DictReader(path.read_text().splitlines())]
        saved.append((later - first) * (steps[1] - steps[0]) / 1e6)
    some = [one for one in saved if one > 0]
    assert f"a task saves {min(some):.1f} to {max(some):.1f} M steps, where it saves any, one of nine more" in results
    assert sum(one > 1.5 for one in saved) == 1 and "exceed what eight of nine tasks save" in readme


def test_words_on_shuffled_weights_are_what_was_recorded():
    """With 4096 environments, two seeds of Go1 and one of ANYmal D, against the same seeds of both PIDMs."""
    text, found = " ".join((report.ROOT / "results/README.md").read_text().split()), []
    for task, seeds in (("go1_loco", 2), ("anymal_loco", 1)):
        shuffled, random, loaded = (recorded(task, f"pidm_{m}", "batch") for m in ("shuffled", "random", "pretrained"))
        assert len(shuffled) == seeds, "(n = 2 and 1)"
        ends = [runs[:seeds, -7:].mean() for runs in (shuffled, random, loaded)]
        found.append([100 * (a / b - 1) for a, b in ((ends[0], ends[1]), (ends[2], ends[0]))])
        calm = [evaluations("batch", task, f"pidm_{m}")[:seeds] for m in ("pretrained", "shuffled")]
        calm = [np.mean([one["episode_return"] for one in each]) for each in calm]
        found[-1] += [100 * (calm[0] / calm[1] - 1), 100 * (ends[2] / ends[1] - 1)]
    (up, left, calm, whole_gain), (other, rest, quiet, _) = found
    assert f"above them, without noise {calm:.1f}% and {quiet:.1f}%: two thirds" in text and 0.6 < up / whole_gain < 0.7
    said = f"they end {up:.1f}% (Go1) and {other:.1f}% (ANYmal D) above PIDM random, the pretrained PIDM "
    assert said + f"{left:.1f}% and {rest:.1f}% above them" in text
    assert f"Shuffled weights bring Go1 {up:.1f}% (n = 2), pretrained ones {whole_gain:.1f}% on these seeds." in text


def test_words_on_orthogonal_weights_are_what_was_recorded():
    """What pretraining adds to them with 4096 environments."""
    text, adds = " ".join((report.ROOT / "results/README.md").read_text().split()), []
    for task in ("go1_loco", "anymal_loco"):
        runs = [recorded(task, f"pidm_{m}_orthogonal", "batch") for m in ("pretrained", "random")]
        assert [len(arm) for arm in runs] == [1, 1], "(n = 1 each)"
        adds.append(100 * (runs[0][:, -7:].mean() / runs[1][:, -7:].mean() - 1))
    assert "With 4096 (n = 1 each) it adds {:.1f}% on Go1 and {:.1f}% on ANYmal D.".format(*adds) in text


def test_words_on_the_mlp_are_what_was_recorded():
    """Against the pretrained PIDM in each task, and its mean gain without the largest one."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    above, sooner, gains = 0, 0, []
    for task in report.TASKS:
        loaded, mlp, random = (recorded(task, m) for m in ("pidm_pretrained", "mlp", "pidm_random"))
        ends = [arm[:, -max(arm.shape[1] // 20, 1) :].mean() for arm in (loaded, mlp, random)]
        reached = [[np.flatnonzero(run >= 0.9 * ends[2]) for run in arm] for arm in (loaded, mlp)]
        there = [np.mean([found[0] if len(found) else 1e9 for found in arm]) for arm in reached]
        above += ends[0] > ends[1] * (1 + 1e-9)
        sooner += there[0] < there[1]
        gains.append(100 * (ends[1] / ends[2] - 1))
    assert f"here it ends above it in {above} and is sooner in {sooner}" in text
    gains.remove(max(gains))
    assert f"({np.mean(gains):.1f}% without climbing up)" in text


def test_words_on_updates_are_what_was_recorded():
    """Mean change of the actor's backbone in the first 100 iterations, of the seeds that both methods have."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())

    def less(scale, task, method, against):
        runs, each = [{}, {}], (method, against)
        for name, found in zip(each, runs, strict=True):
            for path in (report.ROOT / f"results/study/{scale}/{task}/{name}").glob("seed*/metrics.csv"):
                rows = [row for row in csv.DictReader(path.read_text().splitlines()) if float(row["iteration"]) <= 100]
                found[path.parent.name] = np.mean([float(row["update/actor/backbone"]) for row in rows])
        seeds = runs[0].keys() & runs[1].keys()
        a, b = (np.mean([found[seed] for seed in seeds]) for found in runs)
        return f"{100 * (1 - a / b):.0f}%"

    both = ("anymal_loco", "go1_loco")
    shuffled = [less("cpu", task, "pidm_shuffled", "pidm_random") for task in both]
    loaded = [less("cpu", task, "pidm_pretrained", "pidm_shuffled") for task in both]
    orthogonal = [less("batch", task, "pidm_random_orthogonal", "pidm_random") for task in both]
    assert "by {} on ANYmal D and {} on Go1, pretrained".format(*shuffled) in text
    assert "pretrained ones by {} and {} more".format(*loaded) in text
    assert "do, too ({} and {}, n = 1)".format(*orthogonal) in text


def test_words_on_levels_are_what_was_recorded():
    """The mean action at the last level, 1 m, and in training."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    methods = ("pidm_random", "pidm_pretrained", "mlp")

    def last(task, method):
        result = json.loads((report.ROOT / f"results/study/{task}/{method}/seed0/eval.json").read_text())
        return f"{100 * result['level 9']['episode_success']:.0f}%"

    assert all(recorded("anymal_climb_down", m)[0, -1] == 1 for m in methods), "all three pass the last level"
    down = [last("batch/anymal_climb_down", m) for m in methods]
    assert "gets down from 1 m in {}, the pretrained one in {}, the MLP in {}.".format(*down) in text
    crouch = [last("batch/anymal_crouch", m) for m in ("mlp", "pidm_pretrained", "pidm_random")]
    assert "the MLP gets under a table of 0.4 m in {}, the pretrained PIDM in {}, the random".format(*crouch) in text
    assert crouch[2] == "0%" and "the random one in none." in text
    walk = [last("batch/anymal_parkour_walk", m) for m in ("pidm_pretrained", "pidm_random", "mlp")]
    assert "passes the last level in {}, the random one in {}, the MLP in {}.".format(*walk) in text
    jump = [last("cpu/anymal_jump", m) for m in ("pidm_pretrained", "pidm_random")]
    assert "gets over 1 m in {}, the random one in {};".format(*jump) in text


def test_words_on_climbing_up_are_what_was_recorded():
    """What mean actions do at each level, 0.1 m and 0.1 m more for each."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    folder, shares = report.ROOT / "results/study/batch/anymal_climb_up", {}
    for method in ("mlp", "pidm_random", "pidm_pretrained"):
        result = json.loads((folder / method / "seed0/eval.json").read_text())
        shares[method] = [result[f"level {level}"]["episode_success"] for level in range(10)]
        assert method == "mlp" or result["level 4"]["falls"] < 0.1 > shares[method][4], "they stand before 0.5 m"
    mlp, *pidms = shares.values()
    random, loaded = pidms
    said = f"the pretrained PIDM gets onto 0.3 m in {100 * loaded[2]:.0f}% and no higher, the random one onto 0.4 m in "
    assert said + f"{100 * random[3]:.0f}%; both" in text and max(loaded[3:]) == 0
    said = f"The MLP gets onto 0.4 m in {100 * mlp[3]:.0f}%, 0.5 m in {100 * mlp[4]:.0f}%"
    assert said in text and max(mlp[5:]) < 0.05
    (random,), (loaded,), (other,) = (recorded("anymal_climb_up", m) for m in ("pidm_random", "pidm_pretrained", "mlp"))
    for run in (random, loaded):
        assert {f"{x:.2f}" for x in run[42:]} <= {"0.33", "0.34"}  # a row every ten iterations
    assert "both PIDMs hardly rise from iteration 430 on (progress 0.33 to 0.34)" in text
    assert f"the MLP's still does ({other[-1]:.2f})" in text and other[-1] > other[42] * 1.2


@pytest.mark.parametrize("name", ["README.md", "results/README.md"])
def test_intervals_in_words_stand_in_a_table(name):
    """The tables are those of README.md and of the pages of results and runs."""
    names = ("README.md", "results/README.md", "results/study/README.md")
    pages = {page: (report.ROOT / page).read_text() for page in names}
    known = {pair for page in pages.values() for pair in re.findall(r"\[([+-][\d.]+), ([+-][\d.]+)\] \|", page)}
    words = re.sub(r"(intervals of .*?%) and ", r"\1, interval of ", " ".join(pages[name].split()))
    prose = "\n".join(line for line in pages[name].splitlines() if not line.startswith("|"))
    written = {pair for pair in re.findall(r"\[([+-][\d.]+),\s([+-][\d.]+)\]", prose)}
    assert written <= known, written - known
    found = re.findall(r"intervals? of ([+-]?[\d.]+) to ([+-]?[\d.]+)%", words)
    assert found or name == "README.md"
    known = np.array(sorted(known), float)
    for low, high in found:
        half = 0.5 * 0.1 ** len(high.partition(".")[2]) + 0.051  # tables are rounded to 0.1, the words once more
        off = np.abs(known - np.array([low, high], float)).max(-1).min()
        assert off <= half, f"no table has an interval of {low} to {high}%"


def test_words_on_the_batch_are_what_was_recorded():
    """Of both quadrupeds with 4096 environments, a row an iteration; in the project's README as well."""
    pages = [" ".join((report.ROOT / name).read_text().split()) for name in ("results/README.md", "README.md")]
    gains, fewer, medians, above = [], [], [], []
    for task in ("go1_loco", "anymal_loco"):
        arms = [recorded(task, m, "batch") for m in ("pidm_pretrained", "pidm_random", "mlp")]
        ends = [runs[:, -7:].mean(1) for runs in arms]
        reached = [[1 + np.argmax(run >= 0.9 * ends[1].mean()) for run in runs] for runs in arms]
        first = [np.mean(one) for one in reached]
        medians.append(100 * (1 - np.median(reached[0]) / np.median(reached[1])))
        gains.append(100 * (ends[0].mean() / ends[1].mean() - 1))
        above.append(100 * (ends[2].mean() / ends[1].mean() - 1))
        fewer.append(100 * (1 - first[0] / first[1]))
        assert [len(runs) for runs in arms] == [3, 3, 3], "(n = 3; ..."
        each = [f"{100 * (a / b - 1):.1f}%" for a, b in zip(*ends[:2], strict=True)]
        if task == "go1_loco":
            assert ends[0].min() > ends[1].max()
            continue
        first, second, late = (each[i].replace("-0.0", "0.0") for i in range(3))
        said = f"ANYmal D's gain is that of seed 2 (+{late}), whose random PIDM is the late one; seeds 0 and 1 end at "
        assert said + f"+{first} and {second}." in pages[0] and np.argmax(reached[1]) == 2
        two = 100 * (ends[0][:2].mean() / ends[1][:2].mean() - 1)
        assert f"all of it in seed 2: seeds 0 and 1 gain {two:.1f}%." in pages[0]
    assert "(n = 3; with 256" in pages[0]
    assert "every pretrained seed ends above every random one" in pages[0]
    assert f"{gains[0]:.1f}" == f"{gains[1]:.1f}" and f"ends {gains[0]:.1f}% higher on Go1 and on ANYmal D" in pages[0]
    said = "reaches 90% after {:.0f}% and {:.0f}% fewer iterations. By medians these are {:.0f}% and {:.0f}%:"
    assert said.format(*fewer, *medians) in pages[0]
    assert "ends {:.1f}% and {:.1f}% above PIDM random".format(*above) in pages[0]
    said = f"ends {gains[0]:.0f}% higher on both and reaches 90% in " + "{:.0f}% and {:.0f}% fewer"
    assert said.format(*fewer) in pages[1]
    assert "needs {:.0f}% fewer and ANYmal D's {:.0f}%".format(*fewer) in pages[1]


def whole(scale, task, method):
    """The evaluation of each recorded run."""
    paths = (report.ROOT / "results/study" / scale / task / method).glob("seed*/eval.json")
    return [json.loads(path.read_text()) for path in sorted(paths)]


def evaluations(scale, task, method):
    """What the mean action did at the end of each recorded run."""
    return [one["task"] for one in whole(scale, task, method)]


def test_words_on_noise_are_what_was_recorded():
    """Returns of mean actions with 4096 environments; those of small steps on the seeds that have them."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    methods = ("mlp", "pidm_random", "pidm_pretrained", "pidm_shuffled", "pidm_random_slow", "pidm_pretrained_slow")
    gains, found = [], {}
    for task in ("go1_loco", "anymal_loco"):
        of = {m: np.array([one["episode_return"] for one in evaluations("batch", task, m)]) for m in methods}
        means = {m: each.mean() for m, each in of.items() if len(each)}
        mlp, random, loaded, slow, loaded_slow = (means[m] for m in methods if m != "pidm_shuffled")
        pairs = (loaded, random), (mlp, random), (slow, of["pidm_random"][:2].mean()), (loaded_slow, slow)
        gains.append([f"{100 * (a / b - 1):.1f}%" for a, b in pairs])
        found[task] = of
    go1, anymal_d = gains
    assert f"return {go1[0]} (Go1) and {anymal_d[0]} (ANYmal D) more than PIDM random's" in text
    assert f"the MLP's {go1[1]} and {anymal_d[1]}." in text
    assert f"by {go1[2]} and {anymal_d[2]}, and leave the pretrained one's {go1[3]} and {anymal_d[3]} above" in text
    best = [found["go1_loco"].pop(m).min() for m in ("pidm_pretrained", "pidm_pretrained_slow")]
    others = [*found["go1_loco"], "pidm_random_orthogonal", "pidm_pretrained_orthogonal"]
    others = [one["episode_return"] for m in others for one in evaluations("batch", "go1_loco", m)]
    assert min(best) > max(others), "above all other runs"
    lagging = found["anymal_loco"].pop("pidm_random").max()
    assert lagging < min(each.min() for each in found["anymal_loco"].values()), "only PIDM random lags"
    stds = {m: [run[-1]["action_std"] for run in runs] for m, runs in rows_of("batch").items()}
    few = [np.mean(stds.pop(m)) for m in ("mlp", "pidm_random_slow")]
    others = [std for each in stds.values() for std in each]
    said = "is {:.2f} (MLP), {:.2f} (PIDM random, small steps) or {:.2f} to {:.2f} (others)"
    assert said.format(*few, min(others), max(others)) in text


def test_words_on_gaits_are_what_was_recorded():
    """Go1 with 4096 environments: all runs of pretrained PIDMs with PyTorch's other weights against all others."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())

    def gaits(*methods, scale="batch"):
        found = [
            p for m in methods for p in (report.ROOT / f"results/study/{scale}/go1_loco/{m}").glob("seed*/eval.json")
        ]
        return [json.loads(path.read_text())["gait"] for path in sorted(found)]

    loaded = gaits("pidm_pretrained", "pidm_pretrained_slow")
    others = gaits("mlp", "pidm_random", "pidm_random_slow", "pidm_shuffled")
    assert (len(loaded), len(others)) == (5, 10)
    lift, slip = (
        [f(run[name] for run in runs) for runs in (loaded, others) for f in (min, max)]
        for name in ("clearance", "slip")
    )
    assert lift[0] > lift[3] and slip[1] < slip[2]
    said = "lift their feet by {:.1f} to {:.1f} mm and slip {:.3f} to {:.3f} m a metre; all ten of MLPs, random "
    said += "and shuffled PIDMs {:.1f} to {:.1f} mm and {:.3f} to {:.3f}."
    lift = [1000 * x for x in lift]
    assert said.format(*lift[:2], *slip[:2], *lift[2:], *slip[2:]) in text
    few = [gaits(f"pidm_{m}", scale="256") for m in ("pretrained", "random")]
    few = [1000 * np.mean([run["clearance"] for run in runs]) for runs in few]
    assert "With 256 (n = 2) it is {:.0f} against {:.0f} mm.".format(*few) in text
    arms = ("pidm_pretrained", "pidm_random", "mlp", "pidm_pretrained_slow", "pidm_random_slow")
    falls = [sum(run["push of 1.0 m/s/falls"] for run in gaits(m)) for m in arms]
    said = "fells Go1's pretrained PIDM in {:.0f} of 120 episodes, PIDM random in {:.0f}, the MLP in {:.0f}; "
    assert (said + "with small steps in {:.0f} of 80, PIDM random in {:.0f}.").format(*falls) in text
    feet = [1000 * one["gait"]["clearance"] for m in arms[:2] for one in whole("batch", "anymal_loco", m)]
    said = f"less than random ones, {min(feet[:3]):.0f} to {max(feet[:3]):.0f} and not {min(feet[3:]):.0f} to "
    assert said + f"{max(feet[3:]):.0f} mm." in text
    pair = [1000 * gaits(f"pidm_{m}_orthogonal")[0]["clearance"] for m in ("pretrained", "random")]
    assert "With orthogonal weights (n = 1) it is {:.0f} against {:.0f} mm at equal slip".format(*pair) in text


def test_words_on_feet_and_first_actions_are_what_was_recorded():
    """Pedipulation's mean action, and both walks with 256 environments and small first actions."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    feet, falls = (
        [np.mean([run[name] for run in evaluations("cpu", "anymal_pedipulation", m)]) for m in methods]
        for methods in [("pidm_pretrained", "pidm_random")]
        for name in ("foot_error", "falls")
    )
    assert "{:.2f} against {:.2f} m; its falls, ".format(*feet) in text
    assert "its falls, {:.0f}% and not {:.0f}%,".format(*(100 * share for share in falls)) in text
    gains, later, counts = [], [], []
    for task in ("go1_loco", "anymal_loco"):
        arms = [recorded(task, f"pidm_{m}", "256") for m in ("pretrained", "random")]
        counts.append(len(arms[0]))
        final = [arm[:, -4:].mean() for arm in arms]
        there = [np.mean([1 + np.argmax(run >= 0.9 * final[1]) for run in arm]) for arm in arms]
        gains.append(100 * (final[0] / final[1] - 1))
        later.append(100 * (there[0] / there[1] - 1))
    assert counts == [2, 2]
    said = f"with small ones (n = 2) Go1 gains {gains[0]:.1f}% after {later[0]:.0f}% more iterations, "
    assert said + f"ANYmal D {gains[1]:.1f}% after {-later[1]:.0f}% fewer." in text
    assert f"and {gains[1]:.1f}% with small first actions (n = {counts[1]})" in text
    said = f"{gains[1]:.0f}% higher, in {-later[1]:.0f}% fewer (n = {counts[1]}). Go1 ends alike; scaled down it "
    assert said + f"needs {later[0]:.0f}% more." in " ".join((report.ROOT / "README.md").read_text().split())
    small, large = (recorded("anymal_loco", "pidm_random", scale)[:2, -4:].mean(1) for scale in ("256", "cpu"))
    changes = 100 * (small / large - 1)
    assert "by {:+.0f}% and {:+.0f}% on ANYmal D (seeds 0 and 1)".format(*changes) in text


def rows_of(scale):
    """Rows of all runs of the walking quadrupeds at a scale, by method, those of Go1 first."""
    found = {}
    for task in ("go1_loco", "anymal_loco"):
        for path in sorted((report.ROOT / "results/study" / scale / task).glob("*/seed*/metrics.csv")):
            with path.open() as file:
                rows = [{name: float(x) for name, x in row.items()} for row in csv.DictReader(file)]
            found.setdefault(path.parts[-3], []).append(rows)
    return found


def test_words_on_critics_are_what_was_recorded():
    """With 4096 environments the critic of every random PIDM breaks once, early, and of no other run but one."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    large = rows_of("batch")
    assert f"make {max(len(run) for runs in large.values() for run in runs)} of Isaac Lab's 300 iterations" in text
    jumps = {
        method: [max(row["critic_grad_norm"] for row in run[:10]) for run in runs] for method, runs in large.items()
    }
    random = jumps.pop("pidm_random")
    others = max(max(found) for found in jumps.values())
    assert len(random) == 6 and min(random) > 3 * others
    said = "the norm of its gradient jumps to {:.0f} to {:.0f}, and to {:.1f} at most"
    assert said.format(min(random), max(random), others) in text
    late = sorted(run[29]["explained_variance"] for runs in large.values() for run in runs)[:3]
    shares = [f"{100 * share:.0f}%" for share in late]
    assert (
        "critic explains {} (Go1) and {} of the variance of returns at iteration 30, all others {} or".format(*shares)
        in text
    )
    worst = [max(found) for found in (random[:3], random[3:])]
    assert [large["pidm_random"][random.index(x)][29]["explained_variance"] for x in worst] == late[:2]
    small = large["pidm_pretrained"]
    assert max(row["lr"] for run in small for row in run) < 0.008
    loaded = large["pidm_pretrained"][3:]  # ANYmal D's
    half = [next(i for i, row in enumerate(run) if row["episode_return"] > 13) for run in loaded]
    assert others == max(jumps["pidm_pretrained"][3:]) and np.argmax(half) == np.argmax(jumps["pidm_pretrained"][3:])
    small = [rows_of("cpu"), rows_of("256")]
    most = max(row["lr"] for scale in small for runs in scale.values() for run in runs for row in run)
    assert f"limit of 0.01 (with 256 to {most:.3f})" in text


def test_words_on_small_steps_are_what_was_recorded():
    """Of the seeds that have them, against the same seeds; 50% and 90% are those of PIDM random with small steps."""
    text = " ".join((report.ROOT / "results/README.md").read_text().split())
    ends, fewer, beyond, later, half = [], [], [], [], []
    for task in ("go1_loco", "anymal_loco"):
        slow, loaded, large = (
            recorded(task, f"pidm_{m}", "batch") for m in ("random_slow", "pretrained_slow", "random")
        )
        assert len(slow) == len(loaded) == 2, "(n = 2 each)"
        last = [runs[: len(slow), -7:].mean() for runs in (slow, loaded, large)]
        there = [
            [np.mean([1 + np.argmax(run >= share * last[k]) for run in runs[: len(slow)]]) for runs in arms]
            for share, k, arms in ((0.9, 2, (slow, large)), (0.9, 0, (loaded, slow)), (0.5, 0, (loaded, slow)))
        ]
        ends.append(100 * (last[0] / last[2] - 1))
        fewer.append(100 * (1 - there[0][0] / there[0][1]))
        beyond.append(100 * (last[1] / last[0] - 1))
        later.append(100 * (there[1][0] / there[1][1] - 1))
        half += there[2]
    slow, large = (rows_of("batch")[f"pidm_random{kind}"] for kind in ("_slow", ""))
    jumps = [[max(row["critic_grad_norm"] for row in run[:10]) for run in runs] for runs in (slow, large)]
    orthogonal = rows_of("batch")["pidm_random_orthogonal"]
    assert len(orthogonal) == 2, "(n = 1), on both robots"
    jumps[0] += [max(row["critic_grad_norm"] for row in run[:10]) for run in orthogonal]
    assert max(jumps[0]) < min(jumps[1]) / 10, "the critic stays whole, as with orthogonal weights (n = 1)"
    assert "ends {:.1f}% (Go1) and {:.1f}% (ANYmal D) higher".format(*ends) in text
    assert "after {:.0f}% and {:.0f}% fewer iterations. The pre".format(*fewer) in text
    assert f"ends {-beyond[0]:.1f}% and {-beyond[1]:.1f}% below that" in text
    assert min(later) > 0 and max(later) < 2.5 and "with at most 2% more iterations to 90%" in text
    go1, anymal_d = ([f"{x:.0f}" for x in half[i : i + 2]] for i in (0, 2))
    assert (
        f"50% of that it takes {go1[0]} iterations on Go1, not {go1[1]}; on ANYmal D both take {anymal_d[0]}." in text
    )
    assert anymal_d[0] == anymal_d[1]


def test_other_pages_are_what_their_records_give(monkeypatch):
    pages = {}
    monkeypatch.setattr(records, "replace_text", lambda path, text: pages.update({path: text}))
    pidm.write_readme()
    bench.write_page(report.ROOT / "results/bench")
    assert len(pages) == 2 and all(path.read_text() == text for path, text in pages.items())


def test_report_writes_the_same_bytes_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "STUDY", tmp_path)
    study = {"go1_loco": tables.load_task(report.ROOT / "results/study/cpu/go1_loco")}
    images = []
    for _ in range(2):
        report.draw_all({"cpu": study})
        images.append({path.name: path.read_bytes() for path in tmp_path.iterdir()})
    assert images[0] == images[1]
    assert {*images[0]} == {f"{name}.{kind}" for name in ("curves", "controls", "sizes") for kind in ("png", "svg")}


def test_figures_of_parkour_and_updates_are_drawn(tmp_path, monkeypatch):
    """A single seed, three methods; and that a figure goes once the runs no longer allow it."""
    monkeypatch.setattr(report, "STUDY", tmp_path)
    names = ("anymal_jump", "anymal_pedipulation")
    study = {name: tables.load_task(report.ROOT / f"results/study/cpu/{name}") for name in names}

    def drawn(study):
        report.draw_all({"cpu": study})
        return sorted(path.name for path in tmp_path.iterdir())

    names = ("curves", "success", "sizes", "updates")
    assert drawn(study) == sorted(f"{name}.{kind}" for name in names for kind in ("png", "svg"))
    assert drawn({"anymal_jump": study["anymal_jump"]}) == sorted(
        f"{name}.{kind}" for name in names[:3] for kind in ("png", "svg")
    )


def test_each_table_takes_the_scale_that_has_most_of_its_methods():
    """A scale under way does not replace one that is as complete or has several seeds; it does with two of its own.

    Catches runs of two scales in one row, controls that vanish while Table I moves to another scale, and a single seed
    in the place of five.
    """
    small = {method: flat(1.0, 1.0, 1.0) for method in (*report.TABLE_1, "pidm_shuffled")}
    large = {method: flat(2.0, 2.0) for method in report.TABLE_1[1:]}
    loaded = {"cpu": {"go1_loco": small, "g1_loco": small}, "batch": {"go1_loco": large}}
    assert report.pick(loaded) == {"go1_loco": small, "g1_loco": small}
    large["mlp"] = flat(3.0)
    assert report.pick(loaded)["go1_loco"] is small
    large["mlp"] = flat(3.0, 3.0)
    assert report.pick(loaded)["go1_loco"] is large and report.pick(loaded)["g1_loco"] is small
    assert report.pick(loaded, ("pidm_random", "pidm_shuffled"))["go1_loco"] is small


def test_what_pretraining_brings_is_drawn_over_the_batch(tmp_path):
    """A row and a panel a scale, those of 256 environments apart by their initial weights; one batch is no figure."""

    def arms(num_envs, *ends):
        settings = {"settings": {"num_envs": num_envs, "num_steps": 24}}
        both = {"pidm_random": flat(10.0, 11.0), "pidm_pretrained": flat(*ends)}
        return {"go1_loco": {method: [run | settings for run in runs] for method, runs in both.items()}}

    loaded = {"cpu": arms(256, 9.0, 10.0), "256": arms(256, 10.0, 10.0), "batch": arms(4096, 12.0, 13.0)}
    loaded["batch"]["anymal_loco"] = {"pidm_random": flat(1.0)}  # not both PIDMs
    assert drawing.draw_batch(loaded, tmp_path / "batch.png") and (tmp_path / "batch.png").stat().st_size > 5000
    _, _, *rows = [re.split(r" ?\| ?", line) for line in tables.batches_table(loaded)]
    expected = [
        ("256 x 24", "pytorch_unscaled", "-9.5 "),
        ("256 x 24", "pytorch", "-4.8 "),
        ("4096 x 24", "pytorch", "+19.0"),
    ]
    assert [(row[2], row[3], row[5][:5]) for row in rows] == expected
    titled = drawing.curves_by_scale(loaded)
    assert [*titled] == [f"Go1 locomotion, {x}" for x in ("256 x 24, unscaled", "256 x 24", "4096 x 24")]
    assert [runs["pidm_pretrained"][0]["indicator"][0] for runs in titled.values()] == [9.0, 10.0, 12.0]
    one_batch = {"cpu": loaded["cpu"], "256": loaded["256"]}
    assert not drawing.draw_batch(one_batch, tmp_path / "none.png") and not (tmp_path / "none.png").exists()
    assert tables.batches_table({"batch": loaded["batch"]}) == ["One batch so far."]
    assert not drawing.curves_by_scale({"batch": loaded["batch"]})
    assert not drawing.draw_critics({"g1_loco": loaded["batch"]["go1_loco"]}, tmp_path / "none.png")


@pytest.fixture
def study(tmp_path):
    """Two methods of one seed each."""
    args = {"num_envs": 2, "num_steps": 5, "total_steps": 40, "lr": 1.0, "num_epochs": 5, "mirror_coef": 0.1}
    args |= {"config": {}, "seed": 0, "versions": {"machine": "m"}}
    for method in ("mlp", "pidm_random"):
        folder = tmp_path / method / "seed0"
        folder.mkdir(parents=True)
        (folder / "args.json").write_text(json.dumps(args))
        task = {"episode_return": 9.0, "lin_vel_error": 0.1, "falls": 0.0}
        (folder / "eval.json").write_text(json.dumps({"task": task}))
        rows = [f"{i},{10 * i},{i},0.1,0.5,{2.0 * i}" for i in range(1, 5)]
        names = "iteration,env_steps,seconds,lr,action_std,episode_return"
        (folder / "metrics.csv").write_text("\n".join([names, *rows]) + "\n")
    return tmp_path, args


def test_bad_runs_are_left_out_with_a_warning(study, capsys):
    folder, args = study
    assert set(tables.load_task(folder)) == {"mlp", "pidm_random"} and not capsys.readouterr().err
    shutil.copytree(folder / "mlp/seed0", folder / "mlp/seed0.old")
    assert len(tables.load_task(folder)["mlp"]) == 1, "put away, not another seed"
    target = folder / "pidm_random/seed0"
    (target / "args.json").write_text(json.dumps(args | {"lr": 2.0}))
    assert set(tables.load_task(folder)) == {"mlp"}
    assert "other settings" in capsys.readouterr().err
    (target / "args.json").write_text(json.dumps(args))
    half = (target / "metrics.csv").read_text().splitlines()
    (target / "metrics.csv").write_text("\n".join([half[0], *half[2::2]]) + "\n")
    assert set(tables.load_task(folder)) == {"mlp"}
    assert "other settings" in capsys.readouterr().err, "rows of other iterations have no mean curve"
    (target / "metrics.csv").write_text("\n".join(half) + "\n")
    (target / "args.json").write_text(json.dumps(args | {"total_steps": 50}))
    assert set(tables.load_task(folder)) == {"mlp"}
    assert "stopped before its last step" in capsys.readouterr().err
    (target / "args.json").write_text(json.dumps(args))
    text = (target / "metrics.csv").read_text()
    (target / "metrics.csv").write_text(text[:-5] + "\n")
    assert set(tables.load_task(folder)) == {"mlp"}
    assert "left out" in capsys.readouterr().err


def test_success_by_level_is_a_mean_over_runs_of_the_same_levels(study, capsys, monkeypatch, tmp_path):
    folder, args = study
    result = {f"level {i}": {"episode_success": share} for i, share in enumerate((1.0, 0.5))}
    for seed, last in ((0, 0.5), (1, 0.0)):
        target = folder / f"mlp/seed{seed}"
        shutil.copytree(folder / "pidm_random/seed0", target, dirs_exist_ok=True)
        (target / "args.json").write_text(json.dumps(args | {"seed": seed}))
        result["level 1"]["episode_success"] = last
        (target / "eval.json").write_text(json.dumps(result))
    runs = tables.load_task(folder)
    assert list(runs) == ["mlp"] and "other settings" in capsys.readouterr().err  # PIDM random was run on no level
    assert drawing.success_of(runs["mlp"]).tolist() == [100.0, 25.0]
    assert drawing.draw_success({"anymal_jump": runs}, tmp_path / "success.png")


def test_without_a_baseline_there_is_no_level_to_reach(study):
    runs = tables.load_task(study[0])
    assert "no PIDM random" not in "".join(tables.progress_table({"go1_loco": runs}))
    alone = tables.progress_table({"go1_loco": {"mlp": runs["mlp"]}})[-1]
    assert alone.count("no PIDM random") == 2 and "not reached" not in alone


def test_indicator_of_parkour_is_the_level_reached(study, capsys):
    """Older rows have levels solved alone, which are their indicator; newer ones have these in a column."""
    folder, _ = study
    for method, columns, values in (
        ("mlp", "progress,progress_reached", "0.25,0.5"),
        ("pidm_random", "progress", "0.125"),
    ):
        path = folder / method / "seed0/metrics.csv"
        names, *rows = path.read_text().splitlines()
        path.write_text("\n".join([f"{names},{columns}", *(f"{row},{values}" for row in rows)]) + "\n")
    assert list(tables.load_task(folder)) == ["mlp"] and "other settings" in capsys.readouterr().err
    runs = {m: [tables.load_run(folder / m / "seed0")] for m in ("mlp", "pidm_random")}
    assert {method: set(arm[0]["indicator"]) for method, arm in runs.items()} == {"mlp": {0.5}, "pidm_random": {0.125}}
    table = tables.progress_table({"anymal_jump": runs})
    assert "solved at the end" in table[0] and "| 0.25 |" in table[2] and "|  |" in table[3]
    assert "solved" not in tables.progress_table({"anymal_jump": {"pidm_random": runs["pidm_random"]}})[0]


def test_sizes_are_those_that_were_pretrained_on(tmp_path, monkeypatch):
    folder = tmp_path / "pidm"
    monkeypatch.setattr(report, "PARTS", folder)
    (folder / "sizes").mkdir(parents=True)
    for stem, samples, error in (("sizes/7000_", 7000, 0.9), ("sizes/70000_", 70000, 0.6), ("", 920000, 0.3)):
        (folder / f"{stem}validation.json").write_text(json.dumps({"error_rad": error, "normalized_error": 2 * error}))
        (folder / f"{stem}metrics.csv").write_text(f"iteration,samples\n1.0,{samples}.0\n2.0,{2 * samples}.0\n")
    assert tables.sizes_of(folder) == {7000: 0.9, 70000: 0.6, 920000: 0.3}
    run = {"pidm_random": flat(10.0, 11.0), "pidm_7k": flat(9.0, 9.5), "pidm_pretrained": flat(12.0, 13.0)}
    study = {"anymal_climb_up": run, "anymal_climb_down": run}
    assert drawing.draw_sizes(study, tmp_path / "sizes.png", tables.sizes_of(folder), 920000)
    assert drawing.draw_sizes({}, tmp_path / "errors.png", tables.sizes_of(folder), 920000)
    both, errors = (matplotlib.image.imread(tmp_path / f"{name}.png").shape[1] for name in ("sizes", "errors"))
    assert both == 2 * errors  # no empty panel where no task was run with them
    lines = report.sizes(study, report.titles("sizes"), tuple(study))
    assert "Error by number of transitions: 0.900 rad (7,000), 0.600 rad (70,000), 0.300 rad (920,000)." in lines
    line, _, figure = report.sizes({}, report.titles("sizes"), tuple(study))
    assert line.endswith("(920,000). No task was run with the smaller sets yet.") and "sizes.png" in figure


def test_what_has_not_run_is_named():
    """Below Table II the sizes; a table where one of its methods has run, else which have not."""
    runs = {"pidm_random": flat(10.0), "pidm_actor": flat(12.0)}
    loaded = {"batch": {"anymal_climb_up": runs, "anymal_climb_down": runs}}
    names = "actor only; PIDM pretrained, critic only"
    error, _, figure, _, line = report.table_2({})
    assert names in line and error.endswith("No task was run with the smaller sets yet.") and "sizes.png" in figure
    *table, error, _, _ = report.table_2(loaded)
    assert "+20.0" in "".join(table) and error.startswith("Error by number of transitions") and names not in str(table)


def test_comparisons_across_machines_have_a_star():
    """A CPU is cpu:0 in older records, and cpu in newer ones."""

    def star(*devices):
        methods = ("pidm_random", "pidm_shuffled")
        runs = {
            m: [run | {"versions": {"device": d}} for run in flat(9.0)] for m, d in zip(methods, devices, strict=True)
        }
        return "*" in tables.controls({"cpu": {"go1_loco": runs}})[-1]

    assert [star("cpu", "cpu:0"), star("cpu", "cuda:0"), star("NVIDIA H200", "cuda:0")] == [False, True, False]


def test_gait_is_a_mean_over_the_seeds_of_which_it_was_measured(study):
    folder, args = study
    for seed, falls in ((0, 4.0), (1, 8.0), (2, None)):
        target = folder / f"mlp/seed{seed}"
        shutil.copytree(folder / "pidm_random/seed0", target, dirs_exist_ok=True)
        (target / "args.json").write_text(json.dumps(args | {"seed": seed}))
        gait = dict.fromkeys(tables.GAIT, 0.5) | {"episodes": 20.0, "push of 1.0 m/s/episodes": 5.0, "falls": falls}
        gait["slip"] = 0.5 if seed else None  # it fell too early
        (target / "eval.json").write_text(json.dumps({"task": {}} | ({} if falls is None else {"gait": gait})))
    *_, row = tables.gait_table({"go1_loco": tables.load_task(folder)})
    assert row == "| Go1 locomotion | MLP | 2 | 0.3 | 0.1 | 0.5 | 0.5 | 0.5 | 0.5 | 0.5 |"


def test_runs_of_a_task_are_compared(study, capsys):
    """Of any task, before they were evaluated: the baseline ends at 8, PIDM pretrained at 10 with twice the mean."""
    folder, _ = study
    shutil.copytree(folder / "pidm_random/seed0", folder / "pidm_pretrained/seed0")
    for path in folder.glob("*/*/eval.json"):
        path.unlink()
    path = folder / "pidm_pretrained/seed0/metrics.csv"
    path.write_text(path.read_text().replace(",2.0\n", ",10.0\n").replace(",8.0\n", ",10.0\n"))
    report.main(report.Args(compare=str(folder)))
    out = capsys.readouterr().out
    assert "| PIDM pretrained | +25.0 | +50.0 | -50.0 | -75.0 |" in out and folder.name in out
    assert "| PIDM random | +0.0" not in out
    (folder / "mlp").rename(folder / "pidm")
    report.main(report.Args(compare=str(folder)))
    assert "pidm left out: methods are mlp," in capsys.readouterr().err
    assert (folder / "curves.png").stat().st_size > 10_000
    with pytest.raises(records.UserError, match="no complete runs"):
        report.main(report.Args(compare=str(folder / "pidm_random")))


def test_a_task_of_one_s_own_leaves_the_paper_s_numbers_where_they_are():
    runs = {"pidm_random": flat(10.0), "pidm_pretrained": flat(12.0), "mlp": flat(9.0)}
    study = {"go1_stand": runs, "go1_loco": runs}
    rows = tables.table_1(study, tuple(study))
    assert "+0.6" not in rows[2] and "| go1_stand |" in rows[2] and "+0.6" in rows[3]
    assert "| +20.0 | +3.6 |" in rows[4], "the mean of the paper is of its own tasks"


def test_live_draws_until_the_run_is_over(tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(report.ROOT / "results/tasks/go1_loco", run)
    (run / "curve.png").unlink()
    report.main(report.Args(live=str(run)))
    assert (run / "curve.png").stat().st_size > 10_000 and "14.06 of 14.00 M steps" in capsys.readouterr().out
    (run / "metrics.csv").write_text("env_steps\n")
    with pytest.raises(records.UserError, match="has no rows"):
        report.main(report.Args(live=str(run)))


def test_a_run_is_drawn_beside_the_recorded_ones(tmp_path, capsys):
    shutil.copytree(report.ROOT / "results/tasks/go1_loco", tmp_path / "run")
    report.main(report.Args(beside=str(tmp_path / "run")))
    picture = tmp_path / "run/beside_recorded.png"
    assert picture.stat().st_size > 10_000 and f"wrote {picture}" in capsys.readouterr().out
    with pytest.raises(records.UserError, match=r"is not a run of ppo_finetune\.py"):
        report.main(report.Args(beside=str(tmp_path)))
    (tmp_path / "run").rename(tmp_path / "seed0")
    with pytest.raises(records.UserError, match=f"holds several seeds; give one, such as {tmp_path}/seed0"):
        report.main(report.Args(beside=str(tmp_path)))


def test_live_draws_a_run_of_stage_1(tmp_path):
    """A collection has no args.json among the recorded files; its meta.json holds the arguments."""
    folder = report.ROOT / "results/pidm/go1/explore"
    args = json.loads((folder / "meta.json").read_text())["args"]
    (tmp_path / "args.json").write_text(json.dumps(args))
    shutil.copy(folder / "metrics.csv", tmp_path)
    report.main(report.Args(live=str(tmp_path)))
    assert (tmp_path / "curve.png").stat().st_size > 10_000


def test_levels_of_a_recorded_task_are_drawn(tmp_path):
    shutil.copytree(report.ROOT / "results/tasks/anymal_jump", tmp_path / "anymal_jump")
    (tmp_path / "anymal_jump/levels.png").unlink()
    tasks.draw_levels(tmp_path / "anymal_jump")
    assert (tmp_path / "anymal_jump/levels.png").stat().st_size > 5000
