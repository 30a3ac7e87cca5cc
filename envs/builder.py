"""The MJCF of a robot from a file, for loader.py: what a simulation needs of the file, and what the environments add.

These are shapes that every engine knows, PD motors, sites at the feet, contact masks, sensors and a camera.
"""

import mujoco
import numpy as np

from envs import reader

GEOM, JOINT, OBJ = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtObj
PLURAL = {
    GEOM.mjGEOM_SPHERE: "spheres",
    GEOM.mjGEOM_CAPSULE: "capsules",
    GEOM.mjGEOM_BOX: "boxes",
    GEOM.mjGEOM_CYLINDER: "cylinders",
    GEOM.mjGEOM_ELLIPSOID: "ellipsoids",
}


# --- shapes ---


FITTED = dict.fromkeys((GEOM.mjGEOM_MESH, GEOM.mjGEOM_SDF), GEOM.mjGEOM_BOX)  # else what the file asks to fit


def simplify(path, spec, notes):
    """Leave what a simulation needs. Shapes that MuJoCo fits replace meshes.

    Returns the bodies that lose a collision mesh whose file is missing.
    """
    for pair in spec.pairs:  # in files for MJX feet may touch the floor by these alone
        for geom in filter(None, map(spec.geom, (pair.geomname1, pair.geomname2))):
            geom.contype = 1
    lost = reader.strip(path, spec, {reader.mesh_name(m) for m in spec.meshes if not reader.loadable(spec, m)})
    lost = with_shapes(spec, lost, notes)
    reader.drop(spec, "excludes", "pairs")
    fitted, meshes = {}, [geom for geom in spec.geoms if geom.meshname]
    if any(reader.weighs(spec, geom) for geom in meshes):
        reader.fix_masses(path, spec)
    for geom in meshes:
        if reader.solid(geom):
            geom.type = FITTED.get(geom.type, geom.type)
            fitted[geom.parent.name] = None
        elif not reader.weighs(spec, geom):
            spec.delete(geom)
    if fitted:
        notes.append(f"MuJoCo fitted simple shapes to the collision meshes of {', '.join(fitted)}")
    return lost


def with_shapes(spec, lost, notes):
    """Bodies that lost a mesh, but for rigid parts of others that have no shape left, of which a note warns."""
    shapeless = [name for name in lost if reader.rigid_and_bare(spec.body(name))]
    if shapeless:
        names = ", ".join(shapeless)
        notes.append(f"missing meshes leave no shape for {names}; add a primitive <geom> to what touches the ground")
    return [name for name in lost if name not in shapeless]


def below(model, root):
    """Bodies from `root` down, in the order of the tree."""
    inside = {root}
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.add(body)
    return sorted(inside)


def shapes_of(model, root, lost, notes):
    """Spheres, capsules and boxes of each body, as dicts. Others become one of these, which every engine knows."""
    shapes, bodies, changed = [], below(model, root), {}
    for g in np.flatnonzero(np.isin(model.geom_bodyid, bodies)):
        name, owner = model.geom(g).name, model.body(model.geom_bodyid[g]).name
        solid = bool(model.geom_contype[g] or model.geom_conaffinity[g])
        kind, half = int(model.geom_type[g]), model.geom_size[g]
        if kind not in PLURAL:
            continue
        shape = {"body": int(model.geom_bodyid[g]), "name": name, "solid": solid, "rgba": model.geom_rgba[g]}
        shape |= {"type": kind, "size": half, "pos": model.geom_pos[g], "quat": model.geom_quat[g]}
        shapes.append(shape)
        if new := simpler(shape, kind in (GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_ELLIPSOID)) if solid else {}:
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
        place = body["joints"].index(name)
        new.add_joint(
            name=name,
            type=JOINT.mjJNT_HINGE,
            **{field: getattr(model, f"jnt_{field}")[j] for field in ("pos", "axis", "range")},
            ref=model.qpos0[model.jnt_qposadr[j]],
            armature=body["armature"][place],
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
    reader.compiled(path, spec)
