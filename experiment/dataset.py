"""Files of a collection: arrays that stage 1 writes and stage 2 reads, and meta.json, which says what they hold.

Every array is (iterations, T, N, ...), memory-mapped, without sensor noise. meta.json is written last: a folder without
it is an unfinished collection.
"""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

import envs
from experiment import records

KINDS = {  # array -> dtype, axes
    "x": (np.float32, 4),  # x_t
    "lin_vel": (np.float32, 4),  # base velocity in its frame [m/s]
    "action": (np.float32, 4),
    "first": (np.bool_, 3),  # x_t opens an episode
    "rough": (np.bool_, 3),  # on rough ground
}


def array_shapes(args, env, iterations):
    """Shape of each array, by name."""
    widths = {"x": (env.prop_dim,), "lin_vel": (3,), "action": (env.action_dim,)}
    return {name: (iterations, args.num_steps, args.num_envs, *widths.get(name, ())) for name in KINDS}


def create_arrays(folder, args, env, iterations):
    """Memory-mapped arrays of their final size, disk space reserved. UserError if the disk is too small."""
    shapes = array_shapes(args, env, iterations)
    (folder / "meta.json").unlink(missing_ok=True)  # from here on the folder is an unfinished collection
    need = sum(int(np.prod(shape)) * np.dtype(KINDS[name][0]).itemsize for name, shape in shapes.items())
    try:
        arrays = {}
        for name, shape in shapes.items():
            (folder / f"{name}.npy").unlink(missing_ok=True)  # who reads the old file keeps it as it is
            arrays[name] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", KINDS[name][0], shape)
            if hasattr(os, "posix_fallocate"):  # writing to a mapped file on a full disk is fatal; macOS cannot reserve
                with (folder / f"{name}.npy").open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
    except OSError as error:
        for name in shapes:
            (folder / f"{name}.npy").unlink(missing_ok=True)
        raise records.UserError(f"cannot reserve {need / 1e6:.0f} MB in {folder}: {error.strerror}") from None
    return arrays


def open_arrays(folder, args, env, iterations):
    """Arrays of an interrupted collection, to be filled further. UserError if they are not as they were created."""
    arrays = {}
    for name, shape in array_shapes(args, env, iterations).items():
        path = folder / f"{name}.npy"
        try:
            arrays[name] = np.load(path, mmap_mode="r+", allow_pickle=False)
            intact = arrays[name].shape == shape and arrays[name].dtype == KINDS[name][0]
        except PermissionError as error:
            raise records.UserError(f"cannot write {path}: {error.strerror}") from None
        except (OSError, ValueError, EOFError):
            intact = False
        if not intact:
            raise records.UserError(f"{path} is missing or damaged; start the collection again with --force")
    return arrays


def flush(arrays):
    """Write what is in memory to the disk."""
    for array in arrays.values():
        array.flush()


def finish(folder, arrays, args, env, iterations, held_out):
    """Flush the full arrays and write meta.json; the last `held_out` environments are for validation.

    The state for --resume goes: it is as large as the ring buffer, and of no more use.
    """
    flush(arrays)
    meta = {
        "robot": env.robot.name,
        "layout": list(env.prop_layout),
        "iterations": iterations,
        "num_steps": args.num_steps,
        "num_envs": args.num_envs,
        "transitions": iterations * args.num_steps * args.num_envs,
        "validation_envs": list(range(args.num_envs - held_out, args.num_envs)),
        "history": env.config.history,
        "action_scale": list(env.robot.action_scale),
        "dt": env.dt,
        "args": dataclasses.asdict(args),
        "config": dataclasses.asdict(env.config),
        "versions": records.versions(),
    }
    records.replace_text(folder / "meta.json", json.dumps(meta, indent=1) + "\n")
    (folder / records.STATE).unlink(missing_ok=True)


def read_meta(folder):
    """meta.json of a collection. UserError if it is missing, damaged or of an unknown robot."""
    path = Path(folder) / "meta.json"
    try:
        meta = json.loads(path.read_text())
        sizes = [meta[name] for name in ("iterations", "num_steps", "num_envs", "history")]
        held_out = meta["validation_envs"]
        intact = isinstance(held_out, list) and all(type(size) is int and 0 < size < 10**9 for size in sizes)
        intact = intact and all(type(env) is int and 0 <= env < meta["num_envs"] for env in held_out)
        intact = intact and {"layout", "transitions", "args", "versions"} <= meta.keys()
        intact = intact and isinstance(meta["robot"], str)
    except (FileNotFoundError, NotADirectoryError):
        what = "an unfinished collection (no meta.json)" if Path(folder).is_dir() else "not a folder"
        raise records.UserError(f"{folder} is {what}; run ppo_explore.py first") from None
    except OSError as error:
        raise records.UserError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        intact = False
    if not intact:
        raise records.UserError(f"{path} is damaged; collect the data again")
    if robot_of(meta) == meta["robot"] and meta["robot"] not in envs.EXPLORE:
        raise records.UserError(f"{folder} holds robot {meta['robot']!r}; known are {', '.join(envs.EXPLORE)}")
    return meta


def robot_of(meta):
    """Name of a collection's robot, or the body of one that came from a file."""
    config = meta.get("config")
    return (config.get("body") if isinstance(config, dict) else None) or meta["robot"]


def env_of(folder, meta):
    """Environment of a collection's robot. UserError if the robot, x or the scale of actions is another one today."""
    try:
        config = meta["config"] if isinstance(meta.get("config"), dict) else {}
        same = {name: config[name] for name in ("physics_dt", "decimation") if name in config}
        env = envs.make_explore(robot_of(meta), "c", history=meta["history"], **same)
        scale = np.broadcast_to(np.array(meta.get("action_scale", env.robot.action_scale), float), env.action_dim)
    except (ValueError, KeyError, TypeError) as error:
        raise records.UserError(f"{folder}/meta.json is damaged: {error!r}; collect the data again") from None
    if meta["layout"] != list(env.prop_layout):
        raise records.UserError(f"{folder} has x = {meta['layout']}, not {list(env.prop_layout)}")
    if not np.array_equal(scale, env.robot.action_scale):
        found, ours = scale.tolist(), list(env.robot.action_scale)
        raise records.UserError(f"{folder} has action_scale = {found}, not {ours}; collect the data again")
    return env


def read_array(folder, name, meta):
    """One memory-mapped array of a collection. UserError if it is missing, damaged or not as meta.json says."""
    path, (dtype, axes) = Path(folder) / f"{name}.npy", KINDS[name]
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses a header, and has no class for all that can be wrong with one
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise records.UserError(f"cannot read {path}: {why}; collect the data again") from None
    if array.shape[:3] != (meta["iterations"], meta["num_steps"], meta["num_envs"]):
        raise records.UserError(f"{path} has shape {array.shape}, which meta.json does not name; collect it again")
    if array.dtype != dtype or array.ndim != axes:
        raise records.UserError(f"{path} holds {array.dtype} in {array.ndim} dimensions; collect the data again")
    return array
