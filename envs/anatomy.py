"""Feet, shanks and symmetries of a robot, found in its geometry; loader.py asks for them.

All of it looks at the robot's own MjSpec, with the trunk upright at the origin.
Legend: A joints, F feet.
"""

import mujoco
import numpy as np

GEOM = mujoco.mjtGeom

# A reflection negates one component of a polar vector (velocity, gravity, foot position) and the other two
# of an axial one (angular velocity, joint axis).
POLAR = {"left_right": np.array([1, -1, 1]), "front_back": np.array([-1, 1, 1])}
AXIAL = {name: -signs for name, signs in POLAR.items()}
REFLECTIONS = {name: np.diag(signs) for name, signs in POLAR.items()}
NEAR = {"position": 0.005, "centre": 0.015, "mass": 0.05}  # how far mirror images may differ: [m], [m], share


def balls(shape):
    """Centres (n, 3) in the body and radius of the spheres whose hull is the shape."""
    turn, size, pos = np.zeros(9), shape["size"], np.array(shape["pos"])
    mujoco.mju_quat2Mat(turn, np.array(shape["quat"]))
    if shape["type"] == GEOM.mjGEOM_SPHERE:
        return pos[None], size[0]
    if shape["type"] == GEOM.mjGEOM_CAPSULE:
        local, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
    else:
        local, radius = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * size, 0.0
    return pos + local @ turn.reshape(3, 3).T, radius


def posed(spec, pose=None):
    """Model and data of a spec with the trunk upright at the origin, at these joint angles or those of the file."""
    model = spec.compile()
    data = mujoco.MjData(model)  # at qpos0
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    if pose is not None:
        data.qpos[7:] = pose
    mujoco.mj_kinematics(model, data)
    return model, data


def bottom(model, data, geom):
    """Lowest height of a geom in the world [m], infinite for shapes without one."""
    z, (a, b, c), up = data.geom_xpos[geom, 2], model.geom_size[geom], data.geom_xmat[geom, 6:]
    match model.geom_type[geom]:
        case GEOM.mjGEOM_SPHERE:
            return z - a
        case GEOM.mjGEOM_CAPSULE:
            return z - a - abs(up[2]) * b
        case GEOM.mjGEOM_CYLINDER:
            return z - a * np.hypot(up[0], up[1]) - abs(up[2]) * b
        case GEOM.mjGEOM_BOX:
            return z - np.abs(up) @ (a, b, c)
        case GEOM.mjGEOM_ELLIPSOID:
            return z - np.linalg.norm(up * (a, b, c))
    return np.inf


# --- feet and contacts ---


def touch(mass):
    """Force [N] from which on a foot is on the ground: 1 N or, for robots of less than 5 kg, 2% of their weight."""
    return min(1.0, 0.02 * 9.81 * float(mass))


def feet_at_sites(spec, body):
    """Feet of a file that has sites for them, named `..._foot`, and their height above its lowest shape."""
    model, data = posed(spec, np.zeros(len(body["joints"])))  # with all joints at 0 flat feet are level
    feet = [site for site in map(model.site, range(model.nsite)) if site.name.endswith("_foot")]
    places = data.site_xpos[[foot.id for foot in feet]]
    ground = min(bottom(model, data, geom) for geom in np.flatnonzero(model.geom_contype))
    return {
        "feet": [foot.name for foot in feet],
        "foot_bodies": [model.body(foot.bodyid[0]).name for foot in feet],
        "sole": abs(round(places[:, 2].min() - ground, 6)),
        "gait": gait(places[:, :2]),
    }


def feet_of(path, spec, body, shapes, wishes):
    """Feet and their sites, what touches the ground, and what ends an episode: all but the feet and the shanks."""
    model, data = posed(spec, body["default_pose"])
    points = {}  # body -> (world centre, radius, its shape's geom) of all spheres whose hull it is
    for shape in [shape for shape in shapes if shape["solid"]]:
        owner = model.geom(shape["geom"]).bodyid[0]
        centres, radius = balls(shape)
        world = data.xpos[owner] + centres @ data.xmat[owner].reshape(3, 3).T
        points.setdefault(int(owner), []).extend((point, radius, shape["geom"]) for point in world)
    lowest = {b: min(point[2] - radius for point, radius, _ in some) for b, some in points.items()}
    if not lowest:
        raise ValueError(f"{path}: no shape can touch the ground; add a primitive <geom> to each foot")
    ground = min(lowest.values())
    leaves = [b for b in lowest if not any(b != other and b in ancestors(model, other) for other in lowest)]
    leg = ancestors(model, min(leaves, key=lowest.get))[:-1]  # from a foot up to the hip
    length = max((data.xpos[b, 2] for b in leg), default=0.0) - ground
    if -ground < 0.25 * length:
        base = model.body(1).name
        raise ValueError(f"{path}: the frame of {base} is {-ground:.2f} m above the ground; move it into the trunk")
    feet = [b for b in leaves if lowest[b] < ground + 0.1 * length and b > 1]
    if asked := wishes.get("feet"):
        if unknown := [name for name in asked if name not in {model.body(b).name for b in points}]:
            known = ", ".join(model.body(b).name for b in points)
            fused = "parts without a joint belong to the body above them"
            raise ValueError(
                f"{path}: no body {unknown[0]!r} with a shape can be a foot; choose from {known} ({fused})"
            )
        feet = sorted({model.body(name).id for name in asked})
    if len(feet) < 2:
        raise ValueError(f'{path}: only {len(feet)} foot was found; write feet = ["BODY", "BODY"] into robot.toml')
    patches = {b: [point for point in points[b] if point[0][2] - point[1] < lowest[b] + 0.01] for b in feet}
    sole, sites = soles(patches)
    legs = {a for b in feet for a in shank(model, data, b, -ground)}
    names = [model.body(b).name for b in feet]
    ends = wishes.get("contact_ends", [model.body(b).name for b in points if b not in legs])
    if unknown := set(ends) - {model.body(b).name for b in points}:
        raise ValueError(f"{path}: contact_ends names {', '.join(sorted(unknown))}, which has no shape")
    return {
        "feet": [name if "foot" in name.lower() else f"{name}_foot" for name in names],
        "foot_bodies": names,
        "foot_sites": [
            data.xmat[b].reshape(3, 3).T @ (site - data.xpos[b]) for b, site in zip(feet, sites, strict=True)
        ],
        "foot_geoms": [alone(points[b], patches[b]) for b in feet],
        "sole": sole,
        "gait": gait([site[:2] for site in sites]),
        "contact_ends": ends,
        "height": -ground,
        "span": np.linalg.norm(np.ptp(sites, 0)[:2]),  # of the feet
        "mass": model.body_mass.sum(),
        "base_mass": model.body_mass[1],
    }


def ancestors(model, b):
    """A body and those above it, up to the trunk."""
    chain = [b]
    while chain[-1] > 1:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def shank(model, data, foot, height):
    """The bodies from a foot up to the first whose joint is well above the ground."""
    chain = []
    for b in ancestors(model, foot):
        if b == 1:
            break
        chain.append(b)
        if data.xpos[b, 2] > -0.75 * height:
            break
    return chain


def soles(patches):
    """Height of the sites above the ground, and the sites (F, 3) in the world, of the feet's lowest spheres."""
    radii = {round(radius, 4) for patch in patches.values() for _, radius, _ in patch}
    if len(radii) == 1:  # round feet roll about their sphere's centre
        return patches[next(iter(patches))][0][1], [np.mean([p for p, _, _ in patch], 0) for patch in patches.values()]
    return 0.0, [np.mean([p - [0, 0, radius] for p, radius, _ in patch], 0) for patch in patches.values()]


def alone(points, patch):
    """The geom that a foot stands on, where its body has others; else None, for the whole body."""
    standing = {geom for _, _, geom in patch}
    return standing.pop() if len(standing) == 1 and len({geom for _, _, geom in points}) > 1 else None


def gait(places):
    """Share of a step by which feet are ahead of the first: neighbours on a side, and images, are half a step apart."""
    shares = np.zeros(len(places))
    for side in (1, -1):
        row = sorted((i for i, (_, y) in enumerate(places) if (y > 0) == (side > 0)), key=lambda i: -places[i][0])
        for number, i in enumerate(row):
            shares[i] = (number + (side < 0)) % 2 / 2
    return (shares - shares[0]) % 1


# --- symmetry ---


def mirrors_of(spec, body, notes):
    """Tables of each symmetry that is found: joints and feet with the image of each, and the signs of joints."""
    model, data = posed(spec)
    mirrors, errors = {}, {}
    for name, reflection in REFLECTIONS.items():
        images, error = body_images(model, data, reflection)
        table = images and joint_images(model, data, reflection, images, body)
        order = [model.body(foot).id for foot in body["foot_bodies"]]
        if table and {images[foot] for foot in order} == {*order}:
            feet = [images[foot] for foot in order]
            mirrors[name] = table | {"feet": [order.index(foot) for foot in feet]}
            errors[name] = error
    if not mirrors:
        notes.append("no symmetry was found: there are no mirror losses and no mirrored samples")
    return {"mirrors": mirrors, "mirror_errors": errors}


def body_images(model, data, reflection):
    """body -> its mirror image, and the largest differences; (None, None) unless each body has one."""
    images, errors = {0: 0, 1: 1}, dict.fromkeys(NEAR, 0.0)
    for b in range(1, model.nbody):
        parent = images[int(model.body_parentid[b])]
        others = [1] if b == 1 else [o for o in range(2, model.nbody) if model.body_parentid[o] == parent]
        gaps = [differences(model, data, reflection, b, other) for other in others]
        fitting = [
            (gap["position"], other, gap)
            for gap, other in zip(gaps, others, strict=True)
            if all(gap[k] < NEAR[k] for k in gap)
        ]
        if not fitting:
            return None, None
        _, images[b], gap = min(fitting, key=lambda one: one[:2])
        errors = {name: max(errors[name], gap[name]) for name in errors}
    return (images, errors) if all(images[images[b]] == b for b in images) else (None, None)


def differences(model, data, reflection, b, other):
    """How far a body's reflection is from another body."""
    mass = model.body_mass[[b, other]]
    return {
        "position": float(np.linalg.norm(reflection @ data.xpos[b] - data.xpos[other])),
        "centre": float(np.linalg.norm(reflection @ data.xipos[b] - data.xipos[other])),
        "mass": float(abs(mass[0] - mass[1]) / mass.max()),
    }


# Share by which these may differ in a joint and its image. Damping and rotors follow from inertias, never quite equal.
MOTOR = {"kp": 0.02, "torque_limit": 0.02, "action_scale": 0.02, "kd": 0.1, "armature": 0.1}


def joint_images(model, data, reflection, images, body):
    """Image and sign of each joint, or None: axes, limits, pose and motors must be reflections of each other."""
    perm, signs = [], []
    for j in range(1, model.njnt):
        axis, place = -reflection @ data.xaxis[j], reflection @ data.xanchor[j]
        image = images[int(model.jnt_bodyid[j])]
        for other in range(model.body_jntadr[image], model.body_jntadr[image] + model.body_jntnum[image]):
            along = float(axis @ data.xaxis[other])
            if abs(along) > 0.999 and np.linalg.norm(place - data.xanchor[other]) < 2 * NEAR["position"]:
                perm.append(int(other - 1))
                signs.append(int(np.sign(along)))
                break
        else:
            return None
    pose, limits = np.array(body["default_pose"]), model.jnt_range[1:]
    swapped = np.where(np.array(signs)[:, None] > 0, limits[perm], -limits[perm][:, ::-1])
    alike = all(np.allclose(np.array(body[name])[perm], body[name], rtol=most) for name, most in MOTOR.items())
    same = np.allclose(signs * pose[perm], pose, atol=0.02) and np.allclose(swapped, limits, atol=0.05) and alike
    return {"joints": perm, "signs": signs} if same else None


def average(spec, body, notes):
    """Average masses, inertias and gains over each symmetry, so that mirrored motion is exact."""
    for name, reflection in REFLECTIONS.items():
        model, data = posed(spec)
        images, _ = body_images(model, data, reflection)
        table = images and joint_images(model, data, reflection, images, body)
        if not table:
            continue
        average_gains(spec, body, table)
        turns = data.ximat.reshape(-1, 3, 3)
        inertia = np.einsum("bij,bj,bkj->bik", turns, model.body_inertia, turns)  # world axes
        for b in range(1, model.nbody):
            one, other = spec.body(model.body(b).name), images[b]
            turn = data.xmat[b].reshape(3, 3)
            centre = (data.xipos[b] + reflection @ data.xipos[other]) / 2
            mean = turn.T @ (inertia[b] + reflection @ inertia[other] @ reflection) @ turn / 2
            values, vectors, quat = np.zeros(3), np.zeros(9), np.zeros(4)
            mujoco.mju_eig3(values, vectors, quat, mean.ravel())
            one.mass, one.ipos = model.body_mass[[b, other]].mean(), turn.T @ (centre - data.xpos[b])
            one.inertia, one.iquat = values, quat
        notes.append(f"masses, inertias and gains are averaged over {name.replace('_', '-')}")


def average_gains(spec, body, table):
    """Average the motors of mirrored joints, and the angles they hold."""
    perm, signs = table["joints"], np.array(table["signs"])
    for name in ("kp", "kd", "torque_limit", "armature", "action_scale"):
        body[name] = (np.array(body[name]) + np.array(body[name])[perm]) / 2
    body["default_pose"] = (np.array(body["default_pose"]) + signs * np.array(body["default_pose"])[perm]) / 2
    for i, joint in enumerate(body["joints"]):
        limit, motor = body["torque_limit"][i], spec.actuator(joint)
        spec.joint(joint).damping, motor.forcerange = [body["kd"][i], 0, 0], [-limit, limit]
        spec.joint(joint).armature = body["armature"][i]
        motor.set_to_position(kp=body["kp"][i])
