"""Picture of every parkour skill at levels 0, 4 and 9: the robot at the start, its height and ceiling scans as dots.

    python tools/courses.py

Writes results/courses.png.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from PIL import ImageDraw

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from envs import parkour, render, terrain
from experiment import devices, records

LEVELS = (0, 4, 9)


def dots(spec, points, rgba):
    """Add small spheres at points (P, 3)."""
    for point in np.asarray(points, np.float64):
        spec.worldbody.add_site(pos=point, size=[0.015, 0.015, 0.015], rgba=rgba)


def picture(env, level, key):
    """Draw the start of one episode of a level with the robot's noise-free scans. Returns an Image."""
    state = env.reset(key, curriculum=env.at_level(level))
    motion, task = env.motion(state.physics), state.task.replace(shift=jnp.zeros(3))
    spec = render.build(env, state.physics)
    xy = env.grid(parkour.HEIGHT_GRID, motion, task)
    ground = env.ground_height(motion, xy)
    dots(spec, jnp.concatenate([xy, ground[:, None]], -1), [0.9, 0.2, 0.1, 1])
    if env.overhead.any():
        xy = env.grid(parkour.CEILING_GRID, motion, task)
        under = terrain.underside_heights(motion.mocap_pos[env.overhead], env.half[env.overhead], xy)
        near = np.asarray(under - motion.base_pos[2] < 1.0)
        dots(spec, jnp.concatenate([xy, under[:, None]], -1)[near], [0.1, 0.3, 0.9, 1])
    return render.draw(spec, np.asarray(state.physics.qpos, np.float64)[None])[0]


def main():
    """Draw every skill at the levels, into results/courses.png."""
    devices.find()
    tasks = [task for task, (family, _) in envs.TASKS.items() if family is parkour.Parkour]
    images = []
    for task in tasks:
        env = envs.make(task, "c", noise=0.0, rough=0.0)
        for level in LEVELS:
            images.append(picture(env, level, jax.random.key(3)))
            ImageDraw.Draw(images[-1]).text((6, 4), f"{task}, level {level}", fill=(20, 20, 20))
    records.replace_bytes(ROOT / "results/courses.png", render.sheet(images, len(LEVELS)))
    print("wrote results/courses.png")


if __name__ == "__main__":
    with records.one_line_errors():
        tyro.cli(main, description=__doc__)
