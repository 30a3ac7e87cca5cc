"""The world a run lives in: its variables, PATH, cores, folders, disk, terminal and neighbours."""

import contextlib
import csv
import dataclasses
import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import jax
import matplotlib
import numpy as np
import pytest

import envs
import play
import ppo_finetune as script
import pretrain_pidm
from envs import engine, gl, render
from experiment import checkpoints, dataset, devices, figures, records, run
from results import tables

ROOT = Path(__file__).resolve().parent.parent
SMOKE = script.Args(preset="smoke")
STRANGE = {  # each of these once ended a training, or changed its numbers
    "PATH": "/nonexistent",
    "HOME": "/proc/home",
    "XDG_CACHE_HOME": "/proc/cache",
    "XDG_CONFIG_HOME": "/proc/config",
    "TMPDIR": "/nonexistent",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONIOENCODING": "ascii",
    "MUJOCO_GL": "wgl",
    "MPLBACKEND": "none",
    "JAX_ENABLE_X64": "1",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
    "JAX_DEFAULT_PRNG_IMPL": "rbg",
    "JAX_THREEFRY_PARTITIONABLE": "0",
}
needs_locks = pytest.mark.skipif(not records.fcntl, reason="no file locks on this system")
needs_git = pytest.mark.skipif(not shutil.which("git"), reason="no git on this machine")
# For git in a test: not the repository that calls the tests from a hook, nor a user's settings, such as signing.
PLAIN_GIT = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
PLAIN_GIT |= {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_NOSYSTEM": "1"}


@pytest.fixture(scope="module")
def written():
    """Paths of the project that this process opened to write, from here on."""
    paths, here = [], f"{ROOT}{os.sep}"

    def hook(event, args):
        if event == "open" and isinstance(args[0], str) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            path = os.path.abspath(args[0])
            if path.startswith(here) and "__pycache__" not in path:
                paths.append(path)

    sys.addaudithook(hook)
    return paths


@pytest.fixture(scope="module")
def usual(tmp_path_factory, written):
    """Folder of a smoke run, its path with a space and letters beyond ASCII."""
    out = tmp_path_factory.mktemp("world") / "läuft überall" / "run"
    script.main(dataclasses.replace(SMOKE, run_dir=str(out)))
    return out


@pytest.fixture(scope="module")
def strange(usual, tmp_path_factory):
    """The same run in a process that finds its surroundings strange, started elsewhere: the process and the folder."""
    cwd = tmp_path_factory.mktemp("strange")
    environ = {name: value for name, value in os.environ.items() if not name.startswith("MPL")} | STRANGE
    process = subprocess.run(
        [sys.executable, ROOT / "ppo_finetune.py", "--preset", "smoke", "--run-dir", "läuft ü"],
        cwd=cwd,
        env=environ,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=900,
        check=False,
    )
    return process, cwd / "läuft ü"


def rows_of(folder):
    """metrics.csv without the seconds."""
    rows = csv.DictReader((folder / "metrics.csv").open())
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


# --- Variables ---


def test_strange_surroundings_change_nothing(usual, strange):
    """Neither errors nor warnings, and the same numbers to the bit."""
    process, folder = strange
    assert (process.returncode, process.stderr) == (0, b"")
    assert rows_of(folder) == rows_of(usual)
    weights = [checkpoints.load(out / "policy.msgpack", "policy")[0] for out in (usual, folder)]
    jax.tree.map(np.testing.assert_array_equal, *weights)
    assert {path.name for path in folder.iterdir()} == {path.name for path in usual.iterdir()}


def test_a_terminal_without_unicode_gets_escapes(strange):
    assert b"ufft" not in strange[0].stdout and rb"l\udcc3\udca4uft" in strange[0].stdout


def test_a_run_without_git_has_an_unknown_commit(strange, monkeypatch):
    assert json.loads((strange[1] / "args.json").read_text())["versions"]["commit"] == "unknown"
    monkeypatch.setenv("PATH", "/nonexistent")
    assert records.commit() == "unknown"


@needs_git
def test_the_commit_is_that_of_the_project(tmp_path, monkeypatch):
    """Whatever repository is around the working directory, a copy of the project, or in GIT_DIR."""

    def git(*words):
        subprocess.run(["git", "-C", tmp_path, *words], env=PLAIN_GIT, check=True, capture_output=True)

    here = records.commit()
    git("init")
    git("-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "--allow-empty", "-m", "other")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / ".git"))
    assert records.commit() == here
    (tmp_path / "copy").mkdir()
    monkeypatch.setattr(records, "ROOT", tmp_path / "copy")
    assert records.commit() == "unknown"
    monkeypatch.setattr(records, "ROOT", tmp_path.resolve())
    assert records.commit() not in ("unknown", here)


@needs_git
def test_a_checkout_with_letters_beyond_ascii_has_a_commit(tmp_path):
    """In a process of its own, whose locale does not know them."""
    shutil.copytree(ROOT / "experiment", tmp_path / "ü/experiment")
    shutil.copytree(ROOT / "envs", tmp_path / "ü/envs", ignore=shutil.ignore_patterns("*.obj", "*.stl", "*.png"))
    shutil.copytree(ROOT / "assets", tmp_path / "ü/assets", ignore=shutil.ignore_patterns("pidm"))
    for words in (["init"], ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "--allow-empty", "-m", "x"]):
        subprocess.run(["git", "-C", tmp_path / "ü", *words], env=PLAIN_GIT, check=True, capture_output=True)
    environ = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    code = "from experiment import records; print(records.commit())"
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path / "ü", env=environ, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0 and process.stdout.strip() not in ("", "unknown"), process.stderr


def test_a_wrong_opengl_is_replaced_for_pictures(monkeypatch, capsys):
    """MUJOCO_GL names one that does not work: the next one draws, and one line says so."""
    tried = []

    def start(command, env, **_):
        tried.append(env["MUJOCO_GL"])
        if env["MUJOCO_GL"] == "egl":
            np.save(Path(command[2], "frames.npy"), np.zeros((1, 2, 2, 3), np.uint8))
        return subprocess.CompletedProcess(command, env["MUJOCO_GL"] != "egl", "", "")

    monkeypatch.setattr(gl, "ASKED", "wgl")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(subprocess, "run", start)
    env = envs.make("go1_loco", "c")
    for _ in range(2):
        (picture,) = render.draw(env.scene(visual=True), np.zeros((1, env.engine.model.nq)))
    assert picture.size == (2, 2) and tried == ["wgl", "egl", "egl"]
    assert capsys.readouterr().out == "MUJOCO_GL=wgl does not work here: drew with egl\n"


@pytest.mark.parametrize(("system", "names"), [("darwin", ["cgl"]), ("linux", ["egl", "osmesa"])])
def test_pictures_try_the_opengl_of_the_system(system, names, monkeypatch, capsys):
    """On macOS MuJoCo refuses the names of Linux's."""
    tried = []

    def start(command, env, **_):
        tried.append(env["MUJOCO_GL"])
        return subprocess.CompletedProcess(command, 1, "", "")

    monkeypatch.setattr(gl, "ASKED", "")
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(subprocess, "run", start)
    env = envs.make("go1_loco", "c")
    render.draw(env.scene(visual=True), np.zeros((1, env.engine.model.nq)))
    assert tried == names and f"tried {', '.join(names)}" in capsys.readouterr().out


def test_mujoco_never_sees_mujoco_gl():
    assert "MUJOCO_GL" not in os.environ


def test_a_platform_that_is_not_here_is_one_line(monkeypatch, refused):
    """JAX fails with an AssertionError or a RuntimeError; both name the variable and what is here."""
    found, faults = jax.devices, []

    def find():
        if faults:
            raise faults.pop()
        return found()

    monkeypatch.setattr(jax, "devices", find)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    words = "JAX_PLATFORMS=cuda: no such device here", f"set it to {found()[0].platform}"
    for fault in (AssertionError(), RuntimeError("Unknown backend")):
        faults.append(fault)
        refused(script.main, SMOKE, *words)
    monkeypatch.delenv("JAX_PLATFORMS")
    faults.append(RuntimeError("no driver\nmore"))
    refused(script.main, SMOKE, "JAX finds no device: no driver")


def test_play_finds_its_devices_first():
    """In a process of its own, for JAX starts its devices once."""
    words = [sys.executable, "play.py", "results/tasks/go1_loco/policy.msgpack"]
    environ = os.environ | {"JAX_PLATFORMS": "abacus"}
    process = subprocess.run(words, cwd=ROOT, env=environ, capture_output=True, text=True, check=False)
    assert process.returncode == 2 and process.stderr.startswith("error: JAX_PLATFORMS=abacus: no such device here")
    assert process.stderr.count("\n") == 1


# --- Cores ---


def test_engine_c_has_a_thread_for_each_core_it_may_use(monkeypatch):
    started = []
    monkeypatch.setattr(engine, "cpu_quotas", lambda root: iter(()))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {5}, raising=False)
    env = envs.make("go1_loco", "c")
    real = env.engine.make_batch
    env.engine.make_batch = lambda *args, nthread: started.append(nthread) or real(*args, nthread=nthread)
    env.engine.batch(3)
    assert started == [1]
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 2, 5, 7})
    assert engine.cpu_count() == 4
    monkeypatch.setattr(engine, "cpu_quotas", lambda root: iter([2.5, 16.0]))
    assert engine.cpu_count() == 3
    monkeypatch.setattr(engine, "cpu_quotas", lambda root: iter([0.25]))
    assert engine.cpu_count() == 1
    monkeypatch.delattr(os, "sched_getaffinity")  # macOS
    monkeypatch.setattr(engine, "cpu_quotas", lambda root: iter(()))
    assert engine.cpu_count() == os.cpu_count()


@pytest.mark.parametrize(
    ("groups", "files", "quotas"),
    [
        (None, {}, []),
        ("0::/", {"cpu.max": "max 100000"}, []),
        ("0::/", {"cpu.max": "150000 100000"}, [1.5]),
        ("0::/a/b", {"cpu.max": "max 100000", "a/cpu.max": "200000 100000", "a/b/cpu.max": "400000 100000"}, [2, 4]),
        ("0::/../..", {"cpu.max": "100000 100000"}, [1]),  # a namespace of its own
        ("4:cpu,cpuacct:/a", {"cpu/a/cpu.cfs_quota_us": "50000", "cpu/a/cpu.cfs_period_us": "100000"}, [0.5]),
        ("4:cpu,cpuacct:/far/off", {"cpu/cpu.cfs_quota_us": "300000", "cpu/cpu.cfs_period_us": "100000"}, [3]),
        ("4:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, []),
        ("4:memory:/a\n0::/", {"a/cpu.max": "100000 100000"}, []),  # the group of another kind
        ("no group", {"cpu.max": "what?"}, []),
        ("0::/", {"cpu.max": "100000 0"}, []),
    ],
)
def test_quotas_of_control_groups(groups, files, quotas, tmp_path):
    if groups is not None:
        (tmp_path / "proc/self").mkdir(parents=True)
        (tmp_path / "proc/self/cgroup").write_text(groups + "\n")
    for name, text in files.items():
        path = tmp_path / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    assert sorted({*engine.cpu_quotas(tmp_path)}) == quotas


# --- --resume ---


def test_total_steps_extend_a_run(usual, tmp_path, refused):
    out = tmp_path / "run"
    shutil.copytree(usual, out)
    before = (out / "args.json").read_bytes()
    refused(script.main, script.Args(resume=str(out), total_steps=32), "has more than 32 steps already")
    refused(script.main, script.Args(resume=str(out), total_steps=0), "--total-steps must be at least 1, not 0")
    assert (out / "args.json").read_bytes() == before
    (out / "metrics.csv").unlink()  # state.msgpack has its rows, too
    script.main(script.Args(resume=str(out), total_steps=96))
    assert rows_of(out)[:2] == rows_of(usual) and rows_of(out)[2]["env_steps"] == "96"
    assert json.loads((out / "args.json").read_text()) == json.loads(before) | {"total_steps": 96}


def test_arguments_beside_resume_are_refused_even_at_their_default(usual, monkeypatch, refused):
    monkeypatch.setattr(sys, "argv", ["ppo_finetune.py", "--resume", str(usual), "--seed=0", "--no-tensorboard"])
    refused(script.main, script.Args(resume=str(usual)), "--seed cannot change with --resume")


# --- Files ---


@pytest.fixture
def untrained(usual, monkeypatch):
    """play.Args of a policy whose evaluation and pictures cost nothing."""

    def evaluate(env, *_):
        like = jax.eval_shape(env.reset, jax.random.key(0)).replace(key=None)
        return {}, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like), np.zeros((4, env.engine.model.nq))

    monkeypatch.setattr(play, "evaluate", evaluate)
    monkeypatch.setattr(render, "video", lambda *_: b"film")
    converter, helper = types.ModuleType("jax2onnx"), types.SimpleNamespace(set_model_props=lambda *_: None)
    converter.to_onnx = lambda *_, **__: types.SimpleNamespace(SerializeToString=lambda: b"graph")
    monkeypatch.setitem(sys.modules, "jax2onnx", converter)
    monkeypatch.setitem(sys.modules, "onnx", types.SimpleNamespace(helper=helper))
    return play.Args(policy=str(usual / "policy.msgpack"))


@pytest.mark.parametrize(("flag", "end"), [("video", ".gif"), ("export", ".onnx")])
def test_what_play_cannot_write_is_one_line(flag, end, untrained, tmp_path, refused, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / f"folder{end}").mkdir()

    def check(path, *words):
        refused(play.main, dataclasses.replace(untrained, **{flag: str(path)}), f"cannot write {path}", *words)

    check(tmp_path / f"file/x{end}")
    check(tmp_path / f"folder{end}", "it is a folder")
    monkeypatch.setattr(os, "fsync", full)
    check(tmp_path / f"new/x{end}", "No space left on device")
    monkeypatch.undo()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["file", f"folder{end}", "new"]


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_robot_gets_the_gains_of_the_training(untrained, tmp_path, monkeypatch):
    """Metadata of the exported file: Go1's motors as assets/README.md and its makers have them."""
    told, helper = {}, types.SimpleNamespace(set_model_props=lambda _, facts: told.update(facts))
    monkeypatch.setitem(sys.modules, "onnx", types.SimpleNamespace(helper=helper))
    play.main(dataclasses.replace(untrained, export=str(tmp_path / "go1.onnx")))
    facts = {name: json.loads(text) for name, text in told.items()}
    assert (facts["kp"], facts["kd"]) == ([35.0] * 12, [0.5] * 12)
    np.testing.assert_allclose(facts["torque_limit"], [23.7, 23.7, 35.55] * 4)
    np.testing.assert_allclose(facts["default_pose"], [0, 0.9, -1.8] * 4, rtol=1e-6)
    assert facts["history"] == 5 and facts["action_scale"] == [0.25] * 12 and facts["dt"] == 0.02


def test_a_disk_that_fills_up_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "curve.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", full)
    rows = [{"env_steps": float(i), "reward": 1.0} for i in range(3)]
    with pytest.raises(records.UserError, match=r"cannot write .*curve\.png: No space left"):
        figures.plot_curves(rows, {"reward": ["reward"]}, path)
    assert path.read_bytes() == b"old" and [path] == [*tmp_path.iterdir()]


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no /dev/null")
def test_a_device_is_not_replaced_by_a_file():
    with pytest.raises(records.UserError, match="cannot write /dev/null: it is not a file"):
        records.write(Path("/dev/null"), b"")


def test_any_error_of_the_machine_is_one_line(refused):
    def main(error):
        with records.one_line_errors():
            raise error

    refused(main, OSError(errno.EACCES, "Permission denied", "/x/y"), "/x/y: Permission denied")
    refused(main, MemoryError("Unable to allocate 9 TiB"), "out of memory; lower --num-envs", "9 TiB")


def test_a_reader_that_has_gone_is_no_error(monkeypatch, capsys):
    """As in `| head -1`: nothing is said, and the exit code is 1."""
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    with pytest.raises(SystemExit) as stop, records.one_line_errors():
        raise BrokenPipeError
    assert stop.value.code == 1 and not capsys.readouterr().err


def test_a_run_folder_that_is_a_file_is_refused(tmp_path, refused, monkeypatch):
    monkeypatch.setattr(script, "init_state", lambda args, **_: np.zeros(1))
    (tmp_path / "run").touch()
    refused(script.main, dataclasses.replace(SMOKE, run_dir=str(tmp_path / "run")), "cannot write to", "run: ")


def test_a_checkout_may_be_read_only(usual, written):
    """A training, whose folder is elsewhere, writes nothing into the project."""
    assert (usual / "policy.msgpack").exists() and not written


def test_matplotlib_takes_nothing_from_its_surroundings(usual):
    assert matplotlib.get_backend().lower() == "agg" and os.environ["MPLBACKEND"] == "agg"


# --- Neighbours ---


@needs_locks
def test_a_second_process_in_the_same_folder_is_refused(usual, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(script, "init_state", lambda args, **_: np.zeros(1))
    out, new = tmp_path / "run", tmp_path / "new"
    shutil.copytree(usual, out)
    new.mkdir()
    before = {path: path.read_bytes() for path in out.iterdir()}
    with contextlib.ExitStack() as stack:
        for folder in (out, new):  # a lock conflicts with one through another descriptor, as with another process
            file = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, file)
            records.fcntl.flock(file, records.fcntl.LOCK_EX)
        refused(script.main, script.Args(resume=str(out)), "another process is writing")
        refused(script.main, dataclasses.replace(SMOKE, run_dir=str(out), force=True), "another process is writing")
        refused(script.main, dataclasses.replace(SMOKE, run_dir=str(new)), "another process is writing")
    assert {path: path.read_bytes() for path in out.iterdir()} == before and not [*new.iterdir()]
    records.claim(out)
    assert records.CLAIMS.keys() == {out.resolve()}
    os.close(records.CLAIMS.popitem()[1])


def test_sigterm_while_it_compiles(tmp_path, monkeypatch):
    """The run ends with one word. It has no results, so that the folder can be used again without --force."""

    def compile(*_):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)

    handler, args = signal.getsignal(signal.SIGTERM), dataclasses.replace(SMOKE, run_dir=str(tmp_path))
    monkeypatch.setattr(run.Run, "compile", compile)
    for _ in range(2):
        with pytest.raises(SystemExit, match="interrupted"):
            script.main(args)
        assert [path.name for path in tmp_path.iterdir()] == ["args.json"]
    assert signal.getsignal(signal.SIGTERM) == handler and not records.CLAIMS


@pytest.fixture
def collection(tmp_path):
    """Arrays of a tiny collection, and how to create them again."""
    env = types.SimpleNamespace(prop_dim=3, action_dim=2)
    args = types.SimpleNamespace(num_steps=4, num_envs=2)
    return dataset.create_arrays(tmp_path, args, env, 1), lambda: dataset.create_arrays(tmp_path, args, env, 1)


def test_data_still_being_written_are_refused(collection, tmp_path, refused):
    args = pretrain_pidm.Args(data=str(tmp_path), preset="smoke", run_dir=str(tmp_path / "run"))
    refused(pretrain_pidm.main, args, "is an unfinished collection")
    assert not (tmp_path / "run").exists()


def test_data_collected_anew_do_not_change_under_a_reader(collection, tmp_path):
    arrays, again = collection
    arrays["x"][:] = 1.0
    dataset.flush(arrays)
    reader = np.load(tmp_path / "x.npy", mmap_mode="r")
    again()["x"][:] = 2.0
    assert (reader == 1.0).all()


@pytest.mark.parametrize("name", ["metrics.csv", "args.json"])
def test_windows_line_ends_are_read(name, usual, tmp_path, monkeypatch):
    out = tmp_path / "run"
    shutil.copytree(usual, out)
    (out / "eval.json").write_text('{"task": {"falls": 0.0}}')
    want = tables.load_run(out)["columns"]
    (out / name).write_bytes((out / name).read_bytes().replace(b"\n", b"\r\n"))
    assert b"\r\n" in (out / name).read_bytes()
    found = tables.load_run(out)["columns"]
    jax.tree.map(np.testing.assert_array_equal, found, want)


def test_devices_are_found_where_all_is_well():
    assert devices.find() is None


@pytest.mark.parametrize(
    ("size", "longest"), [(1, 1), (2048, 2048), (6144, 1536), (24576, 1536), (2050, 1025), (4097, 4097)]
)
def test_a_mean_in_pieces_is_the_mean(size, longest):
    """Whatever the size of a batch; its pieces fit a CPU's cache where halving allows it."""
    x = np.random.default_rng(size).normal(size=(size, 3)).astype(np.float32)
    seen = set()

    def function(batch):
        seen.add(len(batch["x"]))
        return {"mean": batch["x"].mean(0), "last": (batch["y"] ** 2).mean()}

    got = devices.mean_in_pieces(function, {"x": x, "y": x[:, 0]})
    np.testing.assert_allclose(got["mean"], x.astype(float).mean(0), atol=1e-6)
    np.testing.assert_allclose(got["last"], (x[:, 0].astype(float) ** 2).mean(), rtol=1e-5)
    assert seen == {longest}
