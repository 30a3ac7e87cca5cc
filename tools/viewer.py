"""Watch a policy live and steer it: `play.py POLICY --viewer` in a window, `--web` in a browser.

One robot runs in real time with the task's own physics and noise. Sliders and keys set numpy values, which the next
control step reads.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time

import jax
import mujoco
import numpy as np

from envs import render
from experiment import records

PUSH = 1.0  # [m/s] change of the base's horizontal velocity
FIRST_LEVEL = 4  # of tasks that have levels


# >>> copy: keys (owner: tools/play_onnx.py)
KEYS = {  # GLFW key codes, none of which the window uses itself -> index of a number of the command, and its sign
    265: (0, 1),  # up
    264: (0, -1),  # down
    ord("7"): (1, 1),
    ord("9"): (1, -1),
    263: (2, 1),  # left
    262: (2, -1),  # right
}


def pressed(key, command, low, high):
    """The command (3,) after a key: a twentieth of its range further; for the space bar 0, or the nearest in range."""
    change = np.zeros(len(command))
    if key in KEYS:
        index, side = KEYS[key]
        change[index] = side * (high[index] - low[index]) / 20
    return np.clip(command * (key != ord(" ")) + change, low, high)


# <<< copy: keys


PUSH_KEY, LEVEL_KEYS = 257, {266: 1, 267: -1}  # enter; page up and down
HELP = """up, down: forward and back   7, 9: to the left and right   left, right: turn   space: stop
enter: push   page up, down: level"""


class Watched:
    """A robot that follows a policy, and the controls of a person who watches it."""

    def __init__(self, env, act, level=None):
        """act(state) -> action (A,). level: of a task that has levels; None: FIRST_LEVEL."""
        self.env, self.paused, self.restart_due, self.episodes = env, False, False, 0
        self.kick, self.rng = np.zeros(2), np.random.default_rng(0)
        self.level = (FIRST_LEVEL if level is None else level) if env.LEVELS else None
        self.low, self.high = np.array(list(env.COMMAND_RANGES.values()) or np.zeros((0, 2))).T
        self.command = np.clip(0.0, self.low, self.high)

        def step(state, command, kick):
            state = env.with_command(state, command) if env.COMMAND_RANGES else state
            physics = state.physics.replace(qvel=state.physics.qvel.at[:2].add(kick))
            return env.step(state.replace(physics=physics), act(state))

        self.jitted_reset = jax.jit(lambda key, curriculum: env.reset(key, curriculum=curriculum))
        self.jitted_step = jax.jit(step)
        self.restart()
        self.jitted_step(self.state, np.float32(self.command), np.float32(self.kick))  # compiles, before one can watch
        self.model = render.build(env, self.state.physics).compile()
        self.data = mujoco.MjData(self.model)
        self.update_picture()

    def restart(self):
        """Start a new episode, on a new course of the level."""
        self.episodes += 1
        curriculum = None if self.level is None else self.env.at_level(self.level)
        self.state = self.jitted_reset(jax.random.key(self.episodes), curriculum)

    def step(self):
        """Make one control step with the person's command, or start a new episode if this one is over."""
        over = self.state.terminated or self.state.truncated
        if over or self.restart_due:
            self.restart_due = False
            self.restart()
        elif not self.paused:
            kick, self.kick = self.kick, np.zeros(2)
            self.state = self.jitted_step(self.state, np.float32(self.command), np.float32(kick))

    def update_picture(self):
        """Copy the simulation's poses to the MjData that is drawn."""
        physics = self.state.physics
        self.data.mocap_pos[:], self.data.mocap_quat[:] = physics.mocap_pos, physics.mocap_quat
        render.place(self.model, self.data, physics.qpos)

    def set_command(self, index, value):
        """Set one number of the command, within its range."""
        self.command[index] = np.clip(value, self.low[index], self.high[index])

    def push(self):
        """Push the robot in a random direction in the next step."""
        angle = self.rng.uniform(0, 2 * np.pi)
        self.kick = PUSH * np.array([np.cos(angle), np.sin(angle)])

    def set_level(self, level):
        """Restart at another level, if the task has any."""
        if self.level is not None:
            self.level, self.restart_due = int(np.clip(level, 0, self.env.LEVELS - 1)), True

    def press(self, key):
        """Handle a key of the window by its GLFW code; see HELP."""
        if key == PUSH_KEY:
            self.push()
        elif key in LEVEL_KEYS:
            self.set_level((self.level or 0) + LEVEL_KEYS[key])
        elif self.env.COMMAND_RANGES:
            self.command = pressed(key, self.command, self.low, self.high)


@contextlib.contextmanager
def until_interrupted():
    """Yield a function: True until Ctrl-C or SIGTERM. A second one interrupts at once.

    The exception of a first one could strike, and be lost, inside a callback of JAX or of the server.
    """
    signals, stopped = (signal.SIGINT, signal.SIGTERM), threading.Event()

    def stop(number, _):
        stopped.set()
        signal.signal(number, signal.default_int_handler)

    previous = {number: signal.signal(number, stop) for number in signals}
    try:
        yield lambda: not stopped.is_set()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def run(robot, running, draw):
    """Make control steps in real time, or slower if the machine cannot, while running()."""
    while running():
        start = time.perf_counter()
        robot.step()
        robot.update_picture()
        draw()
        time.sleep(max(0.0, robot.env.dt - (time.perf_counter() - start)))


def window(robot):
    """Show the robot in MuJoCo's viewer, until it is closed or Ctrl-C. UserError if there is no display."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise records.UserError("--viewer needs a display; use --web, or --video FILE")
    import mujoco.viewer

    print(HELP)
    options = {"key_callback": robot.press, "show_left_ui": False, "show_right_ui": False}
    try:
        opened = mujoco.viewer.launch_passive(robot.model, robot.data, **options)
    except RuntimeError as error:  # on macOS: it wants mjpython in place of python
        raise records.UserError(f"--viewer: {error}; or use --web") from None
    with until_interrupted() as wanted, opened as viewer:
        follow(viewer.cam)
        run(robot, lambda: wanted() and viewer.is_running(), viewer.sync)


def follow(camera):
    """Make the window's camera track the robot."""
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1  # the first body after the world
    camera.distance, camera.azimuth, camera.elevation = 3.0, 120.0, -20.0


def browser(robot, host="127.0.0.1", port=8080, running=lambda: True):
    """Serve a page with the robot and its controls, until Ctrl-C.

    If the port is taken, the next free one is used. UserError if requirements-watch.txt is not installed.
    """
    try:
        import mjviser
        import viser
    except ImportError:
        raise records.UserError("--web needs mjviser: pip install -r requirements-watch.txt") from None
    check_address(host, port)
    server = viser.ViserServer(host, port)
    other = f" (port {port} is taken)" if server.get_port() != port else ""
    try:
        with until_interrupted() as wanted:
            print(f"open http://{host}:{server.get_port()} in a browser{other}; Ctrl-C ends", flush=True)
            scene = mjviser.ViserMujocoScene(server, robot.model, num_envs=1)
            add_controls(server.gui, robot)
            scene.create_scene_gui(camera_distance=3.0)
            run(robot, lambda: wanted() and running(), lambda: scene.update_from_mjdata(robot.data))
    finally:
        server.stop()


def check_address(host, port):
    """UserError unless this machine can listen on the address: viser would wait for ever."""
    if not 0 < port < 2**16:
        raise records.UserError(f"--port must be within 1 and {2**16 - 1}, not {port}")
    try:
        family, *_, address = socket.getaddrinfo(host, None)[0]
        socket.create_server((address[0], 0), family=family).close()
    except (OSError, UnicodeError) as error:
        raise records.UserError(f"cannot listen on --host {host}: {error}") from None


def add_controls(gui, robot):
    """Add sliders for the command and the level, and buttons."""
    for i, (name, (low, high)) in enumerate(robot.env.COMMAND_RANGES.items()):
        slider = gui.add_slider(name, low, high, step=0.05, initial_value=float(robot.command[i]))
        slider.on_update(lambda event, i=i: robot.set_command(i, event.target.value))
    if robot.level is not None:
        level = gui.add_slider("level", 0, robot.env.LEVELS - 1, step=1, initial_value=robot.level)
        level.on_update(lambda event: robot.set_level(event.target.value))
    pause = gui.add_checkbox("pause", initial_value=False)
    pause.on_update(lambda event: setattr(robot, "paused", event.target.value))
    gui.add_button("push").on_click(lambda _: robot.push())
    gui.add_button("start again").on_click(lambda _: setattr(robot, "restart_due", True))
