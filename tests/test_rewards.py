"""Every reward term and clock over random rollouts with contacts, falls and resets, against MuJoCo and numpy.

The reference steps MuJoCo's C code on its own, and takes nothing measured from the environment: torques follow from the
gains in the MJCF, clocks of the feet from the contact forces since the reset. Weights are those of test_weights.py.
"""

import copy
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_weights import LIMITS, WEIGHTS

import envs

DT, SUBSTEPS = 0.02, 4  # control step [s], physics steps in it
ROBOTS, STEPS = 8, 45
LEGS = ("LF", "RF", "LH", "RH")  # of ANYmal


def quat_to_matrix(quat):
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Simulation:
    """One control step of one robot in float64, from its state before the step."""

    def __init__(self, env, physics, action):
        self.env, self.action = env, np.asarray(action, np.float64)
        self.joints, self.feet = env.robot.joints, env.robot.feet
        self.home = np.array(env.robot.default_pose)
        self.model = model = copy.copy(env.model)
        model.geom_friction[model.geom_contype > 0, 0] = physics.friction
        model.body_mass[:] = model.body_mass * physics.mass_scale
        model.body_inertia[:] = model.body_inertia * physics.mass_scale[:, None]
        self.data = data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.xfrc_applied[:] = physics.qpos, physics.qvel, physics.wrench
        data.mocap_pos[:], data.mocap_quat[:] = physics.mocap_pos, physics.mocap_quat
        target = np.float32(self.home) + np.float32(env.robot.action_scale) * action
        self.target = data.ctrl[:] = target.astype(np.float64)
        for _ in range(SUBSTEPS):
            held = self.pull()  # by the angles at the start of the last physics step
            mujoco.mj_step(model, data)
        low, high = model.actuator_forcerange.T
        self.torque = np.clip(held, low, high) - model.dof_damping[6:] * data.qvel[6:]
        for compute in (mujoco.mj_fwdPosition, mujoco.mj_sensorPos, mujoco.mj_fwdVelocity, mujoco.mj_sensorVel):
            compute(model, data)  # feet where they are now; forces stay those of the last physics step
        self.base = quat_to_matrix(data.qpos[3:7])
        self.lin_vel, self.ang_vel = self.base.T @ data.qvel[:3], data.qvel[3:6]
        self.gravity = self.base.T @ [0, 0, -1]
        self.yaw = np.arctan2(self.base[1, 0], self.base[0, 0])
        self.q, self.joint_vel, self.joint_acc = data.qpos[7:], data.qvel[6:], data.qacc[6:]
        self.forces = np.array([self.read(f"{foot}_force") for foot in self.feet])
        self.foot_vel = np.array([self.read(f"{foot}_vel") for foot in self.feet])
        self.contact = np.linalg.norm(self.forces, axis=1) > 1

    def pull(self):
        """kp (target - q) of each joint, before the limit."""
        return self.model.actuator_gainprm[:, 0] * (self.target - self.data.qpos[7:])

    def read(self, name):
        return self.data.sensor(name).data.copy()

    def touching(self, *names):
        return sum(np.linalg.norm(self.read(f"{name}_force")) > 1 for name in names)

    def having(self, values, *parts):
        """Values of the joints whose names have one of these parts."""
        return np.array(
            [x for x, joint in zip(values, self.joints, strict=True) if any(part in joint for part in parts)]
        )


class Memory:
    """Memory of a reference within an episode."""

    def __init__(self, env):
        feet = len(env.robot.feet)
        self.last_action = np.zeros(env.action_dim)
        self.air, self.stood, self.flights = np.zeros(feet), np.zeros(feet), np.zeros(feet)
        self.foot_vel = np.zeros((feet, 3))

    def tick(self, now):
        self.foot_acc, self.foot_vel = (now.foot_vel - self.foot_vel) / DT, now.foot_vel
        for i, on in enumerate(now.contact):
            self.flights[i] = self.air[i] if on else 0.0  # that ended in this step
            self.air[i], self.stood[i] = (0.0, self.stood[i] + DT) if on else (self.air[i] + DT, 0.0)


def shared(now, memory, effort=("",)):
    """Terms of several tasks."""
    return {
        "torque": np.sum(now.having(now.torque, *effort) ** 2),
        "joint_acc": np.sum(now.having(now.joint_acc, *effort) ** 2),
        "joint_vel": np.sum(now.joint_vel**2),
        "action_rate": np.sum((now.action - memory.last_action) ** 2),
    }


def locomotion(now, memory, task, clock):
    command = np.asarray(task.command, np.float64)
    moving = float(np.hypot(*command[:2]) > 0.1)
    slips = [np.hypot(*v[:2]) for v, on in zip(now.foot_vel, now.contact, strict=True) if on]
    g1 = now.env.robot.name == "g1"
    terms = shared(now, memory, ("hip", "knee") if g1 else ("",)) | {
        "track_lin_vel": np.exp(-np.sum((command[:2] - now.lin_vel[:2]) ** 2) / 0.25),
        "track_yaw_rate": np.exp(-((command[2] - now.ang_vel[2]) ** 2) / 0.25),
        "vertical_vel": now.lin_vel[2] ** 2,
        "roll_pitch_rate": now.ang_vel[0] ** 2 + now.ang_vel[1] ** 2,
        "orientation": now.gravity[0] ** 2 + now.gravity[1] ** 2,
        "air_time": moving * sum(t - 0.1 for t in memory.flights if t > 0),
        "slip": sum(slips),
        "pose": np.sum((now.q - now.home) ** 2),
        "alive": 1.0,
    }
    if g1:
        terms |= biped(now, memory, command, moving)
    if now.env.robot.name == "anymal_d":
        terms["thigh_contact"] = now.touching(*(f"{leg}_thigh" for leg in LEGS))
    return terms


def biped(now, memory, command, moving):
    cos, sin = np.cos(now.yaw), np.sin(now.yaw)
    heading_vel = np.array([[cos, sin], [-sin, cos]]) @ now.data.qvel[:2]
    phase = [c if on else a for a, c, on in zip(memory.air, memory.stood, now.contact, strict=True)]
    limit = 0.0
    for joint, q in zip(now.joints, now.q, strict=True):
        low, high = now.model.joint(joint).range
        middle, half = (low + high) / 2, 0.9 * (high - low) / 2
        limit += max(0, middle - half - q, q - middle - half) if "ankle" in joint else 0.0
    off = np.abs(now.q - now.home)
    return {
        "track_lin_vel": np.exp(-np.sum((command[:2] - heading_vel) ** 2) / 0.25),
        "track_yaw_rate": np.exp(-((command[2] - (now.base @ now.ang_vel)[2]) ** 2) / 0.25),
        "one_foot": moving * (sum(now.contact) == 1),
        "flight": moving * (sum(now.contact) == 0),
        "single_stance": moving * (sum(now.contact) == 1) * min(*phase, 0.4),
        "ankle_limits": limit,
        "hip_deviation": now.having(off, "hip_roll", "hip_yaw").sum(),
        "arm_deviation": now.having(off, "shoulder", "elbow", "wrist").sum(),
        "waist_deviation": now.having(off, "waist").sum(),
    }


def pedipulation(now, memory, task, clock):
    parts = [f"{leg}_{part}" for leg in LEGS for part in ("thigh", "knee", "shank")]
    error = np.linalg.norm(now.data.site("RF_foot").xpos - task.point)
    return shared(now, memory) | {
        "foot_tracking": np.exp(-error / 0.8),
        "collision": now.touching(*parts, "RF_foot"),
    }


def parkour(now, memory, task, clock):
    to_goal, velocity = task.goal - now.data.qpos[:3], now.data.qvel[:3]
    distance = np.hypot(*to_goal[:2])
    turn = abs(np.angle(np.exp(1j * (task.goal_yaw - now.yaw))))
    last_second = now.env.episode_steps - (clock + 1) < 50
    towards = velocity @ to_goal / (np.linalg.norm(to_goal) + 0.1)
    force = np.linalg.norm(now.forces, axis=1)
    excess = np.abs(now.pull()) - now.model.actuator_forcerange[:, 1]
    acc = now.data.qacc
    return shared(now, memory) | {
        "position": last_second * max(1 - 0.5 * distance, -1.0),
        "heading": last_second * (distance < 0.5) * (1 - 0.5 * turn),
        "approach": (distance > 0.25) * np.clip(towards, -1, 1),
        "wait": (distance > 0.25) * (np.linalg.norm(velocity) < 0.2),
        "stand": (distance < 0.25) * (turn < 0.5) * np.linalg.norm(now.q - now.home),
        "joint_vel_limit": np.sum(np.clip(np.abs(now.joint_vel) - 8.5, 0, 1)),
        "torque_limit": np.sum(np.maximum(excess, 0)),
        "base_acc": min(np.sum(acc[:3] ** 2) + 0.02 * np.sum(acc[3:6] ** 2), 1e3),
        "feet_acc": np.sum(np.minimum(np.linalg.norm(memory.foot_acc, axis=1), 100)),
        "feet_force": np.sum(np.clip(force - 700, 0, 700) ** 2),
        "collision": now.touching(*(f"{leg}_{part}" for leg in LEGS for part in ("knee", "shank"))),
        "stumble": float(any(np.hypot(*f[:2]) > 2 * abs(f[2]) for f in now.forces)),
    }


def exploration(now, memory, task, clock):
    return shared(now, memory) | {
        "action": np.sum(now.action**2),
        "hasty_steps": sum(0.2 - t for t in memory.flights if 0 < t < 0.2),
    }


CASES = {
    "anymal_loco": locomotion,
    "go1_loco": locomotion,
    "g1_loco": locomotion,
    "anymal_pedipulation": pedipulation,
    "anymal_climb_up": parkour,
    "go1": exploration,
}


def build(name, jitted):
    """The task, and ROBOTS starts of it, two of which are soon at their time limit."""
    if name in envs.EXPLORE:
        env = envs.make_explore(name, "c")
        task = SimpleNamespace(env=env, step=jax.jit(jax.vmap(env.step)))
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), ROBOTS))
    else:
        task = jitted(name)
        state = task.start(ROBOTS)
    state = state.replace(clock=state.clock.at[:2].set(task.env.episode_steps - 20))
    if name == "anymal_climb_up":  # three are there, in time; the others run into a box 0.3 m high
        there = state.physics.qpos[:3, :3] + jnp.array([0.1, 0.1, 0.0])
        goal, yaw = state.task.goal.at[:3].set(there), state.task.goal_yaw.at[:3].set(0.0)
        p = state.physics
        box = jnp.stack([p.qpos[3:, 0] + 0.55 + 1.5, p.qpos[3:, 1], jnp.full(ROBOTS - 3, 0.3 - 1.0)], 1)
        p = p.replace(mocap_pos=p.mocap_pos.at[3:, 0].set(box), qvel=p.qvel.at[3:, 0].set(1.5))
        state = state.replace(task=state.task.replace(goal=goal, goal_yaw=yaw), physics=p)
    return task, state


@pytest.mark.parametrize("name", CASES)
def test_terms_and_rewards_over_a_rollout(jitted, name):
    """Each term with its weight, and their sum with its floor and the price of a failure."""
    task, state = build(name, jitted)
    env, rng, seen, resets = task.env, np.random.default_rng(0), set(), 0
    floor, failure = LIMITS[name]
    memories = [Memory(env) for _ in range(ROBOTS)]
    for i in range(STEPS):
        action = rng.normal(size=(ROBOTS, env.action_dim)).astype(np.float32)
        before = jax.device_get(state.replace(key=None))
        state = task.step(state, action)
        after = jax.device_get(state.replace(key=None))
        assert not np.any(after.metrics["diverged"]) and not np.any(after.terminated & after.truncated)
        for n, memory in enumerate(memories):
            physics, tracked = jax.tree.map(lambda x, n=n: x[n], (before.physics, before.task))
            now = Simulation(env, physics, action[n])
            memory.tick(now)
            terms = CASES[name](now, memory, tracked, before.clock[n])
            terms = {term: terms[term] for term in WEIGHTS[name]}
            for term, value in terms.items():
                got = after.metrics[f"reward/{term}"][n] / (WEIGHTS[name][term] * DT)
                np.testing.assert_allclose(got, value, rtol=1e-3, atol=1e-4, err_msg=f"{term} robot {n} step {i}")
                seen |= {term} if abs(value) > 1e-6 else set()
            total = sum(WEIGHTS[name][term] * value for term, value in terms.items())
            want = max(total, floor) * DT + failure * after.terminated[n]
            np.testing.assert_allclose(after.reward[n], want, rtol=1e-3, atol=1e-5)
            memory.last_action = action[n]
            if after.terminated[n] or after.truncated[n]:
                memories[n] = Memory(env)
                resets += 1
    assert seen == WEIGHTS[name].keys(), f"never nonzero: {WEIGHTS[name].keys() - seen}"
    assert resets >= 2


def test_every_kind_of_task_has_a_case():
    """Every family of tasks on every robot it is for; skills of parkour share their terms, explorers theirs."""
    kinds = {task: (family, config.robot) for task, (family, config) in envs.TASKS.items()}
    assert {kinds[task] for task in CASES.keys() & kinds.keys()} == set(kinds.values())
    assert CASES.keys() & envs.EXPLORE.keys() and CASES.keys() <= kinds.keys() | envs.EXPLORE.keys()


def test_a_failure_in_the_last_step_is_no_time_limit(jitted):
    """One robot lies on its back, one stands, when their time is up: the return of the second alone goes on."""
    task = jitted("go1_loco")
    state = task.start(2)
    qpos = state.physics.qpos.at[0, 2:7].set(jnp.array([0.05, 0, 1, 0, 0]))
    state = state.replace(clock=jnp.full(2, task.env.episode_steps - 1), physics=state.physics.replace(qpos=qpos))
    after = task.hold(state)
    assert after.terminated.tolist() == [True, False] and after.truncated.tolist() == [False, True]
