"""The OpenGL that MUJOCO_GL asks for, taken out of the environment before MuJoCo loads.

MuJoCo cannot be imported where that one does not work. Only pictures need it, and render.py draws in a second process.
In the same way matplotlib cannot be imported with some values of MPLBACKEND; figures are only written to files.
"""

import logging
import os

ASKED = os.environ.pop("MUJOCO_GL", "").strip().lower()
os.environ["MPLBACKEND"] = "agg"
logging.getLogger("matplotlib").setLevel(logging.ERROR)  # no word on a HOME that it cannot write
