"""Measures of recorded runs against PIDM random, and their statistics over seeds and over tasks.

A run is a dict with `indicator` (R,) and `iteration` (R,), one entry a row of metrics.csv, and `errors`, the figures of
its evaluation. An arm is the list of the runs of one method, its seeds. Changes are in percent of PIDM random's arm,
the baseline.

Intervals are BCa bootstrap intervals of 95% (Efron 1987; scipy.stats.bootstrap), asked for at a higher level so that
they come as near to Student's as resamples can: a resample of n seeds has only (n - 1) / n of their variance, and its
quantiles are normal, not t (Hesterberg 2015, "expanded percentile interval"). With normal seeds of equal variance they
cover 95% at five seeds and 90% at three, where plain ones cover 88% and 81%; at two seeds 67%, for no resample reaches
beyond the extreme seeds.
"""

import warnings
import zlib
from dataclasses import dataclass

import numpy as np
from scipy import stats

DRAWS = 9_999  # bootstrap resamples
EARLY = 100  # iterations of the paper's Fig. 7


@dataclass(frozen=True)
class Measure:
    """One figure of a run."""

    title: str
    share: float | None = None  # of the baseline's final performance, a goal: the figure is the iterations to it
    rows: int = 1  # whose trailing mean has to reach the goal


MEASURES = {
    "final": Measure("final performance"),
    "area": Measure("mean of the training"),
    "mean action": Measure("return of the mean action at the end, without exploration noise"),
    "to 50%": Measure("iterations to 50%", 0.5),
    "to 90%": Measure("iterations to 90%", 0.9),
    "to 90%, smooth": Measure("iterations to 90%, mean of five rows", 0.9, 5),
}


@dataclass(frozen=True)
class Estimate:
    """A figure in percent with its interval, None if the seeds give none.

    bound: "", or a sign if runs that never reached their goal count by their length: "≥" the method's, "≤" the
    baseline's, "~" both.
    """

    value: float
    interval: tuple[float, float] | None = None
    bound: str = ""

    def __str__(self):
        ends = "" if self.interval is None else f" [{self.interval[0]:+z.1f}, {self.interval[1]:+z.1f}]"
        return f"{self.bound} {self.value:+z.1f}{ends}".strip()


# --- Measures ---


def final(run):
    """Mean indicator of the last 5% of rows."""
    return np.nanmean(run["indicator"][-max(len(run["indicator"]) // 20, 1) :])


def late_gain(run):
    """Share of the final performance gained in the last third of the training: near 0 once the curve is flat."""
    rows = len(run["indicator"])
    end, width = max(2 * rows // 3, 1), max(rows // 20, 1)
    return 1 - np.nanmean(run["indicator"][end - width : end]) / final(run)


def area(run):
    """Mean indicator over the whole training."""
    return np.nanmean(run["indicator"])


def evaluated(run):
    """Return of the mean action in the run's evaluation; NaN if it has none, as in tasks with levels."""
    return run.get("errors", {}).get("episode_return", np.nan)


def iterations_to(run, goal, rows=1):
    """First iteration at which the trailing mean of `rows` indicators is at least `goal` (...); NaN if never."""
    rows = min(rows, len(run["indicator"]))
    level = np.convolve(run["indicator"], np.ones(rows) / rows, "valid")
    best = np.maximum.accumulate(np.nan_to_num(level, nan=-np.inf))
    return np.append(run["iteration"][rows - 1 :], np.nan)[np.searchsorted(best, goal)]


def goal_of(baseline):
    """Final performance of an arm, whose shares are goals."""
    return np.mean([final(run) for run in baseline])


def values(name, arm, goal):
    """A measure of each run of an arm, (..., K), for a baseline that ends at `goal` (...). NaN: goal not reached."""
    measure = MEASURES[name]
    if measure.share is not None:
        return np.stack([iterations_to(run, measure.share * goal, measure.rows) for run in arm], -1)
    each = np.array([{"final": final, "area": area, "mean action": evaluated}[name](run) for run in arm])
    return np.broadcast_to(each, (*np.shape(goal), len(arm)))


def counted(name, arm, goal):
    """`values`, where a run that never reached its goal counts by its length."""
    found = values(name, arm, goal)
    if MEASURES[name].share is None:
        return found
    return np.where(np.isnan(found), [run["iteration"][-1] for run in arm], found)


def bound(name, arm, baseline):
    """Sign of an `Estimate` that counts runs by their length."""
    goal = goal_of(baseline)
    mine, theirs = (np.isnan(values(name, runs, goal)).any() for runs in (arm, baseline))
    return {(False, False): "", (True, False): "≥", (False, True): "≤", (True, True): "~"}[bool(mine), bool(theirs)]


def change(name, arm, baseline, i, j):
    """Change [%] of the mean of runs i (..., n) of an arm against runs j (..., m) of the baseline, (...).

    The goal is that of the same runs j.
    """
    shape = np.broadcast_shapes(i.shape[:-1], j.shape[:-1])
    i, j = (np.broadcast_to(index, (*shape, index.shape[-1])) for index in (i, j))
    goal = np.array([final(run) for run in baseline])[j].mean(-1)
    means = [
        np.take_along_axis(counted(name, runs, goal), index, -1).mean(-1) for runs, index in ((arm, i), (baseline, j))
    ]
    return 100 * (means[0] / means[1] - 1)


def early_ratio(name, arm, baseline):
    """Mean of a column over the first iterations and over runs, as a multiple of the baseline's."""
    means = [
        np.mean([run["columns"][name][run["iteration"] <= EARLY].mean() for run in runs]) for runs in (arm, baseline)
    ]
    return means[0] / means[1]


def seeds(runs, methods):
    """Number of seeds of each of these methods, or one number if they agree."""
    counts = [len(runs.get(method, ())) for method in methods]
    return str(counts[0]) if len(set(counts)) == 1 else " / ".join(map(str, counts))


# --- Statistics ---


def level(sizes, confidence=0.95):
    """Confidence to ask of a bootstrap of samples of these sizes, so that normal ones get Student's interval."""
    n, freedom = min(sizes), sum(sizes) - len(sizes)
    return 1 - 2 * stats.norm.sf(np.sqrt(n / (n - 1)) * stats.t.ppf((1 + confidence) / 2, freedom))


def interval(statistic, samples, *names):
    """BCa interval of statistic(*samples, axis=-1); None if a sample has one entry or nothing varies.

    Draws depend on `names` alone, so that those of two tasks are independent, and a report is the same each time.
    """
    sizes = [len(sample) for sample in samples]
    if min(sizes) < 2:
        return None
    rng = np.random.default_rng(zlib.crc32("/".join(names).encode()))
    options = {"n_resamples": DRAWS, "vectorized": True, "axis": -1, "confidence_level": level(sizes)}
    with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        found = stats.bootstrap(samples, statistic, rng=rng, method="BCa", **options)
    if np.ptp(found.bootstrap_distribution) == 0:
        return None
    ends = found.confidence_interval
    if np.isnan([ends.low, ends.high]).any():  # no acceleration, as where leaving a run out changes nothing
        tail = (1 - options["confidence_level"]) / 2
        return tuple(np.quantile(found.bootstrap_distribution, (tail, 1 - tail)).tolist())
    return float(ends.low), float(ends.high)


def compare(task, runs, method, name, against="pidm_random"):
    """Estimate of a method's change [%] in one measure on one task (method -> arm); None if one of both has none."""
    if method not in runs or against not in runs:
        return None
    arm, baseline = runs[method], runs[against]
    if name == "mean action" and np.isnan([evaluated(run) for run in arm + baseline]).any():
        return None
    samples = [np.arange(len(one)) for one in (arm, baseline)]

    def statistic(i, j, axis=-1):
        return change(name, arm, baseline, i, j)

    return Estimate(float(statistic(*samples)), interval(statistic, samples, task, method), bound(name, arm, baseline))


def bound_of(signs):
    """Sign of a mean of estimates of these signs."""
    signs = {*signs} - {""}
    return signs.pop() if len(signs) == 1 else "~" if signs else ""


def same_seeds(runs, *methods):
    """Arms of these methods with the seeds that all of them have; no arms if there is no such seed."""
    common = set.intersection(*({run["seed"] for run in runs.get(method, ())} for method in methods))
    return {method: [run for run in runs[method] if run["seed"] in common] for method in methods} if common else {}


def several(study, method):
    """Tasks on which both a method and PIDM random have two seeds or more."""
    return [task for task, runs in study.items() if min(len(runs.get(m, ())) for m in (method, "pidm_random")) > 1]


def both(study, method):
    """Tasks on which both a method and PIDM random were run."""
    return [task for task, runs in study.items() if method in runs and "pidm_random" in runs]


def mean_over_seeds(study, method, name):
    """Estimate of the mean change over the tasks with several seeds: its interval is over the seeds of each task."""
    tasks = several(study, method)
    if not tasks:
        return None
    arms = [(study[task][method], study[task]["pidm_random"]) for task in tasks]
    samples = [np.arange(len(one)) for pair in arms for one in pair]

    def statistic(*drawn, axis=-1):
        return sum(change(name, *pair, *drawn[2 * k : 2 * k + 2]) for k, pair in enumerate(arms)) / len(arms)

    sign = bound_of(bound(name, *pair) for pair in arms)
    return Estimate(float(statistic(*samples)), interval(statistic, samples, method), sign)


def over_tasks(study, method, name, each, combine):
    """Estimate of combine(table (..., T, K)), a row (K,) from each(arm, baseline); its interval is over the tasks."""
    tasks = both(study, method)
    if not tasks:
        return None
    arms = [(study[task][method], study[task]["pidm_random"]) for task in tasks]
    table = np.stack([each(*pair) for pair in arms])

    def statistic(drawn, axis=-1):
        return combine(table[drawn])

    samples = [np.arange(len(tasks))]
    sign = bound_of(bound(name, *pair) for pair in arms)
    return Estimate(float(statistic(*samples)), interval(statistic, samples, method), sign)


def mean_over_tasks(study, method, name):
    """Estimate of the mean change over all tasks, as the paper's: its interval is over the tasks."""

    def each(arm, baseline):
        return np.array([change(name, arm, baseline, np.arange(len(arm)), np.arange(len(baseline)))])

    return over_tasks(study, method, name, each, lambda table: table.mean((-2, -1)))


def interquartile_mean(study, method, name):
    """Estimate of the mean change of the middle half of all runs (Agarwal et al. 2021); tasks weigh the same.

    A run's change is against the mean of the baseline on its task. To give tasks the same weight, each run stands as
    often as makes them equally many.
    """
    tasks = both(study, method)
    if not tasks:
        return None
    count = np.lcm.reduce([len(study[task][method]) for task in tasks])

    def each(arm, baseline):
        goal = goal_of(baseline)
        mine = 100 * (counted(name, arm, goal) / counted(name, baseline, goal).mean() - 1)
        return np.repeat(mine, count // len(arm))

    def combine(table):
        return stats.trim_mean(table.reshape(*table.shape[:-2], -1), 0.25, axis=-1)

    return over_tasks(study, method, name, each, combine)


def better(name, arm, baseline):
    """For each seed that both arms have: 1 if the arm's run is better than the baseline's, 0.5 if as good, else 0."""
    goal = goal_of(baseline)
    seeds = [run["seed"] for run in baseline]
    mine, theirs = (counted(name, runs, goal) for runs in (arm, baseline))
    sign = 1 if MEASURES[name].share is None else -1  # fewer iterations are better
    pairs = [(mine[k], theirs[seeds.index(run["seed"])]) for k, run in enumerate(arm) if run["seed"] in seeds]
    return np.array([0.5 + 0.5 * np.sign(sign * (a - b)) for a, b in pairs])


def improvement(study, method, name):
    """Estimate of the probability [%] that a run is better than PIDM random's of the same seed, mean over tasks."""

    study = {task: runs for task, runs in study.items() if same_seeds(runs, method, "pidm_random")}

    def each(arm, baseline):
        return np.array([100 * better(name, arm, baseline).mean()])

    return over_tasks(study, method, name, each, lambda table: table.mean((-2, -1)))
