"""sim_to_sim reads others' models of a robot and drives them as ours. Tests with an ONNX file need its packages."""

import copy
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import envs
import play
from envs.base import NOISE
from envs.robots import ROBOTS
from tools import play_onnx, sim_to_sim

ROOT = Path(__file__).resolve().parent.parent
GO1 = ROBOTS["go1"]
FACTS = {
    "robot": "go1",
    "dt": 0.02,
    "joints": list(GO1.joints),
    "default_pose": list(GO1.default_pose),
    "action_scale": [0.25] * 12,
    "kp": [35.0] * 12,
    "kd": [0.5] * 12,
    "torque_limit": [23.7, 23.7, 35.55] * 4,
    "history": 3,
    "prop": ["ang_vel", "gravity", "joint_pos", "joint_vel"],
}
WIDTHS = {"lin_vel": 3, "ang_vel": 3, "gravity": 3, "command": 3, "joint_pos": 12, "joint_vel": 12}


class Fake:
    """A policy that is a function of its inputs: targets (N, 12) from inputs by name."""

    def __init__(self, targets):
        self.facts, self.targets, self.seen = FACTS, targets, []

    def __call__(self, inputs):
        self.seen.append(inputs)
        target = self.targets(inputs)
        return target - np.array(FACTS["default_pose"]), target, {name: inputs[name] for name in sim_to_sim.HISTORY}


def stand(inputs):
    """Targets of the default pose."""
    return np.tile(FACTS["default_pose"], (len(inputs["joint_pos"]), 1))


def trot(inputs):
    """Targets that depend on every joint's own reading, so that a mixed-up order shows."""
    return np.array(FACTS["default_pose"]) + 0.2 * np.sin(np.arange(12) + 40 * inputs["joint_pos"])


@pytest.fixture(scope="module")
def ours():
    return sim_to_sim.load_robot(GO1.xml, FACTS)


def others_go1():
    """Text of a Go1 as others may write it: other names, legs in another order, D gains as damping, a scene, meshes."""
    spec = GO1.spec()
    for geom in [geom for geom in spec.geoms if geom.group == 2]:
        spec.delete(geom)
    text = re.sub(r'damping="[\d.]+"', 'damping="2"', spec.to_xml())
    text = re.sub(r"\b([FR][RL])_(hip|thigh|calf)_joint\b", lambda m: f"dog/{m[1].lower()}_{m[2]}", text)
    legs = re.findall(r'\n      <body name="[FR][RL]_hip".*?\n      </body>', text, re.S)
    assert len(legs) == 4
    before, after = text.split(legs[0])[0], text.split(legs[3])[1]
    text = before + "".join(legs[::-1]) + after
    text = text.replace("<worldbody>", '<worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 5"/>')
    text = text.replace("<worldbody>", '<asset><mesh name="m" file="not_here.stl"/></asset><worldbody>', 1)
    mesh = '<geom type="mesh" mesh="m" contype="1"/>'
    return text.replace('<freejoint name="root"/>', f'<freejoint name="root"/>{mesh}')


# --- Names ---


def test_names_match_by_likeness_but_never_two():
    wanted = ["FR_hip_joint", "FL_hip_joint"]
    for found in (["fr_hip", "fl_hip"], ["go1/FL-hip", "go1/FR-hip"], ["FLHipJoint", "FRHipJoint"]):
        got = sim_to_sim.match(wanted, found)
        assert [re.sub(r"\W|_|joint|go1", "", name.lower()) for name in got] == ["frhip", "flhip"]
    assert sim_to_sim.match(wanted, ["FR_hip", "fr_hip", "FL_hip_joint"]) == [None, "FL_hip_joint"]
    assert sim_to_sim.match(wanted, ["FR_hip_joint", "FR_hip", "knee"]) == ["FR_hip_joint", None]


# --- Models ---


def test_the_same_robot_in_another_file_moves_alike(tmp_path, ours):
    """Joints in another order, under other names, with damping: the motion and readings are those of ours."""
    (tmp_path / "other.xml").write_text(others_go1())
    other = sim_to_sim.load_robot(tmp_path / "other.xml", FACTS)
    assert other.names[0] == "dog/fr_hip" and sorted(other.qpos) != list(other.qpos), "another order"
    assert not sim_to_sim.unlike(other, ours)
    command = np.tile([0.5, 0.0, 0.0], (10, 2, 1))
    a, b = (sim_to_sim.drive(robot, Fake(trot), command) for robot in (other, ours))
    assert np.ptp(b.joint_pos, axis=0).min() > 0.02, "it moves"
    for name in ("joint_pos", "joint_vel", "torque", "lin_vel", "yaw_rate", "height", "foot_pos", "foot_vel"):
        want = getattr(b, name)  # the other file has six digits of each number
        np.testing.assert_allclose(getattr(a, name), want, atol=1e-3 * np.abs(want).max(), err_msg=name)


def urdf(robot):
    """URDF of a compiled Go1, links of which only the moving ones have an inertia; as exporters write it."""
    m, parts = robot.model, ['<robot name="dog">']
    look = '<{0}><geometry><mesh filename="package://dog/{1}.dae"/></geometry></{0}>'
    for b in range(1, m.nbody):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, m.body_iquat[b])
        turn = turn.reshape(3, 3)
        i = turn @ np.diag(m.body_inertia[b]) @ turn.T
        inertia = f'ixx="{i[0, 0]}" iyy="{i[1, 1]}" izz="{i[2, 2]}" ixy="{i[0, 1]}" ixz="{i[0, 2]}" iyz="{i[1, 2]}"'
        place, name = " ".join(map(str, m.body_ipos[b])), m.body(b).name
        mass = f'<inertial><origin xyz="{place}"/><mass value="{m.body_mass[b]}"/><inertia {inertia}/></inertial>'
        parts += [f'<link name="{name}">{mass}', look.format("visual", b), look.format("collision", b), "</link>"]
        if b > 1:
            j = m.body_jntadr[b]
            tags = f'<parent link="{m.body(m.body_parentid[b]).name}"/><child link="{name}"/>'
            tags += (
                f'<origin xyz="{" ".join(map(str, m.body_pos[b]))}"/><axis xyz="{" ".join(map(str, m.jnt_axis[j]))}"/>'
            )
            tags += f'<limit lower="{m.jnt_range[j, 0]}" upper="{m.jnt_range[j, 1]}" effort="99" velocity="9"/>'
            parts.append(f'<joint name="{m.joint(j).name}" type="revolute">{tags}</joint>')
        if "calf" in name:
            foot = f"{name}_foot"
            ball = '<collision><geometry><sphere radius="0.023"/></geometry></collision>'
            tags = f'<parent link="{name}"/><child link="{foot}"/><origin xyz="0 0 -0.213"/>'
            parts.append(f'<link name="{foot}">{ball}</link><joint name="{foot}" type="fixed">{tags}</joint>')
    return "\n".join([*parts, "</robot>"])


def test_a_urdf_without_meshes_and_free_joint_stands(tmp_path, ours):
    """Mass, joints and feet are those of ours; links that have a shape but no inertia weigh nothing; feet carry it."""
    (tmp_path / "dog.urdf").write_text(urdf(ours))
    robot = sim_to_sim.load_robot(tmp_path / "dog.urdf", FACTS)
    assert robot.model.body_mass.sum() == pytest.approx(ours.model.body_mass.sum(), abs=1e-9)
    assert not sim_to_sim.unlike(robot, ours) and robot.sole == pytest.approx(0.023)
    record = sim_to_sim.drive(robot, Fake(stand), np.zeros((50, 2, 3)))
    weight = ours.model.body_mass.sum() * 9.81
    assert record.foot_force[-10:, :, :, 2].sum(-1).mean() == pytest.approx(weight, rel=0.02)
    np.testing.assert_allclose(record.foot_pos[-1, :, :, 2], 0.023, atol=3e-3)
    same = sim_to_sim.drive(ours, Fake(stand), np.zeros((50, 2, 3)))
    np.testing.assert_allclose(record.joint_pos[-1].mean(0), same.joint_pos[-1].mean(0), atol=0.1)
    assert record.alive.all()


def test_a_payload_that_is_fixed_adds_its_mass_once(tmp_path, ours):
    """In URDF and MJCF: the model is compiled twice."""
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    box = f'<link name="box"><inertial><mass value="0.5"/>{inertia}</inertial></link>'
    box += '<joint name="box" type="fixed"><parent link="trunk"/><child link="box"/></joint></robot>'
    (tmp_path / "dog.urdf").write_text(urdf(ours).replace("</robot>", box))
    box = '<body><inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/></body><camera name="track"'
    (tmp_path / "dog.xml").write_text(GO1.mjcf.replace('<camera name="track"', box))
    for name in ("dog.urdf", "dog.xml"):
        mass = sim_to_sim.load_robot(tmp_path / name, FACTS).model.body_mass.sum()
        assert mass == pytest.approx(ours.model.body_mass.sum() + 0.5, abs=1e-9), name


def test_armature_is_lent_to_joints_that_have_none(tmp_path, ours):
    (tmp_path / "dog.urdf").write_text(urdf(ours))
    robot = sim_to_sim.load_robot(tmp_path / "dog.urdf", FACTS)
    assert sim_to_sim.without_armature(robot, ours).all() and not sim_to_sim.without_armature(ours, ours).any()
    assert any("12 of 12 joints have no armature" in line for line in sim_to_sim.introduce(robot, ours, FACTS))
    before = robot.model.dof_invweight0.copy()
    sim_to_sim.lend_armature(robot, ours)
    np.testing.assert_allclose(robot.model.dof_armature[robot.qvel], [0.005, 0.005, 0.009] * 4)
    assert not np.allclose(robot.model.dof_invweight0, before), "MuJoCo's constants follow"


def test_rotors_at_the_motors_stay(tmp_path, ours):
    spec = mujoco.MjSpec.from_string(GO1.mjcf)
    for motor in spec.actuators:
        motor.armature, motor.gear[0] = 1e-3, 2.0
    (tmp_path / "dog.xml").write_text(spec.to_xml())
    robot = sim_to_sim.load_robot(tmp_path / "dog.xml", FACTS)
    np.testing.assert_allclose(robot.model.dof_armature[robot.qvel], ours.model.dof_armature[ours.qvel] + 4e-3)


def test_bodies_have_their_limits(ours):
    body = ours.body(FACTS)
    np.testing.assert_allclose(body.low[:3], [-0.863, -0.686, -2.818])
    np.testing.assert_allclose(body.high[:3], [0.863, 4.501, -0.888])
    assert body.feet == GO1.feet and body.mass == pytest.approx(12.74, abs=0.01) and body.sole == pytest.approx(0.023)


def test_extra_joints_are_held_and_named(tmp_path):
    text = GO1.mjcf.replace(
        '<camera name="track"',
        '<body name="arm"><joint name="gripper"/><inertial mass="0.1" pos="0 0 0" diaginertia="1 1 1"/></body>'
        '<camera name="track"',
    )
    (tmp_path / "arm.xml").write_text(text)
    robot = sim_to_sim.load_robot(tmp_path / "arm.xml", FACTS)
    assert robot.fixed == ["gripper"] and robot.model.nv == 18


def test_a_joint_that_turns_the_other_way_is_named(tmp_path, ours):
    joint = '<joint name="FL_calf_joint" class="calf"'
    text = GO1.mjcf
    assert joint in text
    (tmp_path / "x.xml").write_text(text.replace(joint, f'{joint} axis="0 -1 0"'))
    assert sim_to_sim.unlike(sim_to_sim.load_robot(tmp_path / "x.xml", FACTS), ours) == ["FL_calf_joint"]


@pytest.mark.parametrize(("shape", "depth"), [("sphere", 0.1), ("capsule", 0.25), ("box", 0.3), ("ellipsoid", 0.3)])
def test_lowest_points_of_upright_shapes(shape, depth):
    size = {"sphere": "0.1", "capsule": "0.1 0.15", "box": "0.1 0.2 0.3", "ellipsoid": "0.1 0.2 0.3"}[shape]
    body = f'<body><geom type="{shape}" size="{size}"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert sim_to_sim.bottom(model, data, 0) == pytest.approx(-depth)


@pytest.mark.parametrize("shape", ["sphere", "capsule", "cylinder", "box", "ellipsoid"])
def test_lowest_points_of_tilted_shapes(shape):
    """Against a plane that the shape just touches: MuJoCo's own contact distance is 0."""
    body = f'<body euler="30 40 0"><freejoint/><geom type="{shape}" size="0.1 0.2 0.3" margin="0.1"/></body>'
    floor = '<geom type="plane" size="1 1 1"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{floor}{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    data.qpos[2] -= sim_to_sim.bottom(model, data, 1)
    mujoco.mj_forward(model, data)
    assert min(data.contact.dist) == pytest.approx(0, abs=1e-6)


def test_feet_may_touch_the_floor_by_contact_pairs_only(tmp_path, ours):
    """As in files for MJX; a pair with a geom that is left out is left out too."""
    text = re.sub(r'name="(\w+_foot_c)"', r'name="\1" contype="0" conaffinity="0"', GO1.mjcf)
    pairs = [f'<pair geom1="{foot}_c" geom2="floor"/>' for foot in GO1.feet] + ['<pair geom1="cone" geom2="floor"/>']
    scene = '<geom name="floor" type="plane" size="1 1 1"/><geom name="cone" size="0.1"/>'
    text = text.replace("<sensor>", f"<contact>{''.join(pairs)}</contact><sensor>").replace(
        "<worldbody>", f"<worldbody>{scene}"
    )
    (tmp_path / "pairs.xml").write_text(text)
    robot = sim_to_sim.load_robot(tmp_path / "pairs.xml", FACTS)
    record = sim_to_sim.drive(robot, Fake(stand), np.zeros((50, 1, 3)))
    weight = ours.model.body_mass.sum() * 9.81
    assert record.foot_force[-10:, :, :, 2].sum(-1).mean() == pytest.approx(weight, rel=0.05)


def test_a_foot_is_where_its_ball_is(tmp_path):
    """Not between the ball and a shin that ends just above it."""
    shin = '<geom class="collision" type="capsule" size="0.01" fromto="0.1 0 -0.1 0 0 -0.23"/>'
    text = re.sub(r'(<geom [^>]*name="\w+_foot_c"[^>]*/>)', rf"\1{shin}", GO1.mjcf)
    (tmp_path / "shin.xml").write_text(text)
    robot = sim_to_sim.load_robot(tmp_path / "shin.xml", FACTS)
    _, data = robot.placed(robot.pose)
    assert text.count(shin) == 4 and robot.sole == pytest.approx(0.023, abs=1e-6)
    for i, foot in enumerate(GO1.feet):
        np.testing.assert_allclose(data.site(f"foot {i}").xpos, data.geom(f"{foot}_c").xpos, atol=1e-9)


# --- Physics ---


def test_weight_on_the_knees_is_told_from_weight_on_the_feet(ours):
    """A robot that kneels with its feet up, and one that stands; a robot told to stand does not count."""
    weight, command = ours.model.body_mass.sum() * 9.81, np.full((75, 1, 3), 0.5)
    kneeling = sim_to_sim.drive(ours, Fake(lambda inputs: np.tile([0, 0, -2.7] * 4, (1, 1))), command)
    standing = sim_to_sim.drive(ours, Fake(stand), command)
    assert kneeling.alive.all() and kneeling.foot_pos[-1, ..., 2].min() > 0.023
    assert kneeling.off_feet[-10:].mean() == pytest.approx(weight, rel=0.02)
    assert 0.5 < kneeling.leaning(weight) < 1.1 and standing.leaning(weight) == pytest.approx(0, abs=1e-6)
    assert sim_to_sim.part(kneeling, 0, 1).leaning(weight) == kneeling.leaning(weight)
    assert sim_to_sim.drive(ours, Fake(stand), 0 * command[:2]).leaning(weight) is None


def test_a_model_of_which_only_the_feet_touch_the_ground_is_named(tmp_path, ours):
    """As Playground's: the same kneeling robot sinks in, and the tool says why."""
    text = re.sub(r'name="(\w+_c)"', r'name="\1" contype="0"', GO1.mjcf)
    text = re.sub(r'name="(\w+_foot_c)" contype="0"', r'name="\1"', text)
    (tmp_path / "feet.xml").write_text(text)
    robot = sim_to_sim.load_robot(tmp_path / "feet.xml", FACTS)
    kneel = Fake(lambda inputs: np.tile([0, 0, -2.7] * 4, (1, 1)))
    assert not sim_to_sim.drive(robot, kneel, np.full((75, 1, 3), 0.5)).alive[-1].any()
    lines = ["only its feet touch" in " ".join(sim_to_sim.introduce(r, ours, FACTS)) for r in (robot, ours)]
    assert lines == [True, False]


def test_motors_are_explicit_pd_with_a_limit_on_the_whole_torque(ours):
    """Equal to torques computed here at every 2 ms; also where the limit bites."""
    m, without = ours.model, copy.deepcopy(ours.model)
    without.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    built_in, by_hand = mujoco.MjData(m), mujoco.MjData(without)
    target, limit, bit = ours.pose + np.tile([0.0, 0.9, -0.9], 4), np.array(FACTS["torque_limit"]), 0
    for data in (built_in, by_hand):
        data.qpos[:] = ours.placed(ours.pose)[0]
    built_in.ctrl[:] = target
    for _ in range(30):
        mujoco.mj_step(m, built_in)
        torque = 35.0 * (target - by_hand.qpos[ours.qpos]) - 0.5 * by_hand.qvel[ours.qvel]
        bit += np.sum(np.abs(torque) > limit)
        by_hand.qfrc_applied[ours.qvel] = np.clip(torque, -limit, limit)
        mujoco.mj_step(without, by_hand)
    assert bit > 10
    np.testing.assert_allclose(built_in.qpos, by_hand.qpos, atol=1e-9)


def test_readings_are_those_of_mujoco_sensors(tmp_path):
    """Velocities and gravity in the base frame, and noise as wide as in training."""
    text = GO1.mjcf.replace(
        "<sensor>",
        '<sensor><velocimeter name="v" site="base"/><gyro name="w" site="base"/>'
        '<framezaxis name="up" objtype="body" objname="world" reftype="site" refname="base"/>',
    )
    assert "velocimeter" in text
    model, rng = mujoco.MjModel.from_xml_string(text), np.random.default_rng(0)
    data, robot = mujoco.MjData(model), SimpleNamespace(qpos=np.arange(7, 19), qvel=np.arange(6, 18))
    data.qpos[:], data.qvel[:] = rng.normal(size=19), rng.normal(size=18)
    mujoco.mj_forward(model, data)
    read = sim_to_sim.readings(robot, data.qpos[None], data.qvel[None])
    for name, sensor in (("lin_vel", "v"), ("ang_vel", "w")):
        np.testing.assert_allclose(read[name][0], data.sensor(sensor).data, atol=1e-9)
    np.testing.assert_allclose(read["gravity"][0], -data.sensor("up").data, atol=1e-9)
    many = [np.repeat(x[None], 2000, 0) for x in (data.qpos, data.qvel)]
    noisy = sim_to_sim.readings(robot, *many, rng)
    for name, width in NOISE.items():
        assert 0.99 * width < np.abs(noisy[name] - read[name]).max() <= width, name


def test_motion_is_recorded_in_the_heading_frame(ours):
    """Of a robot that lies askew and tumbles, against MuJoCo's own velocities and matrices."""
    rng, m = np.random.default_rng(1), ours.model
    data, velocity = mujoco.MjData(m), np.zeros(6)
    data.qpos[:], data.qvel[:] = rng.normal(size=m.nq), rng.normal(size=m.nv)
    mujoco.mj_forward(m, data)
    mujoco.mj_objectVelocity(m, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)  # angular, linear, in the world
    row = sim_to_sim.row(ours, data.qpos[None], data.qvel[None], data.sensordata[None], data.qfrc_actuator[None])
    turn = data.xmat[1].reshape(3, 3)
    heading = turn[:2, 0] / np.linalg.norm(turn[:2, 0])
    want = [heading @ velocity[3:5], heading[0] * velocity[4] - heading[1] * velocity[3], velocity[5]]
    np.testing.assert_allclose(row["lin_vel"][0], want, atol=1e-9)
    assert row["yaw_rate"][0] == pytest.approx(velocity[2])
    (cp, sp), (cr, sr) = ((np.cos(row[name][0]), np.sin(row[name][0])) for name in ("pitch", "roll"))
    np.testing.assert_allclose(turn[2], [-sp, cp * sr, cp * cr], atol=1e-9)
    np.testing.assert_allclose(row["foot_pos"][0], [data.site(f"foot {i}").xpos for i in range(4)], atol=1e-9)


def test_histories_start_with_copies_and_the_phase_with_the_command(ours):
    command = np.zeros((3, 2, 3))
    command[:, 1, 0] = 0.5
    policy = Fake(stand)
    policy.facts = FACTS | {"gait_hz": 5.0}
    sim_to_sim.drive(ours, policy, command)
    first, second = policy.seen[:2]
    x = np.concatenate(
        [first[n] - (np.array(FACTS["default_pose"]) if n == "joint_pos" else 0) for n in FACTS["prop"]], 1
    )
    np.testing.assert_allclose(first["prop_history"], np.repeat(x[:, None], 3, 1))
    assert first["action_history"].shape == (2, 3, 12) and not first["action_history"].any()
    assert not first["phase"][0].any() and not second["phase"][0].any(), "no phase without a command"
    np.testing.assert_allclose(first["phase"][1], [0, 1], atol=1e-9)
    np.testing.assert_allclose(second["phase"][1], [np.sin(0.2 * np.pi), np.cos(0.2 * np.pi)])


def test_falls():
    """By tilt, height, contact of the base, and divergence; not otherwise."""

    def one(tilt=0.0, height=0.3, force=0.0, speed=0.0):
        qpos, qvel = np.zeros((1, 19)), np.full((1, 18), speed)
        qpos[0, 2:5] = height, np.cos(np.deg2rad(tilt) / 2), np.sin(np.deg2rad(tilt) / 2)
        return bool(sim_to_sim.fell(qpos, qvel, np.array([[0, 0, force]]), 0.3)[0])

    assert not one() and not one(tilt=59.0) and not one(height=0.16) and not one(force=0.5)
    assert one(tilt=61.0) and one(height=0.14) and one(force=2.0) and one(speed=2e3)
    assert one(speed=np.nan) and one(tilt=np.nan)


def test_a_fallen_episode_ends_and_the_other_goes_on(ours):
    def lie_down(inputs):
        """Legs folded where the command is to go forward."""
        folded = np.tile([0.0, 2.6, -2.7], 4)
        return np.where(inputs["command"][:, :1] > 0, folded, stand(inputs))

    command = np.zeros((60, 2, 3))
    command[:, 0, 0] = 1.0
    record = sim_to_sim.drive(ours, Fake(lie_down), command)
    assert not record.alive[-1, 0] and record.alive[:, 1].all()
    assert np.all(np.diff(record.alive[:, 0].astype(int)) <= 0), "once fallen it stays so"
    alone = sim_to_sim.drive(ours, Fake(stand), command)
    np.testing.assert_array_equal(record.joint_pos[:, 1], alone.joint_pos[:, 1])


# --- Refusals ---


def test_bad_models_are_one_line(tmp_path):
    def refuse(text, words):
        (tmp_path / "bad.xml").write_text(text)
        with pytest.raises(sim_to_sim.records.UserError, match=words) as found:
            sim_to_sim.load_robot(tmp_path / "bad.xml", FACTS)
        assert "\n" not in str(found.value)

    good = GO1.mjcf
    with pytest.raises(sim_to_sim.records.UserError, match="no such file"):
        sim_to_sim.load_robot(tmp_path / "missing.xml", FACTS)
    refuse("not <xml", "not an XML file")
    refuse("<html/>", "MuJoCo cannot read")
    refuse((ROOT / "assets/anymal_d.xml").read_text(), "no joint for FR_hip_joint")
    refuse(good.replace("FR_calf_joint", "FR_wheel"), "no joint for FR_calf_joint; it has .*FR_wheel")
    solid = [re.escape(line) for line in good.splitlines() if re.search(r'class="collision".*_foot_c', line)]
    assert len(solid) == 4
    nothing = re.sub("|".join(solid), "", good).replace('contype="1" conaffinity="0"', 'contype="0" conaffinity="0"')
    refuse(re.sub(r"<sensor>.*</sensor>", "", nothing, flags=re.S), "no shapes but meshes")
    mesh = '<body name="cap"><geom type="mesh" mesh="m"/></body><camera name="track"'
    heavy = good.replace("<asset>", '<asset><mesh name="m" file="m.stl"/>').replace('<camera name="track"', mesh)
    refuse(heavy, "cap has its mass from mesh m")


@pytest.mark.parametrize("task", ["anymal_pedipulation", "anymal_parkour_walk"])
def test_tasks_that_need_more_than_a_robot_reads_are_refused(task):
    env = envs.make(task, "c")
    shapes = {name: (env.width(kind),) for name, (kind, _) in env.OBS.items() if name != "action"}
    with pytest.raises(sim_to_sim.records.UserError, match="which only the environments"):
        sim_to_sim.check_policy("x.onnx", FACTS, shapes)


def test_policies_of_locomotion_are_welcome_if_complete():
    sim_to_sim.check_policy("x.onnx", FACTS, WIDTHS)
    sim_to_sim.check_policy("x.onnx", FACTS | {"gait_hz": 1.5}, WIDTHS | {"phase": 2})
    for facts, shapes, words in (
        ({}, WIDTHS, "lacks robot, dt"),
        (FACTS, WIDTHS | {"phase": 2}, "lacks gait_hz"),
        (FACTS, {"gravity": 3}, "takes no command"),
        (FACTS | {"robot": "spot"}, WIDTHS, "'spot' of a file; known are"),
        (FACTS | {"mjcf": "<mujoco/>"}, WIDTHS, "'go1' of a file; known are"),
    ):
        with pytest.raises(sim_to_sim.records.UserError, match=words):
            sim_to_sim.check_policy("x.onnx", facts, shapes)


def test_arguments_that_make_no_sense(refused):
    for change, words in (
        ({"starts": 0}, "--starts"),
        ({"seconds": 1.0}, "--seconds"),
        ({"timestep": 0.003}, "divide"),
    ):
        args = sim_to_sim.Args("x.onnx", "x.xml", **change)
        with pytest.raises(sim_to_sim.records.UserError, match=words):
            sim_to_sim.check_args(args, FACTS)
    refused(sim_to_sim.main, sim_to_sim.Args("missing.onnx", GO1.xml), "there is no policy missing.onnx")


# --- A real policy ---


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The recorded Go1 as an ONNX file."""
    pytest.importorskip("jax2onnx")
    pytest.importorskip("onnxruntime")
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    play.main(play.Args(str(ROOT / "results/tasks/go1_loco/policy.msgpack"), engine="c", export=str(path)))
    return path


def test_the_policy_acts_as_in_play_onnx(exported, ours):
    """From the same state and without noise, the first targets are those of tools/play_onnx.py."""
    player, policy = play_onnx.Player(exported), sim_to_sim.Policy(exported)
    command = np.array([0.8, 0.0, 0.0])
    read = sim_to_sim.readings(ours, player.data.qpos[None], player.data.qvel[None]) | {"command": command[None]}
    action, target, after = policy(read | sim_to_sim.first_history(policy.facts, read))
    np.testing.assert_allclose(action[0], player.step(command), atol=1e-6)
    np.testing.assert_allclose(target[0], player.data.ctrl, atol=1e-6)
    for name, x in after.items():
        np.testing.assert_allclose(x[0], player.history[name], atol=1e-6)


def test_both_models_are_compared(exported, tmp_path, capsys):
    """The same robot in another file walks the same way, forward at 0.8 m/s, and everything is printed and written."""
    (tmp_path / "other.xml").write_text(others_go1())
    out = tmp_path / "numbers.json"
    args = sim_to_sim.Args(str(exported), str(tmp_path / "other.xml"), json=str(out), starts=1, seconds=3.0)
    sim_to_sim.main(args)
    text, report = capsys.readouterr().out, json.loads(out.read_text())
    assert "FR_hip_joint is dog/fr_hip" in text and "model: " in text and "ours: " in text
    assert "these joints lie" not in text
    walks = [report[name]["commands"]["forward 0.8"] for name in ("model", "ours")]
    assert all(abs(walk["forward"] - 0.8) < 0.15 and walk["falls"] == 0 for walk in walks)
    assert abs(walks[0]["forward"] - walks[1]["forward"]) < 0.05


def test_without_onnxruntime_it_is_one_line(refused, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "x.onnx").write_bytes(b"")
    refused(sim_to_sim.main, sim_to_sim.Args(str(tmp_path / "x.onnx"), GO1.xml), "requirements-export.txt")


def test_a_file_that_is_no_policy_is_one_line(refused, tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "x.onnx").write_bytes(b"not a graph")
    refused(sim_to_sim.main, sim_to_sim.Args(str(tmp_path / "x.onnx"), GO1.xml), "is not a policy")
