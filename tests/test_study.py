"""The study trains what is missing, resumes what was interrupted, and stops when its time is over."""

import dataclasses
import functools
import json

import pytest
import tyro

import envs
import play
import ppo_finetune
from experiment import records
from results import grid, recording, report, study, tasks

SKILLS = tuple(task for task, (_, config) in envs.TASKS.items() if hasattr(config, "skill"))
FREE = {"run_dir", "save_minutes", "shuffle_blocks"}  # arguments that may differ from those of a recorded run
WIDTHS = {"hidden", "intention"}  # likewise in parkour's earlier tasks, whose MLP had 256 units in its first layer


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A study in an empty folder, with a stand-in for the training that writes half of a run, and then the rest."""
    monkeypatch.setattr(study, "ROOT", tmp_path)
    monkeypatch.setattr(study.recording, "ROOT", tmp_path)
    calls = []

    def run_script(words, log, seconds):
        script, *words = words
        assert script == "ppo_finetune.py"
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

    monkeypatch.setattr(study.recording, "run_script", run_script)
    monkeypatch.setattr(study.recording, "evaluate", evaluate)
    monkeypatch.setattr(study.Cell, "lacks", lambda cell: None)
    return calls


LACKS = study.Cell.lacks


def test_a_study_resumes_what_was_interrupted(runs, capsys):
    args = study.Args(tasks=("go1_loco",), methods=("mlp", "pidm_shuffled"), seeds=(2,))
    study.main(args)
    assert "out of time" in capsys.readouterr().out and len(runs) == 1
    study.show_status(study.planned(args))
    *lines, count = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[1::2] == ["go1_loco mlp 50%", "go1_loco pidm_shuffled ."] and count == "0 of 2 runs"
    assert lines[::2] == [f"batch: {block.why}" for block in (grid.PLAN[0], grid.PLAN[2])]
    study.main(args)
    first, again, other = runs
    assert first[:6] == ["--task", "go1_loco", "--preset", "cpu", "--seed", "2"]
    assert again == ["--resume", "runs/study/batch/go1_loco/mlp/seed2"]
    assert other[6:10] == ["--pretrained", "assets/pidm/go1.msgpack", "--load-into", "shuffled"]
    study.main(args)
    assert len(runs) == 3, "nothing is run twice"
    study.show_status(study.planned(args))
    assert "2 of 2 runs" in capsys.readouterr().out


def test_what_cannot_be_trained_yet_is_left_out(runs, monkeypatch, capsys):
    """One line names the PIDM that is missing; the others are trained."""
    monkeypatch.setattr(study.Cell, "lacks", LACKS)
    (study.ROOT / "assets/pidm").mkdir(parents=True)
    (study.ROOT / "assets/pidm/anymal_d.msgpack").touch()
    small, shipped, mlp = (study.Cell("batch", "anymal_climb_up", m, 0) for m in ("pidm_7k", "pidm_pretrained", "mlp"))
    assert small.lacks() == "results/pidm/anymal_d/sizes/7000.msgpack" and not shipped.lacks() and not mlp.lacks()
    study.main(study.Args(tasks=(small.task,), methods=(small.method,), seeds=(0,), list=True))
    out, err = capsys.readouterr()
    assert not out and err.startswith("left out: runs from results/pidm/anymal_d/sizes/7000.msgpack") and len(err) < 120


def test_a_training_that_was_asked_to_stop_is_not_kept(runs, monkeypatch):
    """It ends well, but without all of its steps."""
    monkeypatch.setattr(study.recording, "run_script", lambda *words: True)
    cell = study.Cell("batch", "go1_loco", "mlp", 2)
    folder = study.ROOT / "runs" / cell.folder
    folder.mkdir(parents=True)
    (folder / "args.json").write_text('{"total_steps": 100}')
    (folder / "metrics.csv").write_text("env_steps\n50\n")
    assert not study.run(cell, 1.0) and not cell.done() and cell.share() == 0.5


def test_a_task_whose_training_was_stopped_keeps_its_record(runs, monkeypatch):
    monkeypatch.setattr(tasks.recording, "run_script", lambda *words: True)
    folder = study.ROOT / "runs/tasks/go1_loco"
    folder.mkdir(parents=True)
    (folder / "args.json").write_text('{"total_steps": 100}')
    (folder / "metrics.csv").write_text("env_steps\n50\n")
    with pytest.raises(records.UserError, match="runs/tasks/go1_loco was stopped"):
        tasks.main(tasks.Args(tasks=("go1_loco",)))


def test_a_run_that_fails_does_not_keep_the_others_from_running(runs, monkeypatch, capsys):
    """Its own error comes at once, and again at the end, with exit code 2 from there."""
    whole = study.recording.run_script

    def fails_first(words, log, seconds):
        if "pidm_shuffled" in words[-2]:
            raise records.UserError("weights are not finite")
        return whole(words, log, seconds) or True

    monkeypatch.setattr(study.recording, "run_script", fails_first)
    args = study.Args(tasks=("go1_loco",), methods=("pidm_shuffled", "pidm_random_orthogonal"), seeds=(2,))
    runs.append("the first stand-in is interrupted")
    with pytest.raises(records.UserError, match=r"1 failed; .*remove runs/study/batch/go1_loco/pidm_shuffled/seed2"):
        study.main(args)
    assert "weights are not finite" in capsys.readouterr().err
    assert study.Cell("batch", "go1_loco", "pidm_random_orthogonal", 2).done()


def test_no_run_starts_when_time_is_over(runs, capsys):
    study.main(study.Args(budget_minutes=0.0))
    assert not runs and "out of time" in capsys.readouterr().out


def test_list_is_a_command_a_line(runs, capsys):
    """Each names one run, the one of its place in the plan."""
    study.main(study.Args(list=True))
    lines = capsys.readouterr().out.splitlines()
    wanted = [cell for cells in study.planned(study.Args()).values() for cell in cells]
    assert len(lines) == len(set(lines)) == len(wanted) > 100 and not runs
    for line, cell in zip(lines, wanted, strict=True):
        args = tyro.cli(study.Args, args=line.split()[2:])
        assert [one for cells in study.planned(args).values() for one in cells] == [cell]


def test_names_that_are_not_planned_are_refused():
    unknown = ({"tasks": ("walk",)}, {"methods": ("walk",)}, {"scales": ("walk",)})
    for choice in unknown:
        with pytest.raises(records.UserError, match=f"unknown name 'walk' in --{next(iter(choice))}; known: "):
            study.main(study.Args(**choice))
    with pytest.raises(records.UserError, match="no such run is planned"):
        study.main(study.Args(tasks=("go1_loco",), seeds=(5,)))


def test_the_plan_has_the_cells_that_were_asked_for():
    """Seeds by scale, task and method: a block that is lost, doubled or moved shows here."""
    seeds = {}
    for block, cells in study.planned(study.Args()).items():
        for cell in cells:
            seeds.setdefault((block.scale, cell.task, cell.method), []).append(cell.seed)
    assert all(len(set(found)) == len(found) for found in seeds.values())
    main = ("mlp", "pidm_random", "pidm_pretrained")
    controls = ("pidm_random_orthogonal", "pidm_pretrained_orthogonal", "pidm_shuffled")
    ablations = ("pidm_actor", "pidm_critic", "pidm_7k", "pidm_70k", "pidm_700k")
    wanted = {("batch", "go1_loco", method): 5 for method in main}
    wanted |= {("batch", "go1_loco", method): 3 for method in controls}
    wanted |= {("batch", "go1_loco", f"{method}_unscaled"): 2 for method in main[1:]}
    wanted |= {("batch", "anymal_loco", method): 3 for method in main}
    wanted |= {("batch", task, f"{m}_slow"): 2 for task in ("go1_loco", "anymal_loco") for m in main[1:]}
    wanted |= {("batch", "anymal_loco", method): 1 for method in controls}
    walks = [(scale, task) for scale in ("1024", "256") for task in ("go1_loco", "anymal_loco")]
    wanted |= {(*walk, method): 2 for walk in walks for method in main[1:]}
    wanted |= {("batch", task, method): 3 for task in ("g1_loco", "anymal_pedipulation", *SKILLS) for method in main}
    wanted |= {("batch", task, method): 2 for task in ("anymal_climb_up", "anymal_climb_down") for method in ablations}
    wanted |= {("batch", task, "pidm_random_orthogonal"): 1 for task in SKILLS}
    assert {cell: len(found) for cell, found in seeds.items()} == wanted
    order = [cell for cells in study.planned(study.Args(tasks=SKILLS)).values() for cell in cells]
    assert [cell.seed for cell in order[:30]] == [0] * 15 + [1] * 15, "the first seed of all skills before any second"


@pytest.mark.parametrize(("scale", "envs_and_steps"), [("batch", (4096, 24, 14e6)), ("1024", (1024, 24, 10e6))])
def test_walking_at_each_batch(scale, envs_and_steps):
    """There are more than a hundred rows, so that 90% is read off to a hundredth of a run."""
    for task in ("go1_loco", "anymal_loco"):
        args = parsed(task, "pidm_random", scale)
        assert (args.num_envs, args.num_steps, args.total_steps) == envs_and_steps
        assert args.total_steps / (args.log_every * args.num_envs * args.num_steps) > 100


def test_main_arms_start_with_small_actions_and_recorded_ones_did_not():
    assert parsed("go1_loco", "pidm_random", "cpu").weight_init == "pytorch_unscaled"
    for task, (_, config) in envs.TASKS.items():
        for method in ("mlp", "pidm_random", "pidm_pretrained"):
            assert parsed(task, method, "batch").weight_init == "pytorch", config.robot
    for method in ("pidm_random", "pidm_pretrained"):
        scaled, unscaled = (parsed("go1_loco", name, "batch") for name in (method, f"{method}_unscaled"))
        assert dataclasses.replace(unscaled, weight_init="pytorch", run_dir=scaled.run_dir) == scaled


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
    planned = {name for block in grid.PLAN for name in block.methods}
    recorded = {path.name for path in report.STUDY.glob("*/*/*")}
    assert planned | recorded <= grid.METHODS.keys()
    assert {block.scale for block in grid.PLAN} <= grid.SCALES.keys()


@functools.cache
def parsed(task, method, scale):
    """Arguments of ppo_finetune.py for a run of the study, as its command line gives them."""
    words = study.Cell(scale, task, method, 0).words()
    return ppo_finetune.merge(tyro.cli(ppo_finetune.Args, args=words), envs.TASKS[task][1].ppo)


RECORDED = sorted(path.parts[-4:-1] for path in report.STUDY.glob("*/*/*/seed0"))


@pytest.mark.parametrize(("scale", "task", "method"), RECORDED)
def test_flags_give_the_arguments_of_recorded_runs(scale, task, method, tmp_path, monkeypatch):
    """A run made today has the arguments of the recorded one, under their new names, and its task.

    Catches a change of a task that its recorded runs do not have, and that the page of results does not tell.
    """
    monkeypatch.setattr(study, "ROOT", tmp_path)
    args = parsed(task, method, scale)
    path = report.STUDY / scale / task / method / "seed0/args.json"
    record, today = json.loads(path.read_text()), json.loads(json.dumps(dataclasses.asdict(args)))
    weights = {"pytorch": "pytorch_unscaled"}.get(record.get("fresh"), "orthogonal")
    record = {"load_into": record.get("init"), "weight_init": weights} | record  # old names
    shared = today.keys() & record.keys() - FREE - (WIDTHS if grid.is_earlier(scale, task) else set())
    assert {name: today[name] for name in shared} == {name: record[name] for name in shared} and len(shared) > 24
    config = json.loads(json.dumps(dataclasses.asdict(envs.TASKS[task][1])))
    same = grid.task_of(config) == grid.task_of(record["config"])
    assert same != grid.is_earlier(scale, task), "grid.py says of which scales the tasks have been changed since"


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
    for block, cells in study.planned(study.Args(scales=tuple(grid.SCALES))).items():
        for cell in cells:
            path = parsed(cell.task, cell.method, block.scale).pretrained
            if path and grid.METHODS[cell.method].group != "sizes":
                assert (study.ROOT / path).exists()
