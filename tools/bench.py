"""Measure speed and memory on this machine, into results/bench/<machine>.json, and make README.md there from them.

    python tools/bench.py
    python tools/bench.py --parts engines --tasks go1_loco --engines mjx warp --counts 1024 4096 --machine h200
    python tools/bench.py --parts peers --peers .peers/bin/python

    engines   steps per second, compile time and memory: of the physics alone ("bare", with random joint targets), and
              of the whole environment step ("env": engine, rewards, observations, resets)
    training  ppo_finetune.py with a task's preset, learning included, after compilation; 512 environments on a CPU,
              each of --counts on an accelerator
    seeds     five seeds in one program against one seed
    solver    error of one control step of an exploring robot when the contact solver's iterations are limited
    peers     PPO of rsl_rl and Brax, and the speed of ours over theirs ("ours": at the same widths); see peers.py

A part that is measured again replaces its older figures. Each figure comes from a process of its own.
"""

import copy
import itertools
import json
import os
import platform
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

# This process keeps the device open while others measure on it, so it must not take most of a GPU's memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import numpy as np
import tyro

import envs
from envs.engine import (
    mujoco,  # envs comes first: it takes MUJOCO_GL out of the way
)
from experiment import devices, records

Part = Literal["engines", "training", "seeds", "solver", "peers"]


@dataclass(frozen=True)
class Args:
    tasks: tuple[str, ...] = tuple(envs.TASKS)
    parts: tuple[Part, ...] = ("engines", "training", "seeds", "solver")
    engines: tuple[Literal["c", "mjx", "warp"], ...] = ("c", "mjx")
    counts: tuple[int, ...] = (256, 1024, 4096)  # environments; mjx and warp on a CPU: 64
    hidden: tuple[int, ...] | None = None  # widths of the trained MLP; None: the task's
    peers: str | None = None  # Python of an environment that has the peers' packages
    machine: str = "cpu"  # name of the results' file
    label: str = ""  # added to the parts' names, so that older figures are kept
    limit_s: float = 400.0  # for each figure
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
    """Speed, compile time and peak memory of the engine alone, or of the whole environment step."""
    env = envs.make(task, engine)
    length = 50 if engine == "c" or jax.default_backend() != "cpu" else 10
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    actions = jax.random.normal(jax.random.key(1), (length, num_envs, env.action_dim))
    step, carry, inputs = jax.vmap(env.step), state, actions
    if not whole:
        targets = env.default_pose + env.action_scale * actions
        step, carry, inputs = jax.vmap(env.engine.step), state.physics, targets
    speed, compile_s = rate(
        lambda c, inputs: jax.lax.scan(lambda s, a: (step(s, a), None), c, inputs)[0], carry, inputs, num_envs * length
    )
    return {"steps/s": speed, "compile s": compile_s, "MiB": memory()}


def memory():
    """Peak memory [MiB] of the device if JAX knows it, else of this process."""
    stats = jax.devices()[0].memory_stats() or {}
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return stats["peak_bytes_in_use"] / 2**20 if "peak_bytes_in_use" in stats else kib / 1024


def training(task, num_envs=512, hidden=None, num_seeds=1, extra=(), iterations=20):
    """Steps per second of ppo_finetune.py after its first row, compile time, and time from start to that row."""
    ppo = envs.TASKS[task][1].ppo["cpu"]
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
        count, seconds = ([row[name] for row in records.read_rows(path)] for name in ("env_steps", "seconds"))
        speed = num_seeds * (count[-1] - count[0]) / (seconds[-1] - seconds[0])
        return {"envs": num_envs, "steps/s": speed, "compile s": compile_s, "start to first row s": to_first}


def in_process(limit_s, name, *inputs):
    """Call a function of FIGURES in a process of its own. If that fails, the row holds the reason.

    jaxlib 0.10.2 can lock up on a CPU of two cores where two batched Cholesky factorisations meet (seen with G1, mjx).
    """
    command = [sys.executable, __file__, "--cell", json.dumps([name, *inputs])]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, start_new_session=True, **pipes) as process:
        try:
            out, error = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            return {"failed": f"did not end in {limit_s:.0f} s"}
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # also a training that it has started
    if process.returncode:
        return {"failed": (error.strip().splitlines() or [f"exit code {process.returncode}"])[-1][:120]}
    return json.loads(out.splitlines()[-1])


def engine_rows(args):
    """Rows of each task, engine and number of environments, bare and whole."""
    for task, engine in itertools.product(args.tasks, args.engines):
        slow = engine != "c" and jax.default_backend() == "cpu"
        for count, what in itertools.product((64,) if slow else args.counts, ("bare", "env")):
            row = in_process(args.limit_s, "stepping", task, engine, count, what == "env")
            yield {"task": task, "engine": engine, "what": what, "envs": count} | row


def training_rows(args):
    """Rows of each task: engine c with 512 environments on a CPU, else each engine and number of environments."""
    on_cpu = jax.default_backend() == "cpu"
    engines, counts = (("c",), (512,)) if on_cpu else (args.engines, args.counts)
    for task, engine, count in itertools.product(args.tasks, engines, counts):
        row = in_process(args.limit_s, "training", task, count, args.hidden, 1, ("--engine", engine))
        yield {"task": task, "engine": engine} | row


def seed_rows(args):
    """Rows of one and of five seeds."""
    for count in (1, 5):
        row = in_process(5 * args.limit_s, "training", "go1_loco", 256, None, count)
        yield {"task": "go1_loco", "seeds": count} | row


def solver_rows(args):
    """Rows of each task and limit."""
    for task, limit in itertools.product(args.tasks, (4, 6, 10)):
        yield {"task": task, "limit": limit} | in_process(args.limit_s, "solver", task, limit)


def solver(task, limit, num_envs=64):
    """Error of one control step after 0.6 s of random actions, against a converged solver.

    It is the 90th percentile over robots of a robot's largest error of qpos [m, rad] and of 0.02 s times qvel.
    """
    env = envs.make(task, "c")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    step = jax.jit(jax.vmap(env.step))
    actions = 0.6 * jax.random.normal(jax.random.key(1), (31, num_envs, env.action_dim))
    for action in actions[:-1]:
        state = step(state, action)
    physics, results, used = jax.device_get(state.physics), {}, []
    for iterations in (limit, 100):
        model = copy.copy(env.model)
        model.opt.iterations = model.opt.ls_iterations = iterations
        rows = []
        for i, target in enumerate(np.asarray(env.default_pose + env.action_scale * actions[-1])):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], data.ctrl[:] = physics.qpos[i], physics.qvel[i], target
            data.mocap_pos[:], data.mocap_quat[:] = physics.mocap_pos[i], physics.mocap_quat[i]
            for _ in range(env.config.decimation):
                mujoco.mj_step(model, data)
                used += [int(data.solver_niter[0])] if iterations == limit else []
            rows.append(np.concatenate([data.qpos, 0.02 * data.qvel]))
        results[iterations] = np.array(rows)
    error = np.abs(results[limit] - results[100]).max(1)
    at_limit = float(np.mean(np.array(used) >= limit))
    return {"mean iterations": float(np.mean(used)), "at limit": at_limit, "error": float(np.quantile(error, 0.9))}


def peer_rows(args):
    """Rows of ours, of rsl_rl on the same physics and networks, and of Playground with Brax; 512 environments.

    Neither of them has a mirror loss, so ours is also measured without.
    """
    for hidden in ((128, 128, 128), (512, 256, 128)):
        for what, extra in (("ours", ()), ("ours, no mirror loss", ("--mirror-coef", 0))):
            row = in_process(args.limit_s, "training", "go1_loco", 512, hidden, 1, extra)
            yield {"what": what, "hidden": hidden} | row
        words = ["rsl_rl", "--hidden", *map(str, hidden)]
        yield {"what": "rsl_rl", "hidden": hidden} | run_peer(args, words)
    yield {"what": "playground", "hidden": (512, 256, 128)} | run_peer(args, ["playground"])


def run_peer(args, words):
    """Run peers.py with these arguments. If it fails, the row holds the reason."""
    command = [args.peers, "tools/peers.py", *words]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ)
    if run.returncode:
        return {"failed": (run.stderr.strip().splitlines() or [f"exit code {run.returncode}"])[-1][:120]}
    return {"envs": 512} | json.loads(run.stdout.splitlines()[-1])


FIGURES = {"stepping": stepping, "training": training, "solver": solver}
ROWS = {
    "engines": engine_rows,
    "training": training_rows,
    "seeds": seed_rows,
    "solver": solver_rows,
    "peers": peer_rows,
}


def cpu_name():
    """Name of the processor, if the system gives it."""
    info = Path("/proc/cpuinfo")  # Linux's
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()


def as_text(value):
    """A number, or numbers, as in the tables."""
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
    """Rows of part peers with the speed of ours over theirs: at the same widths, and at the first ones measured."""
    ours = {tuple(row["hidden"]): row["steps/s"] for row in rows if row["what"] == "ours" and "steps/s" in row}
    compared = []
    for row in rows:
        speed, same = row.get("steps/s"), ours.get(tuple(row["hidden"]))
        ratios = {"ours": same / speed, "ours, small": next(iter(ours.values())) / speed} if speed and same else {}
        compared.append(row | ratios)
    return compared


def main(args):
    """Measure the parts and write the page. UserError for an unknown task, or peers without --peers."""
    devices.find()
    if args.cell:
        name, *inputs = json.loads(args.cell)
        return print(json.dumps(FIGURES[name](*inputs)))
    for name in {*args.tasks} - envs.TASKS.keys():
        raise records.UserError(f"unknown task {name!r}; known: {', '.join(envs.TASKS)}")
    if "peers" in args.parts and not (args.peers and Path(args.peers).exists()):
        raise records.UserError("part peers needs --peers PYTHON, of an environment as in tools/peers.py")
    folder = ROOT / "results/bench"
    path = folder / f"{args.machine}.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    for part in args.parts:
        here, rows = {"cpu": cpu_name()} | records.versions(), []
        print(part, here)
        for row in ROWS[part](args):
            rows.append(row)
            print("  ".join(f"{name} {as_text(value)}" for name, value in row.items()), flush=True)
        if part == "peers":
            print(table(with_ratios(rows)))
        known[f"{part} {args.label}".strip()] = {"machine": here, "rows": rows}
        records.write(path, (json.dumps(known, indent=1) + "\n").encode())
    return write_page(folder)


def write_page(folder):
    """Write README.md: the tables of every machine."""
    page = ["# Speed", "", "Made by [`python tools/bench.py`](../../tools/bench.py), which explains the rows."]
    page += ["Those of the H100 were measured so by a shorter script, beside trainings; it was not kept."]
    for path in sorted(folder.glob("*.json")):
        for part, found in json.loads(path.read_text()).items():
            facts = ", ".join(f"{name} {value}" for name, value in found["machine"].items())
            rows = with_ratios(found["rows"]) if part.startswith("peers") else found["rows"]
            page += ["", f"## {path.stem}: {part}", "", f"{facts}.", "", table(rows)]
    records.replace_text(folder / "README.md", "\n".join(page) + "\n")


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
