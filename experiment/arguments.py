"""Arguments of the three stages: defaults filled in, checked, and read again for --resume."""

import dataclasses
import json
import sys
from pathlib import Path

import jax

from envs.config import FIXED, fits
from experiment import records

ABOVE_0 = ("lr", "max_lr", "ensemble_lr", "desired_kl", "init_std", "clip", "max_grad_norm")  # flags of all scripts


def filled(args, values):
    """The arguments with fields that are None filled in from `values`; UserError unless all counts are at least 1.

    Seeds are at least 0 and fit into 32 bits, since JAX drops the bits above. Counts are below 1e12, as --resume wants
    them. Step sizes and stds are above 0.
    """
    args = dataclasses.replace(args, **{name: v for name, v in values.items() if getattr(args, name) is None})
    for name, value in dataclasses.asdict(args).items():
        flag = f"--{name.replace('_', '-')}"
        least, most = (0, 2**32 - getattr(args, "num_seeds", 1) + 1) if name == "seed" else (1, 10**12)
        for number in value if type(value) is tuple else (value,):
            if type(number) is int and not least <= number < most:
                raise records.UserError(f"{flag} must be at least {least}, not {number}, and below {most}")
        if name in ABOVE_0 and not value > 0:
            raise records.UserError(f"{flag} must be above 0, not {value}")
    return args


def check_minibatches(args):
    """Return args. UserError unless the minibatches divide a rollout, and devices and blocks its environments."""
    size, count = args.num_envs * args.num_steps, jax.device_count()
    if args.num_envs % args.shuffle_blocks or args.num_envs % count:
        raise records.UserError(
            f"{args.num_envs} environments cannot be split over {count} devices in {args.shuffle_blocks} blocks; "
            "change --num-envs or --shuffle-blocks"
        )
    if size // args.shuffle_blocks % args.num_minibatches:
        raise records.UserError(
            f"{args.num_minibatches} minibatches do not divide the {size // args.shuffle_blocks} samples of a block: "
            f"{args.num_envs} environments x {args.num_steps} steps / {args.shuffle_blocks}; "
            "change --num-minibatches or --num-envs"
        )
    return args


def set_fields(words):
    """Fields of a config as typed after --set, name -> text. UserError for those that cannot be set."""
    for word in words:
        if "=" not in word:
            raise records.UserError(f"--set takes NAME=VALUE, not {word!r}")
        if (name := word.split("=", 1)[0]) in FIXED:
            raise records.UserError(f"{name} cannot be set: {FIXED[name]}")
    return dict(word.split("=", 1) for word in words)


def planned_iterations(args):
    """Iterations in whole chunks of log_every that make at least total_steps."""
    return -(-args.total_steps // (args.num_envs * args.num_steps * args.log_every)) * args.log_every


def each_seed(args):
    """Arguments of every training of a run. With --num-seeds their folders are <run_dir>/seed<k>."""
    if getattr(args, "num_seeds", 1) == 1:
        return [args]
    seeds = range(args.seed, args.seed + args.num_seeds)
    return [dataclasses.replace(args, seed=s, run_dir=f"{args.run_dir}/seed{s}", num_seeds=1) for s in seeds]


def resumed(args, *may_change):
    """The arguments of the run in the folder args.resume, to go on with; those named in may_change can be given anew.

    UserError if the folder has no run, or one with other arguments than today's, or if more arguments are given.
    """
    path, fields = Path(args.resume) / "args.json", dataclasses.fields(args)
    flags = [word.split("=")[0][2:].replace("-", "_") for word in sys.argv[1:] if word.startswith("--")]
    typed = {flag.removeprefix("no_") for flag in flags}  # also those with the value of the default
    given = {f.name: getattr(args, f.name) for f in fields if f.name in typed or getattr(args, f.name) != f.default}
    for name in sorted(given.keys() - {"resume", *may_change}):
        raise records.UserError(
            f"--{name.replace('_', '-')} cannot change with --resume; leave it out, or start a new run"
        )
    try:
        record = json.loads(path.read_text())
        names = record.keys() - {"config", "versions"}
        other = sorted(names ^ {field.name for field in fields})
        intact = bool(other) or all(fits(record[field.name], field.type) for field in fields)
        from_file = bool(record.get("config", {}).get("body"))
    except OSError as error:
        raise records.UserError(f"cannot resume from {path}: {error.strerror}") from None
    except (ValueError, TypeError, AttributeError, RecursionError):
        intact = False
    if not intact:
        raise records.UserError(f"{path} is damaged; start the run again")
    if other:
        raise records.UserError(
            f"{path} is of another version or stage, which differs in {', '.join(other)[:99]}; start the run again"
        )
    found = {f.name: tuple(record[f.name]) if isinstance(record[f.name], list) else record[f.name] for f in fields}
    found |= {"robot": str(path)} if from_file and "robot" in found else {}  # the file may have changed since
    return type(args)(**found | given | {"resume": args.resume, "run_dir": args.resume, "force": False})


def extend(args):
    """Record in args.json that the run args.resume goes on to another total_steps."""
    path = Path(args.resume) / "args.json"
    record = json.loads(path.read_text())
    if record.get("total_steps") != getattr(args, "total_steps", None):
        records.replace_text(path, json.dumps(record | {"total_steps": args.total_steps}, indent=1) + "\n")
