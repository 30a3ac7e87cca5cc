"""The MJCF against figures of the robots' published descriptions; what is derived of it against what policies know."""

import mujoco
import numpy as np
import pytest

from envs.robots import ROBOTS
from envs.terrain import flat_scene

TOTAL_MASS = {"anymal_d": 51.63574, "go1": 12.743448, "g1": 33.341142}  # [kg]

# body: mass [kg] and principal moments of inertia [kg m^2], mirror images averaged
BODIES = {
    "anymal_d": {
        "base": (26.45958, [1.540465875, 1.475472707, 0.253240376]),
        "LF_HIP": (0.36586, [0.000558279, 0.000443321, 0.00023849]),
        "RH_THIGH": (5.1322, [0.109169879, 0.107897682, 0.009704327]),
        "LH_SHANK": (0.79598, [0.018914235, 0.01750288, 0.001689955]),
    },
    "go1": {
        "trunk": (5.204, [0.071656309, 0.063009547, 0.016811244]),
        "FR_hip": (0.68, [0.000734064, 0.000468438, 0.000398719]),
        "RL_thigh": (1.009, [0.00478717, 0.00460903, 0.000709268]),
        "RR_calf": (0.195862, [0.001497636, 0.001484705, 3.5851e-05]),
    },
    "g1": {
        "pelvis": (3.813, [0.010549, 0.0093089, 0.0079184]),
        "left_hip_pitch_link": (1.35, [0.00181517, 0.00153422, 0.00116212]),
        "right_hip_roll_link": (1.52, [0.00254986, 0.00241169, 0.00148755]),
        "left_hip_yaw_link": (1.702, [0.00776166, 0.00717575, 0.00160139]),
    },
}

# foot sites in the base frame at the default pose [m]
FEET = {
    "anymal_d": {"LF_foot": [0.495121, 0.309609, -0.557055], "RH_foot": [-0.495121, -0.309609, -0.557055]},
    "go1": {"FR_foot": [0.1881, -0.12675, -0.264806], "RL_foot": [-0.1881, 0.12675, -0.264806]},
    "g1": {"left_foot": [0.033792, 0.118506, -0.756487], "right_foot": [0.033792, -0.118506, -0.756487]},
}

# joint: range [rad], armature [kg m^2], kp [N m / rad], kd [N m s / rad], torque limit [N m]
JOINTS = {
    "anymal_d": {"RF_HAA": ([-0.6108655, 0.7853985], 0.08, 100, 4, 80)},
    "go1": {
        "FR_thigh_joint": ([-0.686, 4.501], 0.005, 35, 0.5, 23.7),
        "RL_calf_joint": ([-2.818, -0.888], 0.009, 35, 0.5, 35.55),
    },
    "g1": {
        "right_hip_roll_joint": ([-2.9671, 0.5236], 0.025101925, 75, 2, 139),
        "left_ankle_pitch_joint": ([-0.87267, 0.5236], 0.00721945, 20, 1, 50),
    },
}


QUADRUPED = {"axes": "xyy" * 4, "gait": (0.0, 0.5, 0.5, 0.0)}
G1_LEG, G1_WAIST = "hip_pitch hip_roll hip_yaw knee ankle_pitch ankle_roll", "waist_yaw waist_roll waist_pitch"
G1_ARM = "shoulder_pitch shoulder_roll shoulder_yaw elbow wrist_roll wrist_pitch wrist_yaw"
G1_JOINTS = [
    f"{side}_{joint}_joint" for part in (G1_LEG, G1_ARM) for side in ("left", "right") for joint in part.split()
]

# what recorded policies and data rely on: order of joints, their axes at rest, action zero, unit of action, feet, and
# the sides that change places
KNOWN = {
    "anymal_d": QUADRUPED
    | {
        "joints": [f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")],
        "default_pose": (0.0, 0.4, -0.8) * 2 + (0.0, -0.4, 0.8) * 2,
        "action_scale": (0.5,) * 12,
        "feet": ("LF_foot", "RF_foot", "LH_foot", "RH_foot"),
        "sole": 0.031455,
        "mirrors": {"left_right": ("LF RF", "LH RH"), "front_back": ("LF LH", "RF RH")},
    },
    "go1": QUADRUPED
    | {
        "joints": [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")],
        "default_pose": (0.0, 0.9, -1.8) * 4,
        "action_scale": (0.25,) * 12,
        "feet": ("FR_foot", "FL_foot", "RR_foot", "RL_foot"),
        "sole": 0.023,
        "mirrors": {"left_right": ("FR FL", "RR RL")},
    },
    "g1": {
        "joints": [*G1_JOINTS[:12], *(f"{joint}_joint" for joint in G1_WAIST.split()), *G1_JOINTS[12:]],
        "axes": "yxzyyx" * 2 + "zxy" + "yxzyxyz" * 2,
        "default_pose": (
            *(-0.312, 0.0, 0.0, 0.669, -0.363, 0.0) * 2,
            *(0.0, 0.0, 0.073),
            *(0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0),
            *(0.2, -0.2, 0.0, 0.6, 0.0, 0.0, 0.0),
        ),
        "action_scale": (
            *(0.293, 0.463, 0.293, 0.463, 0.5, 0.5) * 2,
            *(0.293, 0.167, 0.167),
            *(0.083, 0.083, 0.083, 0.083, 0.5, 0.5, 0.5) * 2,
        ),
        "feet": ("left_foot", "right_foot"),
        "gait": (0.0, 0.5),
        "sole": 0.0,
        "mirrors": {"left_right": ("left right",)},
    },
}


@pytest.fixture(params=ROBOTS)
def robot(request):
    return ROBOTS[request.param]


@pytest.fixture
def model(robot):
    return flat_scene(robot).compile()


def test_masses_and_inertias(robot, model):
    np.testing.assert_allclose(model.body_mass.sum(), TOTAL_MASS[robot.name], rtol=1e-7)
    for name, (mass, inertia) in BODIES[robot.name].items():
        body = model.body(name)
        np.testing.assert_allclose(body.mass, mass, rtol=1e-7)
        np.testing.assert_allclose(np.sort(body.inertia), sorted(inertia), atol=2e-9)


def test_foot_positions(robot, model):
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1, robot.default_pose
    data.qpos[:3] = 0
    mujoco.mj_kinematics(model, data)
    for name, pos in FEET[robot.name].items():
        np.testing.assert_allclose(data.site(name).xpos, pos, atol=2e-6)


def test_joints_and_gains(robot, model):
    for name, (limits, armature, kp, kd, effort) in JOINTS[robot.name].items():
        joint, actuator = model.joint(name), model.actuator(name)
        np.testing.assert_allclose(joint.range, limits, atol=1e-6)
        assert joint.armature[0] == pytest.approx(armature, rel=1e-5)
        assert actuator.gainprm[0] == -actuator.biasprm[1] == kp
        assert joint.damping[0] == kd and actuator.biasprm[2] == 0
        np.testing.assert_allclose(actuator.forcerange, [-effort, effort])


def test_robots_are_as_policies_know_them(robot, model):
    """To the bit: a policy that was trained before acts as it did."""
    known = KNOWN[robot.name]
    for name in ("joints", "default_pose", "action_scale", "feet", "gait", "sole"):
        want = known[name]
        assert getattr(robot, name) == (want if name == "sole" else tuple(want)), name
    assert [model.actuator(i).name for i in range(model.nu)] == known["joints"]
    assert [model.joint(i + 1).name for i in range(model.nu)] == known["joints"]
    np.testing.assert_array_equal(model.jnt_axis[1:], [np.eye(3)["xyz".index(axis)] for axis in known["axes"]])


def test_mirrors_are_as_policies_know_them(robot):
    """Joints and feet change places by name. A mirror keeps an angle about its normal and turns the others round."""
    known = KNOWN[robot.name]
    assert list(robot.mirrors) == list(known["mirrors"])
    for mirror, sides in known["mirrors"].items():
        swap = {a: b for pair in map(str.split, sides) for a, b in (pair, pair[::-1])}
        image = lambda name: "_".join(swap.get(word, word) for word in name.split("_"))  # noqa: E731
        perm, sign = robot.mirror_joints(mirror)
        assert [robot.joints[i] for i in perm] == [image(joint) for joint in robot.joints]
        assert [robot.feet[i] for i in robot.mirror_feet(mirror)] == [image(foot) for foot in robot.feet]
        normal = {"left_right": "y", "front_back": "x"}[mirror]
        assert sign.tolist() == [1 if axis == normal else -1 for axis in known["axes"]]


def test_default_pose_is_within_limits(robot, model):
    low, high = model.jnt_range[1:].T
    assert np.all(low <= robot.default_pose) and np.all(robot.default_pose <= high)


def test_contact_masks(robot, model):
    """Robot geoms touch the ground and nothing else; the ground touches nothing of its own."""
    floor = model.geom("floor").id
    others = np.arange(model.ngeom) != floor
    assert model.geom_contype[floor] == 0 and model.geom_conaffinity[floor] == 1
    assert np.all(model.geom_contype[others] == 1) and np.all(model.geom_conaffinity[others] == 0)


def test_pictures_keep_the_visual_geoms(robot):
    """Physics drops what only a renderer needs; the moving parts are the same."""
    pretty, plain = flat_scene(robot, visual=True).compile(), flat_scene(robot).compile()
    assert pretty.ngeom > plain.ngeom + 20
    np.testing.assert_array_equal(pretty.body_mass, plain.body_mass)


# --- mirrors, in MuJoCo's own double precision ---


def mirrored_state(robot, mirror, qpos, qvel, ctrl):
    """The mirror image of a free-floating robot, worked out from the reflection itself.

    Reflecting space with S maps a rotation R to S R S, a polar vector v to S v and an axial one to -S v.
    """
    s = {"left_right": np.diag([1.0, -1, 1]), "front_back": np.diag([-1.0, 1, 1])}[mirror]
    rotation, quat = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(rotation, qpos[3:7])
    mujoco.mju_mat2Quat(quat, (s @ rotation.reshape(3, 3) @ s).ravel())
    perm, sign = robot.mirror_joints(mirror)
    joints = [sign * x[perm] for x in (qpos[7:], qvel[6:], ctrl)]
    base_vel = np.concatenate([s @ qvel[:3], -s @ qvel[3:6]])
    return np.concatenate([s @ qpos[:3], quat, joints[0]]), np.concatenate([base_vel, joints[1]]), joints[2]


CASES = [(robot.name, mirror) for robot in ROBOTS.values() for mirror in robot.mirrors]


@pytest.mark.parametrize(("name", "mirror"), CASES)
@pytest.mark.parametrize(("height", "tolerance"), [(2.0, 1e-9), (None, 1e-6)], ids=["flight", "contact"])
def test_mirrored_dynamics(name, mirror, height, tolerance):
    """A mirrored robot given mirrored targets moves as the mirror image: one control step, 8 random starts."""
    robot = ROBOTS[name]
    model = flat_scene(robot).compile()
    rng = np.random.default_rng(0)
    touched = 0
    for _ in range(8):
        qpos, qvel = np.zeros(model.nq), 0.3 * rng.normal(size=model.nv)
        low, high = model.jnt_range[1:].T
        pose = np.clip(robot.default_pose + 0.1 * rng.normal(size=model.nu), low, high)
        axis = rng.normal(size=3)
        quat = np.concatenate([[1], 0.05 * axis])
        feet = [pos[2] for pos in FEET[name].values()]
        qpos[:] = [*rng.normal(size=2), height or -min(feet) + robot.sole - 0.01, *quat / np.linalg.norm(quat), *pose]
        ctrl = np.array(robot.default_pose) + 0.2 * rng.normal(size=model.nu)
        images = []
        for state in ((qpos, qvel, ctrl), mirrored_state(robot, mirror, qpos, qvel, ctrl)):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], data.ctrl[:] = state
            mujoco.mj_step(model, data, 4)
            images.append((data.qpos.copy(), data.qvel.copy()))
            touched += data.ncon
        expected = mirrored_state(robot, mirror, *images[0], ctrl)
        for got, want in zip(images[1], expected, strict=False):
            np.testing.assert_allclose(got, want, atol=tolerance)
    assert (touched > 0) == (height is None)


def test_mirror_tables_are_involutions():
    for robot in ROBOTS.values():
        for mirror in robot.mirrors:
            perm, sign = robot.mirror_joints(mirror)
            x = np.arange(len(perm)) + 1.0
            once = sign * x[perm]
            np.testing.assert_array_equal(sign * once[perm], x)
            assert not np.array_equal(once, x)
