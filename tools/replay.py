"""Find where a training broke: continue from its last good state, and dump the robots that failed to nan.npz.

    python tools/replay.py runs/go1_loco/mlp/seed0
    python tools/replay.py runs/go1_loco/mlp/seed0/nan.npz

The first command repeats the training, bit for bit on engine c, up to the first rollout with a number that is not
finite or a simulation that diverged. nan.npz holds these environments up to that step: qpos, qvel, obstacles and forces
on bodies (steps, environments, ...) before each control step, the joint targets `ctrl`, and the environments' numbers.
If no robot failed, it was the update of the weights. The second command steps the dumped robots in plain MuJoCo, with
the masses and friction of their file and without joint friction: those of the episodes are not in the dump.
"""

import io
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
import ppo_finetune
from envs.engine import mujoco  # envs comes first: it takes MUJOCO_GL out of the way
from experiment import arguments, checkpoints, records
from experiment.run import make_env


@dataclass(frozen=True)
class Args:
    path: tyro.conf.Positional[str]  # a run's folder, or its nan.npz
    iterations: int = 10  # of the training to repeat, at most
    robots: int = 8  # in the dump, at most


# before a step; ctrl are the joint targets, xfrc_applied the forces on bodies
DUMPED = ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "xfrc_applied")


def trace(args, env, net, state):
    """One rollout: what is in DUMPED of each step, and where one failed; each (T, N, ...)."""
    k_roll, _ = jax.random.split(jax.random.fold_in(state.key, state.iteration))
    _, (roll, _) = ppo_finetune.rollout(args, env, net, state.params, state.env_state, k_roll)

    def step(before, action):
        after = jax.vmap(env.step)(before, action)
        sound = jnp.isfinite(after.reward) & jnp.isfinite(action).all(-1) & jnp.isfinite(after.final_obs).all(-1)
        physics, target = before.physics, jax.vmap(env.joint_targets)(before, action)
        given = physics.mocap_pos, physics.mocap_quat, physics.wrench
        return after, (physics.qpos, physics.qvel, target, *given, ~sound | after.metrics["diverged"])

    return jax.lax.scan(step, state.env_state, roll.action)[1]


def find(folder, iterations, robots):
    """Write nan.npz and print what failed. UserError if the folder is no run that can be resumed."""
    args = arguments.resumed(ppo_finetune.Args(resume=str(folder)))
    env = make_env(partial(envs.make, robust=args.robust, robot=args.robot), args.task, args)
    args = ppo_finetune.merge(args, env.config.ppo)
    net, opt = ppo_finetune.make_net(args, env), optax.scale_by_adam()
    like = jax.eval_shape(partial(ppo_finetune.init_state, args, env, net, opt))
    state, _ = checkpoints.load_state(folder, like)
    state = jax.tree.map(jnp.asarray, state)
    jitted_trace = jax.jit(partial(trace, args, env, net))
    advance = jax.jit(lambda state: ppo_finetune.iteration(args, env, net, opt, state)[0])
    first = int(state.iteration)
    for _ in range(iterations):
        now = int(state.iteration)
        *states, failed = map(np.asarray, jitted_trace(state))
        if failed.any():
            last = int(np.argmax(failed.any(1)))
            chosen = np.flatnonzero(failed[last])[:robots]
            dump = {name: x[: last + 1, chosen] for name, x in zip(DUMPED, states, strict=True)}
            path, file = Path(folder) / "nan.npz", io.BytesIO()
            robot = str(Path(args.robot).resolve()) if args.robot else ""
            made = {"task": args.task, "robot": robot, "robust": args.robust, "set": np.array(args.set, str)}
            np.savez(file, **dump, **made, environment=chosen, iteration=now)
            records.replace_bytes(path, file.getvalue())
            count = f"{failed[last].sum()} of {args.num_envs}"
            return print(f"iteration {now}, step {last}: {count} environments failed; wrote {path}")
        state = advance(state)
        if not checkpoints.finite(state.params):
            return print(f"iteration {now}: no robot failed, but the update made weights that are not finite")
    return print(f"nothing failed from iteration {first} to {state.iteration - 1}; see --iterations")


def repeat(path):
    """Repeat the last step of each dumped robot in plain MuJoCo."""
    try:
        with np.load(path, allow_pickle=False) as file:
            names = (*DUMPED, "environment", "task", "robot", "robust", "set")
            dump = {name: file[name] for name in names if name in file or name != "xfrc_applied"}  # older ones lack it
        args = ppo_finetune.Args(task=str(dump["task"]), engine="c", set=tuple(dump["set"].tolist()))
        make = partial(envs.make, robust=bool(dump["robust"]), robot=str(dump["robot"]) or None)
        env = make_env(make, args.task, args)
        if dump["qpos"].shape[2:] != (env.model.nq,) or dump["ctrl"].shape[2:] != (env.model.nu,):
            raise ValueError("its shapes are not those of its task")
    except Exception as error:  # numpy has no common class for what can be wrong with a file
        raise records.UserError(f"{path} is not a dump of tools/replay.py: {error}") from None
    env.model.dof_frictionloss[:] = 0.0
    for i, number in enumerate(dump["environment"]):
        data = mujoco.MjData(env.model)
        for name in [name for name in DUMPED if name in dump]:
            getattr(data, name)[:] = dump[name][-1, i]
        print(
            f"environment {number}: base at {np.round(data.qpos[:3], 2)} m, joint targets {np.round(data.ctrl, 2)} rad"
        )
        for step in range(env.config.decimation):
            mujoco.mj_step(env.model, data)
            speed, force = np.abs(data.qvel).max(), np.abs(data.qfrc_constraint).max()
            print(
                f"  physics step {step}: fastest {speed:.3g} m/s or rad/s, largest contact force {force:.3g} N or N m"
            )


def main(args):
    """Find the robots that failed in a run, or repeat those of a dump."""
    if Path(args.path).suffix == ".npz":
        return repeat(Path(args.path))
    return find(Path(args.path), args.iterations, args.robots)


if __name__ == "__main__":
    with records.one_line_errors():
        main(tyro.cli(Args, description=__doc__))
