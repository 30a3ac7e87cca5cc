"""The ground, added to a robot's MJCF: a plane, a field of Perlin noise beside it, or slabs on mocap bodies.

Contact masks are contype 0, conaffinity 1 for the ground and the reverse for the robot. Without them MJX collides
floor and obstacles with each other, and bodies fly off.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np


def flat_scene(robot, visual=False):
    """MjSpec of a robot on a plane at z = 0; `visual` adds what only a renderer needs."""
    spec = robot.spec()
    world = spec.worldbody
    world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], contype=0, conaffinity=1
    )  # its friction has no effect: the robot's geoms have priority
    if visual:
        decorate(spec)
    else:
        for geom in [geom for geom in spec.geoms if geom.group == 2]:
            spec.delete(geom)  # visual geoms would cost time in every physics step
    return spec


ROUGH_CENTRE, ROUGH_HALF, CELL = 15.0, 8.0, 0.1  # [m] x of the rough field's middle, its half-width, its grid


def perlin(cells, period, rng):
    """One octave of gradient noise (cells + 1, cells + 1), about within 0.7 (Perlin 1985).

    A lattice point lies every `period` cells.
    """
    lattice = rng.uniform(0, 2 * np.pi, (cells // period + 2, cells // period + 2))
    position = np.arange(cells + 1) / period
    corner, inside = position.astype(int), position % 1
    fade = inside**3 * (inside * (6 * inside - 15) + 10)
    noise = np.zeros((cells + 1, cells + 1))
    for dy in (0, 1):
        for dx in (0, 1):
            angle = lattice[np.ix_(corner + dy, corner + dx)]
            slope = np.sin(angle) * (inside - dy)[:, None] + np.cos(angle) * (inside - dx)[None]
            noise += slope * np.outer(fade if dy else 1 - fade, fade if dx else 1 - fade)
    return noise


def perlin_heights(amplitude):
    """Heights [m] of the rough field, 0 to 2 amplitude, 0 at the border. Rows are along y, columns along x."""
    rng, cells = np.random.default_rng(0), round(2 * ROUGH_HALF / CELL)
    noise = perlin(cells, 10, rng) + 0.5 * perlin(cells, 5, rng)
    ramp = np.clip(np.minimum(np.arange(cells + 1), np.arange(cells + 1)[::-1]) / 10, 0, 1)  # within 1 m of the border
    return amplitude * np.clip(1 + noise, 0, 2) * np.minimum.outer(ramp, ramp)


def rough_scene(robot, heights, visual=False):
    """The flat scene with a field of `heights` from perlin_heights beside it."""
    spec = flat_scene(robot, visual)
    top = heights.max()
    spec.add_hfield(
        name="rough",
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=[ROUGH_HALF, ROUGH_HALF, top, 0.5],
        userdata=(heights / top).ravel(),
    )
    spec.worldbody.add_geom(
        name="rough",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="rough",
        pos=[ROUGH_CENTRE, 0, 0],
        contype=0,
        conaffinity=1,
    )
    return spec


PARKED = -50.0  # [m] height of a slab that is not used


@dataclass(frozen=True)
class Slab:
    """A box of fixed size on a mocap body. Levels only move it, so one compiled model serves all of them."""

    name: str
    half: tuple[float, float, float]  # [m]
    ceiling: bool = False  # seen by the ceiling scan in place of the height scan


def slab_scene(robot, slabs, floor=0.0, visual=False):
    """The flat scene with its plane at height `floor`, and the slabs, parked out of reach."""
    spec = flat_scene(robot, visual)
    spec.geom("floor").pos = [0, 0, floor]
    colours = ([0.55, 0.5, 0.42, 1], [0.48, 0.44, 0.38, 1])
    for i, slab in enumerate(slabs):
        body = spec.worldbody.add_body(name=slab.name, mocap=True, pos=[0, 0, PARKED])
        body.add_geom(
            name=slab.name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=slab.half,
            contype=0,
            conaffinity=1,
            rgba=[0.3, 0.45, 0.6, 0.6] if slab.ceiling else colours[i % 2],
        )
    if visual:  # place the camera outside of the slabs, or below one that hangs overhead
        camera, below = spec.camera("track"), any(slab.ceiling for slab in slabs)
        camera.pos = [0.6, -4.0, 0.0 if below else 1.8]
        camera.alt.xyaxes = [1, 0, 0, 0, 0, 1] if below else [1, 0, 0, 0, 0.39, 0.92]
    return spec


def top_heights(pos, quat, half, xy, floor):
    """Height [m] of the ground at xy (..., 2): the top face of the highest slab there, or the floor.

    pos (M, 3), quat (M, 4) and half (M, 3) are of slabs that may be tilted about y alone.
    """
    sine, cosine = 2 * quat[:, 0] * quat[:, 2], 1 - 2 * quat[:, 2] ** 2  # of the tilt
    top = pos + half[:, 2:] * jnp.stack([sine, jnp.zeros_like(sine), cosine], -1)  # middle of the top face
    offset = xy[..., None, :] - top[:, :2]  # (..., M, 2)
    inside = (jnp.abs(offset[..., 0]) <= half[:, 0] * cosine) & (jnp.abs(offset[..., 1]) <= half[:, 1])
    height = top[:, 2] - offset[..., 0] * sine / cosine
    return jnp.max(jnp.where(inside, height, floor), -1, initial=floor)


def underside_heights(pos, half, xy):
    """Height [m] of the lowest slab's underside over xy (..., 2), infinite if there is none; pos and half (M, 3)."""
    inside = jnp.all(jnp.abs(xy[..., None, :] - pos[:, :2]) <= half[:, :2], -1) & (pos[:, 2] > PARKED / 2)
    return jnp.min(jnp.where(inside, pos[:, 2] - half[:, 2], jnp.inf), -1, initial=jnp.inf)


def decorate(spec):
    """Add a checkered floor, a sky and a light."""
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.85, 0.9, 0.95],
        rgb2=[1, 1, 1],
        width=32,
        height=32,
    )
    spec.add_texture(
        name="checker",
        type=texture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=[0.45, 0.48, 0.5],
        rgb2=[0.36, 0.39, 0.42],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True, reflectance=0)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    spec.geom("floor").material = "floor"
    spec.worldbody.add_light(
        pos=[0, 0, 5], dir=[0.2, 0.3, -1], castshadow=False, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.4, 0.4, 0.4]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
