"""What the README tells people to type works: commands parse, targets and files exist, Python runs."""

import re
import shlex
from pathlib import Path

import pytest
import tyro

import envs
import ppo_finetune

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, re.S)
COMMANDS = [line for language, body in BLOCKS if language == "bash" for line in body.strip().splitlines()]
SCRIPTS = {"ppo_finetune.py": ppo_finetune.Args}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command):
    words = shlex.split(command)
    if words[0] == "make":
        assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text()
        return
    assert words[0] == ".venv/bin/python"
    args = tyro.cli(SCRIPTS[words[1]], args=words[2:])
    assert args.task in envs.TASKS
    if args.eval and args.eval.startswith("results"):
        assert (ROOT / args.eval).exists()


def test_python_runs():
    for language, body in BLOCKS:
        if language == "python":
            exec(compile(body, "README.md", "exec"), {})


def test_links_lead_somewhere():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


def test_every_task_is_in_the_table():
    assert all(f"| `{task}` |" in README for task in envs.TASKS)
