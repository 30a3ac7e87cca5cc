"""What the README tells people to type works: commands parse, targets and files exist, Python runs."""

import csv
import json
import re
import shlex
from pathlib import Path

import pytest
import tyro

import envs
import ppo_explore
import ppo_finetune
import pretrain_pidm

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, re.S)
COMMANDS = [line for language, body in BLOCKS if language == "bash" for line in body.strip().splitlines()]
SCRIPTS = {
    "ppo_explore.py": ppo_explore.Args,
    "pretrain_pidm.py": pretrain_pidm.Args,
    "ppo_finetune.py": ppo_finetune.Args,
}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command):
    words = shlex.split(command)
    if words[0] == "#SBATCH":
        return
    words = words[words[0] == "srun" :]
    if words[0] == "make":
        assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text()
        return
    assert words[0] == ".venv/bin/python"
    if words[1].startswith("results/"):
        assert (ROOT / words[1]).exists()
        return
    args = vars(tyro.cli(SCRIPTS[words[1]], args=words[2:]))
    assert args.get("task", "go1_loco") in envs.TASKS and args.get("robot", "go1") in envs.EXPLORE
    for name in ("eval", "pretrained"):
        if (args.get(name) or "runs").split("/")[0] in ("results", "assets"):
            assert (ROOT / args[name]).exists()


def test_python_runs():
    for language, body in BLOCKS:
        if language == "python":
            exec(compile(body, "README.md", "exec"), {})


def test_links_lead_somewhere():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


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
        figures = [f"{result[name]:.3f}" for name in ("error", "error_rad", "normalized_error")]
        figures += [f"{result[name]:.2f}" for name in ("mean_action_error", "last_action_error")]
        assert row == f"| {robot} | " + " | ".join(figures) + " |"


def test_speed_tables_are_what_was_measured():
    section = README.split("## Speed")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    measured = (ROOT / "results/bench/README.md").read_text().splitlines()
    assert len(rows) > 5 and set(rows) <= set(measured)
