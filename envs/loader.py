"""A robot from a file that somebody else made: MJCF, or URDF that MuJoCo reads, and a robot.toml for what it lacks.

`load(file)` returns a body: a dict of JSON types with everything that was derived, among it an MJCF of its own, which
has the motors, shapes, sites, sensors and camera that the environments need. `LoadedRobot.of(body)` is the `Robot`.
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

from envs.anatomy import average, feet_of, mirrors_of
from envs.robots import Robot

GEOM, JOINT, OBJ = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtObj
PLURAL = {
    GEOM.mjGEOM_SPHERE: "spheres",
    GEOM.mjGEOM_CAPSULE: "capsules",
    GEOM.mjGEOM_BOX: "boxes",
    GEOM.mjGEOM_CYLINDER: "cylinders",
    GEOM.mjGEOM_ELLIPSOID: "ellipsoids",
}
SOLIDS = tuple(PLURAL)
SHIPPED_LIKE = {"go1": 16, "g1": 10**6}  # shipped robot with the network widths for up to so many joints
# [rad] error that asks for the torque limit, and damping ratio with the base held. At 0.5 rad an action of 1 moves a
# joint by an eighth of a radian, and Go2 learned to stand on the spot; 1 rad is also nearer to what its makers use.
STIFFNESS, DAMPING = 1.0, 0.5
WISHES = {  # fields of robot.toml -> kind; a table has parts of joints' names, of which the longest that fits counts
    "file": str,
    "keyframe": str,
    "pose": dict,
    "kp": (int, float, dict),
    "kd": (int, float, dict),
    "torque_limit": (int, float, dict),
    "action_scale": (int, float, dict),
    "feet": list,
    "contact_ends": list,
    "average": bool,
}


@dataclass(frozen=True)
class LoadedRobot(Robot):
    """A robot of a body. Its mirrors are tables, found from its geometry, in place of parts of names."""

    body: dict

    @classmethod
    def of(cls, body):
        """Build it of what `load` returned."""
        tuples = {name: tuple(body[name]) for name in ("joints", "default_pose", "action_scale", "feet", "gait")}
        few = {name: body[name] for name in ("name", "sole", "mirrors")}
        return cls(**tuples, **few, axes="", body=body)

    @property
    def like(self):
        return next(name for name, most in SHIPPED_LIKE.items() if len(self.joints) <= most)

    def spec(self):
        return mujoco.MjSpec.from_string(self.body["mjcf"])

    def mirror_joints(self, mirror):
        return np.array(self.mirrors[mirror]["joints"]), np.array(self.mirrors[mirror]["signs"])

    def mirror_feet(self, mirror):
        return np.array(self.mirrors[mirror]["feet"])


def load(path):
    """The body of a robot: of an .xml, a .urdf, a .toml that names one of these as `file`, or a run's args.json."""
    path = Path(path)
    if path.suffix == ".json":
        return recorded(path)
    path, wishes = read_wishes(path)
    spec, notes = read_spec(path), []
    refuse_what_cannot_be_walked(path, spec)
    base = base_of(path, spec, notes)
    lost = strip(path, spec, notes)
    model = compiled(path, spec)
    root = model.body(base).id
    joints = joints_of(path, model, root)
    pose = default_pose(path, model, joints, wishes)
    motors = motors_of(path, model, joints, pose, wishes, notes)
    body = {"name": path.stem, "file": path.name, "base": base, **motors}
    body |= {"joints": [model.joint(j).name for j in joints], "default_pose": pose}
    shapes = shapes_of(model, root, lost, notes)
    new = rebuild(model, root, shapes, body)
    if wishes.get("average"):
        average(new, body, notes)
    body |= feet_of(path, new, body, shapes, wishes)
    body |= mirrors_of(new, body, notes)
    equip(path, new, body)
    body |= {"mjcf": new.to_xml(), "notes": notes}
    return rounded(body | measures(body) | {"digest": digest(body)})


def recorded(path):
    """The body that a run recorded in its args.json."""
    try:
        body = json.loads(path.read_text())["config"]["body"]
        LoadedRobot.of(body).spec()
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(
            f"{path} holds no robot; give an .xml, .urdf or .toml file, or the args.json of such a run"
        ) from None
    return body


def rounded(body):
    """The body with tuples and NumPy's numbers as JSON has them."""
    return json.loads(json.dumps(body, default=lambda x: x.tolist()))


# --- reading ---


def read_wishes(path):
    """Path of the robot's file, and the fields of its robot.toml, which stands beside it or names it as `file`."""
    beside = path.with_name("robot.toml")
    toml = path if path.suffix == ".toml" else beside if beside.exists() else None
    try:
        wishes = tomllib.loads(toml.read_text()) if toml else {}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"cannot read {toml}: {error}") from None
    for name, value in wishes.items():
        if name not in WISHES:
            raise ValueError(f"{toml}: unknown field {name!r}; choose one of {', '.join(WISHES)}")
        if not isinstance(value, WISHES[name]):
            raise ValueError(f"{toml}: {name} cannot be {value!r}")
    if path == toml and "file" not in wishes:
        raise ValueError(f'{toml} names no file; add file = "robot.xml"')
    return (toml.parent / wishes["file"] if path == toml else path), wishes


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


def one_line(error):
    """MuJoCo's errors take several lines."""
    return " ".join(str(error).split())[:200]


def read_spec(path):
    """MjSpec of a file."""
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(f"{path} is not XML of a robot that MuJoCo reads: {one_line(error)}") from None


def compiled(path, spec):
    """The model, for its resolved numbers."""
    try:
        return spec.compile()
    except ValueError as error:
        hint = "; give each moving body an <inertial>" if "mass and inertia" in str(error) else ""
        raise ValueError(f"{path}: MuJoCo says {one_line(error)}{hint}") from None


def refuse_what_cannot_be_walked(path, spec):
    """ValueError for closed loops and for tendons that move joints."""
    if spec.equalities:
        names = ", ".join(one.name1 or one.name for one in spec.equalities)
        raise ValueError(f"{path} has closed loops, which no engine here solves; remove its <equality> ({names})")
    for actuator in spec.actuators:
        if actuator.trntype not in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            raise ValueError(f"{path}: actuator {actuator.name!r} pulls at no joint; replace it by a <motor joint=...>")


def base_of(path, spec, notes):
    """Name of the trunk: the body of the free joint, which is added where the trunk hangs in the world."""
    free = [body for body in spec.bodies if any(joint.type == JOINT.mjJNT_FREE for joint in body.joints)]
    if len(free) > 1:
        raise ValueError(
            f"{path}: {' and '.join(b.name or '?' for b in free)} move freely; leave the robot's trunk alone"
        )
    if not free:
        roots = [body for body in spec.worldbody.bodies if body.find_all(OBJ.mjOBJ_JOINT)]
        if len(roots) != 1 or roots[0].joints:
            raise ValueError(f"{path} has a fixed base, which cannot walk; add <freejoint/> to the robot's trunk")
        free, (root,) = roots, roots
        root.add_freejoint()
        for key in spec.keys:
            key.qpos = [0, 0, 0, 1, 0, 0, 0, *key.qpos]
        notes.append(f"a free joint was added to {root.name}")
    free[0].name = free[0].name or "base"
    for body in spec.bodies:
        name_children(body)
    return free[0].name


def name_children(body):
    """Name the nameless bodies below one, by their parent and number, and their joints by the body."""
    for number, child in enumerate(body.bodies, 1):
        child.name = child.name or f"{body.name}_{number}"
        for joint in child.joints:
            joint.name = joint.name or child.name


def loadable(spec, mesh):
    """True if a mesh stands in the file itself, or its own file is there."""
    return not mesh.file or Path(spec.modelfiledir, spec.meshdir, mesh.file).is_file()


def strip(path, spec, notes):
    """Remove what a simulation does not need or cannot have: meshes, textures, sensors, tendons and so on.

    Returns the bodies that lose a collision mesh whose file is missing.
    """
    missing = {mesh_name(mesh) for mesh in spec.meshes if not loadable(spec, mesh)}
    solid = {b.name: [g.meshname for g in b.geoms if g.meshname and (g.contype or g.conaffinity)] for b in spec.bodies}
    if fitted := [name for name, meshes in solid.items() if set(meshes) - missing]:
        notes.append(f"MuJoCo fitted simple shapes to the collision meshes of {', '.join(fitted)}")
    lost = dict.fromkeys(body.name for body in spec.bodies if strip_meshes(path, spec, body, missing))
    for mesh in [mesh for mesh in spec.meshes if mesh_name(mesh) in missing]:
        spec.delete(mesh)
    for geom in spec.geoms:
        if path.suffix == ".urdf":
            geom.mass = 0  # there a link without <inertial> is weightless, whatever its shapes
        material = spec.material(geom.material) if geom.material else None
        geom.rgba, geom.material = geom.rgba if material is None else material.rgba, ""
    for things in (spec.sensors, spec.tendons, spec.skins, spec.materials, spec.textures, spec.excludes, spec.pairs):
        for thing in list(things):
            spec.delete(thing)
    spec.compiler.fusestatic = True
    return lost


def mesh_name(mesh):
    """Name of a mesh, which may be that of its file."""
    return mesh.name or Path(mesh.file).stem


def strip_meshes(path, spec, body, missing):
    """Remove or simplify a body's mesh geoms; True if a collision mesh is missing."""
    lost = False
    for geom in [geom for geom in body.geoms if geom.meshname]:
        solid = bool(geom.contype or geom.conaffinity)
        if geom.meshname in missing:
            if not body.explicitinertial and geom.mass != 0:
                raise ValueError(
                    f"{path}: mesh {geom.meshname} is missing, which {body.name} has its mass from; add it"
                )
            lost |= solid
            spec.delete(geom)
        elif solid:
            geom.type = GEOM.mjGEOM_BOX  # MuJoCo fits it
        elif body.explicitinertial:
            spec.delete(geom)
    return lost


# --- joints, gains, pose ---


def below(model, root):
    """Bodies from `root` down, in the order of the tree."""
    inside = {root}
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.add(body)
    return sorted(inside)


def joints_of(path, model, root):
    """Numbers of the joints below the trunk. ValueError for one that is no hinge or has no limits."""
    bodies = set(below(model, root))
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in bodies and model.jnt_type[j] != JOINT.mjJNT_FREE]
    name = lambda some: ", ".join(model.joint(j).name for j in some)  # noqa: E731
    if other := [j for j in joints if model.jnt_type[j] != JOINT.mjJNT_HINGE]:
        raise ValueError(f"{path}: only hinges can be driven; {name(other)} is none")
    if loose := [j for j in joints if not model.jnt_limited[j]]:
        raise ValueError(f"{path}: joint {name(loose)} has no limits; add range=...")
    if not joints:
        raise ValueError(f"{path} has no joint below {model.body(root).name}")
    return joints


def default_pose(path, model, joints, wishes):
    """Angles (A,) of the keyframe `home`, `stand` or the only one, with those of robot.toml's `pose` over them."""
    keys = [model.key(k).name for k in range(model.nkey)]
    pose, asked = [None] * len(joints), wishes.get("keyframe")
    if asked and asked not in keys:
        raise ValueError(f"{path} has no keyframe {asked!r}; it has {', '.join(keys) or 'none'}")
    chosen = [asked] if asked else [name for name in ("home", "stand") if name in keys][:1] or keys
    if len(chosen) > 1 and "pose" not in wishes:
        raise ValueError(f'{path} has the keyframes {", ".join(keys)}; write keyframe = "{keys[0]}" into robot.toml')
    if len(chosen) == 1:
        qpos = model.key_qpos[keys.index(chosen[0])]
        pose = [float(qpos[model.jnt_qposadr[j]]) for j in joints]
    names = [model.joint(j).name for j in joints]
    pose = wished(wishes.get("pose"), names, pose)
    if None in pose:
        lacking = [name for name, angle in zip(names, pose, strict=True) if angle is None]
        raise ValueError(
            f"{path} has no keyframe; write the angles [rad] it stands with into robot.toml, [pose] {lacking[0]} = 0.0 "
            f"(joints: {', '.join(lacking)}; a part of a name stands for all that have it)"
        )
    low, high = model.jnt_range[joints].T
    if wrong := [n for n, q, a, b in zip(names, pose, low, high, strict=True) if not a - 1e-3 <= q <= b + 1e-3]:
        raise ValueError(f"{path}: the default pose is outside of the limits of {', '.join(wrong)}; change [pose]")
    return np.clip(pose, low, high)


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
    limits, inertia = np.array(limits, float), reflected_inertia(model, joints, pose)
    gains = np.array([file_gains(model, j, driven.get(j)) for j in joints])  # 0: the file has none
    kp = wished(wishes.get("kp"), names, np.where(gains[:, 0] > 0, gains[:, 0], limits / STIFFNESS))
    kd = np.where(gains[:, 1] > 0, gains[:, 1], 2 * DAMPING * np.sqrt(np.abs(kp) * inertia))
    kp, kd = np.array(kp, float), np.array(wished(wishes.get("kd"), names, kd), float)
    scale = wished(wishes.get("action_scale"), names, np.minimum(0.25 * limits / kp, 0.5))
    asked = wished(wishes.get("kp"), names, [None] * len(names))
    source = np.where(gains[:, 0] > 0, "file", "rule")
    source = ["robot.toml" if kp is not None else known for kp, known in zip(asked, source, strict=True)]
    if min(*limits, *kp, *kd, *scale) <= 0:
        raise ValueError(f"{path}: gains, torque limits and action scales must be above 0")
    if model.dof_frictionloss.any():
        notes.append("dry friction of the joints is left out; --set joint_friction=LOW,HIGH [N m] randomises it")
    if [driven.get(j) for j in joints] != sorted(driven.values()) and driven:
        notes.append("actions follow the order of the file's tree, not that of its actuators")
    return {
        "kp": kp,
        "kd": kd,
        "torque_limit": limits,
        "action_scale": scale,
        "gains_from": source,
        "damping_ratio": kd / (2 * np.sqrt(kp * inertia)),
    }


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


def file_gains(model, joint, actuator):
    """kp and kd of a position actuator, 0 where the file has none. A position actuator's kd may be a joint damping."""
    if actuator is None or model.actuator_biasprm[actuator, 1] >= 0:
        return 0.0, 0.0
    square = model.actuator_gear[actuator, 0] ** 2
    damping = model.dof_damping[model.jnt_dofadr[joint]]
    return -model.actuator_biasprm[actuator, 1] * square, -model.actuator_biasprm[actuator, 2] * square + damping


def reflected_inertia(model, joints, pose):
    """Inertia (A,) [kg m^2] about each joint in the default pose, the trunk held: that of the links and the rotor."""
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[model.jnt_qposadr[joints]] = pose
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    return np.diag(full)[model.jnt_dofadr[joints]]


# --- shapes ---


def shapes_of(model, root, lost, notes):
    """Spheres, capsules and boxes of each body, as dicts. Others become one of these, which every engine knows."""
    shapes, bodies, changed = [], below(model, root), {}
    for g in np.flatnonzero(np.isin(model.geom_bodyid, bodies)):
        name, owner = model.geom(g).name, model.body(model.geom_bodyid[g]).name
        solid = bool(model.geom_contype[g] or model.geom_conaffinity[g])
        kind, half = int(model.geom_type[g]), model.geom_size[g]
        if kind not in SOLIDS:
            continue
        shape = {"body": int(model.geom_bodyid[g]), "name": name, "solid": solid, "rgba": model.geom_rgba[g]}
        shape |= {"type": kind, "size": half, "pos": model.geom_pos[g], "quat": model.geom_quat[g]}
        shapes.append(shape)
        if new := simpler(shape, kind in SOLIDS[3:]) if solid else {}:
            shape |= new
            changed.setdefault(f"{PLURAL[kind]} became {PLURAL[new['type']]}", {})[name or owner] = None
    for owner in lost:
        body = mujoco.mj_name2id(model, OBJ.mjOBJ_BODY, owner)
        if body < 0 or any(shape["body"] == body and shape["solid"] for shape in shapes):
            changed.setdefault("missing meshes are left out beside other shapes", {})[owner] = None
        else:
            shapes.append(inertia_shape(model, body))
            changed.setdefault("missing meshes became shapes with the inertia of the body", {})[owner] = None
    notes += [f"{what}: {', '.join(names)}" for what, names in changed.items()]
    return shapes


def inertia_shape(model, body):
    """The shape, a box or capsule, that weighs and turns as the body does."""
    inertia, mass = model.body_inertia[body], model.body_mass[body]
    half = np.sqrt(np.maximum(1.5 / mass * (inertia.sum() - 2 * inertia), 1e-6))
    shape = {"body": body, "name": "", "solid": True, "rgba": np.array([0.5, 0.5, 0.5, 1]), "size": half}
    shape |= {"type": int(GEOM.mjGEOM_BOX), "pos": model.body_ipos[body], "quat": model.body_iquat[body]}
    return shape | simpler(shape, False)


def simpler(shape, must):
    """Changes that make a shape a capsule or sphere, which cost least, or a box if it `must` change; else nothing."""
    kind, half = shape["type"], np.array(shape["size"])
    if kind in (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CAPSULE):
        return {}
    if kind == GEOM.mjGEOM_CYLINDER:
        half = np.array([half[0], half[0], half[1]])
    thin, middle, long = np.sort(half)
    if long >= 1.5 * middle and middle <= 1.5 * thin:
        turn = {0: [1, 0, 1, 0], 1: [1, -1, 0, 0], 2: [1, 0, 0, 0]}[int(np.argmax(half))]  # z along its length
        radius, quat = np.sqrt(thin * middle), np.zeros(4)
        mujoco.mju_mulQuat(quat, np.array(shape["quat"]), np.array(turn) / np.linalg.norm(turn))
        return {"type": int(GEOM.mjGEOM_CAPSULE), "size": np.array([radius, long - radius, 0]), "quat": quat}
    if must and long <= 2.5 * thin:
        return {"type": int(GEOM.mjGEOM_SPHERE), "size": np.array([np.cbrt(thin * middle * long), 0, 0])}
    return {"type": int(GEOM.mjGEOM_BOX), "size": half} if must else {}


# --- the robot's own MJCF ---


def rebuild(model, root, shapes, body):
    """MjSpec of the robot alone: bodies, joints, motors and shapes, with all that defaults and meshes said resolved."""
    spec = mujoco.MjSpec()
    spec.modelname = body["name"]
    option, never = spec.option, mujoco.mjtDisableBit.mjDSBL_AUTORESET
    option.timestep, option.iterations, option.ls_iterations = 0.005, 10, 10  # as in assets/go1.xml
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.disableflags |= int(never)
    spec.compiler.degree = False
    made = {}
    for b in below(model, root):
        parent = made.get(int(model.body_parentid[b]), spec.worldbody)
        made[b] = copy_body(model, b, parent, body, b == root)
    for number, shape in enumerate(shapes):
        owner = made[shape["body"]]
        copies = [True, False] if shape["solid"] and not drawn(shapes, shape["body"]) else [shape["solid"]]
        for solid in copies:
            masks = (
                {"group": 3, "contype": 1, "priority": 1, "name": f"{owner.name}_c{number}"}
                if solid
                else {"group": 2, "contype": 0}
            )
            owner.add_geom(
                **{name: shape[name] for name in ("type", "size", "pos", "quat", "rgba")} | masks,
                conaffinity=0,
                condim=3,
                mass=0,
                friction=[0.7, 0.005, 0.0001],
            )
        shape["geom"] = f"{owner.name}_c{number}" if shape["solid"] else None
    for name, kp, limit in zip(body["joints"], body["kp"], body["torque_limit"], strict=True):
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=[-limit, limit])
        motor.set_to_position(kp=kp)
    return spec


def drawn(shapes, body):
    """True if a body has a shape of its own for pictures."""
    return any(shape["body"] == body and not shape["solid"] for shape in shapes)


def copy_body(model, b, parent, body, is_root):
    """A body with its mass and joints."""
    place = {} if is_root else {"pos": model.body_pos[b], "quat": model.body_quat[b]}
    mass = {"mass": model.body_mass[b], "ipos": model.body_ipos[b], "iquat": model.body_iquat[b]}
    new = parent.add_body(
        name=model.body(b).name, **place, **mass, inertia=model.body_inertia[b], explicitinertial=True
    )
    if is_root:
        new.add_freejoint(name="root")
    for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
        if model.jnt_type[j] == JOINT.mjJNT_FREE:
            continue
        name = model.joint(j).name
        place, dof = body["joints"].index(name), model.jnt_dofadr[j]
        new.add_joint(
            name=name,
            type=JOINT.mjJNT_HINGE,
            **{field: getattr(model, f"jnt_{field}")[j] for field in ("pos", "axis", "range")},
            ref=model.qpos0[model.jnt_qposadr[j]],
            armature=model.dof_armature[dof],
            damping=body["kd"][place],
            stiffness=model.jnt_stiffness[j],
            springref=model.qpos_spring[model.jnt_qposadr[j]],
            limited=True,
        )
    return new


def equip(path, spec, body):
    """Add the feet's sites, the camera and the sensors; contact sensors come last."""
    sensor, site, kind = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor.mjSENS_CONTACT
    far, trunk = 2 * body["height"] + 0.9 * body["span"] + 0.3, spec.body(body["base"])
    look = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    tilt = np.arctan2(1.0, 0.27) / 2  # from the right side, a little from above
    trunk.add_camera(name="track", mode=look, pos=[0, -far, 0.27 * far], quat=[np.cos(tilt), np.sin(tilt), 0, 0])
    for foot, owner, pos in zip(body["feet"], body["foot_bodies"], body["foot_sites"], strict=True):
        spec.body(owner).add_site(name=foot, pos=pos, group=4, size=[0.01, 0.01, 0.01])
        spec.add_sensor(name=f"{foot}_pos", type=sensor.mjSENS_FRAMEPOS, objtype=site, objname=foot)
        spec.add_sensor(name=f"{foot}_vel", type=sensor.mjSENS_FRAMELINVEL, objtype=site, objname=foot)
    covers = {
        foot: (geom or owner, OBJ.mjOBJ_GEOM if geom else OBJ.mjOBJ_BODY)
        for foot, owner, geom in zip(body["feet"], body["foot_bodies"], body["foot_geoms"], strict=True)
    }
    covers |= {name: (name, OBJ.mjOBJ_BODY) for name in body["contact_ends"] if name not in covers}
    for name, (what, of) in covers.items():
        one = spec.add_sensor(name=f"{name}_force", type=kind, reftype=of, refname=what)
        one.intprm[:3] = [2, 3, 1]  # the net force of all contacts
    compiled(path, spec)


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
    yield f"a contact ends an episode: {', '.join(body['contact_ends'])}"
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
