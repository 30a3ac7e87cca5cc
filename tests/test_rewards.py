"""Every reward term of every task against a numpy formula, on states of a random rollout with falls and contacts."""

import jax
import numpy as np
import pytest

import envs

TASKS = ("anymal_loco", "go1_loco", "g1_loco")
AIR_THRESHOLD = 0.1  # [s]


def quat_to_matrix(quat):
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def reference(env, physics, task, action, last_action):
    """All terms of one environment from raw simulator output, in float64 and plain loops."""
    model, robot = env.model, env.robot
    qpos, qvel, qacc = (np.asarray(x, np.float64) for x in (physics.qpos, physics.qvel, physics.qacc))
    base = quat_to_matrix(qpos[3:7])
    lin_vel, ang_vel, gravity = base.T @ qvel[:3], qvel[3:6], base.T @ [0, 0, -1]
    q, tau = dict(zip(robot.joints, qpos[7:], strict=True)), dict(zip(robot.joints, physics.torque, strict=True))
    home, acc = dict(zip(robot.joints, robot.default_pose, strict=True)), dict(zip(robot.joints, qacc[6:], strict=True))

    def read(name):
        sensor = model.sensor(name)
        return np.asarray(physics.sensors[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]], np.float64)

    contact = [np.linalg.norm(read(f"{foot}_force")) > 1 for foot in robot.feet]
    effort = [j for j in robot.joints if robot.name != "g1" or "hip" in j or "knee" in j]
    moving = float(np.hypot(*task.command[:2]) > 0.1)
    terms = {
        "track_lin_vel": np.exp(-((task.command[0] - lin_vel[0]) ** 2 + (task.command[1] - lin_vel[1]) ** 2) / 0.25),
        "track_yaw_rate": np.exp(-((task.command[2] - ang_vel[2]) ** 2) / 0.25),
        "vertical_vel": lin_vel[2] ** 2,
        "roll_pitch_rate": ang_vel[0] ** 2 + ang_vel[1] ** 2,
        "orientation": gravity[0] ** 2 + gravity[1] ** 2,
        "torque": sum(tau[j] ** 2 for j in effort),
        "joint_acc": sum(acc[j] ** 2 for j in effort),
        "action_rate": sum((a - b) ** 2 for a, b in zip(action, last_action, strict=True)),
        "pose": sum((q[j] - home[j]) ** 2 for j in robot.joints),
        "alive": 1.0,
    }
    terms["slip"] = sum(np.hypot(*read(f"{f}_vel")[:2]) for f, on in zip(robot.feet, contact, strict=True) if on)
    terms["air_time"] = moving * sum(t - AIR_THRESHOLD for t in task.landed_after if t > 0)
    if robot.name == "anymal_d":
        terms["thigh_contact"] = sum(np.linalg.norm(read(f"{leg}_thigh_force")) > 1 for leg in ("LF", "RF", "LH", "RH"))
    if robot.name == "g1":
        yaw = np.arctan2(base[1, 0], base[0, 0])
        heading_vel = [
            np.cos(yaw) * qvel[0] + np.sin(yaw) * qvel[1],
            -np.sin(yaw) * qvel[0] + np.cos(yaw) * qvel[1],
        ]
        terms["track_lin_vel"] = np.exp(-np.sum((np.array(task.command[:2]) - heading_vel) ** 2) / 0.25)
        terms["track_yaw_rate"] = np.exp(-((task.command[2] - (base @ ang_vel)[2]) ** 2) / 0.25)
        phase = [c if on else a for a, c, on in zip(task.air_time, task.contact_time, contact, strict=True)]
        terms["one_foot"] = moving * (sum(contact) == 1)
        terms["flight"] = moving * (sum(contact) == 0)
        terms["single_stance"] = moving * (sum(contact) == 1) * min(*phase, 0.4)
        limit = 0.0
        for joint in (j for j in robot.joints if "ankle" in j):
            low, high = model.joint(joint).range
            middle, half = (low + high) / 2, 0.9 * (high - low) / 2
            limit += max(0, middle - half - q[joint]) + max(0, q[joint] - middle - half)
        terms["ankle_limits"] = limit
        groups = {
            "hip_deviation": ("hip_roll", "hip_yaw"),
            "arm_deviation": ("shoulder", "elbow", "wrist"),
            "waist_deviation": ("waist",),
        }
        for term, parts in groups.items():
            terms[term] = sum(abs(q[j] - home[j]) for j in robot.joints if any(part in j for part in parts))
    return terms


@pytest.mark.parametrize("name", TASKS)
def test_terms_match_numpy(jitted, name):
    task = jitted(name)
    env, state = task.env, task.start(16)
    compute = jax.jit(jax.vmap(lambda t, p, a, b: env.rewards(t, env.motion(p), a, b, 0)))
    seen = set()
    for i in range(40):
        last_action, state = state.action, task.act(state, i, std=1.0)
        tracked = state.task
        got = compute(tracked, state.physics, state.action, last_action)
        host = jax.device_get((state.physics, tracked, state.action, last_action))
        for n in range(0, 16, 5):
            one = jax.tree.map(lambda x: x[n], host)
            want = reference(env, *one)
            for term in env.config.weights:
                np.testing.assert_allclose(got[term][n], want[term], rtol=2e-4, atol=2e-5, err_msg=f"{term} step {i}")
                seen |= {term} if abs(want[term]) > 1e-6 else set()
    assert seen == set(env.config.weights), f"never nonzero: {set(env.config.weights) - seen}"


@pytest.mark.parametrize("name", TASKS)
def test_reward_is_the_weighted_sum_with_a_floor(jitted, name):
    task = jitted(name)
    env, state = task.env, task.start(16)
    for i in range(15):
        state = task.act(state, i, std=2.0)
        total = sum(np.asarray(state.metrics[f"reward/{term}"], np.float64) for term in env.config.weights)
        want = np.maximum(total, env.config.reward_floor * env.dt)
        want = want + env.config.termination_reward * np.asarray(state.terminated)
        np.testing.assert_allclose(state.reward, want, rtol=1e-5, atol=1e-6)


def test_every_task_has_a_case():
    assert set(TASKS) <= set(envs.TASKS)
