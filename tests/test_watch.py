"""A person's commands reach the robot, in a window or a browser; films and TensorBoard files are written."""

import csv
import dataclasses
import io
import shutil
import signal
import socket
import struct
import subprocess
import sys
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco.viewer
import numpy as np
import pytest
from PIL import Image

import envs
import play
import ppo_finetune
from envs import render
from experiment import records
from tools import viewer

ROOT = Path(__file__).resolve().parent.parent
WALKER = ROOT / "results/tasks/go1_loco/policy.msgpack"
ARGS = play.Args(str(WALKER))


def stand(state):
    return jnp.zeros_like(state.action)


@pytest.fixture(scope="module")
def walker():
    """The recorded Go1, watched."""
    env, net, params, _ = play.load_policy(WALKER, "c")
    return viewer.Watched(env, lambda s: net.apply(params, {"obs": s.obs}, method=net.mean))


@pytest.fixture(scope="module")
def climber():
    return viewer.Watched(envs.make("anymal_climb_up", "c", rough=0.0), stand, level=2)


@pytest.mark.parametrize(("task", "block"), [("go1_loco", "command"), ("anymal_pedipulation", "target")])
def test_a_command_changes_the_task_and_its_part_of_the_observation(task, block, jitted):
    """The observation shows the command, and is otherwise the same."""
    env = jitted(task).env
    before = jax.jit(env.reset)(jax.random.key(0))
    wanted = np.array([0.3, -0.2, 0.1])
    after, where = env.with_command(before, jnp.asarray(wanted)), env.obs_slices()[block]
    changed = np.flatnonzero(np.asarray(before.obs != after.obs))
    assert changed.size and set(changed) <= set(range(len(before.obs))[where])
    shown = np.asarray(after.obs[where]) / np.array(env.OBS[block][1])
    if task == "anymal_pedipulation":  # a point of the world, seen from a base that stands level
        yaw = float(2 * np.arctan2(before.physics.qpos[6], before.physics.qpos[3]))
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        wanted = turn @ (wanted - np.asarray(before.physics.qpos[:3]))
    np.testing.assert_allclose(shown, wanted, atol=1e-5)


@pytest.mark.parametrize(("command", "slowest", "fastest"), [(0.8, 0.55, 1.05), (0.0, -0.1, 0.1)])
def test_the_robot_goes_where_it_is_told(walker, command, slowest, fastest):
    """From each of four starts; forward within 0.25 m/s."""
    motion = jax.jit(walker.env.motion)
    for _ in range(4):
        walker.restart()
        walker.set_command(0, command)
        speeds = []
        for _ in range(120):
            walker.step()
            speeds.append(float(motion(walker.state.physics).lin_vel[0]))
        assert int(walker.state.clock) == 120, "it fell"
        assert slowest < np.mean(speeds[60:]) < fastest, np.mean(speeds[60:])
    walker.update_picture()
    np.testing.assert_allclose(walker.data.xpos[1], walker.state.physics.qpos[:3], atol=1e-6)


def test_keys(walker):
    walker.press(ord(" "))
    assert not walker.command.any()
    for key in (265, 265, 263, ord("9")):
        walker.press(key)
    np.testing.assert_allclose(walker.command, [0.2, -0.1, 0.1])
    for _ in range(30):
        walker.press(264)
    assert walker.command[0] == -1.0, "within its range"
    before = np.asarray(walker.state.physics.qvel)
    walker.press(viewer.PUSH_KEY)
    assert np.hypot(*walker.kick) == pytest.approx(viewer.PUSH)
    walker.step()
    assert not walker.kick.any() and np.hypot(*(walker.state.physics.qvel - before)[:2]) > 0.3


def test_levels(climber):
    def top():
        return float(np.max(climber.state.physics.mocap_pos[:, 2] + climber.env.half[:, 2]))

    heights = []
    for level in (2, 9, 99):
        climber.set_level(level)
        climber.step()
        assert int(climber.state.task.level) == min(level, 9)
        heights.append(top())
    climber.press(267)
    climber.step()
    assert int(climber.state.task.level) == 8 and heights[0] < heights[1]
    climber.paused, clock = True, int(climber.state.clock)
    climber.step()
    assert int(climber.state.clock) == clock
    climber.paused = False
    climber.step()
    assert int(climber.state.clock) == clock + 1
    climber.update_picture()
    np.testing.assert_allclose(climber.data.mocap_pos, climber.state.physics.mocap_pos, atol=1e-6)


class Gui:
    """A stand-in for viser's, which remembers the callback of each control."""

    def __init__(self):
        self.callbacks = {}

    def control(self, name, *_, **__):
        return SimpleNamespace(**dict.fromkeys(("on_update", "on_click"), lambda do: self.callbacks.update({name: do})))

    add_slider = add_checkbox = add_button = control

    def use(self, name, value=None):
        self.callbacks[name](SimpleNamespace(target=SimpleNamespace(value=value)))


def test_controls_of_the_page(walker, climber):
    gui = Gui()
    viewer.add_controls(gui, walker)
    assert "level" not in gui.callbacks
    gui.use("turning [rad/s]", 0.7)
    gui.use("pause", True)
    assert walker.command[2] == 0.7 and walker.paused
    gui.use("pause", False)
    gui.use("start again")
    walker.step()
    assert int(walker.state.clock) == 0
    gui = Gui()
    viewer.add_controls(gui, climber)
    gui.use("level", 7)
    climber.step()
    assert int(climber.state.task.level) == 7 and not climber.env.COMMAND_RANGES


@pytest.fixture
def port():
    """A free port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_the_page_is_served(walker, port, capsys):
    """Needs requirements-watch.txt: the page answers while the robot walks on."""
    pytest.importorskip("mjviser")
    start, pages = int(walker.state.clock), []

    def running():
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=120) as page:
            pages.append(page.read())
        return len(pages) < 4

    viewer.browser(walker, port=port, running=running)
    assert b"<html" in pages[0].lower() and int(walker.state.clock) == start + 3
    assert f"open http://127.0.0.1:{port} in a browser; Ctrl-C ends" in capsys.readouterr().out


def test_an_interrupt_is_not_lost():
    """Even where Python swallows exceptions, as in a finalizer; a second one interrupts at once."""

    class Swallowing:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with viewer.until_interrupted() as wanted:
        assert wanted()
        Swallowing()
        assert not wanted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_two_pages_are_served_at_once(port):
    """Needs requirements-watch.txt: the second --web takes another port and prints it; Ctrl-C ends both."""
    pytest.importorskip("mjviser")
    command = [sys.executable, "play.py", str(WALKER), "--web", "--engine", "c", "--port", str(port)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    processes = [subprocess.Popen(command, cwd=ROOT, **pipes) for _ in range(2)]
    try:
        lines = [next(line for line in process.stdout if line.startswith("open ")) for process in processes]
        urls = [line.split()[1] for line in lines]
        assert f"http://127.0.0.1:{port}" in urls and len({*urls}) == 2
        assert sum(f"(port {port} is taken)" in line for line in lines) == 1
        for url in urls:
            with urllib.request.urlopen(url, timeout=120) as page:
                assert b"<html" in page.read().lower()
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
    assert [process.wait(300) for process in processes] == [0, 0]


def test_addresses():
    viewer.check_address("127.0.0.1", 8080)
    viewer.check_address("localhost", 8080)
    for host, port, words in (("192.0.2.1", 8080, "--host 192.0.2.1"), ("127.0.0.1", 70000, "--port must be within")):
        with pytest.raises(records.UserError, match=words):
            viewer.check_address(host, port)


def test_what_cannot_be_watched_is_refused(refused, monkeypatch):
    def change(**changes):
        return dataclasses.replace(ARGS, **changes)

    monkeypatch.setitem(sys.modules, "mjviser", None)
    refused(play.main, change(web=True), "requirements-watch.txt")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    refused(play.main, change(viewer=True), "needs a display", "--web")
    refused(play.main, change(viewer=True, web=True), "--viewer and --web")
    refused(play.main, change(web=True, level=3), "no level")


def test_a_window_that_does_not_open_is_one_line(walker, monkeypatch):
    """As on macOS with plain python."""

    def launch(*_, **__):
        raise RuntimeError("it must be run under `mjpython` on macOS")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    with pytest.raises(records.UserError, match="`mjpython` on macOS; or use --web"):
        viewer.window(walker)


def test_films(tmp_path, monkeypatch, capsys):
    """Twenty seconds, 25 frames each second, as a GIF; an MP4 where ffmpeg is."""
    drawn = []

    def draw(spec, qpos, size):
        drawn.append(np.asarray(qpos))
        return [Image.new("RGB", size, (i % 255, 0, 0)) for i in range(len(qpos))]

    monkeypatch.setattr("envs.render.draw", draw)
    kinds = [".gif"] + ([".mp4"] if shutil.which("ffmpeg") else [])
    for kind in kinds:
        path = tmp_path / f"new/walk{kind}"
        play.main(dataclasses.replace(ARGS, video=str(path)))
        assert f"wrote {path}" in capsys.readouterr().out and path.stat().st_size > 1000
    with Image.open(tmp_path / "new/walk.gif") as gif:
        assert gif.n_frames == len(drawn[0]) == 500 and gif.info["duration"] == 40
    assert drawn[0][-1][0] - drawn[0][0][0] > 10, "it walked"


@pytest.mark.parametrize("shade", [30, 110, 240])
def test_time_and_title_can_be_read_on_dark_and_light_pictures(shade):
    """White letters with a black edge, in the upper and lower left corners alone."""
    image = Image.new("RGB", (320, 240), (shade,) * 3)
    render.stamp(image, "1.20 s", "level 4, PIDM pretrained")
    grey = np.asarray(image.convert("L")).astype(int)
    for corner in (grey[:24, :60], grey[-24:, :200]):
        assert corner.max() > 250 and corner.min() < 5 and (np.abs(corner - shade) > 100).mean() > 0.05
    assert (grey[24:-24] == shade).all() and (grey[:, 240:] == shade).all()
    bare = Image.new("RGB", (320, 240), (shade,) * 3)
    render.stamp(bare, "1.20 s", "")
    assert (np.asarray(bare)[24:] == shade).all(), "no title"


def test_a_film_of_parkour_shows_title_goal_and_end(jitted, monkeypatch):
    """The strip's last frame is within 0.2 s of the end, the robot's picture is close, and the goal a sphere."""
    seen, stamps = {}, []

    def draw(spec, qpos):
        seen.update(spec=spec, steps=qpos[:, 0])
        return [Image.new("RGB", (render.WIDTH, render.HEIGHT)) for _ in qpos]

    monkeypatch.setattr(render, "draw", draw)
    monkeypatch.setattr(render, "stamp", lambda _, *words: stamps.append(words))
    env = jitted("anymal_climb_up").env
    state = jax.jit(env.reset)(jax.random.key(0))
    qpos = np.tile(state.physics.qpos, (env.episode_steps, 1))
    qpos[:, 0] = np.arange(env.episode_steps)
    goal = env.markers(state.task)
    made = render.film(env, qpos, state.physics, title="level 4, MLP", markers=goal, **env.FILM_WINDOW)
    sheet = Image.open(io.BytesIO(made["rollout.png"]))
    assert sheet.size == (5 * render.WIDTH, 2 * render.HEIGHT), "ten frames"
    assert {title for _, title in stamps} == {"level 4, MLP"} and ("0.40 s", "level 4, MLP") in stamps
    assert env.episode_steps - 10 < seen["steps"].max() < env.episode_steps - 1, "the last step shows the next episode"
    model = seen["spec"].compile()
    (site,) = np.flatnonzero(model.site_bodyid == 0)
    np.testing.assert_allclose(model.site_pos[site], state.task.goal, atol=1e-6)
    assert model.camera("track").fovy[0] < render.build(env, state.physics).compile().camera("track").fovy[0]


def test_a_film_ends_with_its_episode(jitted):
    """Legs that give way end it at once. The pose stays that of the fall, whatever the next episodes do."""
    env = jitted("go1_loco", noise=0.0, episode_seconds=2.0).env
    flat = 40.0 * jnp.tile(jnp.array([0.0, 1.0, 1.0]), 4)
    net = SimpleNamespace(inputs=lambda obs, _: obs, apply=lambda _, obs, method: jnp.tile(flat, (len(obs), 1)), mean=0)
    result, start, qpos = jax.jit(lambda: play.evaluate(env, net, None, 2))()
    fall = round(float(result["episode_seconds"]) / env.dt)
    assert result["falls"] == 1 and 3 < fall < len(qpos) / 2
    last = np.flatnonzero(np.any(np.diff(qpos, axis=0), axis=1)).max() + 1
    assert 3 < last < len(qpos) / 2 and qpos[-1, 2] < start.physics.qpos[2] - 0.03


def test_markers_are_what_the_robot_is_told_to_reach(jitted):
    """Pedipulation's is the commanded point, which the showcase holds fixed; a walker has none."""
    env = jitted("anymal_pedipulation", **envs.TASKS["anymal_pedipulation"][0].SHOWCASE_FIELDS).env
    state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_allclose(env.markers(state.task), [[0.7, -0.2, 0.5]], atol=1e-6)
    walker = jitted("go1_loco").env
    assert walker.markers(None).shape == (0, 3)


def test_films_that_cannot_be_written(tmp_path, refused, monkeypatch):
    def check(name, *words):
        refused(play.main, dataclasses.replace(ARGS, video=str(tmp_path / name)), *words)

    check("a.avi", "must end in .gif or .mp4")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    check("a.mp4", "ffmpeg")


def scalars(path):
    """Values of an event file by (step, name). It is a series of a length, its checksum, a message and its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    blob, found = path.read_bytes(), {}
    while blob:
        (size,) = struct.unpack("<Q", blob[:8])
        event = Event.FromString(blob[12 : 12 + size])
        found |= {(event.step, value.tag): value.simple_value for value in event.summary.value}
        blob = blob[16 + size :]
    return found


def test_tensorboard_has_every_row(tmp_path):
    """Needs requirements-watch.txt."""
    pytest.importorskip("tensorboardX")
    args = ppo_finetune.Args(preset="smoke", run_dir=str(tmp_path), tensorboard=True)
    ppo_finetune.main(args)
    (path,) = tmp_path.glob("events.out.tfevents.*")
    found = scalars(path)
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    want = {(int(float(row["env_steps"])), name): float(value) for row in rows for name, value in row.items()}
    assert found.keys() == want.keys() and len(rows) == 2
    np.testing.assert_allclose([found[key] for key in want], list(want.values()), rtol=1e-5)
    ppo_finetune.main(dataclasses.replace(args, tensorboard=False, force=True))
    assert not list(tmp_path.glob("events.*")), "the files of the run that was overwritten are gone"


def test_tensorboard_without_its_package_loses_nothing(tmp_path, refused, monkeypatch):
    args = ppo_finetune.Args(preset="smoke", run_dir=str(tmp_path))
    (tmp_path / "metrics.csv").write_text("iteration\n1\n")
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    refused(ppo_finetune.main, dataclasses.replace(args, tensorboard=True, force=True), "requirements-watch.txt")
    assert (tmp_path / "metrics.csv").read_text() == "iteration\n1\n"
