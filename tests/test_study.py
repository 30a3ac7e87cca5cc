"""The study trains what is missing, resumes what was interrupted, and stops when its time is over."""

import dataclasses
import json

import pytest
import tyro

import envs
import play
import ppo_finetune
from experiment import records
from results import grid, recording, report, study

# Tasks that were changed after their runs were recorded, as results/README.md says; take out what is recorded anew.
CHANGED = {*(task for task, (_, config) in envs.TASKS.items() if hasattr(config, "skill")), "g1_loco"}
FREE = {"run_dir", "save_minutes", "shuffle_blocks"}  # arguments that may differ from those of a recorded run


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A study in an empty folder, with a stand-in for the training that writes half of a run, and then the rest."""
    monkeypatch.setattr(study, "ROOT", tmp_path)
    calls = []

    def finetune(words, log, seconds):
        calls.append(words)
        folder = tmp_path / (words[-1] if words[0] == "--resume" else words[-2])
        interrupted = len(calls) == 1
        (folder / "args.json").write_text('{"total_steps": 100}')
        (folder / "metrics.csv").write_text(f"env_steps\n{50 if interrupted else 100}\n")
        (folder / records.STATE).write_bytes(b"")
        return not interrupted

    def evaluate(run, folder, names, log):
        folder.mkdir(parents=True)
        for name in names:
            (folder / name).touch()

    monkeypatch.setattr(study.recording, "finetune", finetune)
    monkeypatch.setattr(study.recording, "evaluate", evaluate)
    return calls


def test_a_study_resumes_what_was_interrupted(runs, capsys):
    args = study.Args(tasks=("go1_loco",), methods=("mlp", "pidm_actor"), seeds=(3,))
    study.main(args)
    assert "out of time" in capsys.readouterr().out and len(runs) == 1
    study.show_status(study.cells(args))
    assert " ".join(capsys.readouterr().out.split()) == "go1_loco mlp 50% go1_loco pidm_actor . 0 of 2 runs"
    study.main(args)
    first, again, other = runs
    assert first[:6] == ["--task", "go1_loco", "--preset", "cpu", "--seed", "3"]
    assert again == ["--resume", "runs/study/cpu/go1_loco/mlp/seed3"]
    assert other[6:10] == ["--pretrained", "assets/pidm/go1.msgpack", "--load-into", "actor"]
    study.main(args)
    assert len(runs) == 3, "nothing is run twice"
    study.show_status(study.cells(args))
    assert "2 of 2 runs" in capsys.readouterr().out


def test_no_run_starts_when_time_is_over(runs, capsys):
    study.main(study.Args(budget_minutes=0.0))
    assert not runs and "out of time" in capsys.readouterr().out


def test_list_is_a_command_a_line(runs, capsys):
    study.main(study.Args(list=True))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(set(lines)) == 5 * sum(len(task.methods) for task in grid.TASKS.values()) and not runs


def test_unknown_names_are_refused():
    with pytest.raises(records.UserError, match="unknown task or method 'walk'"):
        study.main(study.Args(tasks=("walk",)))


def test_scripts_are_stopped_and_failures_reported(tmp_path):
    assert recording.run_script(["-c", ""])
    assert not recording.run_script(["-c", "import time; time.sleep(60)"], seconds=0.5)
    with (tmp_path / "log.txt").open("w") as log, pytest.raises(records.UserError, match=r"code 3; see .*log\.txt"):
        recording.run_script(["-c", "raise SystemExit(3)"], log)


def test_a_policy_is_evaluated_and_its_small_files_kept(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(recording, "run_script", lambda words, log: commands.append(words))
    monkeypatch.setattr(recording, "ROOT", tmp_path)
    (tmp_path / "runs/x").mkdir(parents=True)
    (tmp_path / "runs/x/eval.json").write_text("{}")
    recording.evaluate("x", tmp_path / "kept/x", ("eval.json",))
    assert commands == [["play.py", "runs/x/policy.msgpack"]] and (tmp_path / "kept/x/eval.json").read_text() == "{}"
    assert tyro.cli(play.Args, args=commands[0][1:]).episodes == 64, "as in the recorded runs"


def test_study_and_report_share_one_table():
    assert study.METHODS is report.METHODS is grid.METHODS and study.TASKS is report.TASKS is grid.TASKS
    assert grid.TASKS.keys() == envs.TASKS.keys()
    used = {name for task in grid.TASKS.values() for name in task.methods}
    assert used == grid.METHODS.keys(), "every method has a task, and every task's methods exist"


def parsed(task, method):
    """Arguments of ppo_finetune.py for a run of the study, as its command line gives them."""
    words = study.Cell("cpu", task, method, 0).words()
    return ppo_finetune.merge(tyro.cli(ppo_finetune.Args, args=words), envs.TASKS[task][1].ppo)


@pytest.mark.parametrize(("task", "method"), [(task, m) for task, row in grid.TASKS.items() for m in row.methods])
def test_flags_give_the_arguments_of_recorded_runs(task, method, tmp_path, monkeypatch):
    """Flags parse. If the run is recorded, a new one has its arguments, under their new names, and its task.

    Catches a change of a task that its recorded runs do not have, and that the page of results does not tell.
    """
    monkeypatch.setattr(study, "ROOT", tmp_path)
    args = parsed(task, method)
    path = report.STUDY / "cpu" / task / method / "seed0/args.json"
    if not path.exists():
        return
    record, today = json.loads(path.read_text()), json.loads(json.dumps(dataclasses.asdict(args)))
    record = {"load_into": record.get("init"), "weight_init": record.get("fresh", "orthogonal")} | record  # old names
    shared = today.keys() & record.keys() - FREE
    assert {name: today[name] for name in shared} == {name: record[name] for name in shared} and len(shared) > 24
    config = json.loads(json.dumps(dataclasses.asdict(envs.TASKS[task][1])))
    assert (grid.task_of(config) == grid.task_of(record["config"])) == (task not in CHANGED)


def test_runs_of_one_task_are_equal_whatever_their_age():
    """A run from before the later fields is of the same task as one with them at rest, and as no other."""
    old = {"robot": "go1", "command_seconds": 10.0, "weights": {"slip": -0.1}}
    rest = {"motor_strength": [1.0, 1.0], "joint_friction": [0.0, 0.0], "action_delay": [0.0, 0.0]}
    rest |= {"sensor_lag": [0.0, 0.0], "turning": 0.0, "on_the_spot": 0.0, "tracking_seconds": 0.0, "gait_hz": 0.0}
    new = old | rest | {"command_seconds": [10.0, 10.0], "robust": {"turning": 0.3}, "stance": 0.6, "swing_height": 0.1}
    assert grid.task_of(old) == grid.task_of(new)
    others = (
        {"action_delay": [0.0, 0.04]},
        {"command_seconds": [3.0, 8.0]},
        {"gait_hz": 2.0},
        {"weights": {"slip": -0.2}},
    )
    for change in others:
        assert grid.task_of(old) != grid.task_of(new | change)
    clock = new | {"gait_hz": 2.0}
    assert grid.task_of(clock) != grid.task_of(clock | {"stance": 0.7})


def test_pretrained_weights_exist():
    """Those of parts of the data are made by pidm.py --stages sizes."""
    for task, row in grid.TASKS.items():
        for method in row.methods:
            if grid.METHODS[method].group != "sizes" and (path := parsed(task, method).pretrained):
                assert (study.ROOT / path).exists()
