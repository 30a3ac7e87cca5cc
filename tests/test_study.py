"""The study runs what is missing, goes on with what broke, and stops when its time is over."""

import pytest

from envs import records
from results import report, study


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A study in an empty folder; the training is replaced by one that writes half of a run and then the rest."""
    monkeypatch.setattr(study, "ROOT", tmp_path)
    calls = []

    def finetune(words, log, seconds):
        calls.append(words)
        folder = tmp_path / (words[-1] if words[0] == "--resume" else words[-2])
        broke = len(calls) == 1
        (folder / "args.json").write_text('{"total_steps": 100}')
        (folder / "metrics.csv").write_text(f"env_steps\n{50 if broke else 100}\n")
        (folder / records.STATE).write_bytes(b"")
        return not broke

    def evaluate(task, run, kept, names, log):
        kept.mkdir(parents=True)
        for name in names:
            (kept / name).touch()

    monkeypatch.setattr(study.recording, "finetune", finetune)
    monkeypatch.setattr(study.recording, "evaluate", evaluate)
    return calls


def test_a_study_goes_on_where_it_broke(runs, capsys):
    args = study.Args(tasks=("go1_loco",), methods=("mlp", "pidm_actor"), seeds=(3,))
    study.main(args)
    assert "out of time" in capsys.readouterr().out and len(runs) == 1
    study.show_status(study.cells(args))
    assert " ".join(capsys.readouterr().out.split()) == "go1_loco mlp 50% go1_loco pidm_actor . 0 of 2 runs"
    study.main(args)
    first, again, other = runs
    assert first[:6] == ["--task", "go1_loco", "--preset", "cpu", "--seed", "3"]
    assert again == ["--resume", "runs/study/cpu/go1_loco/mlp/seed3"]
    assert other[6:10] == ["--pretrained", "assets/pidm/go1.msgpack", "--init", "actor"]
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
    assert len(lines) == len(set(lines)) == 5 * sum(map(len, study.GRID.values())) and not runs


def test_unknown_names_are_refused():
    with pytest.raises(records.UserError, match="unknown task or method 'walk'"):
        study.main(study.Args(tasks=("walk",)))


def test_every_method_is_reported():
    assert study.METHODS.keys() == report.METHODS.keys()
    assert study.GRID.keys() == report.TASKS.keys()
