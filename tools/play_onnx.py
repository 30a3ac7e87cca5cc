"""Drive a robot in plain MuJoCo with an exported policy: without JAX, as on the robot's own computer.

    python play.py results/tasks/go1_robust/policy.msgpack --export go1.onnx
    python tools/play_onnx.py go1.onnx --command 0.8 0 0 --seconds 10
    python tools/play_onnx.py go1.onnx --viewer

It works for the locomotion tasks and needs mujoco, numpy, tyro and onnxruntime. In the window of --viewer, arrow keys
change the forward velocity and the turning rate, 7 and 9 the sideways velocity, and the space bar stops.
"""

import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.pop("MUJOCO_GL", None)  # with some values MuJoCo does not load; a window needs none

import mujoco
import numpy as np
import tyro

ROOT = Path(__file__).resolve().parent.parent


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


@dataclass(frozen=True)
class Args:
    policy: tyro.conf.Positional[str]  # ONNX file of play.py --export
    command: tuple[float, float, float] = (0.5, 0.0, 0.0)  # forward, sideways [m/s], turning [rad/s]
    seconds: float = 20.0  # without --viewer
    viewer: bool = False  # watch and steer in a window


class Player:
    """One robot on a plane, its policy, and the history that the policy takes and returns."""

    def __init__(self, path):
        import onnxruntime

        self.session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        facts = self.session.get_modelmeta().custom_metadata_map
        self.facts = {name: json.loads(value) for name, value in facts.items()}
        self.pose = np.array(self.facts["default_pose"])
        trained = self.facts.get("command_ranges", dict.fromkeys("xyz", (-1.0, 1.0)))  # older files do not say
        ranges = np.array([*trained.values()]).reshape(-1, 2)  # none for a task without commands
        self.low, self.high = ranges.T  # of the command: m/s, m/s, rad/s
        self.shapes = {given.name: given.shape for given in self.session.get_inputs()}
        spec = self.spec()
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        self.ground = spec.worldbody.add_geom(type=plane, size=[0, 0, 0.1], contype=0, conaffinity=1)
        spec.worldbody.add_light(pos=[0, 0, 3])
        self.model = spec.compile()
        self.set_gains()
        self.data = mujoco.MjData(self.model)
        self.decimation = max(round(self.facts["dt"] / self.model.opt.timestep), 1)
        self.model.opt.timestep = self.facts["dt"] / self.decimation
        self.stand()

    def spec(self):
        """MjSpec of the robot: of assets, or what the policy file holds of a robot that was loaded from a file."""
        if "mjcf" in self.facts:
            return mujoco.MjSpec.from_string(self.facts["mjcf"])
        path = ROOT / f"assets/{self.facts['robot']}.xml"
        if not path.exists():
            raise FileNotFoundError(f"{path} is missing; this script belongs into tools/ of a checkout")
        return mujoco.MjSpec.from_file(str(path))

    def set_gains(self):
        """Give the motors the gains and limits of the policy file, whatever the MJCF has."""
        m, f = self.model, self.facts
        for name, kp, kd, limit in zip(f["joints"], f["kp"], f["kd"], f["torque_limit"], strict=True):
            motor = int(np.flatnonzero(m.actuator_trnid[:, 0] == m.joint(name).id)[0])
            m.actuator_gainprm[motor, 0], m.actuator_biasprm[motor, :3] = kp, (0.0, -kp, 0.0)
            m.actuator_forcerange[motor] = -limit, limit
            m.dof_damping[m.joint(name).dofadr] = kd

    def stand(self):
        """Put the robot into its default pose, feet on the ground."""
        m, d = self.model, self.data
        mujoco.mj_resetData(m, d)
        d.qpos[:7], d.qpos[7:] = (0, 0, 1, 1, 0, 0, 0), self.pose
        mujoco.mj_kinematics(m, d)
        solid, far = np.flatnonzero(m.geom_contype), 10.0
        d.qpos[2] -= min(mujoco.mj_geomDistance(m, d, self.ground.id, i, far, None) for i in solid)
        mujoco.mj_forward(m, d)
        self.history, self.seconds = None, 0.0

    def readings(self, command):
        """Inputs of the policy by name, in SI units and the base frame."""
        d, turn = self.data, np.zeros(9)
        angle = 2 * np.pi * self.facts.get("gait_hz", 0.0) * self.seconds
        moves = self.facts.get("march", False) or np.hypot(*command[:2]) > 0.1 or abs(command[2]) > 0.1
        mujoco.mju_quat2Mat(turn, d.qpos[3:7])
        down = turn.reshape(3, 3).T
        return {
            "lin_vel": down @ d.qvel[:3],
            "ang_vel": d.qvel[3:6],
            "gravity": down @ [0, 0, -1],
            "command": np.asarray(command),
            "joint_pos": d.qpos[7:],
            "joint_vel": d.qvel[6:],
            "phase": np.array([np.sin(angle), np.cos(angle)]) * moves,  # of policies with a gait clock
        }

    def step(self, command):
        """Make one control step. Returns the action (A,)."""
        read = self.readings(command)
        if self.history is None:
            x = np.concatenate([(read | {"joint_pos": read["joint_pos"] - self.pose})[n] for n in self.facts["prop"]])
            past = np.zeros(self.shapes["action_history"][1:])
            self.history = {"prop_history": np.tile(x, (self.facts["history"], 1)), "action_history": past}
        values = read | self.history
        feed = {name: np.float32(values[name])[None] for name in self.shapes}
        action, target, prop, past = (out[0] for out in self.session.run(None, feed))
        self.history = {"prop_history": prop, "action_history": past}
        self.seconds += self.facts["dt"]
        self.data.ctrl[:] = target
        for _ in range(self.decimation):
            mujoco.mj_step(self.model, self.data)
        return action

    def fallen(self):
        """True if the trunk is tilted by more than 60 degrees."""
        return self.readings((0, 0, 0))["gravity"][2] > -0.5


def watch(player, command):
    """Show the robot in a window and take its command from the keys, until it is closed."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        fail("--viewer needs a display; leave it out to print how the robot moved")
    import mujoco.viewer

    wanted = np.array(command, float)

    def press(key):
        wanted[:] = pressed(key, wanted, player.low, player.high)

    try:
        opened = mujoco.viewer.launch_passive(player.model, player.data, key_callback=press)
    except RuntimeError as error:  # on macOS: it wants mjpython in place of python
        fail(f"--viewer: {error}")
    with opened as window:
        while window.is_running():
            start = time.perf_counter()
            player.step(wanted)
            if player.fallen():
                player.stand()
            window.sync()
            time.sleep(max(0.0, player.facts["dt"] - (time.perf_counter() - start)))


def walk(player, command, seconds):
    """Follow one command. Returns the mean velocity (forward, sideways, turning) in the base frame, and falls."""
    velocities, falls = [], 0
    for _ in range(round(seconds / player.facts["dt"])):
        player.step(command)
        read = player.readings(command)
        velocities.append([*read["lin_vel"][:2], read["ang_vel"][2]])
        if player.fallen():
            falls += 1
            player.stand()
    return np.mean(velocities[len(velocities) // 4 :], axis=0), falls


def fail(text):
    """Print one line and exit with code 2."""
    print(f"error: {text}", file=sys.stderr)
    sys.exit(2)


def open_player(path):
    """The Player of a policy file, or one line and exit code 2."""
    try:
        player = Player(path)
    except ImportError:
        fail("onnxruntime is missing: pip install onnxruntime")
    except FileNotFoundError as error:
        fail(str(error))
    except Exception:  # onnxruntime has no common error class
        fail(f"{path} is not a policy; write one with play.py POLICY --export FILE")
    unknown = player.shapes.keys() - player.readings(np.zeros(3)).keys() - {"prop_history", "action_history"}
    if unknown:
        fail(f"{path} reads {', '.join(sorted(unknown))}, which only the environments of this project provide")
    if "phase" in player.shapes and "gait_hz" not in player.facts:
        fail(f"{path} has a gait clock, but its metadata lack gait_hz; export it anew")
    return player


def main(args):
    """Drive the robot, in a window or for some seconds. Bad input gets one line and exit code 2."""
    if not 0.1 <= args.seconds <= 3600:
        fail(f"--seconds must be from 0.1 to 3600, not {args.seconds}")
    player = open_player(args.policy)
    if args.viewer:
        return watch(player, args.command)
    if (outside := np.clip(args.command, player.low, player.high) != args.command).any():
        wide = ", ".join(f"{low:g} to {high:g}" for low, high in zip(player.low, player.high, strict=True))
        print(f"the training had commands of {wide}; number {np.flatnonzero(outside)[0] + 1} is outside")
    velocity, falls = walk(player, args.command, args.seconds)
    print(f"commanded {np.round(args.command, 2)}, moved {np.round(velocity, 2)} [m/s, m/s, rad/s], {falls} falls")
    return None


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except KeyboardInterrupt:
        sys.exit("interrupted")
