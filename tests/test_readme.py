"""What the README tells people to type works: each command runs, made small; targets and files exist."""

import csv
import dataclasses
import importlib
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import tyro

import envs

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, re.S)
COMMANDS = [line for language, body in BLOCKS if language == "bash" for line in body.strip().splitlines()]


# What makes each kind of command small; later words override earlier ones.
SMALL = {
    "ppo_explore.py": "--preset smoke --total-steps 800 --force",
    "pretrain_pidm.py": "--preset smoke --num-samples 32 --force",
    "ppo_finetune.py": "--preset smoke --num-envs 4 --num-steps 4 --total-steps 32 --eval-envs 2 --force",
    "results/study.py": "--budget-minutes 0",
    "results/play_onnx.py": "--seconds 2",
}
FORMS = {"--export": "jax2onnx", "play_onnx.py": "onnxruntime"}  # what needs more than requirements.txt
NEED_A_PERSON = ("--web", "--viewer")
WRITES_HERE = ("results/report.py", "results/tasks.py", "results/bench.py", "results/pidm.py")  # tested elsewhere


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder that has what the commands read, and the runs that the README has made before."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "assets").symlink_to(ROOT / "assets")
    shutil.copytree(ROOT / "results/tasks/go1_loco", folder / "results/tasks/go1_loco")
    shutil.copytree(ROOT / "results/tasks/go1_loco", folder / "runs/demo")  # as after make demo
    return folder


@pytest.mark.parametrize("command", COMMANDS, ids=range(len(COMMANDS)))
def test_commands_run(command, workplace, monkeypatch, capsys):
    words = shlex.split(command)
    if words[0] in ("#SBATCH", "make"):
        assert words[0] == "#SBATCH" or f"\n{words[1]}:" in (ROOT / "Makefile").read_text()
        return
    python, script, *words = words[words[0] == "srun" :]
    assert python == ".venv/bin/python" and (ROOT / script).exists()
    for word in ({script.split("/")[-1], *words}) & FORMS.keys():
        pytest.importorskip(FORMS[word])
    module = importlib.import_module(script.removesuffix(".py").replace("/", "."))
    small = [] if "--eval" in words and script != "ppo_finetune.py" else SMALL.get(script, "").split()
    args = tyro.cli(module.Args, args=[*words, *small])
    if {*words} & {*NEED_A_PERSON} or script in WRITES_HERE:
        return
    if getattr(args, "distributed", False):
        args = dataclasses.replace(args, distributed=False)  # which test_devices.py tests
    monkeypatch.chdir(workplace)
    module.main(args)
    assert capsys.readouterr().out, "it says what it did"


def test_python_runs():
    for language, body in BLOCKS:
        if language == "python":
            exec(compile(body, "README.md", "exec"), {})


def test_links_lead_somewhere():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize("script", ["ppo_explore", "pretrain_pidm", "ppo_finetune"])
def test_implementation_details_name_what_there_is(script):
    module = importlib.import_module(script)
    details = README.split(f"**Implementation details** of [{script}.py]")[1].split("\n\n")[1]
    names = re.findall(r"^\d+\. (`.*?):", details, re.M)
    assert len(names) == len(re.findall(r"^\d+\.", details, re.M)) > 4
    for name in re.findall(r"`(\w+)`", " ".join(names)):
        assert hasattr(module, name), name


@pytest.mark.parametrize("script", ["ppo_explore", "pretrain_pidm", "ppo_finetune"])
def test_arguments_that_matter_exist(script):
    section = README.split(f"## {script}.py")[1].split("\n## ")[0]
    table = section.split("**Arguments that matter.**")[1].split("\n\n")[1]
    names = re.findall(r"`--([\w-]+)", table)
    fields = {field.name for field in dataclasses.fields(importlib.import_module(script).Args)}
    assert len(names) > 3 and {name.replace("-", "_") for name in names} <= fields


def test_every_task_is_in_the_table():
    assert all(f"| `{task}` |" in README for task in envs.TASKS)


RECORDED = [task for task in envs.TASKS if (ROOT / "results/tasks" / task).exists()]


@pytest.mark.parametrize("task", RECORDED)
def test_task_table_is_what_was_recorded(task):
    """Scale, minutes and result in the README are those of the committed run."""
    run = ROOT / "results/tasks" / task
    args, report = (json.loads((run / name).read_text()) for name in ("args.json", "eval.json"))
    with (run / "metrics.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    scale = f"{args['num_envs']} x {args['num_steps']}, {float(last['env_steps']) / 1e6:.1f} M steps"
    minutes = f"{float(last['seconds']) / 60:.1f} min"
    if "level" in last:
        result = f"mean level {float(last['level']):.1f}"
    else:
        unit, error = ("m", "foot_error") if "foot_error" in last else ("m/s", "lin_vel_error")
        result = f"{report['task'][error]:.2f} {unit}, {100 * report['task']['falls']:.0f}%"
    row = next(line for line in README.splitlines() if line.startswith(f"| `{task}` |"))
    assert row.endswith(f"| {scale} | {minutes}, {result} |")


@pytest.mark.parametrize("task", [task for task in RECORDED if "skill" in dir(envs.TASKS[task][1])])
def test_success_table_is_what_was_recorded(task):
    report = json.loads((ROOT / "results/tasks" / task / "eval.json").read_text())
    row = [f"{100 * report[f'level {level}']['episode_success']:.0f}" for level in range(10)]
    assert f"| `{task}` | {' | '.join(row)} |" in README.splitlines()


def test_demo_is_what_was_recorded():
    run = ROOT / "results/tasks/demo"
    result = json.loads((run / "eval.json").read_text())["task"]
    with (run / "metrics.csv").open() as file:
        minutes = float(list(csv.DictReader(file))[-1]["seconds"]) / 60
    text = " ".join(README.split())
    assert f"training took {minutes:.1f} minutes" in text
    assert f"to {result['lin_vel_error']:.2f} m/s with {100 * result['falls']:.0f}% falls" in text


def test_missing_runs_are_called_missing():
    for task in envs.TASKS.keys() - set(RECORDED):
        row = next(line for line in README.splitlines() if line.startswith(f"| `{task}` |"))
        assert row.endswith("| not recorded yet |")


def test_pidm_table_is_what_was_recorded():
    for robot in envs.EXPLORE:
        result = json.loads((ROOT / f"results/pidm/{robot}/validation.json").read_text())
        row = next(line for line in README.splitlines() if line.startswith(f"| {robot} |"))
        figures = [f"{result[name]:.3f}" for name in ("error", "error_rad", "normalized_error", "error_over_change")]
        figures += [f"{result[name]:.2f}" for name in ("mean_action_error", "last_action_error")]
        assert row == f"| {robot} | " + " | ".join(figures) + " |"


def test_speed_tables_are_what_was_measured():
    section = README.split("## Speed and scale")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    measured = (ROOT / "results/bench/README.md").read_text().splitlines()
    assert len(rows) > 5 and set(rows) <= set(measured)
