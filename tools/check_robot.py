"""See in half a minute whether a robot's file will do: load it, stand it up, mirror it, shake it, look at it.

    python tools/check_robot.py go2.xml
    python tools/check_robot.py h1.toml --no-mjx

Prints what envs/loader.py derived, five checks and what it would change. Draws four views into a PNG. Exit code 1 if
the robot falls over, diverges or is no mirror image of itself where it should be.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from envs import loader, render, terrain
from envs.anatomy import REFLECTIONS, touch
from experiment import devices, records

STEPS, ROBOTS = 250, 4  # random control steps of each of these robots


@dataclass(frozen=True)
class Args:
    """One robot."""

    robot: tyro.conf.Positional[str]  # MJCF or URDF file, or a .toml that names one
    mjx: bool = True  # also run it on the engine mjx, which takes a minute to compile
    out: str | None = None  # picture; None: runs/check/<robot>.png


def standing_start(model, robot, body):
    """MjData of a robot in its default pose, its feet on the ground."""
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, body["height"], 1, 0, 0, 0, *robot.default_pose]
    data.ctrl[:] = robot.default_pose
    return data


def stand(model, robot, body):
    """Hold the default pose for 2 s, or until it falls. Numbers by name: what sinks, tilts, strains and touches."""
    data, up, least = standing_start(model, robot, body), np.zeros(9), touch(body["mass"])
    mujoco.mj_forward(model, data)
    ahead = data.subtree_com[1, :2] - np.mean([data.site(foot).xpos[:2] for foot in body["feet"]], 0)
    while data.time < 2.0:
        mujoco.mj_step(model, data)
        mujoco.mju_quat2Mat(up, data.qpos[3:7])
        touching = {name: np.linalg.norm(data.sensor(f"{name}_force").data) > least for name in body["contact_ends"]}
        if up[8] < np.cos(np.deg2rad(30)) or any(touching.values()):
            break
    feet = [np.linalg.norm(data.sensor(f"{foot}_force").data) > least for foot in body["feet"]]
    return {
        "stands [s]": data.time,
        "sinks [m]": body["height"] - data.qpos[2],
        "tilt [deg]": np.rad2deg(np.arccos(np.clip(up[8], -1, 1))),
        "centre of mass ahead of the feet [m]": ahead[0],
        "joint error [rad]": np.abs(data.qpos[7:] - robot.default_pose).max(),
        "torque [share of limit]": (np.abs(data.actuator_force) / body["torque_limit"]).max(),
        "feet on the ground": sum(feet),
    }


def mirrored(robot, mirror, qpos, qvel, ctrl):
    """Mirror image of a state, worked out from the reflection itself: S v of polar vectors, -S v of axial ones."""
    s, turn, quat = REFLECTIONS[mirror], np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(turn, qpos[3:7])
    mujoco.mju_mat2Quat(quat, (s @ turn.reshape(3, 3) @ s).ravel())
    perm, sign = robot.mirror_joints(mirror)
    joints = [sign * x[perm] for x in (qpos[7:], qvel[6:], ctrl)]
    return (
        np.concatenate([s @ qpos[:3], quat, joints[0]]),
        np.concatenate([s @ qvel[:3], -s @ qvel[3:6], joints[1]]),
        joints[2],
    )


def mirror_error(model, robot, body, mirror):
    """Largest joint error [rad] and that of the base's place [m] between a random motion of 0.2 s and its image."""
    rng, scale = np.random.default_rng(0), np.array(robot.action_scale)
    worst = np.zeros(2)
    for _ in range(8):
        data = standing_start(model, robot, body)
        low, high = model.jnt_range[1:].T
        data.qpos[7:] = np.clip(data.qpos[7:] + 0.5 * scale * rng.normal(size=model.nu), low, high)
        data.qpos[2] += 0.05
        data.qvel[:] = 0.2 * rng.normal(size=model.nv)
        image, ctrl = mujoco.MjData(model), data.ctrl.copy()
        image.qpos[:], image.qvel[:], _ = mirrored(robot, mirror, data.qpos, data.qvel, ctrl)
        for _ in range(10):
            data.ctrl[:] = ctrl + scale * rng.normal(size=model.nu)
            _, _, image.ctrl[:] = mirrored(robot, mirror, data.qpos, data.qvel, data.ctrl)
            mujoco.mj_step(model, data, 4)
            mujoco.mj_step(model, image, 4)
        wanted, _, _ = mirrored(robot, mirror, data.qpos, data.qvel, ctrl)
        gap = np.abs(image.qpos - wanted)
        worst = np.maximum(worst, [gap[7:].max(), gap[:3].max()])
    return {"joints [rad]": worst[0], "base [m]": worst[1]}


def shake(body, engine):
    """Random control steps of the exploration environment on an engine: what failed, and the time.

    On mjx the ground is flat: boxes above a height field take it many minutes to compile.
    """
    env = envs.make_explore(body, engine, **({"rough": 0.0} if engine == "mjx" else {}))
    start = time.perf_counter()

    def step(state, key):
        state = jax.vmap(env.step)(state, jax.random.normal(key, (ROBOTS, env.action_dim)))
        return state, (state.metrics, state.terminated)

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), ROBOTS))
    run = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys)[1])
    report, ended = jax.block_until_ready(run(state, jax.random.split(jax.random.key(1), STEPS)))
    return {
        "diverged": int(report["diverged"].sum()),
        "lost contacts": int(report["overflow"].sum()) if "overflow" in report else 0,
        "falls": int(jnp.sum(ended)),
        "seconds": time.perf_counter() - start,
    }


def picture(robot, body):
    """Image of four sides of the robot as it stands."""
    spec = terrain.flat_scene(robot, visual=True)
    half = np.deg2rad([0, 90, 180, 270]) / 2 + np.deg2rad(15)
    poses = [[0, 0, body["height"], np.cos(a), 0, 0, np.sin(a), *robot.default_pose] for a in half]
    return render.sheet(render.draw(spec, np.array(poses)), 2)


def advice(body, stood, mirrors):
    """What a person should change, as lines."""
    names = np.array(body["joints"])

    def of(mask):
        return ", ".join(names[mask][:3]) + (f" and {mask.sum() - 3} more" if mask.sum() > 3 else "")

    loose, stiff = np.array(body["damping_ratio"]) < 0.25, np.array(body["action_scale"]) < 0.06
    ahead, feet = abs(stood["centre of mass ahead of the feet [m]"]), stood["feet on the ground"]
    uneven = any(error["joints [rad]"] > 1e-3 for error in mirrors.values())
    rules = {
        f"damping ratios below 0.25 let joints swing: raise kd of {of(loose)}": loose.any(),
        f"an action moves {of(stiff)} by less than 0.06 rad: lower kp, or raise action_scale": stiff.any(),
        "standing takes over 70% of a torque limit: straighten [pose]": stood["torque [share of limit]"] > 0.7,
        "a joint sags by more than 0.2 rad: raise kp, or straighten [pose]": stood["joint error [rad]"] > 0.2,
        "its mass is not above its feet: change ankles or hips in [pose]": ahead > 0.03,
        "a foot hangs in the air: change [pose], or name the feet": feet < len(body["feet"])
        and stood["tilt [deg]"] < 30,
        "images are not exact: average = true evens masses and inertias out": uneven,
    }
    return [words for words, holds in rules.items() if holds]


def failures(body, stood, mirrors, shaken):
    """Reasons not to train with this robot."""
    least = 2.0 if len(body["feet"]) > 2 else 0.5  # two feet alone balance nothing
    if stood["stands [s]"] < least:
        yield f"it falls after {stood['stands [s]']:.2f} s; change [pose] or the gains"
    if any(error["joints [rad]"] > 0.1 for error in mirrors.values()):
        yield "its mirror image moves otherwise"
    if any(run["diverged"] for run in shaken.values()):
        yield "it diverges"


def check(args):
    """Do all checks and print what they found, on the CPU. Returns the exit code."""
    jax.config.update("jax_platforms", "cpu")  # for a GPU the engine c compiles for minutes
    devices.find()
    try:
        body = loader.load(args.robot)
    except ValueError as error:
        raise records.UserError(str(error)) from None
    print("\n".join(loader.lines(body)), flush=True)
    robot = loader.Robot.of(body)
    model = terrain.flat_scene(robot).compile()
    stood = stand(model, robot, body)
    print("default pose held:", records.line(stood))
    mirrors = {mirror: mirror_error(model, robot, body, mirror) for mirror in robot.mirrors}
    for mirror, error in mirrors.items():
        print(f"mirrored {mirror}, after 0.2 s:", records.line(error))
    path = Path(args.out or f"runs/check/{body['name']}.png")
    records.write(path, picture(robot, body))
    print(f"wrote {path}", flush=True)
    shaken = {}
    for engine in ("c", "mjx") if args.mjx else ("c",):
        shaken[engine] = shake(body, engine)
        print(f"{STEPS * ROBOTS} random control steps on {engine}:", records.line(shaken[engine]), flush=True)
    for words in advice(body, stood, mirrors):
        print(f"would change: {words}")
    wrong = list(failures(body, stood, mirrors, shaken))
    print(f"does not pass: {'; '.join(wrong)}" if wrong else "passes")
    return 1 if wrong else 0


def main(args):
    """Check a robot. User errors print one line and exit with code 2."""
    with records.one_line_errors():
        code = check(args)
    sys.exit(code)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
