"""Every reward term and clock over random rollouts with contacts, falls and resets, against MuJoCo and numpy.

The reference steps MuJoCo's C code on its own, and takes nothing measured from the environment: torques follow from the
gains in the MJCF, clocks of the feet from the contact forces since the reset. Weights are those of test_weights.py, and
for a robust set, in which delays, motors and friction differ from robot to robot, those of its config.
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
# Feet that step when the others stand: one of two, or one pair of diagonal ones of four.
TAKING_TURNS = ("right_foot", "FL_foot", "RR_foot", "RF_foot", "LH_foot")


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

    def __init__(self, env, physics, action, followed):
        """`followed` (A,) is the action that the motors follow, an earlier one if actions are late."""
        self.env, self.action = env, np.asarray(action, np.float64)
        self.joints, self.feet = env.robot.joints, env.robot.feet
        self.home = np.array(env.robot.default_pose)
        self.model = model = copy.copy(env.model)
        model.geom_friction[model.geom_contype > 0, 0] = physics.friction
        model.body_mass[:] = model.body_mass * physics.mass_scale
        model.body_inertia[:] = model.body_inertia * physics.mass_scale[:, None]
        model.actuator_gainprm[:, 0] *= physics.strength
        model.actuator_biasprm[:, 1] *= physics.strength
        model.dof_frictionloss[6:] = physics.joint_friction
        self.data = data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.xfrc_applied[:] = physics.qpos, physics.qvel, physics.wrench
        data.mocap_pos[:], data.mocap_quat[:] = physics.mocap_pos, physics.mocap_quat
        target = np.float32(self.home) + np.float32(env.robot.action_scale) * np.float32(followed)
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
        self.heights = np.array([self.read(f"{foot}_pos")[2] for foot in self.feet]) - env.robot.sole
        self.weight = 9.81 * mujoco.mj_getTotalmass(env.model)  # [N] without what is added
        at_rest = mujoco.MjData(model)
        at_rest.qpos[:] = 0, 0, 0, 1, 0, 0, 0, *self.home
        mujoco.mj_kinematics(model, at_rest)
        standing = env.robot.sole - min(at_rest.site(foot).xpos[2] for foot in self.feet)
        self.rise = data.qpos[2] / standing - 1  # of the base above where it is in the default pose

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


def tracked(env, qpos, qvel):
    """Velocities [m/s, rad/s] that commands ask for: of the base, or along the heading for the biped."""
    w, x, y, z = qpos[3:7]
    base, yaw = quat_to_matrix(qpos[3:7]), np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    if env.robot.name != "g1":
        return np.array([*(base.T @ qvel[:3])[:2], qvel[5]])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([*np.array([[cos, sin], [-sin, cos]]) @ qvel[:2], (base @ qvel[3:6])[2]])


class Memory:
    """Memory of a reference within an episode."""

    def __init__(self, env, qpos, qvel):
        feet = len(env.robot.feet)
        self.actions = [np.zeros(env.action_dim)] * 6  # oldest first
        self.air, self.flights = np.zeros(feet), np.zeros(feet)
        self.foot_vel = np.zeros((feet, 3))
        self.velocity = tracked(env, np.float64(qpos), np.float64(qvel))

    def late(self, action, steps):
        """The mean of the actions in force during a control step, if each takes `steps` to arrive."""
        past = np.array([*self.actions, action])[::-1]
        return np.array([np.interp(steps, np.arange(len(past)), column) for column in past.T])

    def tick(self, now):
        self.foot_acc, self.foot_vel = (now.foot_vel - self.foot_vel) / DT, now.foot_vel
        for i, on in enumerate(now.contact):
            self.flights[i] = self.air[i] if on else 0.0  # that ended in this step
            self.air[i] = 0.0 if on else self.air[i] + DT
        seconds = getattr(now.env.config, "tracking_seconds", 0.0)
        velocity = tracked(now.env, now.data.qpos, now.data.qvel)
        self.velocity += min(1.0, DT / seconds if seconds else 1.0) * (velocity - self.velocity)


def shared(now, memory, effort=("",)):
    """Terms of several tasks."""
    return {
        "torque": np.sum(now.having(now.torque, *effort) ** 2),
        "joint_acc": np.sum(now.having(now.joint_acc, *effort) ** 2),
        "joint_vel": np.sum(now.joint_vel**2),
        "action_rate": np.sum((now.action - memory.actions[-1]) ** 2),
    }


def locomotion(now, memory, task, clock):
    command, config = np.asarray(task.command, np.float64), now.env.config
    moving = float(np.hypot(*command[:2]) > 0.1 or abs(command[2]) > 0.1)
    slips = [np.hypot(*v[:2]) for v, on in zip(now.foot_vel, now.contact, strict=True) if on]
    off, g1 = now.q - now.home, now.env.robot.name == "g1"
    terms = shared(now, memory, ("hip", "knee") if g1 else ("",)) | {
        "track_lin_vel": np.exp(-np.sum((command[:2] - memory.velocity[:2]) ** 2) / 0.25),
        "track_yaw_rate": np.exp(-((command[2] - memory.velocity[2]) ** 2) / 0.25),
        "vertical_vel": now.lin_vel[2] ** 2,
        "roll_pitch_rate": now.ang_vel[0] ** 2 + now.ang_vel[1] ** 2,
        "orientation": now.gravity[0] ** 2 + now.gravity[1] ** 2,
        "air_time": moving * sum(t - config.air_time_threshold for t in memory.flights if t > 0),
        "impact": sum(max(np.linalg.norm(f) / now.weight - 1.5, 0) for f in now.forces),
        "power": sum(abs(t * v) for t, v in zip(now.torque, now.joint_vel, strict=True)) / now.weight,
        "stand_still": (1 - moving) * np.abs(off).sum(),
        "stand_on_feet": (1 - moving) * sum(not on for on in now.contact),
        "joint_limits": sum(near_limit(now, joint, q) for joint, q in zip(now.joints, now.q, strict=True)),
        "slip": sum(slips),
        "height": now.rise**2,
        "pose": np.sum(off**2),
        "alive": 1.0,
    }
    if g1:
        terms |= biped(now)
    if config.gait_hz:
        terms |= gait(now, moving, clock)
    if now.env.robot.name == "anymal_d":
        terms["thigh_contact"] = now.touching(*(f"{leg}_thigh" for leg in LEGS))
    return terms


def near_limit(now, joint, q):
    """Angle [rad] of a joint beyond the middle 80% of its range in the MJCF."""
    low, high = now.model.joint(joint).range
    return max(0.0, abs(q - (low + high) / 2) - 0.4 * (high - low))


def swing(config, clock, later):
    """Share of its swing that a foot should have behind it, None in its stance; `later` feet begin half a step on."""
    period = 1 / config.gait_hz  # [s]
    begun = (clock * DT + later * period / 2) % period
    aloft = (1 - config.stance) * period
    return begun / aloft if begun < aloft else None


def gait(now, moving, clock):
    config = now.env.config
    swings = [swing(config, float(clock), foot in TAKING_TURNS) if moving else None for foot in now.feet]
    wanted = [0.0 if share is None else config.swing_height * np.sin(np.pi * share) for share in swings]
    return {
        "in_step": np.mean([on == (share is None) for on, share in zip(now.contact, swings, strict=True)]),
        "foot_path": np.exp(-sum((h - want) ** 2 for h, want in zip(now.heights, wanted, strict=True)) / 0.0025),
    }


def biped(now):
    off = np.abs(now.q - now.home)
    return {
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


def ground_height(now):
    """Height of the ground, or of a box on it, under the base [m]."""
    tops = [0.0]
    for body in np.flatnonzero(now.model.body_mocapid >= 0):
        geom = now.model.body_geomadr[body]
        offset = now.data.geom_xmat[geom].reshape(3, 3).T @ (now.data.qpos[:3] - now.data.geom_xpos[geom])
        half = now.model.geom_size[geom]
        tops += [now.data.geom_xpos[geom, 2] + half[2]] if np.all(np.abs(offset[:2]) <= half[:2]) else []
    return max(tops)


def on_feet(now):
    tilt = np.degrees(np.arccos(np.clip(now.base[2, 2], -1, 1)))
    others = now.touching("base", *(f"{leg}_{part}" for leg in LEGS for part in ("thigh", "knee", "shank")))
    high = (now.data.qpos[2] - ground_height(now)) / 0.35
    return np.clip(1.5 - tilt / 50, 0, 1) * np.clip(high, 0, 1) / (1 + others)


def parkour(now, memory, task, clock):
    to_goal, velocity = task.goal - now.data.qpos[:3], now.data.qvel[:3]
    distance = np.hypot(*to_goal[:2])
    turn = abs(np.angle(np.exp(1j * (task.goal_yaw - now.yaw))))
    last_second = now.env.episode_steps - (clock + 1) < 50
    towards = velocity @ to_goal / (np.linalg.norm(to_goal) + 0.1)
    force = np.linalg.norm(now.forces, axis=1)
    excess = np.abs(now.pull()) - now.model.actuator_forcerange[:, 1]
    acc = now.data.qacc
    at_goal = last_second * (distance < 0.5)
    return shared(now, memory) | {
        "position": last_second * max(1 - 0.5 * distance, -1.0),
        "heading": at_goal * (1 - 0.5 * turn),
        "approach": (distance > 0.25) * np.clip(towards, -1, 1),
        "wait": (distance > 0.25) * (np.linalg.norm(velocity) < 0.2),
        "stand": at_goal * np.linalg.norm(now.q - now.home),
        "on_feet": at_goal * on_feet(now),
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
    "go1_loco robust": locomotion,
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
        fields = {"robust": True} if name.endswith(" robust") else {}
        # A clock that falls on no edge of a swing, where rounding decides.
        fields |= {"gait_hz": 1.37} if name in ("g1_loco", "go1_loco robust") else {}
        task = jitted(name.removesuffix(" robust"), **fields)
        state = task.start(ROBOTS)
    if CASES[name] is locomotion:  # two are told to stand
        still = state.task.moves.at[2:4].set(False), state.task.command.at[2:4].set(0.0)
        state = state.replace(task=state.task.replace(moves=still[0], command=still[1]))
    state = state.replace(clock=state.clock.at[:2].set(task.env.episode_steps - 20))
    if name == "go1_loco robust":  # a hip of one is on its way to its limit
        p = state.physics
        p = p.replace(qpos=p.qpos.at[4, 7].set(0.8), qvel=p.qvel.at[4, 6].set(8.0))
        state = state.replace(physics=p)
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
    weights = {term: weight for term, weight in WEIGHTS.get(name, env.config.weights).items() if weight}
    floor, failure = LIMITS[name.removesuffix(" robust")]
    memories = [Memory(env, state.physics.qpos[n], state.physics.qvel[n]) for n in range(ROBOTS)]
    returns = np.zeros(ROBOTS)
    for i in range(STEPS):
        action = rng.normal(size=(ROBOTS, env.action_dim)).astype(np.float32)
        before = jax.device_get(state.replace(key=None))
        state = task.step(state, action)
        after = jax.device_get(state.replace(key=None))
        assert not np.any(after.metrics["diverged"]) and not np.any(after.terminated & after.truncated)
        for n, memory in enumerate(memories):
            physics, told = jax.tree.map(lambda x, n=n: x[n], (before.physics, before.task))
            now = Simulation(env, physics, action[n], memory.late(action[n], before.delay[n]))
            memory.tick(now)
            terms = CASES[name](now, memory, told, before.clock[n])
            terms = {term: terms[term] for term in weights}
            for term, value in terms.items():
                got = after.metrics[f"reward/{term}"][n] / (weights[term] * DT)
                np.testing.assert_allclose(got, value, rtol=1e-3, atol=1e-4, err_msg=f"{term} robot {n} step {i}")
                seen |= {term} if abs(value) > 1e-6 else set()
            total = sum(weights[term] * value for term, value in terms.items())
            want = max(total, floor) * DT + failure * after.terminated[n]
            np.testing.assert_allclose(after.reward[n], want, rtol=1e-3, atol=1e-5)
            returns[n] += want
            np.testing.assert_allclose(after.metrics["episode_return"][n], returns[n], rtol=1e-2, atol=1e-3)
            if CASES[name] is locomotion:
                off = told.command - [*now.lin_vel[:2], now.ang_vel[2]]
                errors = [after.metrics[metric][n] for metric in ("lin_vel_error", "yaw_rate_error")]
                np.testing.assert_allclose(errors, [np.hypot(*off[:2]), abs(off[2])], rtol=1e-3, atol=1e-4)
            memory.actions.append(action[n])
            if after.terminated[n] or after.truncated[n]:
                memories[n], returns[n] = Memory(env, after.physics.qpos[n], after.physics.qvel[n]), 0.0
                resets += 1
    assert seen == weights.keys(), f"never nonzero: {weights.keys() - seen}"
    assert resets >= 2


def test_every_kind_of_task_has_a_case():
    """Every family of tasks on every robot it is for; skills of parkour share their terms, explorers theirs."""
    kinds = {task: (family, config.robot) for task, (family, config) in envs.TASKS.items()}
    assert {kinds[task] for task in CASES.keys() & kinds.keys()} == set(kinds.values())
    robust = {case for case in CASES if case.endswith(" robust")}
    assert robust and CASES.keys() & envs.EXPLORE.keys() and CASES.keys() - robust <= kinds.keys() | envs.EXPLORE.keys()


ENDS = {  # bodies that must not touch the ground
    "go1_loco": ["base"],
    "anymal_loco": ["base"],
    "g1_loco": ["torso", "pelvis"]
    + [f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shin", "upperarm", "forearm", "hand")],
}


@pytest.mark.parametrize("task", ENDS)
def test_any_of_these_bodies_on_the_ground_is_a_failure(task, jitted):
    """Upright, with 3% of the weight at one body after the other; feet may stand."""
    env, p = jitted(task).env, jitted(task).start(ROBOTS).physics
    up = env.motion(jax.tree.map(lambda x: x[0], p)).replace(gravity=jnp.array([0.0, 0, -1]))
    silent = up.replace(sensors=jnp.zeros_like(up.sensors))
    forces = [env.model.sensor(i).name for i in range(env.model.nsensor) if env.model.sensor(i).name.endswith("_force")]
    assert {f"{part}_force" for part in ENDS[task]} < {*forces} and not env.failed(None, silent)
    for name in forces:
        at = env.model.sensor(name).adr[0] + 2
        touching = silent.replace(sensors=silent.sensors.at[at].set(0.03 * 9.81 * float(env.model.body_mass.sum())))
        assert bool(env.failed(None, touching)) == (name.removesuffix("_force") in ENDS[task]), name


def test_a_failure_in_the_last_step_is_no_time_limit(jitted):
    """One robot lies on its back, others stand, when their time is up: their returns alone go on."""
    task = jitted("go1_loco")
    state = task.start(ROBOTS)
    qpos = state.physics.qpos.at[0, 2:7].set(jnp.array([0.05, 0, 1, 0, 0]))
    state = state.replace(clock=jnp.full(ROBOTS, task.env.episode_steps - 1), physics=state.physics.replace(qpos=qpos))
    after = task.hold(state)
    assert after.terminated.tolist() == [True] + [False] * (ROBOTS - 1)
    np.testing.assert_array_equal(after.truncated, ~after.terminated)
