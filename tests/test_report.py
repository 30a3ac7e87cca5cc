"""The report's measures on curves with answers known by hand, and runs that it must leave out."""

import json
import shutil

import numpy as np
import pytest

from experiment import records
from results import pidm, report, tasks
from tools import bench


def curve(values):
    return {"iteration": np.arange(1.0, len(values) + 1), "indicator": np.asarray(values, float)}


def test_final_is_the_mean_of_the_last_twentieth():
    assert report.final(curve([*[0.0] * 38, 4.0, 6.0])) == 5.0
    assert report.final(curve([1.0, 2.0])) == 2.0


def test_late_gain_is_what_the_last_third_brought():
    assert report.late_gain(curve([*[1.0] * 20, *[8.0] * 20, *[10.0] * 20])) == pytest.approx(0.2)
    assert report.late_gain(curve([3.0])) == 0.0


def test_iterations_to_a_level():
    """Rises 1 an iteration: the mean of five rows that ends at iteration i is i - 2."""
    rising = curve(np.arange(1.0, 41.0))
    assert report.iterations_to(rising, 10.0) == 12
    assert np.isnan(report.iterations_to(rising, 100.0))


def test_interval_by_hand():
    assert report.interval(*report.percent([11.0, 11.0], [10.0, 10.0])) == "+10.0"
    assert report.interval(*report.percent([5.0], [10.0])) == "-50.0"
    low, high = report.interval(*report.percent([8.0, 12.0], [10.0, 10.0])).split("[")[1].rstrip("]").split(", ")
    assert (float(low), float(high)) == (-20.0, 20.0)


def test_a_single_seed_has_no_std():
    assert report.spread([12.5]) == "12.5"
    assert report.spread([9.0, 11.0]) == "10 ± 1"


def test_counts_say_how_many_got_there():
    assert report.counts([100.0, 300.0]) == "200"
    assert report.counts([100.0, np.nan, 300.0]) == "200 (2 of 3)"
    assert report.counts([np.nan]) == "not reached"


def test_what_was_not_run_or_not_reached_is_said():
    runs = {"pidm_random": [curve([10.0] * 10)], "mlp": [curve([10.0] * 10), curve([1.0] * 10)]}
    assert report.cell(runs, "mlp", "to 90%") == "not reached by 1 of 2"
    assert report.cell(runs, "mlp", "final").startswith("-45.0 [-90.0, ")
    assert report.cell(runs, "pidm_pretrained", "final") == "not run"
    assert report.cell({}, "mlp", "final") == "not run"
    runs = {"pidm_random": [curve([1.0] * 10), curve([9.0] * 10)], "mlp": [curve([10.0] * 10)]}
    assert report.cell(runs, "mlp", "to 90%") == "not reached by 1 of 2 PIDM random"


def test_mean_over_tasks_is_of_those_with_several_seeds():
    """Two tasks at +10 and -30 percent; one has a single seed of each, one a single seed of one, one no baseline."""
    ten = curve([10.0] * 10)
    study = {
        "go1_loco": {"pidm_random": [ten, ten], "mlp": [curve([11.0] * 10)] * 2},
        "g1_loco": {"pidm_random": [ten, ten], "mlp": [curve([7.0] * 10)] * 2},
        "anymal_climb_up": {"pidm_random": [ten], "mlp": [curve([99.0] * 10)]},
        "anymal_crouch": {"pidm_random": [ten, ten], "mlp": [curve([99.0] * 10)]},
        "anymal_loco": {"mlp": [ten, ten]},
    }
    line = report.table_1(study)[-1].split(" | ")
    assert line[2:4] == ["-10.0", "+0.2"] and line[4:6] == ["not run", ""]
    assert report.cell(study["anymal_climb_up"], "mlp", "final") == "+890.0"


def test_mean_counts_a_run_that_never_got_there_by_its_length():
    """PIDM random is there at row 5, as are the MLPs of one task; the other's are not at row 10: +0, at least +100."""
    ten = curve([10.0] * 10)
    study = {
        "go1_loco": {"pidm_random": [ten, ten], "mlp": [ten, ten]},
        "g1_loco": {"pidm_random": [ten, ten], "mlp": [curve([1.0] * 10)] * 2},
    }
    assert report.cell(study["g1_loco"], "mlp", "to 90%") == "not reached by 2 of 2"
    text, tasks = report.mean_over_tasks(study, "mlp", "to 90%")
    assert text == "at least +50.0" and list(tasks) == ["go1_loco", "g1_loco"]
    assert report.mean_over_tasks({"go1_loco": study["go1_loco"]}, "mlp", "to 90%")[0] == "+0.0"


def test_the_paper_s_means_are_those_it_prints():
    assert np.isclose(np.mean(report.PAPER["final"]["mlp"]), 1.0, atol=0.05)
    assert np.isclose(np.mean(report.PAPER["final"]["pidm_pretrained"]), 4.3, atol=0.05)
    assert np.isclose(np.mean(report.PAPER["to 90%"]["mlp"]), -9.5, atol=0.05)
    assert np.isclose(np.mean(report.PAPER["to 90%"]["pidm_pretrained"]), -36.2, atol=0.1)


def test_pages_are_what_the_runs_give():
    report.main(report.Args(check=True))


def test_other_pages_are_what_their_records_give(monkeypatch):
    pages = {}
    monkeypatch.setattr(records, "replace_text", lambda path, text: pages.update({path: text}))
    pidm.write_readme()
    bench.write_page(report.ROOT / "results/bench")
    assert len(pages) == 2 and all(path.read_text() == text for path, text in pages.items())


def test_report_writes_the_same_bytes_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "STUDY", tmp_path)
    study = {"go1_loco": report.load_task(report.ROOT / "results/study/cpu/go1_loco")}
    images = []
    for _ in range(2):
        report.draw_all(study)
        images.append([(tmp_path / name).read_bytes() for name in ("curves.png", "updates.png")])
    assert images[0] == images[1] and not (tmp_path / "sizes.png").exists()


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Two methods of one seed each."""
    monkeypatch.setattr(report, "ROOT", tmp_path)
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
    assert set(report.load_task(folder)) == {"mlp", "pidm_random"} and not capsys.readouterr().err
    target = folder / "pidm_random/seed0"
    (target / "args.json").write_text(json.dumps(args | {"lr": 2.0}))
    assert set(report.load_task(folder)) == {"mlp"}
    assert "other settings" in capsys.readouterr().err
    (target / "args.json").write_text(json.dumps(args | {"total_steps": 50}))
    assert set(report.load_task(folder)) == {"mlp"}
    assert "stopped before its last step" in capsys.readouterr().err
    (target / "args.json").write_text(json.dumps(args))
    text = (target / "metrics.csv").read_text()
    (target / "metrics.csv").write_text(text[:-5] + "\n")
    assert set(report.load_task(folder)) == {"mlp"}
    assert "left out" in capsys.readouterr().err


def test_success_by_level_is_a_mean_over_runs_of_the_same_levels(study, capsys):
    folder, args = study
    result = {f"level {i}": {"episode_success": share} for i, share in enumerate((1.0, 0.5))}
    for seed, last in ((0, 0.5), (1, 0.0)):
        target = folder / f"mlp/seed{seed}"
        shutil.copytree(folder / "pidm_random/seed0", target, dirs_exist_ok=True)
        (target / "args.json").write_text(json.dumps(args | {"seed": seed}))
        result["level 1"]["episode_success"] = last
        (target / "eval.json").write_text(json.dumps(result))
    runs = report.load_task(folder)
    assert list(runs) == ["mlp"] and "other settings" in capsys.readouterr().err  # PIDM random was run on no level
    assert "success by level [%]" in report.details(runs)[-3] and "| 100 25 |" in report.details(runs)[-1]


def test_without_a_baseline_there_is_no_level_to_reach(study):
    runs = report.load_task(study[0])
    assert "no PIDM random" not in report.details(runs)[2]
    alone = {"mlp": runs["mlp"]}
    assert report.details(alone)[2].count("no PIDM random") == 2 and "not reached" not in report.details(alone)[2]


def test_sizes_are_those_that_were_pretrained_on(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "ROOT", tmp_path)
    folder = tmp_path / "results/pidm/anymal_d"
    for stem, samples, error in (("sizes/7000_", 7000, 0.9), ("sizes/70000_", 70000, 0.6), ("", None, 0.3)):
        for name, content in (("args", {"num_samples": samples}), ("validation", {"normalized_error": error})):
            (folder / f"{stem}{name}.json").parent.mkdir(parents=True, exist_ok=True)
            (folder / f"{stem}{name}.json").write_text(json.dumps(content))
    (folder / "explore").mkdir()
    (folder / "explore/meta.json").write_text('{"transitions": 1000000}')
    assert report.sizes_of("anymal_d") == {7000: 0.9, 70000: 0.6, 1000000: 0.3}
    assert report.draw_sizes({}, tmp_path / "sizes.png") and (tmp_path / "sizes.png").stat().st_size > 5000


def test_live_draws_until_the_run_is_over(tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(report.ROOT / "results/tasks/go1_loco", run)
    (run / "curve.png").unlink()
    report.main(report.Args(live=str(run)))
    assert (run / "curve.png").stat().st_size > 10_000 and "4.06 of 4.00 M steps" in capsys.readouterr().out
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
