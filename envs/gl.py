"""The OpenGL that MUJOCO_GL asks for, taken out of the environment before MuJoCo loads.

MuJoCo cannot be imported where that one does not work. Only pictures need it, and render.py draws in a second process.
"""

import os

ASKED = os.environ.pop("MUJOCO_GL", "").strip().lower()
