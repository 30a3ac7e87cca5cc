"""The ground a robot stands on, added to its MJCF. Flat for now.

Contact masks: ground contype 0, conaffinity 1; robot contype 1, conaffinity 0. Without them MJX collides floor
and obstacles with each other and throws bodies into the air.
"""

import mujoco


def flat_scene(robot, visual=False):
    """MjSpec of a robot on a plane at z = 0; `visual` keeps the geoms that only a renderer needs."""
    spec = mujoco.MjSpec.from_file(str(robot.xml))
    world = spec.worldbody
    world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], contype=0, conaffinity=1
    )  # its friction never counts: the robot's geoms have priority
    if visual:
        decorate(spec)
    else:
        for geom in [geom for geom in spec.geoms if geom.group == 2]:
            spec.delete(geom)  # their poses would be computed in every physics step
    return spec


def decorate(spec):
    """Checkered floor, sky and light, for pictures."""
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
