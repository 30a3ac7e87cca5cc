"""The numbers of a gait: synthetic recordings with known answers, one policy from end to end, and refusals."""

import dataclasses
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import envs
import play
from experiment import gait, walks
from tools import gait as tool

TASKS = Path(__file__).resolve().parent.parent / "results/tasks"
DT, STEPS, EPISODES, HZ = 0.02, 500, 3, 2.0
FEET = ("left_foot", "right_foot")
BODY = gait.Body(10.0, np.array([20.0, 40.0]), np.full(2, -1.0), np.array([1.0, 2.0]), FEET, 0.02)


def walk(command=(0.5, 0.0, 0.0), speed=0.5):
    """A biped with 2 strides a second: left foot 60% and right foot 40% in stance, 5 and 8 cm of lift, 0.1 m/s slip."""
    t = np.arange(STEPS) * DT
    phase = (HZ * t[:, None] + [0.255, 0.755]) % 1
    duty, lift = np.array([0.6, 0.4]), np.array([0.05, 0.08])
    stance = phase < duty
    height = np.where(stance, 0, lift * np.sin(np.pi * (phase - duty) / (1 - duty)))
    zero, joints = np.zeros((STEPS, EPISODES)), np.zeros((STEPS, EPISODES, 2))
    foot = np.zeros((STEPS, EPISODES, 2, 3))
    pos, vel, force = foot.copy(), foot.copy(), foot.copy()
    pos[..., 2] = BODY.sole + height[:, None]
    vel[..., 0] = np.where(stance, 0.1, 1.2)[:, None]
    force[..., 2] = np.where(stance, 2 * BODY.mass * gait.GRAVITY, 0)[:, None]
    return gait.Recording(
        dt=DT,
        command=np.tile(np.array(command, float), (STEPS, EPISODES, 1)),
        lin_vel=np.tile([speed, 0.0, 0.0], (STEPS, EPISODES, 1)),
        yaw_rate=zero.copy(),
        height=zero + 0.3 + 0.01 * np.sqrt(2) * np.sin(2 * np.pi * HZ * t)[:, None],
        roll=zero.copy(),
        pitch=zero.copy(),
        joint_pos=joints + np.array([0.5, 1.7]),
        joint_vel=joints + np.array([2.0, -3.0]),
        torque=joints + 10.0,
        action=joints + np.sin(2 * np.pi * HZ * t)[:, None, None],
        foot_pos=pos,
        foot_vel=vel,
        foot_force=force,
        alive=np.ones((STEPS, EPISODES), bool),
    )


def close(measured, **wanted):
    for name, value in wanted.items():
        assert measured[name.replace("__", "/")] == pytest.approx(
            value, rel=0.01 if name.startswith("clearance") else 1e-6, abs=1e-9
        ), name


def test_feet_of_a_known_gait():
    """Faults: swapped feet or sides, clearance from the ground instead of the stance, slip summed over the feet."""
    m = gait.measure(walk(), BODY)
    close(m, duty__left_foot=0.6, duty__right_foot=0.4, duty=0.5, duty_difference=0.2, duty_spread=0.2)
    close(m, clearance__left_foot=0.05, clearance__right_foot=0.08, clearance=0.065, stride_frequency=HZ)
    close(m, slip=0.1 * 0.5 / 0.5, foot_force=2.0, still=0.0, falls=0, episodes=EPISODES)


def test_effort_of_a_known_gait():
    """Faults: negative work counted, a torque over the wrong joint's limit, the margin of one side only, no height."""
    m = gait.measure(walk(), BODY)
    close(m, cost_of_transport=10 * 2 / (BODY.mass * gait.GRAVITY * 0.5), torque_peak=0.5, torque_max=0.5)
    close(m, torque_rms=0.5, joint_margin=0.3, height=0.3, height_std=0.01, roll_std=0.0, fast_action=0.0)
    r = walk()
    r.torque[300, 1] = [0, -100]
    r.joint_pos[300:305] = [-1.1, 0]
    r.pitch[:] = 0.1 * np.sqrt(2) * np.sin(2 * np.pi * HZ * np.arange(STEPS) * DT)[:, None]
    m = gait.measure(r, BODY)
    close(m, torque_max=2.5, torque_peak=0.5, joint_margin=-0.1, pitch_std=0.1, roll_std=0.0)


def test_speed_and_its_error():
    """Faults: the error of the mean mistaken for the mean error, the warm-up counted, a command of another step."""
    r = walk(command=(0.5, 0.1, 0.8))
    r.lin_vel[..., 1] = 0.1
    r.lin_vel[::2, :, 0], r.lin_vel[1::2, :, 0] = 0.6, 0.2
    r.yaw_rate[:] = 0.5
    r.lin_vel[:100], r.yaw_rate[:100] = 9, 9  # 2 s
    m = gait.measure(r, BODY)
    close(m, forward=0.4, sideways=0.1, turning=0.5, velocity_error=0.1, velocity_error_steps=0.2, turning_error=0.3)


def test_fast_actions_are_told_from_slow_ones():
    """Faults: amplitudes in place of powers, the mean counted, a wrong unit of frequency."""
    r, t = walk(), np.arange(STEPS) * DT
    r.action[:] = (5 + np.sin(2 * np.pi * 2 * t) + 0.5 * np.sin(2 * np.pi * 12 * t))[:, None, None]
    close(gait.measure(r, BODY), fast_action=0.25 / 1.25)


def test_chatter_is_no_stride():
    """Faults: every lost contact of one step counted as a flight, every brush of one step as a touch-down."""
    r = walk()
    for step in np.flatnonzero(np.arange(STEPS) % 25 == 5):
        r.foot_force[step, :, 0] = 0  # left foot, in stance
    m = gait.measure(r, BODY)
    close(m, stride_frequency=HZ, clearance__left_foot=0.05)
    for step in np.flatnonzero(np.arange(STEPS) % 25 == 14):
        r.foot_force[step, :, 0, 2] = 50  # in swing
    close(gait.measure(r, BODY), stride_frequency=HZ)
    flags = np.array([0, 1, 0, 0, 1, 1, 0, 1, 1, 0], bool)
    assert gait.without_chatter(flags, 0.03).astype(int).tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 1, 0]
    assert (gait.without_chatter(flags, 0.04) == flags).all(), "40 ms is no chatter"


@pytest.mark.parametrize("names", [("FR_foot", "FL_foot", "RR_foot", "RL_foot"), ("LF_foot", "RF_foot", "LH_foot")])
def test_sides_of_feet(names):
    """Fault: rear left (RL) taken for a right foot, or left front (LF) for a front foot of no side."""
    assert [gait.is_left(name) for name in names] == [
        name in ("FL_foot", "RL_foot", "LF_foot", "LH_foot") for name in names
    ]


def test_rows_after_a_fall_do_not_count():
    """Faults: the robot's next episode measured as well, a fall forgotten, one fall counted at every step."""
    whole, r = gait.measure(walk(), BODY), walk()
    r.alive[300:, 1] = False
    for name in (
        "lin_vel",
        "torque",
        "joint_pos",
        "foot_pos",
        "foot_vel",
        "foot_force",
        "action",
        "height",
        "yaw_rate",
    ):
        getattr(r, name)[300:, 1] = np.nan
    m = gait.measure(r, BODY)
    assert m.pop("falls") == 1 and whole.pop("falls") == 0
    assert m == pytest.approx(whole, rel=0.02, abs=1e-2)


def test_a_fall_in_the_warm_up_leaves_nothing_to_measure():
    """Fault: a crash, a warning, or a number made of nothing."""
    r = walk()
    r.alive[50:] = False
    m = gait.measure(r, BODY)
    assert m["falls"] == EPISODES and np.isnan([x for name, x in m.items() if name not in ("falls", "episodes")]).all()


def test_a_robot_that_stands():
    """Faults: slip and cost of transport per metre of a robot that is to stay, one foot's rest taken for all feet's."""
    r = walk(command=(0, 0, 0))
    r.foot_vel[:] = 0
    r.foot_vel[:250, :, 1] = 1.0
    m = gait.measure(r, BODY, warm_up=0)
    assert np.isnan([m["slip"], m["cost_of_transport"]]).all() and m["still"] == 0.5


def test_commands_of_every_episode():
    """Faults: a sequence that does not switch, episodes that all switch alike, a command out of turn."""
    for name, command in gait.COMMANDS.items():
        assert (gait.schedule(name, DT, 20) == command).all()
    assert sum(gait.schedule(name, DT, 20).shape[1] for name in gait.COMMANDS) == 200
    back = gait.schedule("reverse", DT, 20)
    assert back.shape == (500, 24, 3) and (back[:200] == [0.8, 0, 0]).all() and (back[200:] == [-0.6, 0, 0]).all()
    drawn = gait.schedule("switches", DT, 20)
    assert drawn.shape == (500, 20, 3) and len(np.unique(drawn[0], axis=0)) > 4
    changed = np.flatnonzero((drawn[1:] != drawn[:-1]).any((1, 2))) + 1
    assert changed.tolist() == [125, 250, 375] and (drawn[1:] != drawn[:-1]).any(-1)[changed - 1].all()
    assert {*map(tuple, drawn.reshape(-1, 3))} <= {*gait.COMMANDS.values()}


def test_reversals():
    """Faults: a robot that stops or falls counted as one that reversed, earlier seconds than the last two counted."""
    r = walk()
    r.lin_vel[400:, :, 0] = [-0.41, -0.39, -0.6]
    assert gait.reversals(r) == 2
    r.alive[-1, 2] = False
    assert gait.reversals(r) == 1


@pytest.fixture(scope="module")
def by_command():
    """A robot that turns left at 0.7 and right at 0.2 of the command, falls once, and nearly at a joint limit."""
    out = {}
    for name, command in gait.COMMANDS.items():
        r = walk(command)
        r.yaw_rate[:] = command[2] * (0.7 if command[2] > 0 else 0.2)
        if name == "left":
            r.alive[450:, 0] = False
            r.joint_pos[:] = [0.95, 0]
        out[name] = gait.measure(r, BODY)
    return out | {"switches": out["left"], "reverse": out["left"] | {"reversed": 2.0}}


def test_summary(by_command):
    """Faults: sides of the slope swapped or mixed, sequences among the falls of all, the best in place of the worst."""
    s = gait.summary(by_command, {"push": (1.0, 6.0), "delay": None})
    close(s, yaw_slope_left=0.7, yaw_slope_right=0.2, yaw_slope=0.45, drift=0.5, joint_margin=0.05)
    close(s, falls=1, episodes=3 * len(gait.COMMANDS), switches__falls=1, reverse__reversed=2, push__falls=1)
    assert s["delay/falls"] is None and json.loads(json.dumps(s, allow_nan=False)) == s


def test_table(by_command):
    """Faults: a row or a limit left out, columns that do not line up, NaN shown."""
    text = gait.lines(by_command, gait.summary(by_command, {"push": (1.0, 6.0), "delay": None}))
    table, limits = text.split("\n\nlimits\n")
    assert len({len(line) for line in table.splitlines()}) == 1 and "nan" not in text
    assert [line[:12].strip() for line in table.splitlines()[1:]] == [*by_command]
    for words in ("right: 0.70, 0.20", "all commands: 1 of 33 fell", "reverse: 1 of 3 fell, 2 of 3 reversed"):
        assert words in limits
    assert "push: 1 of 6 fell" in limits and "delay: not measured" in limits


# --- The tool ---


def test_a_recorded_policy_from_end_to_end(tmp_path, capsys):
    """Faults: a command that does not reach the robot, a mirrored or world frame, torque or feet of another joint."""
    path = tmp_path / "new/gait.json"
    tool.main(tool.Args(str(TASKS / "go1_loco/policy.msgpack"), json=str(path), starts=1, seconds=3.0))
    out, report = capsys.readouterr().out, json.loads(path.read_text())
    assert "forward 0.8" in out and "limits" in out and report["summary"]["episodes"] == len(gait.COMMANDS)
    of = report["commands"]
    assert of["forward 0.8"]["forward"] > 0.5 and of["left"]["sideways"] > 0.2 > -0.2 > of["right"]["sideways"]
    assert of["arc left"]["turning"] > 0.2 > -0.2 > of["arc right"]["turning"]
    assert abs(of["stand"]["forward"]) < 0.1 and of["stand"]["duty"] > of["forward 1.0"]["duty"] > 0.3
    assert 0.05 < of["forward 0.8"]["torque_rms"] < 1 and 0.5 < of["forward 0.8"]["foot_force"] < 5


@pytest.mark.parametrize(
    "left",
    [
        "left_foot",
        "leg_front_left_foot",
        "LF_foot",
        "RL_calf_foot",
        "BL_foot",
        "LM_foot",
        "leg_l_foot",
        "LeftFoot",
        "lleg_link",
    ],
)
def test_left_feet_are_known_by_their_names(left):
    right = left.replace("Left", "Right").replace("left", "right").replace("_l_", "_r_").replace("lleg", "rleg")
    right = right.replace("L", "R")
    assert gait.is_left(left) and not gait.is_left(right)


def test_motion_is_seen_in_the_heading_frame(jitted):
    """Faults: base frame in place of the heading frame, roll and pitch swapped or of the wrong sign."""
    env, state = jitted("go1_loco").env, jitted("go1_loco").start(1)
    tilt = 0.3  # [rad] nose down, after a turn by 90 degrees to the left
    quat = np.sqrt(0.5) * np.array([np.cos(tilt / 2), -np.sin(tilt / 2), np.sin(tilt / 2), np.cos(tilt / 2)])
    p = state.physics
    qvel = p.qvel.at[0, :6].set(np.array([0.1, 0.7, 0, 0, 0, 2.0]))
    state = state.replace(physics=p.replace(qpos=p.qpos.at[0, 3:7].set(quat), qvel=qvel))
    seen = jax.vmap(partial(walks.observed, env))(state, state.action)
    np.testing.assert_allclose(seen["lin_vel"][0], [0.7, -0.1, 0], atol=1e-6)
    np.testing.assert_allclose(
        [seen["pitch"][0], seen["roll"][0], seen["yaw_rate"][0]], [tilt, 0, 2 * np.cos(tilt)], atol=1e-5
    )


class Still:
    """A network whose action never changes."""

    mean = None

    def inputs(self, obs, history):
        return obs

    def apply(self, params, obs, method):
        return jax.numpy.full((len(obs), 12), 0.4)


def test_changes_reach_the_robot(jitted):
    """Faults: a push, load, friction or delay that changes nothing, or the wrong episodes."""
    env, steps = jitted("go1_loco", added_mass=(0.0, 0.0)).env, 120
    kicks = np.zeros((steps, 1, 2))
    kicks[100] = [[0.6, 0.8]]
    changes = {"delay": {"delay": 0.04}, "load": {"load": 3.0}, "kick": {"kicks": kicks}}
    changes |= {"ice": {"kicks": kicks, "friction": 0.01}}
    seen = walks.run(env, Still(), {}, dict.fromkeys(["plain", *changes], np.zeros((steps, 1, 3))), changes)
    moved = {name: np.abs(r.joint_pos[:, 0] - env.default_pose).max(-1) for name, r in seen.items()}
    assert moved["delay"][1] < 0.5 * moved["plain"][1] and moved["delay"][3] > 0.8 * moved["plain"][1]
    speed = {name: np.linalg.norm(r.lin_vel[:, 0, :2], axis=-1) for name, r in seen.items()}
    assert speed["kick"][99] < 0.1 and speed["kick"][100] > 0.5 and speed["plain"][60:].max() < 0.1
    assert speed["ice"][110] > speed["kick"][110] + 0.3
    force = {name: r.foot_force[60:100, 0, :, 2].sum(-1).mean() for name, r in seen.items()}
    assert force["load"] - force["plain"] == pytest.approx(3 * gait.GRAVITY, rel=0.15)
    assert all(r.alive.all() for r in seen.values())


def test_a_delay_that_an_environment_cannot_keep_is_not_measured(monkeypatch):
    """60 ms of the training and 40 ms of the test are five steps; four are kept."""
    asked = []

    def run(env, net, params, commands, changes):
        asked.append(changes)
        return {name: walk() for name in commands}

    monkeypatch.setattr(walks, "run", run)
    env, *_ = play.load_nominal(TASKS / "go1_loco/policy.msgpack", "c", ("action_delay=0.06,0.06",))
    monkeypatch.setattr(gait, "measure", lambda *_: dict.fromkeys(("falls", "episodes", "turning"), 1.0))
    monkeypatch.setattr(gait, "summary", lambda by_command, robustness: robustness)
    _, found = walks.evaluate(env, Still(), {}, starts=1)
    late, *others = found
    assert late == "delay of 40 ms" and found[late] is None and late not in asked[0] and {*others} == {*asked[0]}
    assert asked[0].pop("push of 1.0 m/s").keys() == {"kicks"}
    assert [*asked[0].values()] == [{"load": 3.0}, {"friction": 0.3}]


def test_a_push_is_of_one_metre_a_second_at_two_fifths():
    kicks = walks.pushes(500, 40)
    np.testing.assert_allclose(np.linalg.norm(kicks[200], axis=-1), 1.0)
    assert not np.delete(kicks, 200, 0).any() and np.ptp(kicks[200], axis=0).min() > 1.5, "from all sides"


def test_the_task_is_nominal():
    """Faults: pushes or delays of a robust training in the measurement, a time limit, --set without use."""
    env, *_ = play.load_nominal(
        TASKS / "anymal_loco/policy.msgpack", "c", ("episode_seconds=1", "friction=0.2,0.2"), 9.0
    )
    config = env.config
    assert config.push_velocity == 0 and config.added_mass == (0, 0) and config.spawn_velocity == 0
    assert config.friction == (0.2, 0.2) and config.episode_seconds > 9 and config.noise == 1
    robust = play.load_nominal(TASKS / "go1_robust/policy.msgpack", "c")[0].config
    for name in (
        "friction",
        "link_mass",
        "added_mass",
        "motor_strength",
        "joint_friction",
        "action_delay",
        "sensor_lag",
    ):
        assert np.ptp(getattr(robust, name)) == 0, name
    unknown = walks.NOMINAL.keys() - {field.name for field in dataclasses.fields(envs.TASKS["go1_loco"][1])}
    assert not unknown, "a field has another name"


def test_other_tasks_are_refused(refused):
    """Fault: a table of a robot that follows no command, or a traceback."""
    refused(tool.main, tool.Args(str(TASKS / "anymal_pedipulation/policy.msgpack")), "anymal_pedipulation", "velocity")
    refused(tool.main, tool.Args("no/policy.msgpack"), "no/policy.msgpack")
    refused(tool.main, tool.Args(str(TASKS / "go1_loco/policy.msgpack"), starts=0), "--starts")
