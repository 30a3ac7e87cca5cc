"""The README's first picture: three recorded policies walk, each robot drawn at several instants on one ground.

    python tools/lead.py

Writes docs/walking.png. Needs OpenGL, for example Debian's libosmesa6.
"""

import io
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
import play
from envs import render, terrain
from experiment import records

# task -> robot's name, first instant [s], number of instants, least distance between them [m], robot's height [m]
ROWS = {
    "go1_loco": ("Unitree Go1", 1.5, 5, 0.68, 0.4),
    "anymal_loco": ("ANYmal D", 2.0, 5, 1.06, 0.83),
    "g1_loco": ("Unitree G1", 0.6, 8, 0.56, 1.4),
}
SWING = 0.34  # [s] in which every foot is lifted once
WIDTH, OVER, UNDER, BETWEEN = 1600, 20, 75, 8  # [pixels] of the picture; over and under robots; between rows
SHARPER = 2  # rendered so many times larger
DISTANCE, ELEVATION = 40.0, np.deg2rad(9)  # [m] from camera to robots, almost a parallel projection; angle of view
INK, FONT = (30, 34, 40), ImageFont.load_default(27)


def instants(env, qpos, first, count, gap):
    """Control steps, the robot at least gap metres further each time: left and right foot in turn, highest in swing."""
    data, heights = mujoco.MjData(env.model), []
    for pose in qpos:
        render.place(env.model, data, pose)
        heights.append([data.site(foot).xpos[2] for foot in env.robot.feet[:2]])
    steps = []
    for i in range(count):
        swing = np.array(heights)[first : first + round(SWING / env.dt), i % 2]
        steps.append(first + np.argmax(swing))
        first = steps[-1] + np.argmax(np.linalg.norm(qpos[steps[-1] :, :2] - qpos[steps[-1], :2], axis=-1) > gap)
    return np.array(steps)


def scene(robot, poses, size, scale):
    """MjSpec of a robot in all poses (n, nq) at once, seen from its right side by a camera that stays."""
    spec = terrain.flat_scene(robot, visual=True)
    spec.camera("track").name = "robot"  # render.draw looks through the one called track
    for i in range(1, len(poses)):
        spec.attach(robot.spec(), prefix=f"{i}/", frame=spec.worldbody.add_frame())
    along = np.append(poses[-1, :2] - poses[0, :2], 0.0)
    along /= np.linalg.norm(along)
    back = np.array([np.cos(ELEVATION) * along[1], -np.cos(ELEVATION) * along[0], np.sin(ELEVATION)])
    middle = np.append((poses[0, :2] + poses[-1, :2]) / 2, (size[1] / 2 - UNDER) / scale)
    camera = spec.worldbody.add_camera(
        name="track", pos=middle + DISTANCE * back, xyaxes=[*along, *np.cross(back, along)]
    )
    camera.fovy = np.rad2deg(2 * np.arctan(size[1] / scale / 2 / DISTANCE))
    checker, light = spec.texture("checker"), spec.lights[0]
    checker.rgb1, checker.rgb2 = [0.86, 0.88, 0.9], [0.76, 0.79, 0.82]
    light.pos, light.dir, light.castshadow = middle + np.array([0, 0, 5]), [0.05, 0.2, -1], True
    spec.stat.extent = 0.55 * size[0] / scale  # [m] shadows are drawn as far as this from the middle
    spec.visual.map.shadowclip, spec.visual.quality.shadowsize = 1.0, 8192
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SHARPER * size[0], SHARPER * size[1]
    return spec


def picture(env, name, poses, times, tall):
    """One wide Image of a robot, `tall` metres high, in poses (n, nq), with its name and times."""
    x = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=-1)
    scale = WIDTH / (x[-1] * (1 + 1.08 / (len(x) - 1)))  # [pixels / m]; half a gap is left at both ends
    size = WIDTH, round(scale * tall) + OVER + UNDER
    sharp = SHARPER * size[0], SHARPER * size[1]
    image = render.draw(scene(env.robot, poses, size, scale), poses.reshape(1, -1), sharp)[0]
    if image.size != sharp:
        raise records.UserError("this picture needs OpenGL; on Linux libosmesa6 will do")
    image = image.resize(size, Image.LANCZOS)
    pen = ImageDraw.Draw(image)
    pen.text((20, size[1] - 14), f"{name}, {times[0]:.1f} s", INK, FONT, anchor="ls")
    for at, time in zip(WIDTH / 2 + scale * (x - x[-1] / 2)[1:], times[1:], strict=True):
        pen.text((at, size[1] - 14), f"{time:.1f} s", INK, FONT, anchor="ms")
    return image


def row(task, name, start, count, gap, tall):
    """A task's recorded policy, walking forward. Returns an Image."""
    path, fields = ROOT / f"results/tasks/{task}/policy.msgpack", envs.TASKS[task][0].SHOWCASE_FIELDS
    env, net, params, _ = play.load_policy(path, "c", **fields)
    qpos = np.asarray(jax.jit(lambda params: play.evaluate(env, net, params, 1))(params)[2], np.float64)
    steps = instants(env, qpos, round(start / env.dt), count, gap)
    return picture(env, name, qpos[steps], steps * env.dt, tall)


def main():
    """Draw the README's picture of three walking robots."""
    images = [row(task, *about) for task, about in ROWS.items()]
    sheet = Image.new("RGB", (WIDTH, sum(image.height + BETWEEN for image in images) - BETWEEN), "white")
    top = 0
    for image in images:
        sheet.paste(image, (0, top))
        top += image.height + BETWEEN
    file = io.BytesIO()
    sheet.quantize(128, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    records.replace_bytes(ROOT / "docs/walking.png", file.getvalue())
    print("wrote docs/walking.png")


if __name__ == "__main__":
    with records.one_line_errors():
        tyro.cli(main, description=__doc__)
