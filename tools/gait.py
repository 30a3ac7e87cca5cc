"""Measure how a policy walks: fixed commands on flat ground, then a delay, a push, a load and a slippery floor.

    python tools/gait.py results/tasks/go1_loco/policy.msgpack
    python tools/gait.py runs/go1_loco/mlp/seed0/policy.msgpack --set friction=0.4,0.4 --json runs/gait.json

It works for the locomotion tasks. docs/play.md explains the numbers of the table.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import play
from envs.locomotion import LocomotionConfig
from experiment import gait, records, walks


@dataclass(frozen=True)
class Args:
    """A policy of a locomotion task."""

    policy: tyro.conf.Positional[str]  # a policy.msgpack of ppo_finetune.py
    set: tuple[str, ...] = ()  # NAME=VALUE of the task's config, e.g. friction=0.3,0.3 noise=0
    json: str | None = None  # also write the numbers to this file
    starts: int = 20  # episodes of a command; tests of robustness have twice as many
    seconds: float = 10.0  # of an episode
    engine: str = "auto"  # physics: c, mjx, warp


def measure(args):
    """Numbers of each command and sequence by name, and their summary. UserError for other families of tasks."""
    env, net, params, meta = play.load_nominal(args.policy, args.engine, args.set, args.seconds)
    if not isinstance(env.config, LocomotionConfig):
        raise records.UserError(f"{args.policy} is a policy for {meta['task']!r}, which follows no velocity command")
    return walks.evaluate(env, net, params, args.starts, args.seconds)


def main(args):
    """Print the table, and write the JSON file if asked to."""
    with records.one_line_errors():
        if args.starts < 1 or not 1 <= args.seconds <= 60:
            raise records.UserError("--starts must be at least 1, and --seconds from 1 to 60")
        by_command, summary = measure(args)
        print(gait.lines(by_command, summary))
        if args.json:
            plain = {name: {key: gait.plain(x) for key, x in numbers.items()} for name, numbers in by_command.items()}
            text = json.dumps({"summary": summary, "commands": plain}, indent=1) + "\n"
            records.write(Path(args.json), text.encode())
            print(f"wrote {args.json}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
