"""Measure speed and memory on this machine: results/bench/<machine>.json, and README.md with the tables.

    python results/bench.py
    python results/bench.py --parts engines --tasks go1_loco --engines mjx warp --counts 1024 4096 --machine h200
    python results/bench.py --parts peers --peers .peers/bin/python

engines   steps per second of the physics alone ("bare": random joint targets, as at the start of a training) and of the
          whole environment step ("env": engine, rewards, observations, resets), compile time and memory
training  ppo_finetune.py with a task's preset, learning included, after compilation: of 512 environments on a CPU, of
          each number on an accelerator
seeds     five seeds in one program against one seed
solver    how far a limit on the contact solver's iterations moves a control step of an exploring robot
peers     PPO of rsl_rl and Brax, and how many times faster ours is ("ours": at the same widths); see peers.py

A part that is measured again replaces what stood there. Every figure comes from a process of its own.
"""

import copy
import csv
import itertools
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

# This process names the device while others measure on it: it must not take most of a GPU's memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import mujoco
import numpy as np
import tyro

import envs

Part = Literal["engines", "training", "seeds", "solver", "peers"]


@dataclass(frozen=True)
class Args:
    tasks: tuple[str, ...] = tuple(envs.TASKS)
    parts: tuple[Part, ...] = ("engines", "training", "seeds", "solver")
    engines: tuple[Literal["c", "mjx", "warp"], ...] = ("c", "mjx")
    counts: tuple[int, ...] = (256, 1024, 4096)  # environments; mjx and warp on a CPU: 64
    hidden: tuple[int, ...] | None = None  # widths of the trained MLP; None: the task's
    peers: str | None = None  # Python that has the peers' packages
    machine: str = "cpu"  # name of the results
    label: str = ""  # added to the parts' names, so that they stand beside what was measured before
    limit_s: float = 400.0  # for one figure
    cell: str | None = None  # internal: measure one figure and print it


def rate(function, carry, inputs, steps, repeats=3):
    """Best steps per second of `carry = function(carry, inputs)`, which makes `steps` steps, and its compile time."""
    start = time.perf_counter()
    function = jax.jit(function).lower(carry, inputs).compile()
    compile_s, times = time.perf_counter() - start, []
    for _ in range(repeats + 1):  # the first fills caches
        start = time.perf_counter()
        carry = jax.block_until_ready(function(carry, inputs))
        times.append(time.perf_counter() - start)
    return steps / min(times), compile_s


def stepping(task, engine, num_envs, whole):
    """Speed of the engine alone, or of the whole environment step; with compile time and peak memory."""
    env = envs.make(task, engine)
    length = 50 if engine == "c" or jax.default_backend() != "cpu" else 10
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    actions = jax.random.normal(jax.random.key(1), (length, num_envs, env.action_dim))
    step, carry, inputs = jax.vmap(env.step), state, actions
    if not whole:
        targets = env.default_pose + env.robot.action_scale * actions
        step, carry, inputs = jax.vmap(env.engine.step), state.physics, targets
    speed, compile_s = rate(
        lambda c, inputs: jax.lax.scan(lambda s, a: (step(s, a), None), c, inputs)[0], carry, inputs, num_envs * length
    )
    return {"steps/s": speed, "compile s": compile_s, "MiB": memory()}


def memory():
    """Peak memory [MiB]: of the device where JAX knows it, else of this process."""
    stats = jax.devices()[0].memory_stats() or {}
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return stats["peak_bytes_in_use"] / 2**20 if "peak_bytes_in_use" in stats else kib / 1024


def training(task, num_envs=None, hidden=None, num_seeds=1, extra=(), iterations=20):
    """Steps per second of ppo_finetune.py after its first row, compile time, and time from start to that row."""
    ppo = envs.TASKS[task][1].ppo["cpu"]
    num_envs = num_envs or 512
    steps = num_envs * ppo.get("num_steps", 24)
    with tempfile.TemporaryDirectory() as folder:
        words = ["--task", task, "--num-envs", num_envs, "--run-dir", folder, "--force", "--num-seeds", num_seeds]
        words += ["--total-steps", steps * iterations, *(["--hidden", *hidden] if hidden else []), *extra]
        start, to_first, compile_s = time.perf_counter(), None, None
        command = [sys.executable, "ppo_finetune.py", *map(str, words)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            for text in process.stdout:
                if text.startswith("compiled in"):
                    compile_s = float(text.split()[2])
                if " steps " in text and to_first is None:
                    to_first = time.perf_counter() - start
        path = Path(folder, "metrics.csv") if num_seeds == 1 else Path(folder, "seed0/metrics.csv")
        with path.open() as file:
            rows = list(csv.DictReader(file))
        count, seconds = ([float(row[name]) for row in rows] for name in ("env_steps", "seconds"))
        speed = num_seeds * (count[-1] - count[0]) / (seconds[-1] - seconds[0])
        return {"envs": num_envs, "steps/s": speed, "compile s": compile_s, "start to first row s": to_first}


def in_process(limit_s, what, *inputs):
    """One of the functions above in a process of its own, or a row that says why there is no figure.

    jaxlib 0.10.2 can lock up on a CPU of two cores where two batched Cholesky factorisations meet (seen with G1, mjx).
    """
    command = [sys.executable, __file__, "--cell", json.dumps([what, *inputs])]
    try:
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return {"failed": f"did not end in {limit_s:.0f} s"}
    if run.returncode:
        return {"failed": run.stderr.strip().splitlines()[-1][:120]}
    return json.loads(run.stdout.splitlines()[-1])


def engine_rows(args):
    """Each task on each engine with each number of environments, bare and whole."""
    for task, engine in itertools.product(args.tasks, args.engines):
        slow = engine != "c" and jax.default_backend() == "cpu"
        for count, what in itertools.product((64,) if slow else args.counts, ("bare", "env")):
            row = in_process(args.limit_s, "stepping", task, engine, count, what == "env")
            yield {"task": task, "engine": engine, "what": what, "envs": count} | row


def training_rows(args):
    """Engine c with 512 environments on a CPU; on an accelerator each engine with each number of environments."""
    on_cpu = jax.default_backend() == "cpu"
    engines, counts = (("c",), (512,)) if on_cpu else (args.engines, args.counts)
    for task, engine, count in itertools.product(args.tasks, engines, counts):
        row = in_process(args.limit_s, "training", task, count, args.hidden, 1, ("--engine", engine))
        yield {"task": task, "engine": engine} | row


def seed_rows(args):
    for count in (1, 5):
        row = in_process(5 * args.limit_s, "training", "go1_loco", 256, None, count)
        yield {"task": "go1_loco", "seeds": count} | row


def solver_rows(args):
    for task, limit in itertools.product(args.tasks, (4, 6, 10)):
        yield {"task": task, "limit": limit} | in_process(args.limit_s, "solver", task, limit)


def solver(task, limit, num_envs=64):
    """One control step after 0.6 s of random actions, against the converged one.

    The error is of qpos [m, rad] and of 0.02 s times qvel, the largest of a robot, its 90th percentile over robots.
    """
    env = envs.make(task, "c")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    step = jax.jit(jax.vmap(env.step))
    actions = 0.6 * jax.random.normal(jax.random.key(1), (31, num_envs, env.action_dim))
    for action in actions[:-1]:
        state = step(state, action)
    physics, ends, used = jax.device_get(state.physics), {}, []
    for most in (limit, 100):
        model = copy.copy(env.model)
        model.opt.iterations = model.opt.ls_iterations = most
        rows = []
        for i, target in enumerate(np.asarray(env.default_pose + env.robot.action_scale * actions[-1])):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], data.ctrl[:] = physics.qpos[i], physics.qvel[i], target
            data.mocap_pos[:], data.mocap_quat[:] = physics.mocap_pos[i], physics.mocap_quat[i]
            for _ in range(env.config.decimation):
                mujoco.mj_step(model, data)
                used += [int(data.solver_niter[0])] if most == limit else []
            rows.append(np.concatenate([data.qpos, 0.02 * data.qvel]))
        ends[most] = np.array(rows)
    error = np.abs(ends[limit] - ends[100]).max(1)
    at_limit = float(np.mean(np.array(used) >= limit))
    return {"mean iterations": float(np.mean(used)), "at limit": at_limit, "error": float(np.quantile(error, 0.9))}


def peer_rows(args):
    """Ours beside rsl_rl on the same physics and networks, and beside Playground with Brax; 512 environments.

    Neither has a mirror loss, so ours stands there without it as well.
    """
    for hidden in ((128, 128, 128), (512, 256, 128)):
        for what, extra in (("ours", ()), ("ours, no mirror loss", ("--mirror-coef", 0))):
            row = in_process(args.limit_s, "training", "go1_loco", 512, hidden, 1, extra)
            yield {"what": what, "hidden": hidden} | row
        words = ["rsl_rl", "--hidden", *map(str, hidden)]
        yield {"what": "rsl_rl", "hidden": hidden} | run_peer(args, words)
    yield {"what": "playground", "hidden": (512, 256, 128)} | run_peer(args, ["playground"])


def run_peer(args, words):
    command = [args.peers, "results/peers.py", *words]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ)
    if run.returncode:
        return {"failed": run.stderr.strip().splitlines()[-1][:120]}
    return {"envs": 512} | json.loads(run.stdout.splitlines()[-1])


ROWS = {
    "engines": engine_rows,
    "training": training_rows,
    "seeds": seed_rows,
    "solver": solver_rows,
    "peers": peer_rows,
}


def cpu_name():
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()


def machine():
    """What the figures were measured on."""
    git = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return {
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "commit": git.stdout.strip(),
    }


def as_text(value):
    if isinstance(value, float):
        digits = 0 if abs(value) >= 100 else 2
        return f"{value:,.{digits}f}" if not 0 < abs(value) < 0.01 else f"{value:.1e}"
    return "-".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def table(rows):
    """Rows as a Markdown table whose columns are all keys, in order."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(as_text(row.get(name, '')) for name in columns)} |" for row in rows]
    return "\n".join(lines)


def with_ratios(rows):
    """Rows of part peers, and how many times faster ours is: at the same widths, and at the first ones measured."""
    ours = {tuple(row["hidden"]): row["steps/s"] for row in rows if row["what"] == "ours" and "steps/s" in row}
    told = []
    for row in rows:
        speed, same = row.get("steps/s"), ours.get(tuple(row["hidden"]))
        known = speed and same
        told.append(row | ({"ours": same / speed, "ours, small": next(iter(ours.values())) / speed} if known else {}))
    return told


def main(args):
    if args.cell:
        what, *inputs = json.loads(args.cell)
        print(json.dumps({"stepping": stepping, "training": training, "solver": solver}[what](*inputs)))
        return
    for name in {*args.tasks} - envs.TASKS.keys():
        print(f"error: unknown task {name!r}; known: {', '.join(envs.TASKS)}", file=sys.stderr)
        sys.exit(2)
    if "peers" in args.parts and not (args.peers and Path(args.peers).exists()):
        print("error: part peers needs --peers PYTHON, of an environment as results/peers.py says", file=sys.stderr)
        sys.exit(2)
    out = ROOT / "results/bench"
    path = out / f"{args.machine}.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    for part in args.parts:
        here, rows = machine(), []
        print(part, here)
        for row in ROWS[part](args):
            rows.append(row)
            print("  ".join(f"{name} {as_text(value)}" for name, value in row.items()), flush=True)
        if part == "peers":
            print(table(with_ratios(rows)))
        known[f"{part} {args.label}".strip()] = {"machine": here, "rows": rows}
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(known, indent=1) + "\n")
    write_page(out)


def write_page(out):
    """README.md: the tables of every machine."""
    page = ["# Speed", "", "Made by `python results/bench.py`; what the rows mean stands in [bench.py](../bench.py)."]
    for path in sorted(out.glob("*.json")):
        for part, found in json.loads(path.read_text()).items():
            facts = ", ".join(f"{name} {value}" for name, value in found["machine"].items())
            rows = with_ratios(found["rows"]) if part.startswith("peers") else found["rows"]
            page += ["", f"## {path.stem}: {part}", "", f"{facts}.", "", table(rows)]
    (out / "README.md").write_text("\n".join(page) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
