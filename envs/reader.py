"""Read a robot's file that somebody else made: MJCF, or URDF that MuJoCo reads. Its meshes need not be there.

loader.py makes a robot to train of it, and tools/sim_to_sim.py drives a policy on it. Refusals are ValueErrors of one
line.
"""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np

JOINT, OBJ = mujoco.mjtJoint, mujoco.mjtObj
BESIDES = ("sensors", "tendons", "skins", "lights", "cameras", "tuples", "materials", "textures", "hfields")


def read(path):
    """MjSpec of a file."""
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, LookupError, ValueError) as error:  # the last two: of unknown encodings
        raise ValueError(f"{path} is not an XML file: {one_line(error)}") from None
    if root.tag == "robot" and any("/xacro}" in part.tag or "${" in str(part.attrib) for part in root.iter()):
        raise ValueError(f"{path} has macros; expand them first: xacro {path.name} > robot.urdf")
    try:
        spec = mujoco.MjSpec.from_file(os.fsencode(path).decode())  # MuJoCo wants UTF-8, whatever the locale
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"MuJoCo cannot read {path}: {one_line(error)}") from None
    if root.tag == "robot":
        for geom in spec.geoms:
            geom.mass = 0.0  # in URDF a link without <inertial> is weightless, whatever its shapes
        find_meshes(path, spec)
    return spec


def find_meshes(path, spec):
    """Find a URDF's meshes as ROS does: package://bot/meshes/leg.stl is bot/meshes/leg.stl in a folder above it."""
    for mesh in [mesh for mesh in spec.meshes if not loadable(spec, mesh)]:
        parts = Path(mesh.file.split("://")[-1]).parts
        tails = [Path(*parts[i:]) for i in range(min(2, len(parts)))]  # the package's own folder may have another name
        files = (folder / tail for tail in tails for folder in path.resolve().parents)
        mesh.file = str(next((file for file in files if file.is_file()), mesh.file))
    spec.strippath = False


def compiled(path, spec):
    """The model, for its resolved numbers."""
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        hint = "; give each moving body an <inertial>" if "mass and inertia" in str(error) else ""
        raise ValueError(f"{path}: MuJoCo says {one_line(error)}{hint}") from None


def one_line(error):
    """MuJoCo's errors take several lines."""
    return " ".join(str(error).split())[:200]


# --- the trunk ---


def free_the_base(path, spec, notes):
    """Add the free joint where the trunk hangs in the world, and name nameless parts. Returns the trunk's name."""
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
        root.name = root.name or "base"
        place = place_of(path, spec, root.name) if spec.keys else None
        root.add_freejoint()
        for key in spec.keys:
            key.qpos = [*place, *key.qpos] if len(key.qpos) else []
            key.qvel = [*[0] * 6, *key.qvel] if len(key.qvel) else []
        notes.append(f"a free joint was added to {root.name}")
    free[0].name = free[0].name or "base"
    for body in spec.bodies:
        name_children(body)
    return free[0].name


def place_of(path, spec, name):
    """Position and quaternion of a body that hangs in the world, whichever way the file gives them."""
    twin = spec.copy()
    strip(path, twin, {mesh_name(mesh) for mesh in twin.meshes if not loadable(twin, mesh)})
    drop(twin, "keys", "pairs", "excludes")
    twin.compiler.fusestatic = False  # else it becomes part of the world
    body = compiled(path, twin).body(name)
    return [*body.pos, *body.quat]


def name_children(body):
    """Name the nameless bodies below one, by their parent and number, and their joints by the body."""
    for number, child in enumerate(body.bodies, 1):
        child.name = child.name or f"{body.name}_{number}"
        for joint in child.joints:
            joint.name = joint.name or child.name


# --- what is not the robot ---


def drop(spec, *kinds):
    """Remove all members of these lists of an MjSpec."""
    for thing in [thing for kind in kinds for thing in getattr(spec, kind)]:
        spec.delete(thing)


def strip(path, spec, meshes):
    """Remove scene, looks, sensors and the like, and these meshes. Returns the bodies that lose a collision mesh."""
    lost = {}
    for geom in list(spec.geoms):
        material = spec.material(geom.material) if geom.material else None
        geom.rgba, geom.material = geom.rgba if material is None else material.rgba, ""
        if geom.meshname in meshes and weighs(spec, geom):
            what = f"{geom.parent.name} has its mass from mesh {geom.meshname}, which is left out"
            raise ValueError(f"{path}: {what}; give it an <inertial>")
        if geom.meshname in meshes and solid(geom):
            lost[geom.parent.name] = None
        if geom.meshname in meshes or geom.parent == spec.worldbody:
            spec.delete(geom)
    for site in spec.sites:
        site.material = ""
    for mesh in [mesh for mesh in spec.meshes if mesh_name(mesh) in meshes]:
        spec.delete(mesh)
    drop(spec, *BESIDES)
    spec.compiler.fusestatic = True  # bodies without joints become part of others
    return list(lost)


def rigid_and_bare(body):
    """True for a body without joints, which becomes part of another, that has no collision shape."""
    return not body.joints and not any(map(solid, body.geoms))


def fix_masses(path, spec):
    """Write the mass and inertia of every body into the spec, so that they stay when meshes become other shapes."""
    twin = spec.copy()
    twin.compiler.fusestatic = False
    model = compiled(path, twin)
    for body in spec.bodies[1:]:
        b = model.body(body.name).id
        body.mass, body.inertia = model.body_mass[b], model.body_inertia[b]
        body.ipos, body.iquat = model.body_ipos[b], model.body_iquat[b]
        body.fullinertia, body.explicitinertial = [np.nan] * 6, True
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE


def weighs(spec, geom):
    """True if a geom adds to the mass of the robot."""
    computed = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if geom.parent == spec.worldbody or (geom.parent.explicitinertial and not computed):
        return False
    return geom.density > 0 if np.isnan(geom.mass) else geom.mass > 0


def solid(geom):
    """True if a geom touches others."""
    return bool(geom.contype or geom.conaffinity)


def mesh_name(mesh):
    """Name of a mesh, which may be that of its file."""
    return mesh.name or Path(mesh.file).stem


def loadable(spec, mesh):
    """True if a mesh stands in the file itself, or its own file is there, of a kind that MuJoCo reads."""
    kind = mesh.content_type or Path(mesh.file).suffix.lower() in (".stl", ".obj", ".msh")
    return not mesh.file or (kind and Path(spec.modelfiledir, spec.meshdir, mesh.file).is_file())
