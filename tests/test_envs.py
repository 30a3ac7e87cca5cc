"""The environment contract: hooks, history, resets, noise, randomisation, commands, mirrors, faults, options."""

import dataclasses
import io
import re
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import envs
from envs import render
from envs.base import PROP, Env
from envs.config import fits, parse
from envs.engine import ENGINES, make_engine
from envs.robots import ROBOTS
from tools import play_onnx, sim_to_sim

TASKS = list(envs.TASKS)
LOCOMOTION = ["anymal_loco", "go1_loco", "g1_loco"]  # one a robot; parkour has tests of its own


def spawn(env):
    """key -> Physics at the start of an episode."""
    return lambda key: env.spawn(key, env.course(key, env.first_curriculum()))


def assert_trees_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.asarray, a), jax.tree.map(np.asarray, b))


def without_keys(state):
    """A state whose random keys are plain numbers, so that numpy can compare them."""
    return state.replace(key=jax.random.key_data(state.key))


@pytest.mark.parametrize("task", TASKS)
def test_contract(task):
    """Reset and step give the same pytree, with strong types: a weak one would compile everything twice."""
    env = envs.make(task, "c")
    start = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, start, jnp.zeros(env.action_dim))
    assert jax.tree.structure(start) == jax.tree.structure(after)
    for (path, a), b in zip(jax.tree.leaves_with_path(start), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type), jax.tree_util.keystr(path)
    assert start.obs.shape == (env.obs_dim,)
    assert start.history["prop"].shape == (env.config.history + 1, env.prop_dim)
    assert start.history["action"].shape == (env.config.history, env.action_dim)
    assert set(env.config.weights) == {name[7:] for name in start.metrics if name.startswith("reward/")}


def documented_hooks():
    """Order of the hooks in `reset` and in `step`, as the docstring of Env has it."""
    reset, step = re.search(r"reset: (.*) step: (.*)", " ".join(Env.__doc__.split())).groups()
    reset = [word.strip() for word in reset.split(",")]
    step = step.replace("as in reset without first_curriculum", ",".join(reset[1:]))
    return reset, [word.strip().removeprefix("then ") for word in step.split(",")]


def recorded(family, names, calls):
    """A subclass of a task family that appends the names of its hooks to `calls` as they are called."""

    def recording(name):
        def hook(self, *args):
            calls.append(name)
            return getattr(family, name)(self, *args)

        return hook

    return type("Recorded", (family,), {name: recording(name) for name in names})


@pytest.mark.parametrize("task", ["g1_loco", "anymal_pedipulation", "anymal_crouch", "exploration"])
def test_hooks_are_called_in_the_documented_order(task):
    family, config = envs.TASKS[task] if task in envs.TASKS else (envs.Explore, envs.EXPLORE["go1"])
    twice = {"ground_height"} if task == "anymal_crouch" else set()  # its scans ask for it as well
    in_reset, in_step = ([name for name in names if name not in twice] for names in documented_hooks())
    calls = []
    env = recorded(family, {*in_reset, *in_step}, calls)(config, "c")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert calls == in_reset
    calls.clear()
    jax.eval_shape(env.step, state, jnp.zeros(env.action_dim))
    assert calls == in_step and {"before_rewards", "next_curriculum", "after_rewards"} < set(in_step)


@pytest.mark.parametrize("task", TASKS)
def test_slices_tile_the_vectors(task):
    """Blocks follow each other without gaps, each as wide as its kind says."""
    env = envs.make(task, "c")
    obs_kinds = {name: kind for name, (kind, _) in env.OBS.items()}
    for slices, kinds, size in ((env.obs_slices(), obs_kinds, env.obs_dim), (env.prop_slices(), PROP, env.prop_dim)):
        assert list(slices) == list(kinds)
        assert [i for s in slices.values() for i in range(s.start, s.stop)] == list(range(size))
        assert [s.stop - s.start for s in slices.values()] == [env.width(kind) for kind in kinds.values()]
    assert tuple(env.prop_slices()) == env.prop_layout


def test_slices_by_hand():
    env = envs.make("go1_loco", "c")
    assert env.obs_slices()["command"] == slice(9, 12) and env.obs_slices()["action"] == slice(36, 48)
    assert env.prop_slices()["joint_pos"] == slice(6, 18) and env.prop_slices()["joint_vel"] == slice(18, 30)


def test_observation_widths():
    widths = {"anymal_loco": 48, "go1_loco": 48, "g1_loco": 101, "anymal_pedipulation": 48, "anymal_crouch": 348}
    assert {task: envs.make(task, "c").obs_dim for task in TASKS} == dict.fromkeys(TASKS, 282) | widths


@pytest.mark.parametrize("task", [*LOCOMOTION, "anymal_climb_up"])
def test_same_key_same_rollout(jitted, task):
    runs = []
    for _ in range(2):
        state = jitted(task).start(4)
        for i in range(5):
            state = jitted(task).act(state, i)
        runs.append(without_keys(state))
    assert_trees_equal(*runs)
    assert not np.array_equal(jitted(task).start(4, seed=1).obs, jitted(task).start(4, seed=0).obs)


@pytest.mark.parametrize("task", [*LOCOMOTION, "anymal_pedipulation"])
def test_robots_start_on_their_feet(jitted, task):
    """At reset the lowest foot site is `sole` above the ground, by MuJoCo's kinematics; nobody starts inside it."""
    env, state = jitted(task).env, jitted(task).start(4)
    data = mujoco.MjData(env.model)
    for qpos in np.asarray(state.physics.qpos):
        data.qpos[:] = qpos
        mujoco.mj_forward(env.model, data)
        lowest = min(data.site(foot).xpos[2] for foot in env.robot.feet)
        assert lowest == pytest.approx(env.robot.sole, abs=1e-5)
        assert all(contact.dist > -0.01 for contact in data.contact)


@pytest.mark.parametrize("task", LOCOMOTION)
def test_motion_is_what_mujoco_says(jitted, task):
    """Velocities, gravity and feet of Motion against MuJoCo's own sensors and frames, after some steps."""
    env, state = jitted(task).env, jitted(task).start(4)
    for i in range(8):
        state = jitted(task).act(state, i)
    motion = jax.vmap(env.motion)(state.physics)
    data = mujoco.MjData(env.model)
    for n in range(4):
        data.qpos[:], data.qvel[:] = state.physics.qpos[n], state.physics.qvel[n]
        mujoco.mj_forward(env.model, data)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(env.model, data, mujoco.mjtObj.mjOBJ_SITE, env.model.site("base").id, velocity, 1)
        np.testing.assert_allclose(motion.ang_vel[n], velocity[:3], atol=1e-4)
        np.testing.assert_allclose(motion.lin_vel[n], velocity[3:], atol=1e-4)
        np.testing.assert_allclose(motion.gravity[n], -data.xmat[1].reshape(3, 3)[2], atol=1e-5)
        for i, foot in enumerate(env.robot.feet):
            np.testing.assert_allclose(motion.foot_pos[n, i], data.site(foot).xpos, atol=1e-5)
            np.testing.assert_allclose(motion.foot_vel[n, i], data.sensor(f"{foot}_vel").data, atol=1e-3)


def test_history_is_padded_then_shifts(jitted):
    """The first x fills the history and actions are zero; then both move on by one, oldest first."""
    task = jitted("go1_loco")
    state = task.start(4)
    first = np.asarray(state.history["prop"])
    assert np.ptp(first, axis=1).max() == 0 and not np.any(state.history["action"])
    actions, props = [], [first[:, -1]]
    for i in range(8):
        state = task.act(state, i)
        actions.append(np.asarray(state.action))
        props.append(np.asarray(state.history["prop"][:, -1]))
        padded_props = [props[0]] * 6 + props[1:]
        padded_actions = [np.zeros_like(actions[0])] * 5 + actions
        np.testing.assert_array_equal(state.history["prop"], np.stack(padded_props[-6:], 1))
        np.testing.assert_array_equal(state.history["action"], np.stack(padded_actions[-5:], 1))


def test_history_is_what_the_policy_saw(jitted):
    """x_t in the history carries the same noise as the observation of the same step."""
    env, state = jitted("go1_loco").env, jitted("go1_loco").start(4)
    state = jitted("go1_loco").act(state, 0)
    obs, prop = np.asarray(state.obs), np.asarray(state.history["prop"][:, -1])
    scales = {name: scale for name, (_, scale) in env.OBS.items()}
    for name, in_obs, in_prop in [
        ("ang_vel", slice(3, 6), slice(0, 3)),
        ("gravity", slice(6, 9), slice(3, 6)),
        ("joint_pos", slice(12, 24), slice(6, 18)),
        ("joint_vel", slice(24, 36), slice(18, 30)),
    ]:
        np.testing.assert_allclose(obs[:, in_obs], prop[:, in_prop] * scales[name], rtol=1e-6, atol=1e-7)


def test_noise_has_the_stated_width(jitted):
    env = jitted("go1_loco").env
    state = jitted("go1_loco").start(512)
    exact = np.asarray(jax.vmap(env.motion)(state.physics).joint_vel)
    seen = np.asarray(state.history["prop"][:, -1, 18:30]) - exact
    assert 1.4 < np.abs(seen).max() <= 1.5
    assert np.std(seen) == pytest.approx(3.0 / 12**0.5, rel=0.05)
    motion, where = jax.vmap(env.motion)(state.physics), env.obs_slices()
    for name, width in {"lin_vel": 0.1, "ang_vel": 0.2, "gravity": 0.05, "joint_pos": 0.01, "joint_vel": 1.5}.items():
        noise = np.asarray(state.obs[:, where[name]]) / env.OBS[name][1] - np.asarray(getattr(motion, name))
        assert 0.9 * width < np.abs(noise).max() <= width + 1e-5, name


def test_robots_start_as_their_config_says(jitted):
    """Of 512 starts: place, heading and load on the base fill their ranges evenly."""
    env, state = jitted("go1_loco").env, jitted("go1_loco").start(512)
    c, physics = env.config, jax.device_get(state.physics)
    load = (physics.mass_scale[:, 1] - 1) * env.model.body_mass[1]
    yaw = 2 * np.arctan2(physics.qpos[:, 6], physics.qpos[:, 3])
    drawn = [(physics.qpos[:, i], -c.spawn_xy, c.spawn_xy) for i in (0, 1)]
    drawn += [((yaw + np.pi) % (2 * np.pi) - np.pi, -c.spawn_yaw, c.spawn_yaw), (load, *c.added_mass)]
    for values, low, high in drawn:
        assert high > low
        got = (np.quantile(values, [0, 0.25, 0.5, 0.75, 1]) - low) / (high - low)
        np.testing.assert_allclose(got, [0, 0.25, 0.5, 0.75, 1], atol=0.08)


def overturned(state):
    """The first robot lies on its back, the others stand."""
    flipped = state.physics.qpos.at[0, 3:7].set(jnp.array([0.0, 1, 0, 0])).at[0, 2].set(0.05)
    return state.replace(physics=state.physics.replace(qpos=flipped))


def test_failure_resets_everything(jitted):
    """A fallen robot terminates; a new episode follows, and final_obs shows the old one."""
    task = jitted("go1_loco")
    state = task.start(4)
    for i in range(3):
        state = task.act(state, i)
    after = task.hold(overturned(state))
    assert after.terminated.tolist() == [True, False, False, False] and not np.any(after.truncated)
    assert after.clock.tolist() == [0, 4, 4, 4] and after.episode_return[0] == 0 and after.episode_return[1] != 0
    assert not np.any(after.action[0]) and not np.any(after.history["action"][0])
    assert np.ptp(after.history["prop"][0], axis=0).max() == 0
    assert not np.any(after.physics.qvel[0]) and not np.any(after.task.air_time[0])
    assert after.physics.qpos[0, 2] == pytest.approx(float(task.start(4).physics.qpos[0, 2]), abs=1e-6)
    assert after.final_obs[0, 8] > 0.5 > after.obs[0, 8], "gravity in final_obs is of the overturned robot"
    np.testing.assert_array_equal(after.final_obs[1], after.obs[1])
    np.testing.assert_array_equal(after.final_history["prop"][1], after.history["prop"][1])
    assert not np.array_equal(after.task.command[0], state.task.command[0])


def test_time_limit_truncates(jitted):
    task = jitted("go1_loco")
    state = task.start(4)
    after = task.hold(state.replace(clock=state.clock.at[0].set(task.env.episode_steps - 1)))
    assert after.truncated.tolist() == [True, False, False, False] and not np.any(after.terminated)
    assert after.clock.tolist() == [0, 1, 1, 1]
    assert after.metrics["episode_seconds"][0] == pytest.approx(20.0)
    assert not np.array_equal(after.final_obs[0], after.obs[0])


def test_divergence_is_caught_and_counted(jitted):
    """A simulation that blows up ends, is counted, and leaves only finite numbers behind."""
    task = jitted("go1_loco")
    state = task.start(4)
    state = state.replace(
        physics=state.physics.replace(qvel=state.physics.qvel.at[0, 8].set(jnp.nan).at[1, 7].set(1e9))
    )
    after = task.hold(state)
    assert after.terminated.tolist() == [True, True, False, False]
    assert after.metrics["diverged"].tolist() == [True, True, False, False]
    for leaf in jax.tree.leaves(without_keys(after)):
        assert np.all(np.isfinite(np.asarray(leaf, np.float64)))


def test_command_follows_the_heading(jitted):
    """The turning command is half the heading error within +-1; standing commands are exactly zero."""
    state = jitted("go1_loco").start(512)
    command, moves = np.asarray(state.task.command), np.asarray(state.task.moves)
    w, x, y, z = np.asarray(state.physics.qpos[:, 3:7]).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    error = (np.asarray(state.task.heading) - yaw + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(command[moves, 2], np.clip(0.5 * error, -1, 1)[moves], atol=1e-5)
    assert not np.any(command[~moves]) and 0 < np.mean(~moves) < 0.06
    assert np.abs(command[:, :2]).max() <= 1 and np.all(np.asarray(state.task.steers))
    assert np.all(np.asarray(state.task.remaining) == 500)


def with_task(state, **fields):
    return state.replace(task=state.task.replace(**fields))


def test_command_changes_when_due(jitted):
    """After the time that was drawn with it, whatever the clock says, and then for as long again."""
    task = jitted("go1_loco")
    state = with_task(task.start(4), remaining=jnp.array([2, 100, 2, 100]))
    before = task.hold(state.replace(clock=jnp.array([498, 499, 0, 0], jnp.int32)))
    after = task.hold(before)
    changed = np.any(np.asarray(after.task.command[:, :2] != before.task.command[:, :2]), axis=1)
    assert before.task.remaining.tolist() == [1, 99] * 2 and after.task.remaining.tolist() == [500, 98] * 2
    assert changed.tolist() == [True, False] * 2


def test_shares_and_ranges_of_commands():
    """Of 20 000 draws the shares that the config states stand, turn on the spot or turn at a rate; times are even."""
    ranges = {"command_seconds": (3.0, 8.0), "lin_vel_x": (-0.5, 1.5), "lin_vel_y": (-0.3, 0.7)}
    env = envs.make("go1_loco", "c", standing=0.1, turning=0.3, on_the_spot=0.15, **ranges)
    drawn = jax.device_get(jax.vmap(env.draw_command)(jax.random.split(jax.random.key(0), 20_000)))
    spot, rate = np.all(drawn["command"][:, :2] == 0, axis=1), ~drawn["steers"]
    shares = [np.mean(~drawn["moves"]), np.mean(rate & spot), np.mean(rate & ~spot), np.mean(rate & ~drawn["moves"])]
    np.testing.assert_allclose(shares, [0.1, 0.15, 0.3, 0.045], atol=0.012)
    assert not np.any(spot & ~rate), "who turns to a heading walks"
    seconds, (x, y, turn) = drawn["remaining"] * env.dt, drawn["command"].T
    drawn_from = (seconds, 3, 8), (turn[rate], -1, 1), (drawn["heading"], -np.pi, np.pi)
    assert abs(np.corrcoef(x[~spot], y[~spot])[0, 1]) < 0.05
    for values, low, high in (*drawn_from, (x[~spot], -0.5, 1.5), (y[~spot], -0.3, 0.7)):
        np.testing.assert_allclose(np.quantile(values, [0, 0.5, 1]), [low, (low + high) / 2, high], atol=0.1)


def test_a_fixed_velocity_takes_the_place_of_all_commands():
    env = envs.make("go1_loco", "c", fixed_velocity=(0.8, -0.1), standing=1.0, turning=0.5, on_the_spot=0.5)
    drawn = jax.vmap(env.draw_command)(jax.random.split(jax.random.key(0), 50))
    assert drawn["moves"].all() and drawn["steers"].all() and not drawn["heading"].any()
    np.testing.assert_allclose(drawn["command"], np.tile([0.8, -0.1, 0.0], (50, 1)))


def test_a_turning_rate_is_not_steered(jitted):
    """It stays as drawn while the robot turns; a command to stand is zero whatever its kind."""
    task = jitted("go1_loco")
    command, moves = jnp.tile(jnp.array([0.0, 0.0, 0.7]), (4, 1)), jnp.array([True, False] * 2)
    state = with_task(task.start(4), command=command, moves=moves, steers=jnp.zeros(4, bool))
    state = task.hold(state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[:, 5].set(2.0))))
    np.testing.assert_array_equal(state.task.command, [[0, 0, np.float32(0.7)], [0, 0, 0]] * 2)


def test_a_command_that_was_set_holds(jitted):
    """No other one follows, and no heading steers it, even if one was due in this step or told to stand."""
    task = jitted("go1_loco")
    state = with_task(task.start(4), remaining=jnp.array([1, 2, 400, 1]), moves=jnp.array([True, False, True, False]))
    command = jnp.array([[0.8, -0.2, 0.5], [0.3, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    state = state.replace(task=jax.vmap(task.env.set_command)(state.task, command))
    for i in range(4):
        state = task.act(state, i)
        np.testing.assert_array_equal(state.task.command, command)
        np.testing.assert_allclose(state.obs[:, 9:12], command * jnp.array([2.0, 2.0, 0.25]))


@pytest.mark.parametrize(("seconds", "share"), [(0.0, 1.0), (0.01, 1.0), (0.1, 0.2), (0.2, 0.1)])
def test_tracked_velocity_is_low_passed(seconds, share, jitted):
    """At a constant velocity the rest of the first one decays by a share of dt / seconds in each step, at most 1."""
    env = envs.make("go1_loco", "c", tracking_seconds=seconds)
    state = jax.tree.map(lambda x: x[0], jitted("go1_loco", spawn_velocity=0.5).start(4))  # a reset knows no seconds
    first, last = np.asarray(state.task.velocity), np.array([0.7, -0.3, 0.9])
    np.testing.assert_allclose(first[2], state.physics.qvel[5], atol=1e-6)
    motion = env.motion(state.physics)
    motion = motion.replace(lin_vel=motion.lin_vel.at[:2].set(last[:2]), ang_vel=motion.ang_vel.at[2].set(last[2]))
    task = state.task
    for k in range(1, 6):
        task = env.before_rewards(task, motion)
        np.testing.assert_allclose(task.velocity, last + (first - last) * (1 - share) ** k, atol=1e-6)


# --- the clock of a gait ---

HALF = 20  # control steps; half a step at 1.25 steps a second


@pytest.fixture
def paced(jitted):
    """paced(task): a walker with a clock whose half step is a whole number of control steps."""
    return lambda task: jitted(task, noise=0.0, gait_hz=1 / (2 * HALF * 0.02))


@pytest.mark.parametrize(
    ("task", "pairs"),
    [
        ("g1_loco", {"left_foot": "right_foot"}),
        ("go1_loco", {"FR_foot": "FL_foot", "RL_foot": "RR_foot"}),
        ("anymal_loco", {"LF_foot": "RF_foot", "RH_foot": "LH_foot"}),
    ],
)
def test_feet_of_the_gait_are_half_a_step_apart(paced, task, pairs):
    """Diagonal feet move as one. Each stands for its share of a step, and swings up to the stated height and down."""
    env, walk = paced(task).env, jnp.array([0.5, 0.0, 0.0])
    stance, height = jax.vmap(lambda clock: env.gait(walk, clock))(jnp.arange(4 * HALF) + 0.5)
    stance, height = np.asarray(stance), np.asarray(height)
    first, other = ([env.robot.feet.index(foot) for foot in feet] for feet in (pairs.keys(), pairs.values()))
    assert sorted(first + other) == list(range(len(env.robot.feet)))
    np.testing.assert_array_equal(stance[:-HALF, first], stance[HALF:, other])
    np.testing.assert_allclose(height[:-HALF, first], height[HALF:, other], atol=1e-5)
    np.testing.assert_array_equal(stance[:, first], stance[:, first[:1] * len(first)])
    np.testing.assert_allclose(stance.mean(0), env.config.stance, atol=0.01)
    assert stance.any(1).all() and stance.all(1).mean() == pytest.approx(2 * env.config.stance - 1, abs=0.01)
    assert np.abs(height[stance]).max() < 1e-6 and height[~stance].min() > 0
    np.testing.assert_allclose(height.max(0), env.config.swing_height, rtol=0.01)
    swing = height[: 2 * HALF, 0][~stance[: 2 * HALF, 0]]
    np.testing.assert_allclose(swing, swing[::-1], atol=1e-5)
    for still in ([0.0, 0.0, 0.0], [0.05, 0.05, 0.05]):
        stance, height = env.gait(jnp.array(still), 3)
        assert np.all(np.asarray(stance)) and not np.any(np.asarray(height))
    assert not np.all(np.asarray(env.gait(jnp.array([0.0, 0.0, 0.5]), 3)[0])), "turning on the spot takes steps"


def test_a_marching_robot_steps_at_rest(jitted):
    """Told to stand it has the steps, the phase and the prices of walking, with JAX and without."""
    march, walk = (jitted("g1_loco", noise=0.0, march=march).env for march in (True, False))
    rest, ahead, clock = jnp.zeros(3), jnp.array([0.5, 0.0, 0.0]), jnp.arange(25)
    steps = [jax.vmap(partial(env.gait, command))(clock) for env, command in ((march, rest), (walk, ahead))]
    jax.tree.map(np.testing.assert_array_equal, *steps)
    state = jax.jit(march.reset)(jax.random.key(0))
    task, motion = march.set_command(state.task, rest), march.motion(state.physics)
    facts = {"gait_hz": march.config.gait_hz, "march": True}
    data = SimpleNamespace(qpos=np.eye(1, 36, 3)[0], qvel=np.zeros(35))
    robot = SimpleNamespace(data=data, facts=facts, seconds=3 * march.dt)
    phase = march.task_inputs(task, motion, 3)["phase"]
    np.testing.assert_allclose(phase, play_onnx.Player.readings(robot, np.zeros(3))["phase"], atol=1e-6)
    np.testing.assert_allclose(phase, sim_to_sim.phase_of(facts, np.zeros((1, 3)), 3 * march.dt)[0], atol=1e-6)
    assert np.linalg.norm(phase) == pytest.approx(1)
    action = jnp.zeros(march.action_dim)
    prices = march.rewards(task, motion.replace(foot_contact=jnp.zeros(2, bool)), action, action, 3)
    assert prices["stand_still"] == 0 == prices["stand_on_feet"]


def test_phase_is_the_clock_of_the_next_reward(paced):
    """Sine and cosine of the time since the episode began, as the policy and a robot without JAX see it; 0 at rest."""
    biped = paced("g1_loco")
    state = biped.start(4)
    command = jnp.array([[0.5, 0.0, 0.0], [0.0, 0.0, -0.4], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    state = state.replace(clock=jnp.array([0, 7, 9, 3], jnp.int32))
    state = state.replace(task=jax.vmap(biped.env.set_command)(state.task, command))
    moves = np.array([1, 1, 0, 1])
    for _ in range(3):
        state = biped.hold(state)
        angle = np.pi / HALF * np.asarray(state.clock)
        want = np.stack([np.sin(angle), np.cos(angle)], 1) * moves[:, None]
        np.testing.assert_allclose(state.obs[:, biped.env.obs_slices()["phase"]], want, atol=1e-5)
        for n in range(4):
            q, v, seconds = np.eye(1, 36, 3)[0], np.zeros(35), int(state.clock[n]) * 0.02
            facts, data = {"gait_hz": biped.env.config.gait_hz}, SimpleNamespace(qpos=q, qvel=v)
            robot = SimpleNamespace(data=data, facts=facts, seconds=seconds)
            phase = play_onnx.Player.readings(robot, np.asarray(command[n]))["phase"]
            np.testing.assert_allclose(phase, want[n], atol=1e-5)


# --- the set for robots ---


@pytest.fixture
def varied(jitted):
    """Go1 with late actions and readings, and motors that differ."""
    ranges = {"action_delay": (0.0, 0.08), "sensor_lag": (0.0, 0.02), "motor_strength": (0.5, 1.5)}
    return jitted("go1_loco", noise=0.0, joint_friction=(0.0, 0.5), **ranges)


def alike(state, **fields):
    """The same robot in every environment, with its joints as they should be and nothing late."""
    count = state.reward.shape[0]
    state = state.replace(physics=jax.tree.map(lambda x: jnp.stack([x[0]] * count), state.physics))
    fit = {"strength": jnp.ones((count, 12)), "joint_friction": jnp.zeros(count)}
    zero = {"delay": jnp.zeros(count), "lag": jnp.zeros(count)}
    return state.replace(physics=state.physics.replace(**fit), **zero | fields)


def test_randomised_delays_and_motors_are_drawn_in_their_ranges(varied, jitted):
    """One delay, lag and joint friction a robot, one strength a motor, and new ones in a new episode."""
    state = varied.start(256)
    for values, low, high in (
        (state.delay, 0, 4),
        (state.lag, 0, 1),
        (state.physics.strength, 0.5, 1.5),
        (state.physics.joint_friction, 0, 0.5),
    ):
        middle = (low + high) / 2
        np.testing.assert_allclose(np.quantile(values, [0, 0.5, 1]), [low, middle, high], atol=0.2 * middle)
        assert low <= np.min(values) and np.max(values) <= high
    assert np.ptp(np.asarray(state.physics.strength), axis=1).min() > 0.2
    few = jax.tree.map(lambda x: x[:6], state)
    after = varied.hold(overturned(few))
    for name in ("delay", "lag"):
        assert (np.asarray(getattr(after, name)) != np.asarray(getattr(few, name))).tolist() == [True] + [False] * 5
    plain = jitted("go1_loco")
    start = plain.start(4)
    assert not np.any(start.delay) and not np.any(start.lag) and np.all(np.asarray(start.physics.strength) == 1)
    assert not np.any(plain.env.model.dof_frictionloss), "no friction, no rows for the solver"


def test_late_actions(varied):
    """Delays of 0, 10, 20, 30, 40 and 80 ms: the engine gets targets of the actions in force, written out by hand."""
    env, rng = varied.env, np.random.default_rng(0)
    a = rng.normal(0, 0.4, (8, 12)).astype(np.float32)
    none = np.zeros(12, np.float32)  # before the first action a robot holds its default pose
    orders = {
        0.00: list(a),
        0.01: [a[0] / 2, *((a[k - 1] + a[k]) / 2 for k in range(1, 8))],
        0.02: [none, *a[:7]],
        0.03: [none, a[0] / 2, *((a[k - 2] + a[k - 1]) / 2 for k in range(2, 8))],
        0.04: [none, none, *a[:6]],
        0.08: [none, none, none, none, *a[:4]],
    }
    late = jnp.array(list(orders)) / 0.02
    state = alike(varied.start(6), delay=late)
    want, engine = state.physics, jax.jit(jax.vmap(env.engine.step))
    for k in range(8):
        state = varied.step(state, jnp.tile(a[k], (6, 1)))
        followed = np.array([order[k] for order in orders.values()])
        want = engine(want, np.array(env.robot.default_pose, np.float32) + np.float32(0.25) * followed)
        assert not np.any(np.asarray(state.terminated))
        np.testing.assert_allclose(state.physics.qpos, want.qpos, atol=1e-5)
        np.testing.assert_allclose(state.history["action"][:, -1], jnp.tile(a[k], (6, 1)), err_msg="the policy's own")
    assert np.abs(np.asarray(state.physics.qpos)[:-1, 7:] - np.asarray(state.physics.qpos)[1:, 7:]).max(1).min() > 0.01


def test_late_readings(varied):
    """At a lag of 20 ms x_t is that of the step before, at 10 ms the mean of the two; rewards see the truth."""
    lag = np.array([[0.0], [0.5], [1.0]] * 2)
    state = alike(varied.start(6), lag=jnp.asarray(lag[:, 0]))
    state = state.replace(task=jax.vmap(varied.env.set_command)(state.task, jnp.zeros((6, 3))))

    def truth(physics):
        qpos, qvel = np.asarray(physics.qpos), np.asarray(physics.qvel)
        down, turn = [], np.zeros(9)
        for quat in np.float64(qpos[:, 3:7]):
            mujoco.mju_quat2Mat(turn, quat)
            down.append(turn.reshape(3, 3).T @ [0, 0, -1])
        return np.hstack([qvel[:, 3:6], down, qpos[:, 7:] - varied.env.robot.default_pose, qvel[:, 6:]])

    state = state.replace(readings=jax.tree.map(lambda x: jnp.stack([x[0]] * 6), state.readings))
    before = truth(state.physics)
    for i in range(4):
        state = varied.step(state, jnp.tile(0.5 * jax.random.normal(jax.random.key(i), (12,)), (6, 1)))
        now = truth(state.physics)
        np.testing.assert_allclose(state.history["prop"][:, -1], now + lag * (before - now), atol=1e-4)
        np.testing.assert_allclose(state.obs[:, 24:36], 0.05 * (now + lag * (before - now))[:, 18:], atol=1e-5)
        np.testing.assert_allclose(state.reward, jnp.repeat(state.reward[:1], 6), atol=1e-5)
        assert np.abs(now - before).max() > 1
        before = now


def test_weak_motors_pull_less_up_to_the_same_limit():
    """kp part of the torque in one physics step: strength x kp x (target - angle), within the limit of the MJCF."""
    env = envs.make("go1_loco", "c", decimation=1)
    physics = spawn(env)(jax.random.key(0))
    strength = jnp.concatenate([jnp.array([0.5]), jnp.linspace(0.6, 1.4, 11)])
    for offset in (0.1, -3.0):
        after = jax.jit(env.engine.step)(physics.replace(strength=strength), physics.qpos[7:] + offset)
        held = np.asarray(after.torque) + env.model.dof_damping[6:] * np.asarray(after.qvel[6:])
        limit = env.model.actuator_forcerange[:, 1]
        want = np.clip(np.asarray(strength) * env.model.actuator_gainprm[:, 0] * offset, -limit, limit)
        np.testing.assert_allclose(held, want, rtol=1e-3)
        assert (np.abs(want) < limit).all() == (offset == 0.1)
    np.testing.assert_allclose(held, -limit, rtol=1e-5)


def test_joint_friction_is_that_of_mujoco(varied):
    """As a model with this frictionloss in every joint moves in plain MuJoCo; pulls below it hardly move a joint."""
    env = varied.env
    state = jax.tree.map(lambda x: x[:2], alike(varied.start(6)))
    physics = state.physics.replace(joint_friction=jnp.array([0.0, 0.4]), qpos=state.physics.qpos.at[:, 2].add(0.5))
    start, target = np.asarray(physics.qpos[0]), env.default_pose + 0.01  # 0.2 to 0.3 N m
    step, moved = jax.jit(jax.vmap(env.engine.step)), []
    spec = envs.make("go1_loco", "c").scene()
    spec.option.timestep = 0.005
    for joint in spec.joints[1:]:
        joint.frictionloss = 0.4
    model = spec.compile()
    model.geom_friction[model.geom_contype > 0, 0] = physics.friction[0]
    model.body_mass[:] *= physics.mass_scale[0]
    model.body_inertia[:] *= np.asarray(physics.mass_scale[0])[:, None]
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = start, physics.qvel[0], target
    for _ in range(5):
        physics = step(physics, jnp.stack([target] * 2))
        data.qacc_warmstart[:] = 0
        mujoco.mj_step(model, data, nstep=4)
        np.testing.assert_allclose(physics.qpos[1], data.qpos, atol=1e-5)
        moved.append(np.abs(np.asarray(physics.qpos) - start)[:, 7:].mean(1))
    free, rubbed = moved[-1]
    assert free > 0.01 and rubbed < free / 5


def test_actions_of_g1_are_scaled_joint_by_joint():
    """A unit of action asks for a quarter of the joint's torque limit, by the gains in the MJCF, or for 0.5 rad."""
    env = envs.make("g1_loco", "c", noise=0.0)
    kp, limit = env.model.actuator_gainprm[:, 0], env.model.actuator_forcerange[:, 1]
    scale = np.minimum(0.25 * limit / kp, 0.5)
    np.testing.assert_allclose(env.robot.action_scale, scale, atol=1e-3)
    assert scale.min() < 0.1 and scale.max() == 0.5
    state = jax.eval_shape(env.reset, jax.random.key(0))
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.replace(key=None))
    action = np.linspace(-1, 1, env.action_dim, dtype=np.float32)
    want = np.array(env.robot.default_pose) + scale * action
    np.testing.assert_allclose(env.joint_targets(state, action), want, atol=1e-3)


@pytest.mark.parametrize("task", TASKS)
def test_robust_set(task):
    """Three walkers have one, which replaces fields of their config and no other; the rest refuse in one line."""
    usual = envs.TASKS[task][1]
    if task not in LOCOMOTION:
        words = f"{task} has no robust set; anymal_loco, go1_loco, g1_loco have one"
        with pytest.raises(ValueError, match=words) as refusal:
            envs.make(task, "c", robust=True)
        assert "\n" not in str(refusal.value)
        return
    config = envs.make(task, "c", robust=True, noise=0.0).config
    assert config == dataclasses.replace(usual, **usual.robust | {"noise": 0.0}) and config != usual
    harder = ("action_delay", "sensor_lag", "motor_strength", "joint_friction", "friction", "link_mass", "added_mass")
    for name in harder:
        low, high = getattr(config, name)
        assert low < high and low <= getattr(usual, name)[0] and getattr(usual, name)[1] <= high, name
    assert config.push_velocity >= usual.push_velocity and config.turning > 0 and config.on_the_spot > 0


def test_the_documented_robust_sets_are_those_of_the_configs():
    """Each row of the table in docs/ppo_finetune.md, and a row for each field but weights and gait."""
    text = (Path(__file__).parent.parent / "docs/ppo_finetune.md").read_text().split("### Train for a robot")[1]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", text.split("\n## ")[0], re.M))
    for i, task in enumerate(LOCOMOTION):
        usual = envs.TASKS[task][1]
        config = envs.replace_checked(usual, usual.robust)
        assert usual.robust.keys() - {"weights", "gait_hz", "stance", "swing_height", "march"} <= rows.keys()
        for name, row in rows.items():
            numbers = [float(word) for word in row.split(" | ")[i].split(" to ")]
            assert numbers == np.ravel(getattr(config, name)).tolist(), (task, name)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("action_delay", (0.0, 0.09), "action_delay must be from 0 to 0.08 s, not (0.0, 0.09)"),
        ("action_delay", "-0.01,0", "action_delay must be from 0 to 0.08 s, not (-0.01, 0.0)"),
        ("action_delay", "0.04,0.02", "action_delay takes its lower end first"),
        ("sensor_lag", "0,0.03", "sensor_lag must be from 0 to 0.02 s"),
        ("command_seconds", "0,5", "command_seconds must be above 0"),
        ("robust", "{}", "robust cannot be set: --robust turns it on as a whole"),
    ],
)
def test_what_no_robot_does_is_refused(name, value, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        envs.make("go1_loco", "c", **{name: value})


def test_pushes(jitted):
    """When the clock reaches push_at the horizontal velocity jumps by at most push_velocity; else it does not."""
    task = jitted("anymal_loco")
    state = task.start(64).replace(push_at=jnp.full(64, 1, jnp.int32))
    quiet = task.hold(state.replace(push_at=jnp.full(64, 999, jnp.int32)))
    pushed = task.hold(state)
    jump = np.asarray(pushed.physics.qvel - quiet.physics.qvel)
    assert 0.3 < np.abs(jump[:, :2]).max() <= 0.5 + 1e-5 and not jump[:, 2:].any()
    assert np.all((np.asarray(pushed.push_at) >= 501) & (np.asarray(pushed.push_at) <= 751))


def test_a_gait_without_a_clock_is_refused():
    """Its terms would pay for feet that never change."""
    with pytest.raises(ValueError, match="in_step and foot_path need gait_hz"):
        envs.make("g1_loco", "c", gait_hz=0.0)


def test_a_weight_without_its_term_is_named(jitted):
    env = jitted("go1_loco").env
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(env), "rewards", lambda *_: {"torque": 0.0})
        with pytest.raises(ValueError, match="this task has torque"):
            jax.eval_shape(lambda key: env.step(env.reset(key), jnp.zeros(12)), jax.random.key(0))


def test_a_task_of_one_s_own(monkeypatch):
    """Found by name without a word of it elsewhere."""
    family, config = envs.TASKS["go1_loco"]
    monkeypatch.setitem(envs.OWN, "go1_mine", (family, envs.replace_checked(config, {"yaw_rate": 0.5})))
    assert envs.make("go1_mine", "c").config.yaw_rate == 0.5 and envs.family("go1_mine") is family
    with pytest.raises(ValueError, match="go1_mine"):
        envs.make("go1_yours", "c")


@pytest.mark.parametrize("engine", ENGINES)
def test_randomised_fields_reach_the_engine(engine):
    """Heavier robots press harder, slippery ones slide, wrenches push: the same on every engine."""
    if engine == "warp":
        pytest.importorskip("warp")
    fixed = {"noise": 0.0, "spawn_xy": 0.0, "spawn_yaw": 0.0, "added_mass": (0.0, 0.0)}
    env = envs.make("go1_loco", engine, joint_friction=(0.0, 5.0), **fixed)
    one = spawn(env)(jax.random.key(0)).replace(joint_friction=jnp.zeros(()))
    trunk = env.model.body("trunk").id
    batch = jax.tree.map(lambda x: jnp.stack([x] * 6), one)
    batch = batch.replace(
        mass_scale=batch.mass_scale.at[1, trunk].mul(2.0),
        friction=batch.friction.at[2].set(0.01),
        wrench=batch.wrench.at[2:4, trunk, 0].set(20.0),
        strength=batch.strength.at[4].set(0.5),
        joint_friction=batch.joint_friction.at[5].set(5.0),
    )
    step = jax.jit(jax.vmap(env.engine.step))
    for _ in range(25):
        batch = step(batch, jnp.tile(env.default_pose, (6, 1)))
    height, forward = np.asarray(batch.qpos)[:, [2, 0]].T
    assert height[1] < height[0] - 0.01, "twice the trunk mass sags"
    assert forward[2] > 0.1 > forward[3], "a pull of 20 N slides the slippery robot and not the other"
    assert height[4] < height[0] - 0.01, "half the strength sags"
    assert height[5] > height[0] + 0.003, "joints that rub hold the robot up"


@pytest.mark.parametrize("name", ROBOTS)
def test_engines_agree(name):
    """Same start, same random targets, 25 control steps on each engine (c in double, mjx in single precision).

    Until the first feet slip the two differ by rounding; after that contact makes any two simulations part. Robots
    start 1 mm in the ground: whether a foot that just touches it is in contact is a matter of rounding.
    """
    task = {"anymal_d": "anymal_loco", "go1": "go1_loco", "g1": "g1_loco"}[name]
    paths = {}
    for engine in ("c", "mjx"):
        env = envs.make(task, engine, spawn_velocity=0.0, spawn_joints=(1.0, 1.0))
        physics = jax.vmap(spawn(env))(jax.random.split(jax.random.key(0), 2))
        physics = physics.replace(qpos=physics.qpos.at[:, 2].add(-0.001))
        targets = env.default_pose + 0.05 * jax.random.normal(jax.random.key(1), (25, 2, env.action_dim))
        step = jax.vmap(env.engine.step)
        run = jax.jit(lambda p, t, step=step: jax.lax.scan(lambda p, t: (step(p, t),) * 2, p, t))
        paths[engine] = jax.device_get(run(physics, targets)[1])
    a, b = paths["c"], paths["mjx"]
    early, late = (1e-4, 5e-2) if name == "g1" else (1e-5, 1e-3)  # [m, rad]
    np.testing.assert_allclose(a.qpos[:5], b.qpos[:5], atol=early)
    np.testing.assert_allclose(a.qpos, b.qpos, atol=late)
    np.testing.assert_allclose(a.torque[:5], b.torque[:5], atol=1e-2)
    np.testing.assert_allclose(a.sensors[:5], b.sensors[:5], atol=1.0)  # contact forces reach 500 N


def test_vmap_twice_is_one_batch(jitted):
    """Seeds x environments through engine c: each seed's numbers are those of a run of its own, bit for bit."""
    env = jitted("go1_loco").env
    physics = jax.vmap(spawn(env))(jax.random.split(jax.random.key(0), 6))
    targets = env.default_pose + 0.2 * jax.random.normal(jax.random.key(1), (6, 12))
    flat = jax.jit(jax.vmap(env.engine.step))(physics, targets)
    nest = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), (physics, targets))
    nested = jax.jit(jax.vmap(jax.vmap(env.engine.step)))(*nest)
    assert_trees_equal(flat, jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested))


@pytest.mark.parametrize("task", LOCOMOTION)
def test_mirrored_rollout_is_seen_mirrored(paced, task):
    """Simulate a robot and its mirror image; observation, x_t and reward of the one map onto those of the other.

    The image is half a step later in its gait.
    """
    base = paced(task)
    env = base.env
    for mirror in env.mirrors:
        perm, sign = env.robot.mirror_joints(mirror)
        polar = {"left_right": [1, -1, 1], "front_back": [-1, 1, 1]}[mirror]
        axial = [-s for s in polar]
        quat = [1, axial[0], axial[1], axial[2]]
        state = base.start(4)
        p = state.physics

        def reflect(qpos, qvel, quat=quat, polar=polar, axial=axial, perm=perm, sign=sign):
            joints = [x[:, perm] * sign for x in (qpos[:, 7:], qvel[:, 6:])]
            base_pos, turn = qpos[:, :3] * jnp.array(polar), qpos[:, 3:7] * jnp.array(quat)
            base_vel = [qvel[:, :3] * jnp.array(polar), qvel[:, 3:6] * jnp.array(axial)]
            return jnp.concatenate([base_pos, turn, joints[0]], 1), jnp.concatenate([*base_vel, joints[1]], 1)

        qpos, qvel = reflect(p.qpos, p.qvel)
        planar = jnp.array([polar[0], polar[1], axial[2]])
        flipped_task = state.task.replace(
            command=state.task.command * planar, velocity=state.task.velocity * planar, heading=-state.task.heading
        )
        image = state.replace(physics=p.replace(qpos=qpos, qvel=qvel), task=flipped_task)
        image = image.replace(clock=image.clock + HALF)
        for i in range(4):
            action = 0.3 * jax.random.normal(jax.random.key(i), (4, env.action_dim))
            state = base.step(state, action)
            image = base.step(image, env.mirror(mirror, "action", action))
            assert not np.any(state.terminated | image.terminated)
            np.testing.assert_allclose(image.obs, env.mirror(mirror, "obs", state.obs), atol=2e-3)
            got, want = image.history["prop"][:, -1], env.mirror(mirror, "prop", state.history["prop"][:, -1])
            np.testing.assert_allclose(got, want, atol=2e-3)
            np.testing.assert_allclose(image.reward, state.reward, atol=1e-4)


def test_the_clock_turns_over_where_images_are_half_a_step_apart():
    """Front and hind feet of a hexapod are in phase, its left and right feet are not."""
    left_right, front_back = np.array([3, 4, 5, 0, 1, 2]), np.array([2, 1, 0, 5, 4, 3])
    hexapod = SimpleNamespace(gait=(0, 0.5, 0, 0.5, 0, 0.5))
    for image, turns in ((left_right, True), (front_back, False)):
        hexapod.mirror_feet = lambda _, image=image: image
        assert envs.base.Env.swaps_steps(SimpleNamespace(robot=hexapod), "") == turns


@pytest.mark.parametrize("task", TASKS)
def test_mirrors_are_involutions(jitted, task):
    env = jitted(task).env
    for mirror in env.mirrors:
        for name, width in (("obs", env.obs_dim), ("prop", env.prop_dim), ("action", env.action_dim)):
            x = jax.random.normal(jax.random.key(0), (3, width))
            once = env.mirror(mirror, name, x)
            assert not np.allclose(once, x)
            np.testing.assert_array_equal(env.mirror(mirror, name, once), x)


# --- options ---

OPTIONS = [  # task, name, text after --set NAME=, value
    ("go1_loco", "push_velocity", "1", 1.0),
    ("go1_loco", "noise", ".5", 0.5),
    ("go1_loco", "max_tilt", "1e2", 100.0),
    ("go1_loco", "history", "7", 7),
    ("go1_loco", "push_axes", "6", 6),
    ("go1_loco", "friction", "0.3,1.2", (0.3, 1.2)),
    ("go1_loco", "lin_vel_x", "-1, 2", (-1.0, 2.0)),
    ("go1_loco", "command_seconds", "3,8", (3.0, 8.0)),
    ("go1_loco", "added_mass", "(-1,3)", (-1.0, 3.0)),
    ("go1_loco", "fixed_velocity", "none", None),
    ("go1_loco", "fixed_velocity", "1,0", (1.0, 0.0)),
    ("g1_loco", "contact_ends", "torso,pelvis", ("torso", "pelvis")),
    ("g1_loco", "effort_joints", "knee", ("knee",)),
    ("anymal_jump", "level", "4", 4),
    ("anymal_jump", "level", "None", None),
    ("anymal_jump", "skill", "walk", "walk"),
    ("g1_loco", "march", "true", True),
    ("g1_loco", "march", "False", False),
    ("anymal_pedipulation", "fixed_point", "0.7,0,1", (0.7, 0.0, 1.0)),
    ("anymal_pedipulation", "box", "(0,1),(0,.5),(-1,1)", ((0.0, 1.0), (0.0, 0.5), (-1.0, 1.0))),
    ("go1_loco", "weights.torque", "-1e-4", -1e-4),
]


@pytest.mark.parametrize(("task", "name", "text", "value"), OPTIONS)
def test_options_are_read_from_text(task, name, text, value):
    """Text becomes a value of the field's type; the value itself is taken as well."""
    for given in (text, value):
        config = envs.replace_checked(envs.TASKS[task][1], {name: given})
        got = config.weights[name[8:]] if name.startswith("weights.") else getattr(config, name)
        assert got == value and repr(got) == repr(value)  # 1 == 1.0 == True


def test_options_leave_the_rest_as_it_is():
    """One weight changes in its place: the order of the reward's sum stays. The task's own config stays, too."""
    config = envs.TASKS["go1_loco"][1]
    changed = envs.replace_checked(config, {"weights.alive": "2", "noise": "0"})
    assert list(changed.weights) == list(config.weights)
    assert changed.weights == config.weights | {"alive": 2.0} and config.weights["alive"] == 0.25
    assert dataclasses.replace(changed, weights=config.weights, noise=config.noise) == config
    assert envs.replace_checked(config, {"friction": [1, 2]}).friction == (1.0, 2.0)
    assert envs.make_explore("go1", "c", perturb_force="0").config.perturb_force == 0.0


REFUSALS = [
    (
        "go1_loco",
        "gravity",
        "1",
        "unknown option 'gravity'; choose one of action_delay, added_mass, air_time_threshold, com",
    ),
    ("go1_loco", "weights.fun", "1", "unknown option 'weights.fun'; choose one of weights.action_rate, weights.air_"),
    ("go1_loco", "engine", "c", "unknown option 'engine'; choose one of"),
    ("go1_loco", "task", "c", "unknown option 'task'; choose one of"),
    ("go1_loco", "ppo", "{}", "ppo cannot be set: PPO's settings are flags of their own, like --lr"),
    ("go1_loco", "robot", "g1", "robot cannot be set: it belongs to the task"),
    ("go1_loco", "weights", "1", "weights takes one number at a time, as weights.NAME=0.5, not '1'"),
    ("go1_loco", "weights.alive", "much", "weights.alive takes a number like 0.5, not 'much'"),
    ("go1_loco", "friction", "abc", "friction takes two numbers like 0.3,1.2, not 'abc'"),
    ("go1_loco", "friction", "1", "friction takes two numbers like 0.3,1.2, not '1'"),
    ("go1_loco", "friction", "1,2,3", "friction takes two numbers like 0.3,1.2, not '1,2,3'"),
    ("go1_loco", "friction", "0.3,inf", "friction takes two numbers like 0.3,1.2, not '0.3,inf'"),
    ("go1_loco", "friction", "1.2,0.3", "friction takes its lower end first, not '1.2,0.3'"),
    ("go1_loco", "friction", (1.0,), "friction takes two numbers like 0.3,1.2, not (1.0,)"),
    ("go1_loco", "noise", "", "noise takes a number like 0.5, not ''"),
    ("go1_loco", "noise", "nan", "noise takes a number like 0.5, not 'nan'"),
    ("go1_loco", "noise", "1e999", "noise takes a number like 0.5, not '1e999'"),
    ("go1_loco", "noise", float("nan"), "noise takes a number like 0.5, not nan"),
    ("go1_loco", "noise", "true", "noise takes a number like 0.5, not 'true'"),
    ("go1_loco", "noise", "1if", "noise takes a number like 0.5, not '1if'"),
    ("go1_loco", "noise", "open('x')", "noise takes a number like 0.5, not"),
    ("go1_loco", "noise", "[" * 9999, "noise takes a number like 0.5, not"),
    ("go1_loco", "noise", "-1", "noise must be at least 0, not -1.0"),
    ("go1_loco", "spawn_velocity", "-0.5", "spawn_velocity must be at least 0"),
    ("go1_loco", "friction", "-1,0.5", "friction must be at least 0"),
    ("go1_loco", "push_seconds", "0,0", "push_seconds must be above 0"),
    ("go1_loco", "standing", "5", "standing must be from 0 to 1, not 5.0"),
    ("g1_loco", "turning", "0.95", "turning and on_the_spot are shares, together at most 1, not 1.05"),
    ("g1_loco", "stance", "1", "stance must be from 0.05 to 0.95"),
    ("go1_loco", "max_tilt", "270", "max_tilt must be from 1 to 180"),
    ("go1_loco", "reward_floor", "1", "reward_floor must be at most 0"),
    ("go1_loco", "added_mass", "-30,-20", "added_mass and link_mass leave the base with -2"),
    ("go1_loco", "episode_seconds", "0.005", "episode_seconds must be at least a control step of 0.02 s"),
    ("go1_loco", "weights", "{'slip': -0.1}", "weights takes one number at a time, as weights.NAME=0.5"),
    ("anymal_pedipulation", "box", "(1,0),(0,.5),(-1,1)", "box takes its lower end first"),
    ("go1_loco", "history", "2.5", "history takes a whole number like 4, not '2.5'"),
    ("go1_loco", "history", "0", "history must be above 0, not 0"),
    ("go1_loco", "history", "9" * 5000, "history takes a whole number like 4, not"),
    ("go1_loco", "push_axes", "3", "push_axes takes 2 or 6, not '3'"),
    ("go1_loco", "fixed_velocity", "1", "fixed_velocity takes two numbers like 0.3,1.2 or none, not '1'"),
    ("anymal_jump", "level", "high", "level takes a whole number like 4 or none, not 'high'"),
    ("anymal_jump", "level", "10", "level 10 does not exist; choose 0 to 9"),
    ("anymal_jump", "skill", "fly", "unknown skill 'fly'; choose one of walk"),
    ("g1_loco", "march", "1", "march takes true or false, not '1'"),
    (
        "anymal_pedipulation",
        "fixed_point",
        "1,2",
        "fixed_point takes three numbers like 0.7,-0.2,0.5 or none, not '1,2'",
    ),
    ("anymal_pedipulation", "box", "0,1", "box takes three pairs like (0,1),(-0.4,0.2),(-0.1,1.3), not '0,1'"),
    ("anymal_pedipulation", "foot", "LF", "unknown foot 'LF'; choose one of LF_foot, RF_foot"),
    ("g1_loco", "contact_ends", "torso,tail", "the robot's MJCF has no sensor 'tail_force'"),
    ("g1_loco", "effort_joints", "wing", "no joint of g1 has 'wing' in its name"),
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("task", "name", "value", "message"), REFUSALS)
def test_options_are_refused_in_one_line(task, name, value, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        envs.make(task, "c", **{name: value})
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("value", "kind", "good"),
    [
        (3, int, True),
        (3.0, int, False),
        (True, int, False),
        (2**31, int, True),
        (10**12, int, False),
        (3, float, True),
        (float("inf"), float, False),
        (None, str | None, True),
        ("a", str | None, True),
        (1, str | None, False),
        ([1, 2, 3], tuple[int, ...], True),
        ([1, "2"], tuple[int, ...], False),
        ([1] * 100, tuple[int, ...], False),
        ([1.0, 2.0], tuple[float, float], True),
        ([1.0], tuple[float, float], False),
    ],
)
def test_values_of_json_fit_their_annotation(value, kind, good):
    assert fits(value, kind) == good
    if good and kind in (int, float):
        assert parse(repr(value), kind) == value


def test_wrong_names_are_listed():
    with pytest.raises(
        ValueError, match="unknown task 'go2_loco'; choose one of anymal_loco, go1_loco, g1_loco, anymal_ped"
    ):
        envs.make("go2_loco")
    with pytest.raises(ValueError, match="unknown robot 'spot'; choose one of anymal_d, go1, g1"):
        envs.make_explore("spot")
    with pytest.raises(ValueError, match="unknown engine 'bullet'; choose one of auto, c, mjx"):
        envs.make("go1_loco", "bullet")


@pytest.mark.parametrize(("engine", "module"), [("mjx", "mujoco.mjx"), ("c", "mujoco.batch")])
def test_missing_package_is_named(monkeypatch, engine, module):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delattr(mujoco, module.split(".")[1], raising=False)
    with pytest.raises(ImportError, match=f"engine {engine} needs"):
        envs.make("go1_loco", engine)


def test_auto_engine_on_a_cpu():
    spec = envs.make("go1_loco", "c").scene()
    assert type(make_engine("auto", spec, 4)) is ENGINES["c"]


def test_configs_are_frozen_and_prop_is_sensed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        envs.TASKS["go1_loco"][1].noise = 0
    assert sum(3 if kind != "joint" else 12 for kind in PROP.values()) == envs.make("go1_loco", "c").prop_dim == 30


# --- pictures ---


def test_frames_of_a_strip_show_a_stride_in_different_phases(monkeypatch):
    """Frames carry the number of their step as their colour. No two in a row are near the same phase of a stride."""

    def draw(_, qpos):
        return [Image.new("RGB", (render.WIDTH, render.HEIGHT), (int(step), 0, 200)) for step in qpos[:, 0] % 256]

    monkeypatch.setattr(render, "build", lambda *_: None)
    monkeypatch.setattr(render, "draw", draw)
    env = envs.make("go1_loco", "c")
    steps = np.arange(500.0)[:, None]
    pictures = render.film(env, steps, None, **env.FILM_WINDOW)
    assert sorted(pictures) == ["rollout.gif", "rollout.png"]
    sheet = Image.open(io.BytesIO(pictures["rollout.png"]))
    middles = [(render.WIDTH * (i % 5) + 160, render.HEIGHT * (i // 5) + 120) for i in range(10)]
    apart = np.diff([sheet.getpixel(at)[0] for at in middles]) * env.dt  # [s]
    for stride in np.arange(0.30, 0.46, 0.01):
        phase = apart / stride % 1
        assert (np.minimum(phase, 1 - phase) > 0.1).all(), stride
