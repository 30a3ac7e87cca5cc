"""Pictures of a rollout: a strip of frames, a GIF or an MP4, by MuJoCo's renderer or, without OpenGL, by matplotlib.

MuJoCo fixes its OpenGL when it is imported, and a broken driver can end the process. So this file runs as a script in
a second process, which draws the frames, and tries one OpenGL after the other.
"""

import io
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT = 320, 240  # [pixels] of one frame
EVERY = 2  # control steps between frames of a moving picture


def film(env, qpos, course, start=4.0, strip_seconds=0.6, strip_frames=10, gif_seconds=4.0, title="", markers=()):
    """Draw qpos (steps, nq) on a course: rollout.png, a strip of frames, and rollout.gif. Returns name -> bytes.

    Every frame shows its time and the title. `markers` (n, 3) [m] are points of the world that are drawn as spheres.
    Both start after `start` seconds, when the robot has found its pace, or earlier if the rollout is short. By default
    the strip has a frame every 0.06 s, so a stride of 0.3 to 0.45 s appears in five to seven phases.
    """
    qpos = np.asarray(qpos, np.float64)
    first = max(0, min(round(start / env.dt), len(qpos) - round(gif_seconds / env.dt)))
    moving = np.arange(first, min(first + round(gif_seconds / env.dt), len(qpos)), EVERY)
    strip = first + np.round(np.linspace(0, strip_seconds, strip_frames, endpoint=False) / env.dt).astype(int)
    strip = strip[strip < len(qpos)]
    shown = np.unique(np.concatenate([moving, strip]))
    images = dict(zip(shown, draw(build(env, course, markers, True), qpos[shown]), strict=True))
    for i, image in images.items():
        stamp(image, f"{i * env.dt:.2f} s", title)

    frames = [images[i] for i in moving]
    return {"rollout.png": sheet([images[i] for i in strip], 5), "rollout.gif": gif_bytes(frames, env.dt)}


def sheet(images, columns):
    """Images of the usual size beside and below each other, as a PNG."""
    page, png = Image.new("RGB", (columns * WIDTH, -(-len(images) // columns) * HEIGHT), "white"), io.BytesIO()
    for i, image in enumerate(images):
        page.paste(image, (i % columns * WIDTH, i // columns * HEIGHT))
    page.save(png, "PNG", optimize=True)
    return png.getvalue()


def stamp(image, time, title):
    """Write a time into the upper left corner of an image, and a title into the lower left one."""
    pen, size = ImageDraw.Draw(image), image.height / 16  # [pixels]
    font = ImageFont.load_default(size)
    outlined = {"fill": "white", "stroke_fill": "black", "stroke_width": size / 12, "font": font}
    pen.text((size / 2, size / 4), time, **outlined)
    pen.text((size / 2, image.height - size / 2), title, anchor="ls", **outlined)


def gif_bytes(images, dt):
    """Images, EVERY control steps apart, as an endless GIF."""
    frames, gif = [image.quantize(64) for image in images], io.BytesIO()
    duration = round(1000 * EVERY * dt)  # [ms]
    frames[0].save(gif, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    return gif.getvalue()


def check_video(path):
    """ValueError unless `video` can write a file of this name."""
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path} must end in .gif or .mp4")
    if path.suffix == ".mp4" and not shutil.which("ffmpeg"):
        raise ValueError("an MP4 needs the program ffmpeg; install it, or choose a .gif")


def video(env, qpos, course, path, title="", markers=()):
    """Film a rollout qpos (steps, nq) as `film` does. Returns the bytes of a GIF or MP4, after the end of `path`."""
    size = (WIDTH, HEIGHT) if path.suffix == ".gif" else (2 * WIDTH, 2 * HEIGHT)  # a GIF grows large
    images = draw(build(env, course, markers, True), np.asarray(qpos[::EVERY], np.float64), size)
    for i, image in enumerate(images):
        stamp(image, f"{i * EVERY * env.dt:.2f} s", title)
    if path.suffix == ".gif":
        return gif_bytes(images, env.dt)
    width, height = images[0].size
    command = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", f"{1 / (EVERY * env.dt):g}", "-i", "-", "-pix_fmt", "yuv420p"]
    with tempfile.TemporaryDirectory() as folder:
        mp4 = Path(folder, "film.mp4")
        frames = b"".join(image.tobytes() for image in images)
        encoder = subprocess.run([*command, str(mp4)], input=frames, capture_output=True, text=False, check=False)
        if encoder.returncode:
            said = encoder.stderr.decode().strip().splitlines() or [f"exit code {encoder.returncode}"]
            raise ValueError(f"ffmpeg could not make {path}: {said[-1]}")
        return mp4.read_bytes()


def build(env, course, markers=(), close=False):
    """MjSpec of an environment's scene, with the obstacles at their places in a course (or a Physics).

    Markers (n, 3) [m] are points of the world, such as a goal. `close` zooms in where obstacles keep the camera away.
    """
    spec = env.scene(visual=True)
    slabs = [body for body in spec.bodies if body.mocap]
    for body, pos, quat in zip(slabs, course.mocap_pos, course.mocap_quat, strict=True):
        body.pos, body.quat = np.asarray(pos, np.float64), np.asarray(quat, np.float64)
    if close and slabs:
        spec.camera("track").fovy = 30
    for point in np.asarray(markers, np.float64):
        spec.worldbody.add_site(pos=point, size=[0.05, 0, 0], rgba=[0.1, 0.9, 0.9, 0.6])
    return spec


def draw(spec, qpos, size=(WIDTH, HEIGHT)):
    """Images of poses (n, nq), by the first OpenGL that works, else by matplotlib."""
    model = spec.compile()
    from envs import gl  # not at the top, for the second process has no package `envs`

    linux = ("glfw" if os.environ.get("DISPLAY") else "", "egl", "osmesa")
    here = {"darwin": ("cgl",), "win32": ("wgl",)}.get(sys.platform, linux)  # what MuJoCo knows on each system
    names = [name for name in (gl.ASKED, *here) if name]
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "model.xml").write_text(spec.to_xml())
        np.save(Path(folder, "qpos.npy"), qpos)
        for name in dict.fromkeys(names):
            command = [sys.executable, __file__, folder, *map(str, size)]
            done = subprocess.run(command, env=os.environ | {"MUJOCO_GL": name}, capture_output=True, check=False)
            if done.returncode == 0:
                if gl.ASKED and name != gl.ASKED:
                    print(f"MUJOCO_GL={gl.ASKED} does not work here: drew with {name}")
                gl.ASKED = name  # the next picture needs no search
                return [Image.fromarray(frame) for frame in np.load(Path(folder, "frames.npy"))]
    tried = ", ".join(names)
    print(f"no OpenGL here (tried {tried}): drawing stick figures; on Linux libosmesa6 gives real pictures")
    data = mujoco.MjData(model)
    return [stick_figure(model, data, q) for q in qpos]


def render(folder, width, height):
    """Draw the poses in qpos.npy of model.xml as frames.npy (n, height, width, 3); called in the second process."""
    model = mujoco.MjModel.from_xml_path(str(Path(folder, "model.xml")))
    data, frames = mujoco.MjData(model), []
    with mujoco.Renderer(model, int(height), int(width)) as renderer:
        for qpos in np.load(Path(folder, "qpos.npy")):
            place(model, data, qpos)
            renderer.update_scene(data, camera="track")
            frames.append(renderer.render().copy())
    np.save(Path(folder, "frames.npy"), np.array(frames))


def place(model, data, qpos):
    """Set a pose and compute the positions of bodies, cameras and lights."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def stick_figure(model, data, qpos):
    """Image of a pose from the right side: lines from bodies to their parents, and the ground."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    place(model, data, qpos)
    fig, ax = plt.subplots(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
    for body in range(2, model.nbody):
        a, b = data.xpos[model.body_parentid[body]], data.xpos[body]
        ax.plot([a[0], b[0]], [a[2], b[2]], "-o", color="0.3", lw=2, ms=2)
    for geom in np.flatnonzero((model.geom_group == 3) & (model.geom_bodyid > 0)):
        a, b = data.xpos[model.geom_bodyid[geom]], data.geom_xpos[geom]
        ax.plot([a[0], b[0]], [a[2], b[2]], "-", color="tab:red", lw=1)
    for x, _, z in data.site_xpos[model.site_bodyid == 0]:  # markers
        ax.plot(x, z, "o", color="tab:cyan", ms=6)
    ax.axhline(0, color="0.6")
    ax.set_xlim(qpos[0] - 0.9, qpos[0] + 0.9)
    ax.set_ylim(-0.1, 1.4)
    ax.set_aspect("equal")
    ax.axis("off")
    fig.canvas.draw()
    image = Image.fromarray(np.asarray(fig.canvas.buffer_rgba())[..., :3].copy())
    plt.close(fig)
    return image


if __name__ == "__main__":
    render(*sys.argv[1:])
