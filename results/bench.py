"""Measure speed on this machine and write results/bench/<name>.json and README.md with the table.

    python results/bench.py

bare      the physics engine alone, moved by random joint targets as at the start of a training
env       the whole environment step under jit: engine, rewards, observations, resets; the same actions
training  ppo_finetune.py, learning included, after its compilation
"""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import jax
import mujoco

import envs


def rate(function, carry, steps, repeats=3):
    """Best steps per second of `carry = function(carry)`, which makes `steps` environment steps, and compile time."""
    start = time.perf_counter()
    carry = jax.block_until_ready(function(carry))
    first = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        carry = jax.block_until_ready(function(carry))
        times.append(time.perf_counter() - start)
    return steps / min(times), first - min(times)


def stepping(task, engine, num_envs, length, whole):
    """Control steps per second of the engine alone, or of the whole environment. Returns (steps/s, compile s)."""
    env = envs.make(task, engine)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_envs))
    actions = jax.random.normal(jax.random.key(1), (length, num_envs, env.action_dim))
    step, carry, inputs = jax.vmap(env.step), state, actions
    if not whole:
        targets = env.default_pose + env.robot.action_scale * actions
        step, carry, inputs = jax.vmap(env.engine.step), state.physics, targets
    many = jax.jit(lambda c: jax.lax.scan(lambda s, a: (step(s, a), None), c, inputs)[0])
    return rate(many, carry, num_envs * length)


def stepping_mjx(task, num_envs, limit_s=300):
    """`stepping` of engine mjx in a process of its own; (None, None) if it does not end.

    jaxlib 0.10.2 can lock up on a CPU of two cores where two batched Cholesky factorisations meet (seen with G1).
    """
    code = f"import json, bench; print(json.dumps(bench.stepping({task!r}, 'mjx', {num_envs}, 10, False)))"
    try:
        run = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT / "results",
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=True,
        )
    except subprocess.TimeoutExpired:
        return None, None
    return json.loads(run.stdout.splitlines()[-1])


def training(task, num_envs):
    """Steps per second of ppo_finetune.py after its first row, its compile time and the time to that row."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "ppo_finetune.py", "--task", task, "--num-envs", str(num_envs), "--run-dir", folder]
        command += ["--total-steps", str(num_envs * 24 * 40)]
        start, to_first, compile_s = time.perf_counter(), None, None
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            for text in process.stdout:
                if text.startswith("compiled in"):
                    compile_s = float(text.split()[2])
                if " steps " in text and to_first is None:
                    to_first = time.perf_counter() - start
        with Path(folder, "metrics.csv").open() as file:
            rows = list(csv.DictReader(file))
        steps, seconds = ([float(row[name]) for row in rows] for name in ("env_steps", "seconds"))
        return (steps[-1] - steps[0]) / (seconds[-1] - seconds[0]), compile_s, to_first


def help_seconds():
    """Wall time of `ppo_finetune.py --help`, the better of two."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        subprocess.run([sys.executable, "ppo_finetune.py", "--help"], cwd=ROOT, capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    return min(times)


def cpu_name():
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    names = (
        [line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        if info.exists()
        else []
    )
    return names[0] if names else platform.processor() or platform.machine()


def measure(tasks, num_envs):
    """All figures as rows of (what, task, environments, figure, unit)."""
    rows = []
    for task in tasks:
        for what, whole in (("bare", False), ("env", True)):
            speed, _ = stepping(task, "c", num_envs, 50, whole)
            rows.append((f"{what}, engine c", task, num_envs, speed, "steps/s"))
        speed, compile_s, to_first = training(task, num_envs)
        rows.append(("training, engine c", task, num_envs, speed, "steps/s"))
        rows.append(("training over bare", task, num_envs, speed / rows[-3][3], "x"))
        rows.append(("compile", task, num_envs, compile_s, "s"))
        rows.append(("start to first row", task, num_envs, to_first, "s"))
        bare = rows[-6][3]
        speed, compile_s = stepping_mjx(task, 64)
        rows.append(("bare, engine mjx", task, 64, speed, "steps/s"))
        rows.append(("compile, engine mjx", task, 64, compile_s, "s"))
        rows.append(("engine c over mjx", task, "", bare / speed if speed else None, "x"))
        print("\n".join(as_text(row) for row in rows[-9:]), flush=True)
    rows.append(("--help", "", "", help_seconds(), "s"))
    print(as_text(rows[-1]))
    return rows


def as_text(row):
    what, task, num_envs, figure, unit = row
    if figure is None:
        return f"| {what} | {task} | {num_envs} | did not end |"
    return f"| {what} | {task} | {num_envs} | {figure:,.{0 if figure >= 100 else 2}f} {unit} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(envs.TASKS), default=list(envs.TASKS))
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--out", default=str(ROOT / "results/bench"))
    args = parser.parse_args()
    git = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    machine = {
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": str(jax.devices()[0]),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "commit": git.stdout.strip(),
    }
    print(machine)
    rows = measure(args.tasks, args.num_envs)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    (out / "cpu.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    table = "\n".join(as_text(row) for row in rows)
    facts = ", ".join(f"{name} {value}" for name, value in machine.items())
    head = f"# Speed\n\nMade by `python results/bench.py --tasks {' '.join(args.tasks)}` on: {facts}.\n\n"
    head += "| what | task | environments | figure |\n|---|---|---|---|\n"
    (out / "README.md").write_text(head + table + "\n")


if __name__ == "__main__":
    main()
