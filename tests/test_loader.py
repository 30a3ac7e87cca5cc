"""Robots from files: what is derived of small MJCFs whose answers are known, and what is refused."""

import json
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
import ppo_finetune
from envs import anatomy, loader, reader
from envs.terrain import flat_scene
from experiment import checkpoints
from tools import check_robot, replay

SIDES = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}


def leg(name, x, y, shape='<geom name="{0}_toe" type="sphere" size="0.02" pos="0 0 -0.2"/>', mass=0.2):
    """A leg of a hip, a thigh of 0.2 m and a calf of 0.2 m with a round foot."""
    return f"""
    <body name="{name}_hip" pos="{x} {y} 0"><inertial pos="0 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="{name}_hip" axis="1 0 0" range="-0.8 0.8"/>
      <body name="{name}_thigh" pos="0 {np.sign(y) * 0.05} 0">
        <inertial pos="0 0 -0.1" mass="0.8" diaginertia="3e-3 3e-3 1e-3"/>
        <joint name="{name}_thigh" axis="0 1 0" range="-1 3"/>
        <geom type="capsule" size="0.02" fromto="0 0 -0.03 0 0 -0.17"/>
        <body name="{name}_calf" pos="0 0 -0.2">
          <inertial pos="0 0 -0.1" mass="{mass}" diaginertia="1e-3 1e-3 1e-4"/>
          <joint name="{name}_calf" axis="0 1 0" range="-2.7 -0.5"/>
          <geom type="capsule" size="0.01" fromto="0 0 -0.03 0 0 -0.15"/>
          {shape.format(name)}
        </body></body></body>"""


def motors(names=SIDES, extra=""):
    joints = [f"{name}_{part}" for name in names for part in ("hip", "thigh", "calf")]
    return "<actuator>" + "".join(f'<motor joint="{j}" ctrlrange="-20 20" {extra}/>' for j in joints) + "</actuator>"


def quadruped(legs=None, base="<freejoint/>", more=None, keys=None):
    """MJCF of a robot with four legs; keyword arguments replace parts of it."""
    legs = "".join(leg(name, x, y) for name, (x, y) in SIDES.items()) if legs is None else legs
    qpos = "0 0 0.3 1 0 0 0" + " 0 0.8 -1.6" * 4
    keys = f'<keyframe><key name="home" qpos="{qpos}"/></keyframe>' if keys is None else keys
    return f"""<mujoco><compiler angle="radian" autolimits="true"/>
    <worldbody><geom type="plane" size="5 5 1"/><body name="trunk" pos="0 0 0.3">{base}
      <inertial pos="0 0 0" mass="6" diaginertia="0.02 0.06 0.07"/>
      <geom name="trunk" type="box" size="0.2 0.08 0.05"/>{legs}</body></worldbody>
    {motors() if more is None else more}{keys}</mujoco>"""


def biped():
    """MJCF of a robot with two legs, flat feet of four spheres, and position actuators in another order."""

    def side(name, y):
        balls = "".join(f'<geom size="0.01" pos="{x} {z} -0.04"/>' for x in (-0.05, 0.1) for z in (-0.03, 0.03))
        return f"""<body name="{name}_thigh" pos="0 {y} -0.1"><joint name="{name}_hip" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.4"/>
        <body name="{name}_shin" pos="0 0 -0.4"><joint name="{name}_knee" axis="0 -1 0" range="-2 0.1"/>
        <geom type="capsule" size="0.04" fromto="0 0 -0.1 0 0 -0.35"/>
        <body name="{name}_foot" pos="0 0 -0.4"><joint name="{name}_ankle" axis="0 1 0" range="-1 1"/>
        <inertial pos="0.02 0 -0.02" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>{balls}</body></body></body>"""

    joints = [f"{s}_{part}" for s in ("left", "right") for part in ("hip", "knee", "ankle")]
    moved = "".join(f'<position joint="{j}" kp="80" kv="3" forcerange="-60 50"/>' for j in reversed(joints))
    return f"""<mujoco><compiler angle="radian" autolimits="true"/>
    <worldbody><body name="pelvis" pos="0 0 1"><freejoint/>
    <geom type="box" size="0.1 0.15 0.1" mass="8"/>{side("left", 0.1)}{side("right", -0.1)}</body></worldbody>
    <actuator>{moved}</actuator>
    <keyframe><key qpos="0 0 1 1 0 0 0 -0.2 -0.4 -0.2 -0.2 -0.4 -0.2"/></keyframe></mujoco>"""


@pytest.fixture
def write(tmp_path):
    """write(text, toml="") -> path of an MJCF, with a robot.toml beside it."""

    def to_file(text, toml="", name="dog.xml"):
        (tmp_path / name).write_text(text)
        (tmp_path / "robot.toml").write_text(toml)
        return tmp_path / name

    return to_file


# --- what is derived ---


def test_a_quadruped(write):
    body = loader.load(write(quadruped()))
    robot = loader.Robot.of(body)
    assert robot.joints == tuple(f"{name}_{part}" for name in SIDES for part in ("hip", "thigh", "calf"))
    assert robot.feet == tuple(f"{name}_calf_foot" for name in SIDES) and robot.sole == 0.02
    assert robot.gait == (0.0, 0.5, 0.5, 0.0) and robot.like == "go1"
    np.testing.assert_allclose(robot.default_pose, [0, 0.8, -1.6] * 4)
    np.testing.assert_allclose(body["kp"], 20.0)  # the limit of 20 N m at 1 rad
    np.testing.assert_allclose(robot.action_scale, 0.25)
    np.testing.assert_allclose(body["height"], 0.4 * np.cos(0.8) + 0.02)
    np.testing.assert_allclose(body["mass"], 6 + 4 * 1.5)
    assert body["contact_ends"] == ["trunk", *(f"{name}_thigh" for name in SIDES)]
    assert list(robot.mirrors) == ["left_right"]  # all knees bend the same way
    perm, sign = robot.mirror_joints("left_right")
    np.testing.assert_array_equal(perm, [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
    np.testing.assert_array_equal(sign, [-1, 1, 1] * 4)
    np.testing.assert_array_equal(robot.mirror_feet("left_right"), [1, 0, 3, 2])


def test_damping_has_the_ratio_that_is_printed(write):
    """kd of the rule, against the inertia of the links below a joint worked out by hand: the parallel-axis theorem."""
    body = loader.load(write(quadruped()))
    knee = 1e-3 + 0.2 * 0.1**2
    np.testing.assert_allclose(body["kd"][2], 2 * 0.5 * np.sqrt(20 * knee), rtol=1e-6)
    np.testing.assert_allclose(body["damping_ratio"], 0.5)


def test_a_biped_keeps_the_gains_of_its_file(write):
    body = loader.load(write(biped(), name="walker.xml"))
    robot = loader.Robot.of(body)
    assert robot.joints[:3] == ("left_hip", "left_knee", "left_ankle")  # of the tree, the actuators are reversed
    assert any("order" in note for note in body["notes"])
    assert set(body["kp"]) == {80.0} and set(body["kd"]) == {3.0} and set(body["torque_limit"]) == {50.0}
    np.testing.assert_allclose(robot.action_scale, 0.25 * 50 / 80, atol=5e-4)  # three digits
    assert robot.feet == ("left_foot", "right_foot") and robot.gait == (0.0, 0.5)
    assert body["contact_ends"] == ["pelvis", "left_thigh", "right_thigh"]  # shins stand close to the ground
    np.testing.assert_allclose(body["foot_sites"][0], [0.025, 0, -0.04], atol=1e-9)  # between the four spheres
    perm, sign = robot.mirror_joints("left_right")
    np.testing.assert_array_equal(perm, [3, 4, 5, 0, 1, 2])
    np.testing.assert_array_equal(sign, 1)


def test_robot_toml_goes_before_the_file(write):
    toml = """kp = { calf = 40.0, RR_calf = 50.0 }
    kd = 1.5
    action_scale = 0.3
    contact_ends = ["trunk"]
    pose = { RL_thigh = 1.0 }"""
    body = loader.load(write(quadruped(), toml))
    np.testing.assert_allclose(body["kp"][:3], [20, 20, 40])
    assert body["kp"][11] == 50 and body["kd"] == [1.5] * 12 and body["action_scale"] == [0.3] * 12
    assert body["gains_from"][:3] == ["rule", "rule", "robot.toml"]
    assert body["default_pose"][6:9] == [0.0, 1.0, -1.6] and body["contact_ends"] == ["trunk"]
    assert body["mirrors"] == {} and any("no symmetry" in note for note in body["notes"])


@pytest.mark.parametrize("field", ["kp", "kd", "torque_limit", "armature", "action_scale"])
def test_legs_whose_motors_differ_are_no_images(write, field):
    """Fault: mirrored samples of another motion, since an action moves one leg farther than the other."""
    alike, unlike = (
        loader.load(write(quadruped(), f"{field} = {value}")) for value in ("0.3", "{ FL = 0.6, '' = 0.3 }")
    )
    assert "left_right" in alike["mirrors"] and "left_right" not in unlike["mirrors"]
    assert f"robot.toml gives {field}" in alike["notes"]


def test_a_robot_toml_of_another_file_does_not_count(write):
    plain, other = (loader.load(write(quadruped(), toml)) for toml in ("", 'file = "a1.xml"\nkp = 99.0'))
    assert other == plain
    for name in ("dog.xml", "./dog.xml"):
        assert set(loader.load(write(quadruped(), f'file = "{name}"\nkp = 99.0'))["kp"]) == {99.0}


def test_rotors_are_those_of_joint_and_motor(write):
    """A motor's inertia counts with the square of its gear, and robot.toml goes before the file."""
    text = quadruped().replace('range="-0.8 0.8"', 'range="-0.8 0.8" armature="0.01"')
    text = text.replace('joint="FL_hip" ctrlrange="-20 20"', 'joint="FL_hip" ctrlrange="-4 4" gear="5" armature="2e-3"')
    body = loader.load(write(text, "armature = { thigh = 0.03 }"))
    model = mujoco.MjModel.from_xml_string(body["mjcf"])
    np.testing.assert_allclose(model.dof_armature[6:], [0.06, 0.03, 0, *[0.01, 0.03, 0] * 3])
    assert body["kp"][0] == body["kp"][3] and "at FL_calf, FR_calf, RL_calf, RR_calf;" in " ".join(body["notes"])
    knee = 1e-3 + 0.2 * 0.1**2
    heavy = loader.load(write(quadruped(), "armature = 0.02"))
    np.testing.assert_allclose(heavy["kd"][2], 2 * 0.5 * np.sqrt(20 * (knee + 0.02)), rtol=1e-6)


def test_a_foot_without_an_image_leaves_no_mirror(write):
    body = loader.load(write(quadruped(), 'feet = ["FL_calf", "FR_calf", "RL_calf", "FL_calf"]'))
    assert body["foot_bodies"] == ["FL_calf", "FR_calf", "RL_calf"] and not body["mirrors"]


def test_masses_are_averaged_on_request(write):
    """A calf that is 3 % too heavy spoils the mirror image; averaging mends it and keeps the mass."""
    legs = "".join(leg(n, x, y, mass=0.206 if n == "FL" else 0.2) for n, (x, y) in SIDES.items())
    errors, masses = [], []
    for toml in ("", "average = true"):
        body = loader.load(write(quadruped(legs), toml))
        robot = loader.Robot.of(body)
        model = flat_scene(robot).compile()
        errors.append(check_robot.mirror_error(model, robot, body, "left_right")["joints [rad]"])
        masses.append(model.body_mass.sum())
    assert errors[0] > 1e-4 and errors[1] < 1e-6
    np.testing.assert_allclose(masses, 12.006)


def test_a_trunk_without_joint_becomes_free(write):
    """Its keyframe has angles alone."""
    keys = f'<keyframe><key qpos="{"0 0.8 -1.6 " * 4}"/></keyframe>'
    body = loader.load(write(quadruped(base="", keys=keys)))
    free = loader.load(write(quadruped()))
    assert body["digest"] == free["digest"] and any("free joint" in note for note in body["notes"])


def test_a_hanging_trunk_that_lacks_a_mesh_and_a_name_becomes_free(write):
    """It touches the floor by contact pairs, as in files for MJX."""
    keys = f'<keyframe><key qpos="{"0 0.8 -1.6 " * 4}"/></keyframe>'
    mesh = '<geom type="mesh" mesh="part" contype="0" conaffinity="0" mass="0"/><geom name="trunk"'
    text = quadruped(base="", keys=keys).replace('<body name="trunk"', "<body").replace('<geom name="trunk"', mesh, 1)
    text = text.replace("<worldbody>", '<asset><mesh name="part" file="part.dae"/></asset><worldbody>')
    text = text.replace('<geom type="plane"', '<geom name="floor" type="plane"')
    text = text.replace("<actuator>", '<contact><pair geom1="FL_toe" geom2="floor"/></contact><actuator>')
    body = loader.load(write(text))
    assert body["base"] == "base" and len(body["joints"]) == 12 and len(body["feet"]) == 4


def test_a_urdf_whose_meshes_are_missing(write):
    """Two legs that swing below a trunk."""
    solid = '<inertial><mass value="{}"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    ball = '<collision><origin xyz="0 0 -0.4"/><geometry><sphere radius="0.03"/></geometry></collision>'
    look = '<visual><geometry><mesh filename="package://bot/meshes/trunk.dae"/></geometry></visual>'
    text = f'<robot name="bot"><link name="trunk">{solid.format(5)}{look}</link>'
    for side, y in (("left", 0.1), ("right", -0.1)):
        text += f'<link name="{side}_leg">{solid.format(1)}{ball}</link><joint name="{side}_hip" type="revolute">'
        text += f'<parent link="trunk"/><child link="{side}_leg"/><origin xyz="0 {y} 0"/><axis xyz="0 1 0"/>'
        text += '<limit lower="-1" upper="1" effort="30" velocity="9"/></joint>'
    body = loader.load(write(text + "</robot>", "pose = { hip = 0.0 }", "bot.urdf"))
    assert body["base"] == "trunk" and body["joints"] == ["left_hip", "right_hip"]
    np.testing.assert_allclose([body["mass"], body["height"]], [7.0, 0.43], atol=1e-6)


def test_the_scene_stays_behind(write):
    """Ground, lights, materials and the like, of which some name files that are not there."""
    plain = quadruped()
    assets = (
        '<asset><hfield name="hill" file="hill.png" size="1 1 1 1"/><texture name="wood" type="2d" file="wood.png"/>'
    )
    assets += '<material name="wood" texture="wood"/></asset>'
    scene = f'{assets}<worldbody><geom type="hfield" hfield="hill"/><light pos="0 0 3"/><body><geom size="1"/></body>'
    text = plain.replace("<worldbody>", scene).replace('<geom name="trunk"', '<geom name="trunk" material="wood"')
    text = text.replace("<actuator>", '<sensor><framequat objtype="body" objname="trunk"/></sensor><actuator>')
    text = text.replace('<geom name="FL_toe"', '<site name="s" material="wood"/><geom name="FL_toe"')
    models = [mujoco.MjModel.from_xml_string(loader.load(write(one))["mjcf"]) for one in (text, plain)]
    assert models[0].ngeom == models[1].ngeom and models[0].nbody == models[1].nbody
    np.testing.assert_array_equal(models[0].body_mass, models[1].body_mass)


def test_feet_that_touch_the_floor_by_contact_pairs(write):
    """As in files for MJX: the toes collide with nothing else, and the model is that of toes that do."""
    text = quadruped()
    for name in SIDES:
        text = text.replace(f'name="{name}_toe"', f'name="{name}_toe" contype="0" conaffinity="0"')
    pairs = "".join(f'<pair geom1="{name}_toe" geom2="floor"/>' for name in SIDES)
    text = text.replace('<geom type="plane"', '<geom name="floor" type="plane"')
    text = text.replace("<actuator>", f"<contact>{pairs}</contact><actuator>")
    assert loader.load(write(text))["mjcf"] == loader.load(write(quadruped()))["mjcf"]


def test_missing_meshes_give_way(write):
    """Where a body has other shapes they are left out, else a shape with its inertia takes their place."""
    mesh = '<geom type="mesh" mesh="part"/>'
    text = quadruped().replace('<body name="FL_thigh"', f'{mesh}<body name="FL_thigh"', 1)
    text = text.replace('<geom name="trunk"', f'{mesh}<geom name="trunk"', 1)
    text = text.replace("<worldbody>", '<asset><mesh name="part" file="part.stl"/></asset><worldbody>')
    body = loader.load(write(text))
    notes = [note for note in body["notes"] if "missing" in note]
    assert notes == [
        "missing meshes are left out beside other shapes: trunk",
        "missing meshes became shapes with the inertia of the body: FL_hip",
    ]
    model = mujoco.MjModel.from_xml_string(body["mjcf"])
    (shape,) = [
        g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body("FL_hip").id and model.geom_contype[g]
    ]
    np.testing.assert_allclose(model.geom_size[shape] ** 2 * 2 / 3 * 0.5, 1e-3, rtol=1e-5)  # inertia of a cube


@pytest.mark.parametrize(
    ("asked", "fitted"), [("mesh", mujoco.mjtGeom.mjGEOM_CAPSULE), ("sphere", mujoco.mjtGeom.mjGEOM_SPHERE)]
)
def test_a_mesh_that_is_there_becomes_a_fitted_shape(asked, fitted, write, tmp_path):
    """A bar of 0.2 m becomes a capsule, or what the file asks for."""
    corners = np.array(np.meshgrid([-0.1, 0.1], [-0.02, 0.02], [-0.02, 0.02])).reshape(3, -1).T
    (tmp_path / "bar.obj").write_text("".join("v {} {} {}\n".format(*c) for c in corners) + CUBE)
    text = quadruped().replace('type="box" size="0.2 0.08 0.05"', f'type="{asked}" mesh="bar"')
    body = loader.load(write(text.replace("<worldbody>", '<asset><mesh file="bar.obj"/></asset><worldbody>')))
    model = mujoco.MjModel.from_xml_string(body["mjcf"])
    (shape,) = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 1 and model.geom_contype[g]]
    assert model.geom_type[shape] == fitted
    if asked == "mesh":
        np.testing.assert_allclose(model.geom_size[shape, :2], [0.02, 0.08], rtol=1e-4)
    assert any("collision meshes of trunk" in note for note in body["notes"])


@pytest.mark.parametrize("kind", ["obj", "dae"])
def test_meshes_of_a_ros_package_are_found(kind, tmp_path):
    """In urdf/ and meshes/ beside each other; MuJoCo cannot read .dae, which counts as missing."""
    corners = np.array(np.meshgrid([-0.1, 0.1], [-0.02, 0.02], [-0.02, 0.02])).reshape(3, -1).T
    for name in ("urdf", "meshes"):
        (tmp_path / "bot" / name).mkdir(parents=True)
    (tmp_path / f"bot/meshes/bar.{kind}").write_text("".join("v {} {} {}\n".format(*c) for c in corners) + CUBE)
    shape = f'<geometry><mesh filename="package://bot/meshes/bar.{kind}"/></geometry>'
    links = f'<link name="a"><collision>{shape}</collision></link><link name="b"/>'
    text = f'<robot name="bot">{links}<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>'
    (tmp_path / "bot/urdf/bot.urdf").write_text(text)
    spec = reader.read(tmp_path / "bot/urdf/bot.urdf")
    assert [reader.loadable(spec, mesh) for mesh in spec.meshes] == [kind == "obj"]


def test_contact_begins_at_the_weight_of_the_robot():
    """At 1 N for shipped robots; one of 0.5 kg stands on six feet with 0.8 N each."""
    assert {envs.make(task, "c").touch for task in ("go1_loco", "anymal_climb_up", "g1_loco")} == {1.0}
    assert 0.05 < anatomy.touch(0.5) < 0.2


def test_a_body_that_weighs_its_mesh_keeps_its_mass(write, tmp_path):
    """Half of a cube of 0.2 m, cut along a diagonal: 4 kg at 1000 kg/m3, and its centre is that of a triangle."""
    corners = [(x, y, z) for y in (-0.1, 0.1) for x, z in ((-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1))]
    faces = "f 1 2 3\nf 4 6 5\nf 1 4 5\nf 1 5 2\nf 2 5 6\nf 2 6 3\nf 3 6 4\nf 3 4 1\n"
    (tmp_path / "wedge.obj").write_text("".join("v {} {} {}\n".format(*c) for c in corners) + faces)
    text = quadruped().replace('<inertial pos="0 0 0" mass="6" diaginertia="0.02 0.06 0.07"/>', "")
    text = text.replace('<geom name="trunk" type="box" size="0.2 0.08 0.05"/>', '<geom type="mesh" mesh="wedge"/>')
    body = loader.load(write(text.replace("<worldbody>", '<asset><mesh file="wedge.obj"/></asset><worldbody>')))
    np.testing.assert_allclose(body["base_mass"], 4.0, rtol=1e-3)
    model = mujoco.MjModel.from_xml_string(body["mjcf"])
    np.testing.assert_allclose(model.body_ipos[1], [-0.1 / 3, 0, -0.1 / 3], atol=1e-3)
    np.testing.assert_allclose(body["mass"], 4.0 + 4 * 1.5, rtol=1e-3)


def test_a_rigid_foot_that_lost_its_mesh_is_named(write):
    """It becomes part of the calf, whose own shapes would otherwise stand in without a word."""
    foot = '<body name="{0}_pad" pos="0 0 -0.2"><geom type="mesh" mesh="part" mass="0"/></body>'
    text = quadruped().replace('<geom name="FL_toe" type="sphere" size="0.02" pos="0 0 -0.2"/>', foot.format("FL"))
    text = text.replace("<worldbody>", '<asset><mesh name="part" file="part.stl"/></asset><worldbody>')
    (note,) = [note for note in loader.load(write(text))["notes"] if "missing" in note]
    assert "no shape for FL_pad; add a primitive" in note


CUBE = "f 1 2 4\nf 1 4 3\nf 5 8 6\nf 5 7 8\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"


def test_the_digest_is_that_of_the_kinematics(write):
    """It ignores masses, and changes with a length, the pose or the order of joints."""
    first = loader.load(write(quadruped()))["digest"]
    heavier = quadruped().replace('mass="6"', 'mass="7"')
    assert loader.load(write(heavier))["digest"] == first
    longer = quadruped().replace('pos="0 0 -0.2">', 'pos="0 0 -0.21">', 1)
    swapped = quadruped(legs="".join(leg(n, *SIDES[n]) for n in reversed(SIDES)))
    bent = loader.load(write(quadruped(), "pose = { thigh = 0.9 }"))["digest"]
    assert len({first, bent, *(loader.load(write(text))["digest"] for text in (longer, swapped))}) == 4


# --- what is refused ---

MESH = '<asset><mesh name="m" file="m.stl"/></asset><worldbody>'
TWO = "".join(f'<key name="{n}" qpos="0 0 0.3 1 0 0 0 {"0 0.8 -1.6 " * 4}"/>' for n in ("crouch", "sleep"))
REFUSED = {
    "not XML": ("no robot", "not an XML file"),
    "another XML": ("<html/>", "MuJoCo cannot read"),
    "a fixed base": (quadruped(base='<joint axis="0 0 1" range="-1 1"/>', keys=""), "fixed base", "<freejoint/>"),
    "a closed loop": (
        quadruped(more=motors() + '<equality><connect body1="FL_calf" body2="FR_calf" anchor="0 0 0"/></equality>'),
        "closed loops",
    ),
    "coupled joints": (
        quadruped(more=motors() + '<equality><joint joint1="FL_calf" joint2="FL_thigh"/></equality>'),
        "couples FL_calf to other joints",
    ),
    "macros": ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:leg/></robot>', "xacro dog.xml > robot.urdf"),
    "a trunk's frame on the ground": (
        re.sub(r'(_hip" pos="[^ ]* [^ ]*) 0"', r'\1 0.28"', quadruped()),
        "frame of trunk is 0.05 m above the ground",
    ),
    "a fixed base on its side": (
        quadruped(base="", keys=f'<keyframe><key qpos="{"0 0.8 -1.6 " * 4}"/></keyframe>').replace(
            'name="trunk" pos="0 0 0.3"', 'name="trunk" pos="0 0 0.3" euler="1.5708 0 0"'
        ),
        "trunk is tilted by 90 degrees",
    ),
    "a tendon": (
        quadruped(
            more='<tendon><fixed name="t"><joint joint="FL_calf" coef="1"/></fixed></tendon>'
            '<actuator><motor name="puller" tendon="t"/></actuator>'
        ),
        "puller",
        "<motor joint",
    ),
    "a body that weighs its mesh": (
        quadruped(keys="")
        .replace("<worldbody>", MESH)
        .replace('<inertial pos="0 0 0" mass="6" diaginertia="0.02 0.06 0.07"/>', '<geom type="mesh" mesh="m"/>'),
        "mass from mesh m",
        "trunk",
    ),
    "no mass": (quadruped().replace('mass="0.8"', 'mass="0"'), "mass and inertia", "<inertial>"),
    "two keyframes": (quadruped(keys=f"<keyframe>{TWO}</keyframe>"), "crouch, sleep", "keyframe ="),
    "two keyframes without names": (
        quadruped(keys=f"<keyframe>{re.sub('name=.[a-z]*.', '', TWO)}</keyframe>"),
        "keyframes 0, 1",
        'keyframe = "0"',
    ),
    "no keyframe": (quadruped(keys=""), "has no keyframe", "[pose]", "FL_hip"),
    "a pose without one joint": (quadruped(keys=f"<keyframe>{TWO}</keyframe>"), "none of its keyframes crouch, sleep"),
    "a joint without limits": (
        quadruped().replace('axis="1 0 0" range="-0.8 0.8"', 'axis="1 0 0"', 1),
        "FL_hip",
        "range=",
    ),
    "a slide": (quadruped().replace('axis="1 0 0"', 'type="slide" axis="1 0 0"', 1), "only hinges", "FL_hip"),
    "an idle joint": (quadruped(more=motors(("FL", "FR", "RL"))), "RR_hip", "no actuator"),
    "no torque limit": (quadruped(more=motors().replace('ctrlrange="-20 20"', "")), "torque_limit ="),
    "a pose beyond the limits": (quadruped(), "limits of FL_calf"),
    "a trunk on its side": (
        quadruped().replace('qpos="0 0 0.3 1 0 0 0', 'qpos="0 0 0.3 1 1 0 0'),
        "trunk is tilted by 90 degrees",
        "z points up",
    ),
}
TOMLS = {
    "a pose beyond the limits": "pose = { FL_calf = 1.0 }",
    "a pose without one joint": "pose = { thigh = 0.8, calf = -1.6 }",
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refusals_take_one_line(write, fault, refused):
    """And exit code 2."""
    text, *words = REFUSED[fault]
    refused(check_robot.main, check_robot.Args(str(write(text, TOMLS.get(fault, "")))), *words)


@pytest.mark.parametrize(
    ("toml", "word"),
    [
        ("speed = 1", "unknown field 'speed'"),
        ("pose = 1", "pose cannot be 1"),
        ("= 3", "cannot read"),
        ('feet = ["x"]', "'x'"),
        ("feet = [1]", "feet cannot be"),
        ("kp = true", "kp cannot be True"),
        ("kd = nan", "kd cannot be nan"),
        ("pose = { hip = 'up' }", "pose cannot be"),
        ("pose = { hpi = 0.0 }", "'hpi', which is part of no joint's name"),
    ],
)
def test_a_wrong_robot_toml_is_refused(write, toml, word):
    with pytest.raises(ValueError, match=word) as error:
        loader.load(write(quadruped(), toml))
    assert "\n" not in str(error.value)


# --- in the environments ---


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    for name, text in (("dog", quadruped()), ("walker", biped())):
        (folder / f"{name}.xml").write_text(text)
    return {name: loader.load(folder / f"{name}.xml") for name in ("dog", "walker")}


@pytest.mark.parametrize("name", ["dog", "walker"])
def test_legs_reach_where_mujoco_says(bodies, name):
    """Feet of the environment's own kinematics against MuJoCo's, at random joint angles."""
    env = envs.make("loco", "c", robot=bodies[name])
    data, rng = mujoco.MjData(env.model), np.random.default_rng(0)
    for _ in range(4):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *rng.normal(size=env.action_dim)]
        mujoco.mj_kinematics(env.model, data)
        want = [data.site(foot).xpos for foot in env.robot.feet]
        np.testing.assert_allclose(env.feet_in_base(jnp.array(data.qpos[7:])), want, atol=1e-5)


def test_offset_joints_and_uneven_legs(write):
    """A hinge away from its body's origin, with an angle of its own at rest, and a leg with one joint more."""
    text = quadruped().replace(
        'name="FL_thigh" axis="0 1 0"', 'name="FL_thigh" axis="0 1 0" pos="0.01 0 0.02" ref="0.1"'
    )
    text = text.replace(
        '<joint name="FR_thigh"', '<joint name="FR_thigh_2" axis="0 0 1" range="-1 1"/><joint name="FR_thigh"'
    )
    text = text.replace("</actuator>", '<motor joint="FR_thigh_2" ctrlrange="-20 20"/></actuator>')
    body = loader.load(
        write(text.split("<keyframe>")[0] + "</mujoco>", "pose = { hip = 0.0, thigh = 0.8, calf = -1.6 }")
    )
    test_legs_reach_where_mujoco_says({"dog": body}, "dog")


def test_a_dog_walks_through_its_task(bodies):
    """Stands with zero actions, and mirrored observations follow the tables: sides swap, and twice is once."""
    env = envs.make("loco", "c", robot=bodies["dog"], noise=0.0, spawn_yaw=0.0)
    state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    for _ in range(50):
        state = step(state, jnp.zeros(env.action_dim))
        assert not state.terminated
    assert env.motion(state.physics).foot_contact.all()
    obs = jax.random.normal(jax.random.key(1), state.obs.shape)
    image, joints = env.mirror("left_right", "obs", obs), env.obs_slices()["joint_pos"]
    np.testing.assert_array_equal(env.mirror("left_right", "obs", image), obs)
    right = obs[joints][jnp.array([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])]
    np.testing.assert_array_equal(image[joints], right * jnp.array([-1, 1, 1] * 4))  # hips turn the other way


def test_without_contact_ends_only_a_tilt_ends_an_episode(write):
    body = loader.load(write(quadruped(), "contact_ends = []"))
    env = envs.make("loco", "c", robot=body)
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    assert "only a tilt" in "\n".join(loader.lines(body))
    for degrees, ends in ((60, False), (80, True)):
        half = np.deg2rad(degrees) / 2
        qpos = state.physics.qpos.at[2:7].set(jnp.array([1.0, np.cos(half), np.sin(half), 0, 0]))
        fallen = step(state.replace(physics=state.physics.replace(qpos=qpos)), jnp.zeros(12))
        assert bool(fallen.terminated) == ends, degrees


def test_weights_follow_the_body(bodies):
    """Go1's numbers for a body with its motors and joints; torques of stronger motors weigh less."""
    body = bodies["dog"]
    twice = body | {"effort": 4 * body["effort"]}
    weights = [envs.newcomers.loco(one).weights for one in (body, twice)]
    assert weights[0]["torque"] == pytest.approx(4 * weights[1]["torque"])
    assert weights[0]["pose"] == envs.locomotion.GO1_LOCO.weights["pose"]
    two_feet, four_feet = envs.newcomers.loco(bodies["walker"]), envs.newcomers.loco(body)
    assert two_feet.gait_hz > 0 == four_feet.gait_hz and two_feet.march > four_feet.march


def test_a_run_is_repeatable_without_its_file(write, tmp_path, refused, capsys, monkeypatch):
    """args.json holds the body; a checkpoint of another one is refused, in one line."""
    path = write(quadruped())
    args = {"task": "loco", "preset": "smoke", "total_steps": 32, "run_dir": str(tmp_path / "run")}
    ppo_finetune.main(ppo_finetune.Args(robot=str(path), **args))
    path.unlink()
    record = tmp_path / "run/args.json"
    assert loader.load(record) == json.loads(record.read_text())["config"]["body"]
    _, meta = checkpoints.load(tmp_path / "run/policy.msgpack", "policy")
    assert meta["body"] == loader.load(record)
    longer = write(quadruped().replace('pos="0 0 -0.2">', 'pos="0 0 -0.21">'), name="long.xml")
    again = ppo_finetune.Args(
        robot=str(longer), policy=str(tmp_path / "run/policy.msgpack"), **args | {"run_dir": str(tmp_path / "b")}
    )
    refused(ppo_finetune.main, again, "another body", meta["body"]["digest"])
    monkeypatch.setattr(replay, "trace", lambda *_: (jnp.zeros(1),) * 6 + (jnp.zeros((1, 4), bool),))
    monkeypatch.setattr(
        ppo_finetune, "iteration", lambda *parts: (parts[-1].replace(iteration=parts[-1].iteration + 1), {})
    )
    replay.main(replay.Args(str(tmp_path / "run"), iterations=1))
    assert "nothing failed from iteration 2 to 2" in capsys.readouterr().out
    assert envs.label("loco", str(record)) == "dog_loco"


def test_folders_have_the_name_of_the_robot(write, tmp_path):
    """Not that of its robot.toml, which is the same for every robot; one of args.json is tried above."""
    write(quadruped(), toml='file = "dog.xml"')
    assert envs.label("loco", str(tmp_path / "robot.toml")) == "dog_loco"
    assert envs.label(str(tmp_path / "robot.toml")) == envs.label(str(tmp_path / "dog.xml")) == "dog"
    assert (envs.label("go1_loco"), envs.label("go1")) == ("go1_loco", "go1")
    theirs = str(write(quadruped(), name="go1.xml"))
    assert (envs.label("loco", theirs), envs.label(theirs)) == ("go1_file_loco", "go1_file"), "not the shipped Go1's"
    assert envs.label(loader.load(theirs)) == "go1_file"


def test_wrong_pairs_of_flags(refused, write):
    refused(ppo_finetune.main, ppo_finetune.Args(task="loco"), "--robot FILE")
    refused(ppo_finetune.main, ppo_finetune.Args(task="go1_loco", robot="x.xml"), "belongs to the task", "--task loco")
    refused(ppo_finetune.main, ppo_finetune.Args(task="loco", robot="nowhere.xml"), "no such file")
