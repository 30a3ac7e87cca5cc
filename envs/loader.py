"""A robot from a file that somebody else made: MJCF, or URDF that MuJoCo reads, and a robot.toml for what it lacks.

`load(file)` returns a body: a dict of JSON types with everything that was derived, among it an MJCF of its own, which
has the motors, shapes, sites, sensors and camera that the environments need. `Robot.of(body)` is what they know of it.
A file is refused with a ValueError of one line.
Legend: A joints, in the order of the file's tree, F feet.
"""

import hashlib
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from envs import builder, reader
from envs.anatomy import average, feet_at_sites, feet_of, mirrors_of

JOINT = mujoco.mjtJoint
SHIPPED_LIKE = {"go1": 16, "g1": 10**6}  # shipped robot with the network widths for up to so many joints
# [rad] error that asks for the torque limit, and damping ratio with the base held. At 0.5 rad an action of 1 moves a
# joint by an eighth of a radian, and Go2 learned to stand on the spot; 1 rad is also nearer to what its makers use.
STIFFNESS, DAMPING = 1.0, 0.5


@dataclass(frozen=True)
class Robot:
    """What the environments know of a robot. Tuples (A,) follow `joints`, the order of its actuators."""

    name: str
    xml: str  # the file it came from
    mjcf: str  # text of what is simulated
    like: str  # shipped robot whose networks fit this one
    joints: tuple[str, ...]
    default_pose: tuple[float, ...]  # (A,) [rad] joint targets of action zero
    action_scale: tuple[float, ...]  # (A,) [rad] change of the joint target per unit of action
    feet: tuple[str, ...]  # (F,) sites; sensors <foot>_pos, <foot>_vel and <foot>_force
    gait: tuple[float, ...]  # (F,) share of a step by which a foot is ahead
    sole: float  # [m] height of a foot's site above the ground it stands on
    mirrors: dict[str, dict]  # symmetry -> images of its `joints`, their `signs`, and images of its `feet`

    @classmethod
    def of(cls, body):
        """Build it of a body."""
        tuples = {name: tuple(body[name]) for name in ("joints", "default_pose", "action_scale", "feet", "gait")}
        fields = {name: body[name] for name in ("name", "mjcf", "sole", "mirrors")}
        like = next(name for name, most in SHIPPED_LIKE.items() if len(body["joints"]) <= most)
        return cls(**tuples, **fields, xml=body["file"], like=body.get("like", like))

    def spec(self):
        """MjSpec of the robot alone."""
        return mujoco.MjSpec.from_string(self.mjcf)

    def mirror_joints(self, mirror):
        """perm (A,), sign (A,): mirrored[i] = sign[i] * original[perm[i]], for positions, velocities and actions."""
        return np.array(self.mirrors[mirror]["joints"]), np.array(self.mirrors[mirror]["signs"])

    def mirror_feet(self, mirror):
        """perm (F,): mirrored[i] = original[perm[i]], for feet."""
        return np.array(self.mirrors[mirror]["feet"])


def load(path):
    """The body of a robot: of an .xml, a .urdf, a .toml that names one of these as `file`, or a run's args.json."""
    path = Path(path)
    if path.suffix == ".json":
        return recorded(path)
    path, wishes = read_wishes(path)
    spec, notes = reader.read(path), []
    if given := sorted(wishes.keys() - {"file"}):
        notes.append(f"robot.toml gives {', '.join(given)}")
    refuse_what_cannot_be_walked(path, spec)
    base = reader.free_the_base(path, spec, notes)
    if spec.tendons or any(one.gravcomp for one in spec.bodies):
        notes.append("tendons and gravity compensation are left out")
    lost = builder.simplify(path, spec, notes)
    model = reader.compiled(path, spec)
    root = model.body(base).id
    body = {"name": path.stem, "file": path.name, "base": base} | drive_of(path, model, root, wishes, notes)
    shapes = builder.shapes_of(model, root, lost, notes)
    new = builder.rebuild(model, root, shapes, body)
    if wishes.get("average"):
        average(new, body, notes)
    body |= feet_of(path, new, body, shapes, wishes)
    body |= mirrors_of(new, body, notes)
    builder.equip(path, new, body)
    body |= {"mjcf": new.to_xml(), "notes": notes}
    return rounded(body | measures(body) | {"digest": digest(body)})


def name_of(path):
    """Name of the robot of a file that `load` takes."""
    return recorded(path)["name"] if path.suffix == ".json" else read_wishes(path)[0].stem


def shipped(path, wishes):
    """The body of a robot whose file already has all that `load` gives to others, and is simulated as it is."""
    spec = reader.read(path)
    body = {"name": path.stem, "like": path.stem, "file": str(path), "mjcf": path.read_text()}
    body |= drive_of(path, reader.compiled(path, spec), 1, wishes, [])
    body |= feet_at_sites(spec, body)
    return rounded(body | mirrors_of(spec, body, []))


def recorded(path):
    """The body that a run recorded in its args.json."""
    try:
        body = json.loads(path.read_text())["config"]["body"]
        Robot.of(body).spec()
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(
            f"{path} holds no robot; give an .xml, .urdf or .toml file, or the args.json of such a run"
        ) from None
    return body


def rounded(body):
    """The body with tuples and NumPy's numbers as JSON has them."""
    return json.loads(json.dumps(body, default=lambda x: x.tolist()))


# --- the file ---


def refuse_what_cannot_be_walked(path, spec):
    """ValueError for closed loops, coupled joints, and tendons that move joints."""
    if coupled := [one.name1 for one in spec.equalities if one.type == mujoco.mjtEq.mjEQ_JOINT]:
        what = f"couples {', '.join(coupled)} to other joints (<mimic>, <equality>), which no engine here solves"
        raise ValueError(f"{path} {what}; remove that, and make these joints fixed or drive them alone")
    if spec.equalities:
        names = ", ".join(one.name1 or one.name for one in spec.equalities)
        raise ValueError(f"{path} has closed loops, which no engine here solves; remove its <equality> ({names})")
    for actuator in spec.actuators:
        if actuator.trntype not in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            raise ValueError(f"{path}: actuator {actuator.name!r} pulls at no joint; replace it by a <motor joint=...>")


# --- robot.toml ---


FIELDS = {  # fields of robot.toml -> types; a table has parts of joints' names, of which the longest that fits counts
    "file": (str,),
    "keyframe": (str,),
    "pose": (dict,),
    "kp": (int, float, dict),
    "kd": (int, float, dict),
    "torque_limit": (int, float, dict),
    "armature": (int, float, dict),
    "action_scale": (int, float, dict),
    "feet": (list,),
    "contact_ends": (list,),
    "average": (bool,),
}


def sound(value):
    """True if numbers, alone or in a table, are finite, and lists have names."""
    if isinstance(value, list):
        return all(isinstance(one, str) for one in value)
    numbers = value.values() if isinstance(value, dict) else [value] if isinstance(value, float) else []
    return all(type(one) in (int, float) and np.isfinite(one) for one in numbers)


def read_wishes(path):
    """Path of the robot's file, and the fields of its robot.toml, which stands beside it or names it as `file`.

    One beside it that names another file does not count.
    """
    beside = path.with_name("robot.toml")
    toml = path if path.suffix == ".toml" else beside if beside.exists() else None
    try:
        wishes = tomllib.loads(toml.read_text()) if toml else {}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"cannot read {toml}: {error}") from None
    for name, value in wishes.items():
        if name not in FIELDS:
            raise ValueError(f"{toml}: unknown field {name!r}; choose one of {', '.join(FIELDS)}")
        if type(value) not in FIELDS[name] or not sound(value):
            raise ValueError(f"{toml}: {name} cannot be {value!r}")
    if path == toml and "file" not in wishes:
        raise ValueError(f'{toml} names no file; add file = "robot.xml"')
    if path == toml:
        return toml.parent / wishes["file"], wishes
    here = (path.parent / wishes.get("file", path.name)).resolve() == path.resolve()
    return path, wishes if here else {}


def wished(value, joints, otherwise):
    """Numbers (A,) of a field of robot.toml, else those of `otherwise`.

    The field is None, one number for all joints, or a table of parts of their names, of which the longest counts.
    """
    numbers = list(otherwise)
    for i, joint in enumerate(joints):
        parts = [part for part in value if part in joint] if isinstance(value, dict) else []
        if parts or isinstance(value, (int, float)):
            numbers[i] = value[max(parts, key=len)] if parts else value
    return numbers


# --- joints, pose, motors ---


def drive_of(path, model, root, wishes, notes):
    """Joints below the trunk, the pose they stand in, and their motors."""
    joints = joints_of(path, model, root)
    names = [model.joint(j).name for j in joints]
    for field, value in wishes.items():
        for part in value if isinstance(value, dict) else ():
            if not any(part in name for name in names):
                raise ValueError(f"{path}: {field} has {part!r}, which is part of no joint's name: {', '.join(names)}")
    pose = default_pose(path, model, joints, wishes)
    body = {"joints": names, "default_pose": pose}
    return body | motors_of(path, model, joints, pose, wishes, notes)


def joints_of(path, model, root):
    """Numbers of the joints below the trunk. ValueError for one that is no hinge or has no limits."""
    bodies = set(builder.below(model, root))
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in bodies and model.jnt_type[j] != JOINT.mjJNT_FREE]
    name = lambda some: ", ".join(model.joint(j).name for j in some)  # noqa: E731
    if other := [j for j in joints if model.jnt_type[j] != JOINT.mjJNT_HINGE]:
        raise ValueError(f"{path}: only hinges can be driven; {name(other)} is none")
    if loose := [j for j in joints if not model.jnt_limited[j]]:
        how = "in MJCF add range=..., in URDF type=revolute with a <limit>; make the joint of a sensor fixed"
        raise ValueError(f"{path}: joint {name(loose)} has no limits; {how}")
    if not joints:
        raise ValueError(f"{path} has no joint below {model.body(root).name}")
    return joints


def default_pose(path, model, joints, wishes):
    """Angles (A,) of the keyframe `home`, `stand` or the only one, with those of robot.toml's `pose` over them."""
    keys = [model.key(k).name or str(k) for k in range(model.nkey)]
    pose, asked = [None] * len(joints), wishes.get("keyframe")
    if asked and asked not in keys:
        raise ValueError(f"{path} has no keyframe {asked!r}; it has {', '.join(keys) or 'none'}")
    chosen = [asked] if asked else [name for name in ("home", "stand") if name in keys][:1] or keys
    if len(chosen) > 1 and "pose" not in wishes:
        raise ValueError(f'{path} has the keyframes {", ".join(keys)}; write keyframe = "{keys[0]}" into robot.toml')
    if len(chosen) == 1:
        qpos = model.key_qpos[keys.index(chosen[0])]
        pose = [float(qpos[model.jnt_qposadr[j]]) for j in joints]
    refuse_a_tilted_trunk(path, model, joints, qpos if len(chosen) == 1 else model.qpos0)
    names = [model.joint(j).name for j in joints]
    pose = wished(wishes.get("pose"), names, pose)
    if None in pose:
        lacking = [name for name, angle in zip(names, pose, strict=True) if angle is None]
        which = f"uses none of its keyframes {', '.join(keys)}; choose one, or" if keys else "has no keyframe;"
        raise ValueError(
            f"{path} {which} write the angles [rad] it stands with into robot.toml, [pose] {lacking[0]} = 0.0 "
            f"(joints: {', '.join(lacking)}; a part of a name stands for all that have it)"
        )
    low, high = model.jnt_range[joints].T
    if wrong := [n for n, q, a, b in zip(names, pose, low, high, strict=True) if not a - 1e-3 <= q <= b + 1e-3]:
        raise ValueError(f"{path}: the default pose is outside of the limits of {', '.join(wrong)}; change [pose]")
    return np.clip(pose, low, high)


def refuse_a_tilted_trunk(path, model, joints, qpos):
    """ValueError unless the trunk's z axis points up; all that follows takes it to, and its x axis to point forward."""
    trunk, turn = model.body_rootid[model.jnt_bodyid[joints[0]]], np.zeros(9)
    first = model.jnt_qposadr[model.body_jntadr[trunk]]
    mujoco.mju_quat2Mat(turn, qpos[first + 3 : first + 7])
    if turn[8] < np.cos(np.deg2rad(15)):
        tilt = np.rad2deg(np.arccos(turn[8]))
        raise ValueError(
            f"{path}: {model.body(trunk).name} is tilted by {tilt:.0f} degrees; turn its frame so that z points up and "
            "x forward, or stand it upright in the keyframe"
        )


def motors_of(path, model, joints, pose, wishes, notes):
    """Gains and limits (A,): from position actuators, else from robot.toml, else by a rule. Also the action scale."""
    driven = {}
    for a in range(model.nu):
        if model.actuator_trnid[a, 0] in driven:
            raise ValueError(f"{path}: {model.joint(model.actuator_trnid[a, 0]).name} has two actuators; remove one")
        driven[int(model.actuator_trnid[a, 0])] = a
    names = [model.joint(j).name for j in joints]
    if idle := [name for name, j in zip(names, joints, strict=True) if driven and j not in driven]:
        raise ValueError(f"{path}: joint {', '.join(idle)} has no actuator; add a <motor>, or remove the joint")
    limits = [torque_limit(model, j, driven.get(j)) for j in joints]
    limits = wished(wishes.get("torque_limit"), names, limits)
    if None in limits:
        lacking = ", ".join(name for name, limit in zip(names, limits, strict=True) if limit is None)
        raise ValueError(f"{path} gives no torque limit for {lacking}; write torque_limit = 30.0 [N m] into robot.toml")
    limits = np.array(limits, float)
    armature, inertia = inertias(path, model, joints, driven, pose, wishes, notes)
    gains = np.array([file_gains(model, j, driven.get(j)) for j in joints])  # 0: the file has none
    kp = wished(wishes.get("kp"), names, np.where(gains[:, 0] > 0, gains[:, 0], limits / STIFFNESS))
    kd = np.where(gains[:, 1] > 0, gains[:, 1], 2 * DAMPING * np.sqrt(np.abs(kp) * inertia))
    kp, kd = np.array(kp, float), np.array(wished(wishes.get("kd"), names, kd), float)
    scale = wished(wishes.get("action_scale"), names, np.round(np.minimum(0.25 * limits / kp, 0.5), 3))
    asked = wished(wishes.get("kp"), names, [None] * len(names))
    source = np.where(gains[:, 0] > 0, "file", "rule")
    source = ["robot.toml" if kp is not None else known for kp, known in zip(asked, source, strict=True)]
    if min(*limits, *kp, *kd, *scale) <= 0:
        raise ValueError(f"{path}: gains, torque limits and action scales must be above 0")
    notes += left_out(model, joints, driven, gains[:, 1])
    if path.suffix == ".urdf":
        notes.append("limits of joint velocity are left out: motors are as strong at any speed")
    return {
        "kp": kp,
        "kd": kd,
        "torque_limit": limits,
        "armature": armature,
        "action_scale": scale,
        "gains_from": source,
        "damping_ratio": kd / (2 * np.sqrt(kp * inertia)),
    }


def left_out(model, joints, driven, kd):
    """Notes on what the file says of joints and motors that does not count. kd (A,): 0 where it has none."""
    notes = []
    if model.dof_damping[model.jnt_dofadr[joints]][kd == 0].any():
        notes.append("damping of joints without a position actuator is replaced by kd")
    if model.dof_frictionloss.any():
        notes.append("dry friction of the joints is left out; --set joint_friction=LOW,HIGH [N m] randomises it")
    if [driven.get(j) for j in joints] != sorted(driven.values()) and driven:
        notes.append("actions follow the order of the file's tree, not that of its actuators")
    return notes


def torque_limit(model, joint, actuator):
    """The smallest limit [N m] of a joint's motor that the file states, or None."""
    found = [abs(model.jnt_actfrcrange[joint]).min()] if model.jnt_actfrclimited[joint] else []
    if actuator is not None:
        gear = abs(model.actuator_gear[actuator, 0])
        if model.actuator_forcelimited[actuator]:
            found.append(gear * abs(model.actuator_forcerange[actuator]).min())
        if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE and model.actuator_ctrllimited[actuator]:
            gain = model.actuator_gainprm[actuator, 0]
            found.append(gear * gain * abs(model.actuator_ctrlrange[actuator]).min())
    return min(found, default=None)


def inertias(path, model, joints, driven, pose, wishes, notes):
    """Rotor inertia of each joint, and with it the whole inertia about it, both (A,) [kg m^2]."""
    names = [model.joint(j).name for j in joints]
    own = np.array([rotor(model, j, driven.get(j)) for j in joints])
    armature = np.array(wished(wishes.get("armature"), names, own), float)
    if min(armature) < 0:
        raise ValueError(f"{path}: armature must be 0 or more")
    if bare := [name for name, one in zip(names, armature, strict=True) if not one]:
        which = "all joints" if len(bare) == len(names) else ", ".join(bare)
        notes.append(f"no rotor inertia (armature), which motors have, at {which}; robot.toml can give it")
    return armature, reflected_inertia(model, joints, pose) - own + armature


def rotor(model, joint, actuator):
    """Rotor inertia [kg m^2] of a joint: the file may have it at the joint or at its motor."""
    own = 0.0 if actuator is None else model.actuator_armature[actuator] * model.actuator_gear[actuator, 0] ** 2
    return model.dof_armature[model.jnt_dofadr[joint]] + own


def file_gains(model, joint, actuator):
    """kp and kd of a position actuator, 0 where the file has none. Its kd may be a damping, of the joint or its own."""
    if actuator is None or model.actuator_biasprm[actuator, 1] >= 0:
        return 0.0, 0.0
    square = model.actuator_gear[actuator, 0] ** 2
    damping = model.dof_damping[model.jnt_dofadr[joint]] + model.actuator_damping[actuator] * square
    return -model.actuator_biasprm[actuator, 1] * square, -model.actuator_biasprm[actuator, 2] * square + damping


def reflected_inertia(model, joints, pose):
    """Inertia (A,) [kg m^2] about each joint in the default pose, the trunk held: that of the links and the rotor."""
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[model.jnt_qposadr[joints]] = pose
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    return np.diag(full)[model.jnt_dofadr[joints]]


# --- what is derived of all this ---


def digest(body):
    """Twelve letters that change with the kinematics and the layout of vectors, not with masses or names of files."""
    spec = mujoco.MjSpec.from_string(body["mjcf"])
    model = spec.compile()
    fields = ("body_parentid", "body_pos", "body_quat", "jnt_bodyid", "jnt_axis", "jnt_pos", "jnt_range")
    numbers = [np.round(getattr(model, name), 4).tolist() for name in fields]
    numbers += [np.round(np.array(body[name], float), 4).tolist() for name in ("default_pose", "action_scale")]
    text = json.dumps([body["joints"], body["feet"], numbers]).replace("-0.0,", "0.0,")
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def measures(body):
    """Randomisation as shares of the mass, and the effort of the motors, for the configs of tasks."""
    share = min(0.1 * body["mass"], 0.5 * body["base_mass"])
    return {
        "added_mass": (-share, 2 * share),  # [kg] on the trunk
        "perturb_force": 0.2 * 9.81 * body["mass"],  # [N]
        "push_velocity": 0.5,  # [m/s]
        "max_tilt": 70.0,  # [deg]
        "effort": float(np.sum(np.square(body["torque_limit"]))),  # [N^2 m^2]
    }


def lines(body):
    """The table of a body, as text."""
    wide = max(len(name) for name in body["joints"])
    size = f"{body['mass']:.2f} kg, base {body['base']} at {body['height']:.3f} m"
    yield f"{body['name']} ({body['file']}): {size}, digest {body['digest']}"
    yield f"{'joint':{wide}}    pose  scale      kp     kd  limit  ratio  gains"
    columns = ("joints", "default_pose", "action_scale", "kp", "kd", "torque_limit", "damping_ratio", "gains_from")
    for row in zip(*(body[column] for column in columns), strict=True):
        yield "{:{wide}}  {:6.3f} {:6.3f} {:7.2f} {:6.2f} {:6.1f} {:6.2f}  {}".format(*row, wide=wide)
    yield "feet: " + ", ".join(body["feet"]) + f"; their sites are {body['sole']:.4f} m above the ground"
    yield f"gait: {', '.join(f'{share:g}' for share in body['gait'])} of a step ahead"
    yield f"a contact ends an episode: {', '.join(body['contact_ends']) or 'none does, only a tilt'}"
    for mirror, table in body["mirrors"].items():
        joints, images, gaps = body["joints"], table["joints"], body["mirror_errors"][mirror]
        pairs = [
            f"{joint} = {joints[image]}"
            for i, (joint, image) in enumerate(zip(joints, images, strict=True))
            if image > i
        ]
        yield f"symmetry {mirror}: {', '.join(pairs)}"
        where = ", ".join(f"{name} {1e3 * gaps[name]:.1f} mm" for name in ("position", "centre"))
        yield f"  images differ by at most: {where}, mass {gaps['mass']:.1%}"
    low, high = body["added_mass"]
    drawn = f"{low:+.2f} to {high:+.2f} kg on the base, forces to {body['perturb_force']:.0f} N"
    yield f"randomisation: {drawn}; a tilt of {body['max_tilt']:g} deg ends an episode"
    yield from (f"note: {note}" for note in body["notes"])
