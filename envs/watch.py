"""Watch a policy live and steer it: `ppo_finetune.py --eval POLICY --viewer` in a window, `--web` in a browser.

One robot runs in real time on the task's own physics and noise. What a person sets on a slider or with a key is kept
in numpy, and the next step takes it from there.
"""

import os
import sys
import time

import jax
import mujoco
import numpy as np

from envs import records, render

PUSH = 1.0  # [m/s] change of the base's horizontal velocity
FIRST_LEVEL = 4  # of tasks that have levels
# >>> copy: keys (owner: results/play_onnx.py)
KEYS = {  # GLFW key codes, none of which the window uses itself -> which number of the command changes, and its sign
    265: (0, 1),  # up
    264: (0, -1),  # down
    ord("7"): (1, 1),
    ord("9"): (1, -1),
    263: (2, 1),  # left
    262: (2, -1),  # right
}


def pressed(key, command, low, high):
    """The command (3,) after a key: a twentieth of its range further, or 0 (as near as it goes) for the space bar."""
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
    """A robot that follows a policy, and a person who watches it."""

    def __init__(self, env, act, level=None):
        """act(state) -> action (A,); level, where the task has levels (None: FIRST_LEVEL)."""
        self.env, self.kick, self.paused, self.renew, self.resets = env, np.zeros(2), False, False, 0
        self.rng = np.random.default_rng(0)
        self.level = (FIRST_LEVEL if level is None else level) if hasattr(env, "at_level") else None
        self.low, self.high = np.array(list(env.COMMAND.values()) or np.zeros((0, 2))).T
        self.command = np.clip(0.0, self.low, self.high)

        def step(state, command, kick):
            state = env.tell(state, command) if env.COMMAND else state
            physics = state.physics.replace(qvel=state.physics.qvel.at[:2].add(kick))
            return env.step(state.replace(physics=physics), act(state))

        self.start = jax.jit(lambda key, curriculum: env.reset(key, curriculum=curriculum))
        self.advance = jax.jit(step)
        self.restart()
        self.model = render.build(env, self.state.physics).compile()
        self.data = mujoco.MjData(self.model)
        self.show()

    def restart(self):
        """A new episode, on a new course of the level."""
        self.resets += 1
        curriculum = None if self.level is None else self.env.at_level(self.level)
        self.state = self.start(jax.random.key(self.resets), curriculum)

    def tick(self):
        """One control step with what the person wants, or a new episode."""
        over = self.state.terminated or self.state.truncated
        if over or self.renew:
            self.renew = False
            self.restart()
        elif not self.paused:
            kick, self.kick = self.kick, np.zeros(2)
            self.state = self.advance(self.state, np.float32(self.command), np.float32(kick))

    def show(self):
        """Bring the picture's MjData up to the simulation."""
        physics = self.state.physics
        self.data.mocap_pos[:], self.data.mocap_quat[:] = physics.mocap_pos, physics.mocap_quat
        render.place(self.model, self.data, physics.qpos)

    def want(self, index, value):
        """Set one number of the command, within its range."""
        self.command[index] = np.clip(value, self.low[index], self.high[index])

    def push(self):
        angle = self.rng.uniform(0, 2 * np.pi)
        self.kick = PUSH * np.array([np.cos(angle), np.sin(angle)])

    def to_level(self, level):
        """Go on at another level, if the task has any."""
        if self.level is not None:
            self.level, self.renew = int(np.clip(level, 0, self.env.LEVELS - 1)), True

    def press(self, key):
        """A key of the window, by its GLFW code; see HELP."""
        if key == PUSH_KEY:
            self.push()
        elif key in LEVEL_KEYS:
            self.to_level((self.level or 0) + LEVEL_KEYS[key])
        elif self.env.COMMAND:
            self.command = pressed(key, self.command, self.low, self.high)


def play(robot, alive, draw):
    """Control steps in real time, or slower where the machine cannot, while alive()."""
    while alive():
        start = time.perf_counter()
        robot.tick()
        robot.show()
        draw()
        time.sleep(max(0.0, robot.env.dt - (time.perf_counter() - start)))


def window(robot):
    """MuJoCo's viewer, until it is closed. UserError where there is no display."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise records.UserError("--viewer needs a display; use --web, or --video FILE")
    import mujoco.viewer

    print(HELP)
    with mujoco.viewer.launch_passive(
        robot.model, robot.data, key_callback=robot.press, show_left_ui=False, show_right_ui=False
    ) as shown:
        follow(shown.cam)
        play(robot, shown.is_running, shown.sync)


def follow(camera):
    """Let the window's camera go with the robot."""
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1  # the first body after the world
    camera.distance, camera.azimuth, camera.elevation = 3.0, 120.0, -20.0


def browser(robot, port=8080, alive=lambda: True):
    """A page that shows the robot and its controls, until Ctrl-C. UserError if requirements-watch.txt is missing."""
    try:
        import mjviser
        import viser
    except ImportError:
        raise records.UserError("--web needs mjviser: pip install -r requirements-watch.txt") from None
    server = viser.ViserServer(port=port)
    scene = mjviser.ViserMujocoScene(server, robot.model, num_envs=1)
    add_controls(server.gui, robot)
    scene.create_scene_gui(camera_distance=3.0)
    try:
        play(robot, alive, lambda: scene.update_from_mjdata(robot.data))
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


def add_controls(gui, robot):
    """Sliders for the command and the level, and buttons."""
    for i, (name, (low, high)) in enumerate(robot.env.COMMAND.items()):
        slider = gui.add_slider(name, low, high, step=0.05, initial_value=float(robot.command[i]))
        slider.on_update(lambda event, i=i: robot.want(i, event.target.value))
    if robot.level is not None:
        level = gui.add_slider("level", 0, robot.env.LEVELS - 1, step=1, initial_value=robot.level)
        level.on_update(lambda event: robot.to_level(event.target.value))
    pause = gui.add_checkbox("pause", initial_value=False)
    pause.on_update(lambda event: setattr(robot, "paused", event.target.value))
    gui.add_button("push").on_click(lambda _: robot.push())
    gui.add_button("start again").on_click(lambda _: setattr(robot, "renew", True))
