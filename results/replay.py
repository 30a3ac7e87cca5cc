"""Find where a training broke: go on from its last good state, and dump the robots that went wrong to nan.npz.

    python results/replay.py runs/go1_loco/mlp/seed0
    python results/replay.py runs/go1_loco/mlp/seed0/nan.npz

The first repeats the rollout in which something first was not finite, or a simulation blew up, bit for bit on engine c,
and writes what those environments did up to then: qpos, qvel (steps, environments, ...) before each control step, the
joint targets `ctrl` sent, and which environment it was. Where no robot did anything wrong it was the learning: it says
so. The second steps the dumped robots in plain MuJoCo from there.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import ppo_finetune
from envs import records


@dataclass(frozen=True)
class Args:
    where: tyro.conf.Positional[str]  # a run folder, or its nan.npz
    iterations: int = 10  # how far to go on
    most: int = 8  # robots in the dump


def follow(env, net, args, state):
    """One rollout: qpos, qvel before each step, joint targets, and whether each step was bad, all (T, N, ...)."""
    k_roll, _ = jax.random.split(jax.random.fold_in(state.key, state.iteration))
    _, roll, _ = ppo_finetune.rollout(args, env, net, state.params, state.env, k_roll)

    def step(env_state, action):
        after = jax.vmap(env.step)(env_state, action)
        fine = jnp.isfinite(after.reward) & jnp.isfinite(action).all(-1) & jnp.isfinite(after.final_obs).all(-1)
        physics, target = env_state.physics, env.default_pose + env.robot.action_scale * action
        return after, (physics.qpos, physics.qvel, target, ~fine | after.metrics["diverged"])

    return jax.lax.scan(step, state.env, roll.action)[1]


def find(folder, iterations, most):
    """Write nan.npz and say what happened; UserError if the folder is no run that can be resumed."""
    args = records.resumed(ppo_finetune.Args(resume=str(folder)))
    env = ppo_finetune.make_env(args)
    args = ppo_finetune.merge(args, env.config.ppo)
    net, opt = ppo_finetune.make_net(args, env), ppo_finetune.make_optimizer(args)
    like = jax.eval_shape(partial(ppo_finetune.init_state, args, env, net, opt))
    state, _ = records.load_state(folder, like)
    state = jax.tree.map(jnp.asarray, state)
    trace = jax.jit(partial(follow, env, net, args))
    advance = jax.jit(lambda state: ppo_finetune.iteration(args, env, net, opt, state)[0])
    for _ in range(iterations):
        now = int(state.iteration)
        qpos, qvel, ctrl, bad = map(np.asarray, trace(state))
        if bad.any():
            last = int(np.argmax(bad.any(1)))
            envs = np.flatnonzero(bad[last])[:most]
            dump = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl}
            dump = {name: x[: last + 1, envs] for name, x in dump.items()}
            path = Path(folder) / "nan.npz"
            with path.open("wb") as file:
                np.savez(file, **dump, environment=envs, task=args.task, iteration=now)
            many = f"{bad[last].sum()} of {args.num_envs}"
            return print(f"iteration {now}, step {last}: {many} environments went wrong; wrote {path}")
        state = advance(state)
        if not records.finite(state.params):
            return print(f"iteration {now}: every robot did well, but the update made weights that are not finite")
    return print(f"nothing went wrong in {iterations} iterations from {now + 1 - iterations} on; see --iterations")


def repeat(path):
    """The last step of each dumped robot again, in plain MuJoCo."""
    try:
        with np.load(path, allow_pickle=False) as file:
            dump = {name: file[name] for name in ("qpos", "qvel", "ctrl", "environment", "task", "iteration")}
        env = ppo_finetune.envs.make(str(dump["task"]), "c")
        if dump["qpos"].shape[2:] != (env.model.nq,) or dump["ctrl"].shape[2:] != (env.model.nu,):
            raise ValueError("its shapes are not those of its task")
    except Exception as error:  # numpy has no common class for what can be wrong with a file
        raise records.UserError(f"{path} is not a dump of this script: {error}") from None
    for i, number in enumerate(dump["environment"]):
        data = mujoco.MjData(env.model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (dump[name][-1, i] for name in ("qpos", "qvel", "ctrl"))
        print(
            f"environment {number}: base at {np.round(data.qpos[:3], 2)} m, joint targets {np.round(data.ctrl, 2)} rad"
        )
        for step in range(env.config.decimation):
            mujoco.mj_step(env.model, data)
            fast, hard = np.abs(data.qvel).max(), np.abs(data.qfrc_constraint).max()
            print(f"  physics step {step}: fastest {fast:.3g} m/s or rad/s, hardest contact {hard:.3g} N or N m")


def main(args):
    if Path(args.where).suffix == ".npz":
        return repeat(Path(args.where))
    return find(Path(args.where), args.iterations, args.most)


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
