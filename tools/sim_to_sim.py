"""Drive a policy on somebody else's model of its robot, and compare its gait with the one on our own model.

    python play.py results/tasks/go1_robust/policy.msgpack --export go1.onnx
    python tools/sim_to_sim.py go1.onnx mujoco_menagerie/unitree_go1/go1.xml

MODEL is an MJCF or URDF file. Both models are simulated alike, in plain MuJoCo: with explicit PD and the gains and
limits of the policy file, at 2 ms, with noisy sensors, on a plane. It works for the locomotion tasks and needs
requirements-export.txt.

Legend: A joints and actions in the policy's order, F feet, N episodes, T control steps.
"""

import json
import os
import re
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

os.environ.pop("MUJOCO_GL", None)  # with some values MuJoCo does not load; this needs no pictures
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import mujoco
import numpy as np
import tyro
from mujoco.batch import Batch

from envs import reader
from envs.anatomy import bottom
from envs.base import DIVERGED, NOISE
from envs.engine import cpu_count
from envs.robots import ROBOTS
from experiment import gait, records

FACTS = ("robot", "dt", "joints", "default_pose", "action_scale", "kp", "kd", "torque_limit", "history", "prop")
READINGS = ("lin_vel", "ang_vel", "gravity", "command", "joint_pos", "joint_vel", "phase")
HISTORY = ("prop_history", "action_history")
UPRIGHT = np.cos(np.deg2rad(60.0))  # of the base's tilt; less is a fall
LOW = 0.5  # of the standing height; a lower base is a fall
CONTACT = 1.0  # [N] more at the base is a fall
GEOM, SENSOR = mujoco.mjtGeom, mujoco.mjtSensor
JOINT, FREE = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtJoint.mjJNT_FREE


@dataclass(frozen=True)
class Args:
    """One policy and one model."""

    policy: tyro.conf.Positional[str]  # ONNX file of play.py --export
    model: tyro.conf.Positional[str]  # MJCF or URDF file of the same robot; meshes need not be there
    json: str | None = None  # write all numbers to this file
    starts: int = 20  # episodes of a command
    timestep: float = 0.002  # [s] of the physics
    seconds: float = gait.SECONDS  # of an episode
    armature: bool = False  # give joints without an armature that of ours


# --- Names of joints ---


def plain_names(names):
    """Names without case, separators, words such as "joint", and first words that all of them share."""
    words = [[w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)] for name in names]
    shared = next((i for i, column in enumerate(zip(*words, strict=False)) if len({*column}) > 1), 0)
    return ["".join(w for w in word[shared:] if w not in ("joint", "jnt")) for word in words]


def match(wanted, found):
    """Name in `found` of each name in `wanted`: the same one, else the only one that is alike, else None."""
    alike = defaultdict(list)
    for name, plain in zip(found, plain_names(found), strict=True):
        if name not in wanted:
            alike[plain].append(name)
    like = [alike[plain] for plain in plain_names(wanted)]
    return [w if w in found else names[0] if len(names) == 1 else None for w, names in zip(wanted, like, strict=True)]


# --- Reading a model ---


def read_joints(path, spec, wanted):
    """The file's names (A,) of the joints that are `wanted`, and the names of its other joints."""
    found = [joint.name for joint in spec.joints if joint.type != FREE]
    names = match(wanted, found)
    if missing := [name for name, got in zip(wanted, names, strict=True) if got is None]:
        raise ValueError(f"{path} has no joint for {', '.join(missing)}; it has {', '.join(found) or 'none'}")
    return names, [name for name in found if name not in names]


def keep_rotors(spec):
    """Move rotor inertia that stands at motors to their joints."""
    for motor in spec.actuators:
        joint = spec.joint(motor.target)
        if joint is not None:
            joint.armature += motor.armature * motor.gear[0] ** 2


def isolate(path, spec, names):
    """Leave only the robot, free and without meshes; joints without a name in `names` become stiff at 0.

    Returns its base's name.
    """
    keep_rotors(spec)
    reader.drop(spec, "actuators", "keys", "equalities")
    roots = list(spec.worldbody.bodies)
    count = [sum(joint.name in names for joint in root.find_all(JOINT)) for root in roots]
    base = roots[int(np.argmax(count))]
    if max(count) < len(names):
        raise ValueError(f"the joints in {path} hang on several bodies; it must be one robot")
    for root in roots:
        if root != base:
            spec.delete(root)
    for joint in base.find_all(JOINT):
        if joint.name not in names and joint.type != FREE:
            spec.delete(joint)
    base = reader.free_the_base(path, spec, [])
    reader.strip(path, spec, {reader.mesh_name(mesh) for mesh in spec.meshes})
    for i, geom in enumerate(spec.geoms):
        geom.name = geom.name or f"geom {i}"
    return base


def add_ground(spec):
    """Put a plane below, and drop contact pairs with geoms that are no longer there."""
    spec.worldbody.add_geom(name="floor", type=GEOM.mjGEOM_PLANE, size=[0, 0, 0.1], contype=1, conaffinity=1)
    geoms = {geom.name for geom in spec.geoms}
    for pair in spec.pairs:
        if not {pair.geomname1, pair.geomname2} <= geoms:
            spec.delete(pair)


def add_motors(spec, names, facts):
    """Explicit PD: torque = kp (target - q) - kd qdot, limited as a whole, at every physics step."""
    for name, kp, kd, limit in zip(names, facts["kp"], facts["kd"], facts["torque_limit"], strict=True):
        joint = spec.joint(name)
        joint.damping = np.zeros_like(joint.damping)  # often the D part of the file's own motors
        motor = spec.add_actuator(name=f"motor of {name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0], motor.biasprm[:3] = kp, (0.0, -kp, -kd)
        motor.forcelimited, motor.forcerange = True, (-limit, limit)


def set_options(spec, timestep):
    """Physics alike for all models. Friction cones and contact parameters stay those of the file."""
    option = spec.option
    option.timestep, option.integrator = timestep, mujoco.mjtIntegrator.mjINT_EULER
    option.solver, option.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 1e-8
    # Files made for MJX allow a few iterations; elliptic cones of a high impratio need about 50 in the line search.
    option.iterations, option.ls_iterations = 100, 50
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # a robot that diverges must show
    option.enableflags = 0


# --- Feet ---


@dataclass
class Foot:
    """The middle of the shapes on which a foot stands."""

    body: str
    place: np.ndarray  # (3,) in the body's frame
    shapes: list  # names of its geoms
    sole: float  # [m] height above the ground


def solid_geoms(model):
    """Geoms (G,) of the robot that the floor stops."""
    floor = model.geom("floor").id
    paired = {int(g) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True) if floor in pair for g in pair}
    solid = (model.geom_contype & 1 | model.geom_conaffinity & 1) > 0
    return [g for g in range(model.ngeom) if (solid[g] or g in paired) and g != floor]


def end_bodies(model):
    """Moving bodies (L,) that no other moves on, such as feet and hands."""
    root = model.body_weldid
    carry = {int(root[model.body_parentid[b]]) for b in range(1, model.nbody) if root[b] == b}
    return [b for b in range(1, model.nbody) if root[b] == b and b not in carry]


def joint_above(model, body, known):
    """The first of the joints `known`, by id, on the way from a body to the base; None if there is none."""
    while body:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            if joint in known:
                return known.index(joint)
        body = model.body_parentid[body]
    return None


def last_joints(robot):
    """Index (F,) into the policy's joints of the last joint of each leg of one of our robots."""
    model = robot.spec().compile()
    joints = [model.joint(name).id for name in robot.joints]
    return [joint_above(model, model.site(foot).bodyid[0], joints) for foot in robot.feet]


def find_feet(model, joints, pose, ends, path):
    """The feet: the F lowest ends in the default pose, in the order of `ends`, their last joints.

    ValueError if these are not the feet of our robot.
    """
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joints]] = pose
    mujoco.mj_kinematics(model, data)
    shapes = {body: [] for body in end_bodies(model)}
    for geom in solid_geoms(model):
        shapes.get(int(model.body_weldid[model.geom_bodyid[geom]]), []).append(geom)
    low = {body: min([bottom(model, data, g) for g in geoms], default=np.inf) for body, geoms in shapes.items()}
    lowest = sorted(low, key=low.get)[: len(ends)]
    feet = {}
    for body in lowest:
        if low[body] == np.inf:
            raise ValueError(f"{path}: the feet have no shapes but meshes, which are left out; add some spheres")
        sole = min(shapes[body], key=lambda g: bottom(model, data, g))
        like = [g for g in shapes[body] if model.geom_type[g] == model.geom_type[sole]]
        touching = [g for g in like if bottom(model, data, g) < low[body] + 0.005]
        middle = data.geom_xpos[touching].mean(0)
        end = joint_above(model, body, [joints[i] for i in ends])
        place = data.xmat[body].reshape(3, 3).T @ (middle - data.xpos[body])
        feet[end] = Foot(model.body(body).name, place, [model.geom(g).name for g in like], middle[2] - low[body])
    if feet.keys() != set(range(len(ends))):
        names = ", ".join(model.body(body).name for body in lowest)
        raise ValueError(f"{path}: its lowest bodies, {names}, are not the feet of the policy's robot")
    return [feet[i] for i in range(len(ends))]


def add_sensors(spec, feet, base):
    """Position, velocity and force of each foot, and the force of the ground on the base, the robot and the soles."""
    site, body = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY
    for i, foot in enumerate(feet):
        spec.body(foot.body).add_site(name=f"foot {i}", pos=foot.place)
        for kind, sensor in (("pos", SENSOR.mjSENS_FRAMEPOS), ("vel", SENSOR.mjSENS_FRAMELINVEL)):
            spec.add_sensor(name=f"{kind} {i}", type=sensor, objtype=site, objname=f"foot {i}")
        add_force(spec, f"force {i}", mujoco.mjtObj.mjOBJ_XBODY, foot.body)
    add_force(spec, "force base", body, base)
    add_force(spec, "force all", mujoco.mjtObj.mjOBJ_XBODY, base)
    for i, shape in enumerate(shape for foot in feet for shape in foot.shapes):
        add_force(spec, f"sole {i}", mujoco.mjtObj.mjOBJ_GEOM, shape)


def add_force(spec, sensor, kind, name):
    """Sensor of the net force (3,) of the ground on a body or subtree, in the world [N]."""
    force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    net = 3  # of the ways to reduce contacts to one: their sum in the world frame
    geom, contact = mujoco.mjtObj.mjOBJ_GEOM, SENSOR.mjSENS_CONTACT
    target = {"objtype": geom, "objname": "floor", "reftype": kind, "refname": name}
    spec.add_sensor(name=sensor, type=contact, intprm=[force, net, 1], **target)


# --- A robot that can be driven ---


@dataclass
class Robot:
    """A compiled model with the policy's motors, on a plane."""

    path: str
    model: mujoco.MjModel
    names: list  # (A,) of its joints
    fixed: list  # names of joints that the policy does not know
    pose: np.ndarray  # (A,) [rad] the default
    qpos: np.ndarray  # (A,) indices of the joints in qpos
    qvel: np.ndarray  # (A,) and in qvel
    feet: tuple  # (F,) names that our robot has for them
    sole: float  # [m] height of their positions above the ground

    def __post_init__(self):
        joints = self.model.dof_jntid[self.qvel]
        range_ = np.where(self.model.jnt_limited[joints, None], self.model.jnt_range[joints], (-np.inf, np.inf))
        self.low, self.high = range_.T  # (A,) [rad]

    def sensor(self, *names):
        """Indices (len(names), 3) of these sensors into the sensor values."""
        return np.array([self.model.sensor(name).adr[0] + np.arange(3) for name in names])

    def off_feet(self, sensors):
        """Upward force (N,) of the ground on all but the feet's own shapes [N], from sensor values (N, S)."""
        return sensors[:, self.sensor("force all")[0, 2]] - sensors[:, self.soles()[:, 2]].sum(1)

    def soles(self):
        """Indices (G, 3) of the sensors of the force on each shape of the feet."""
        names = [self.model.sensor(i).name for i in range(self.model.nsensor)]
        return self.sensor(*(name for name in names if name.startswith("sole ")))

    def feet_sensor(self, kind):
        """Indices (F, 3) of the feet's sensors of a kind: pos, vel or force."""
        return self.sensor(*(f"{kind} {i}" for i in range(len(self.feet))))

    def placed(self, joints, yaw=0.0):
        """State qpos (nq,) with these joint angles (A,), lowest point on the ground; and MjData of it."""
        data = mujoco.MjData(self.model)
        data.qpos[:7] = 0, 0, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        data.qpos[self.qpos] = joints
        mujoco.mj_kinematics(self.model, data)
        data.qpos[2] = -min(bottom(self.model, data, geom) for geom in solid_geoms(self.model))
        mujoco.mj_forward(self.model, data)
        return data.qpos.copy(), data

    def body(self, facts):
        """The facts for `gait.measure`."""
        limit = np.array(facts["torque_limit"])
        return gait.Body(float(self.model.body_mass.sum()), limit, self.low, self.high, self.feet, self.sole)


def load_robot(path, facts, timestep=0.002):
    """Robot of an MJCF or URDF file with the motors of the policy's facts. UserError if it is not that robot."""
    try:
        return build_robot(Path(path), facts, timestep)
    except (ValueError, mujoco.FatalError) as error:
        raise records.UserError(reader.one_line(error)) from None


def build_robot(path, facts, timestep):
    """As `load_robot`, but with a ValueError."""
    ours, pose = ROBOTS[facts["robot"]], np.array(facts["default_pose"])
    spec = reader.read(path)
    names, fixed = read_joints(path, spec, facts["joints"])
    base = isolate(path, spec, names)
    add_ground(spec)
    add_motors(spec, names, facts)
    set_options(spec, timestep)
    model = reader.compiled(path, spec)
    feet = find_feet(model, [model.joint(name).id for name in names], pose, last_joints(ours), path)
    add_sensors(spec, feet, base)
    model = reader.compiled(path, spec)
    joints = [model.joint(name).id for name in names]
    adr = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    return Robot(str(path), model, names, fixed, pose, *adr, ours.feet, np.mean([foot.sole for foot in feet]))


def unlike(robot, ours):
    """Names of joints that, in the default pose, lie or turn elsewhere than those of our own model."""
    (_, a), (_, b) = robot.placed(robot.pose), ours.placed(ours.pose)
    i, j = (m.dof_jntid[r.qvel] for m, r in ((robot.model, robot), (ours.model, ours)))
    moved = np.linalg.norm((a.xanchor[i] - a.qpos[:3]) - (b.xanchor[j] - b.qpos[:3]), axis=1) > 0.02
    turned = (a.xaxis[i] * b.xaxis[j]).sum(1) < 0.98
    return [name for name, other in zip(robot.names, moved | turned, strict=True) if other]


def feet_only(robot):
    """True if no shapes but the feet's own touch the ground."""
    return len(solid_geoms(robot.model)) == len(robot.soles())


def without_armature(robot, ours):
    """True (A,) for joints that have no armature (rotor inertia) where those of our own model have one."""
    return (robot.model.dof_armature[robot.qvel] == 0) & (ours.model.dof_armature[ours.qvel] > 0)


def lend_armature(robot, ours):
    """Give joints without an armature that of ours."""
    bare = without_armature(robot, ours)
    robot.model.dof_armature[robot.qvel[bare]] = ours.model.dof_armature[ours.qvel[bare]]
    mujoco.mj_setConst(robot.model, mujoco.MjData(robot.model))


# --- Policy ---


class Policy:
    """An exported policy; it answers for one robot at a time."""

    def __init__(self, path):
        """Read the ONNX file. UserError if it is none, or a policy that needs more than a robot's own readings."""
        if not Path(path).is_file():
            raise records.UserError(f"there is no policy {path}; write one with play.py POLICY --export FILE")
        try:
            import onnxruntime
        except ImportError:
            raise records.UserError("onnxruntime is missing: pip install -r requirements-export.txt") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # more cost time in such small graphs
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            facts = self.session.get_modelmeta().custom_metadata_map
            self.facts = {name: json.loads(value) for name, value in facts.items()}
        except Exception:  # onnxruntime has no common error class
            raise records.UserError(f"{path} is not a policy; write one with play.py POLICY --export FILE") from None
        self.shapes = {given.name: given.shape[1:] for given in self.session.get_inputs()}
        check_policy(path, self.facts, self.shapes)

    def __call__(self, inputs):
        """Actions (N, A), joint targets (N, A) [rad] and the next histories from inputs by name, each (N, ...)."""
        inputs = {name: np.asarray(inputs[name], np.float32) for name in self.shapes}
        feeds = ({name: x[n : n + 1] for name, x in inputs.items()} for n in range(len(inputs["joint_pos"])))
        action, target, *histories = map(np.concatenate, zip(*(self.session.run(None, f) for f in feeds), strict=True))
        return action, target, dict(zip(HISTORY, histories, strict=True))


def check_policy(path, facts, shapes):
    """UserError unless a robot's own readings, a command and a phase are all that the policy needs."""
    more = sorted(shapes.keys() - {*READINGS, *HISTORY})
    if more:
        raise records.UserError(f"{path} reads {', '.join(more)}, which only the environments of this project provide")
    needed = (*FACTS, "gait_hz") if "phase" in shapes else FACTS
    lacking = [name for name in needed if name not in facts]
    if lacking or "command" not in shapes:
        what = f"lacks {', '.join(lacking)}" if lacking else "takes no command"
        raise records.UserError(f"{path} {what}; export a policy of a locomotion task with play.py --export")
    if "mjcf" in facts or facts["robot"] not in ROBOTS:
        raise records.UserError(f"{path} is for the robot {facts['robot']!r} of a file; known are {', '.join(ROBOTS)}")


def phase_of(facts, command, seconds):
    """Sine and cosine (N, 2) of the gait's clock at a time since the start, 0 where it rests; command (N, 3)."""
    angle = 2 * np.pi * facts.get("gait_hz", 0.0) * seconds
    moves = (np.hypot(command[:, :1], command[:, 1:2]) > 0.1) | (np.abs(command[:, 2:]) > 0.1)
    return np.array([np.sin(angle), np.cos(angle)]) * (moves | facts.get("march", False))


# --- Driving ---


@dataclass
class Drive(gait.Recording):
    """A recording that also tells what parts other than the feet bear."""

    off_feet: np.ndarray  # (T, N) upward force on them [N]

    def leaning(self, weight):
        """Share of the weight [N] on parts other than the feet while told to move; None if never."""
        on = self.alive & self.command.any(-1)
        return float(self.off_feet[on].mean() / weight) if on.any() else None


def turns(qpos):
    """Rotations (N, 3, 3) from the base frame to the world."""
    w, x, y, z = qpos[:, 3:7].T / np.linalg.norm(qpos[:, 3:7], axis=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def readings(robot, qpos, qvel, rng=None):
    """Sensors of N robots by name, in SI units and the base frame; with an rng as noisy as in training."""
    turn = turns(qpos)
    read = {
        "lin_vel": np.einsum("nij,ni->nj", turn, qvel[:, :3]),
        "ang_vel": qvel[:, 3:6],
        "gravity": -turn[:, 2],
        "joint_pos": qpos[:, robot.qpos],
        "joint_vel": qvel[:, robot.qvel],
    }
    return read if rng is None else {n: x + rng.uniform(-NOISE[n], NOISE[n], x.shape) for n, x in read.items()}


def first_history(facts, read):
    """Histories at the start of N episodes: copies of the first readings, and actions of 0."""
    relative = read | {"joint_pos": read["joint_pos"] - np.array(facts["default_pose"])}
    prop = np.concatenate([relative[name] for name in facts["prop"]], 1)
    actions = np.zeros((len(prop), facts["history"], len(facts["joints"])))
    return {"prop_history": np.repeat(prop[:, None], facts["history"], 1), "action_history": actions}


def starts(robot, count, rng):
    """Start states qpos (count, nq): the default pose times 0.9 to 1.1, within limits, and any yaw."""
    joints = np.clip(robot.pose * rng.uniform(0.9, 1.1, (count, len(robot.pose))), robot.low, robot.high)
    return np.array([robot.placed(q, yaw)[0] for q, yaw in zip(joints, rng.uniform(-np.pi, np.pi, count), strict=True)])


def fell(qpos, qvel, base_force, height):
    """True (N,) for robots that tilt too far, are too low, touch the ground with the base, or have diverged."""
    bounded = np.concatenate([qpos[:, 2:], qvel], 1)  # a long walk may lead anywhere
    sound = (np.abs(bounded) < DIVERGED).all(1) & np.isfinite(qpos).all(1)
    upright = turns(np.where(sound[:, None], qpos, 1.0))[:, 2, 2] > UPRIGHT
    return ~(sound & upright & (qpos[:, 2] > LOW * height) & ~(np.linalg.norm(base_force, axis=1) > CONTACT))


def drive(robot, policy, command, seed=0):
    """Recording of N episodes that follow command (T, N, 3). An episode that has fallen is not simulated any further.

    policy: a `Policy`, or anything that has its `facts` and is called as it is.
    """
    facts, rng, (steps, count, _) = policy.facts, np.random.default_rng(seed), command.shape
    batch = Batch(robot.model, count, nthread=cpu_count())
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    torque, sensors = batch.bind("qfrc_actuator"), batch.bind("sensordata")
    height = robot.placed(robot.pose)[0][2]
    qpos[:], alive, history, rows = starts(robot, count, rng), np.ones(count, bool), None, []
    still = qpos.copy()
    action = np.zeros((count, len(robot.names)))
    for step in range(steps):
        noisy = readings(robot, qpos, qvel, rng)  # of all, so that noise is the same on every model
        history = history or first_history(facts, noisy)
        phase = phase_of(facts, command[step], step * facts["dt"])
        on = np.flatnonzero(alive)
        if len(on):
            inputs = noisy | {"command": command[step], "phase": phase} | history
            action[on], ctrl[on], after = policy({name: x[on] for name, x in inputs.items()})
            for name, x in after.items():
                history[name][on] = x
            batch.step(ids=on, nstep=round(facts["dt"] / robot.model.opt.timestep), stage=mujoco.mjtStage.mjSTAGE_VEL)
        alive &= ~fell(qpos, qvel, sensors[:, robot.sensor("force base")[0]], height)
        qpos[~alive], qvel[~alive] = still[~alive], 0.0
        seen = np.where(alive[:, None], sensors, 0.0)
        rows.append(row(robot, qpos, qvel, seen, np.where(alive[:, None], torque, 0.0)) | {"alive": alive.copy()})
        rows[-1] |= {"action": action.copy(), "off_feet": robot.off_feet(seen)}
    return Drive(facts["dt"], command, **{name: np.array([r[name] for r in rows]) for name in rows[0]})


def row(robot, qpos, qvel, sensors, torque):
    """One step of a `gait.Recording` by name."""
    turn = turns(qpos)
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    cos, sin, (x, y, z) = np.cos(yaw), np.sin(yaw), qvel[:, :3].T
    return {
        "lin_vel": np.stack([cos * x + sin * y, cos * y - sin * x, z], -1),
        "yaw_rate": np.einsum("ni,ni->n", turn[:, 2], qvel[:, 3:6]),
        "height": qpos[:, 2].copy(),
        "roll": np.arctan2(turn[:, 2, 1], turn[:, 2, 2]),
        "pitch": np.arcsin(np.clip(-turn[:, 2, 0], -1, 1)),
        "joint_pos": qpos[:, robot.qpos],
        "joint_vel": qvel[:, robot.qvel],
        "torque": torque[:, robot.qvel],
        "foot_pos": sensors[:, robot.feet_sensor("pos")],
        "foot_vel": sensors[:, robot.feet_sensor("vel")],
        "foot_force": sensors[:, robot.feet_sensor("force")],
    }


def part(recording, begin, end):
    """The episodes from `begin` to before `end` of a recording."""
    cut = {name: x[:, begin:end] for name, x in vars(recording).items() if name != "dt"}
    return Drive(recording.dt, **cut)


def assess(robot, policy, count, seconds):
    """Numbers of all commands and sequences by name, and their summary, as in experiment/gait.py."""
    dt, by_command, done = policy.facts["dt"], {}, 0
    plans = {name: gait.schedule(name, dt, count, seconds) for name in (*gait.COMMANDS, *gait.SEQUENCES)}
    recording, body = drive(robot, policy, np.concatenate([*plans.values()], 1)), robot.body(policy.facts)
    for name, plan in plans.items():
        here = part(recording, done, done + plan.shape[1])
        by_command[name] = gait.measure(here, body, gait.WARM_UP * seconds / gait.SECONDS)
        done += plan.shape[1]
        if name == "reverse":
            by_command[name]["reversed"] = gait.reversals(here)
    return by_command, gait.summary(by_command) | {"off_feet": recording.leaning(9.81 * body.mass)}


# --- Main ---


def side_by_side(summaries):
    """Table of summaries by name, a column for each."""
    keys = [*dict.fromkeys(key for summary in summaries.values() for key in summary)]
    cells = {name: ["-" if s.get(k) is None else f"{s[k]:.4g}" for k in keys] for name, s in summaries.items()}
    wide = {name: max(map(len, [name, *column])) for name, column in cells.items()}
    left = max(map(len, keys))
    head = " " * left + "".join(f"  {name:>{wide[name]}}" for name in cells)
    return "\n".join(
        [head, *(f"{k:{left}}" + "".join(f"  {cells[n][i]:>{wide[n]}}" for n in cells) for i, k in enumerate(keys))]
    )


def check_args(args, facts):
    """UserError unless the numbers make sense together."""
    if not 1 <= args.starts <= 10_000:
        raise records.UserError(f"--starts must be from 1 to 10000, not {args.starts}")
    if not 2.0 <= args.seconds <= 1000:
        raise records.UserError(f"--seconds must be from 2 to 1000, not {args.seconds}")
    steps = facts["dt"] / args.timestep if args.timestep > 0 else 0
    if steps < 1 or abs(steps - round(steps)) > 1e-6:
        raise records.UserError(
            f"--timestep must divide the {facts['dt']} s of a control step; {args.timestep} does not"
        )


def introduce(robot, ours, facts):
    """Lines that say how the model was read."""
    alike = [f"{name} is {got}" for name, got in zip(facts["joints"], robot.names, strict=True) if name != got]
    yield f"{robot.path}: {robot.model.body_mass.sum():.2f} kg, ours {ours.model.body_mass.sum():.2f} kg"
    if alike:
        yield f"joints matched by likeness: {', '.join(alike)}"
    if robot.fixed:
        yield f"joints that the policy does not know, held at 0: {', '.join(robot.fixed)}"
    if unlike(robot, ours):
        yield f"these joints lie or turn elsewhere than in ours: {', '.join(unlike(robot, ours))}"
    if feet_only(robot):
        yield "only its feet touch the ground: knees and shins sink into it, and a policy that leans on them falls"
    bare = without_armature(robot, ours).sum()
    if bare:
        yield f"{bare} of {len(robot.names)} joints have no armature (rotor inertia); --armature gives them ours"


def run(args):
    """Assess both models, print their tables, and write the numbers if asked to."""
    policy = Policy(args.policy)
    check_args(args, policy.facts)
    robot = load_robot(args.model, policy.facts, args.timestep)
    ours = load_robot(ROBOTS[policy.facts["robot"]].xml, policy.facts, args.timestep)
    print("\n".join(introduce(robot, ours, policy.facts)), flush=True)
    if args.armature:
        lend_armature(robot, ours)
    report = {}
    for name, which in (("model", robot), ("ours", ours)):
        by_command, summary = assess(which, policy, args.starts, args.seconds)
        report[name] = {"path": which.path, "commands": by_command, "summary": summary}
        print(f"\n{name}: {which.path}\n{gait.lines(by_command, summary)}", flush=True)
        if summary["off_feet"] is not None:
            print(f"  weight on knees, shins and the like while told to move: {summary['off_feet']:.1%}", flush=True)
    print("\n" + side_by_side({name: found["summary"] for name, found in report.items()}))
    if args.json:
        for found in report.values():
            found["commands"] = {n: {k: gait.plain(x) for k, x in c.items()} for n, c in found["commands"].items()}
        text = json.dumps({"policy": args.policy, "timestep": args.timestep} | report, indent=1) + "\n"
        records.write(Path(args.json), text.encode())
        print(f"wrote {args.json}")


def main(args):
    """Compare the models. User errors print one line and exit with code 2."""
    with records.one_line_errors():
        run(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
