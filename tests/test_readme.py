"""Test README.md and docs/*.md: commands run (made small), tables equal the records, names and links exist."""

import contextlib
import csv
import dataclasses
import importlib
import json
import re
import shlex
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import tyro
from PIL import Image

import envs
import play
import ppo_explore
import ppo_finetune
from envs import render
from experiment import checkpoints, walks
from experiment.run import Run

ROOT = Path(__file__).resolve().parent.parent
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"))}
README, DOCS = PAGES["README.md"], {Path(name).stem: text for name, text in PAGES.items()}
SCRIPTS = ("ppo_explore", "pretrain_pidm", "ppo_finetune", "play")
HEADINGS = ["Overview", "Usage", "Arguments", "Logged metrics", "Implementation details", "Results"]
BLOCKS = [
    block for name in ("README.md", *sorted(PAGES)) for block in re.findall(r"```(\w*)\n(.*?)```", PAGES[name], re.S)
]
COMMANDS = list(dict.fromkeys(line for kind, body in BLOCKS if kind == "bash" for line in body.strip().splitlines()))
RECORDED = [task for task in envs.TASKS if (ROOT / "results/tasks" / task).exists()]

# What makes each kind of command small; later words override earlier ones.
SMALL = {
    "ppo_explore.py": "--preset smoke --total-steps 800 --ensemble-batch 64 --force",
    "pretrain_pidm.py": "--preset smoke --num-samples 32 --force",
    "ppo_finetune.py": "--preset smoke --num-envs 4 --num-steps 4 --total-steps 32 --force",
    "play.py": "--episodes 2",
    "results/study.py": "--budget-minutes 0",
    "tools/gait.py": "--starts 1 --seconds 2",
    "tools/play_onnx.py": "--seconds 2",
}
FORMS = {"--export": "jax2onnx", "tools/play_onnx.py": "onnxruntime"}  # what needs more than requirements.txt
READ = ("runs/g1_loco/pidm_pretrained/seed0", "runs/explore/g1/seed0", "runs/explore/go1/random")  # by other commands
NEED_A_PERSON = ("--web", "--viewer")
WRITES_HERE = ("results/report.py", "results/tasks.py", "results/pidm.py", "tools/bench.py")  # tested elsewhere


def section(page, heading):
    """Text of a page below a heading, up to the next one of its level or above."""
    level, body = re.search(rf"^(#+) {re.escape(heading)}\n(.*)", DOCS[page], re.M | re.S).groups()
    return re.split(rf"^#{{1,{len(level)}}} ", body, flags=re.M)[0]


def anchors(text):
    """Anchors of a page's headings, as GitHub makes them."""
    return {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in re.findall(r"^#+ (.*)", text, re.M)}


def last_row(run):
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))[-1]


def read(run, name):
    return json.loads((ROOT / "results" / run / name).read_text())


# --- Commands ---


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with what the commands read: assets, a recorded run, and the run that `make demo` leaves."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "assets").symlink_to(ROOT / "assets")
    for copy, of in (
        ("results/tasks/go1_loco",) * 2,
        ("results/tasks/go1_robust",) * 2,
        ("runs/demo", "results/tasks/go1_loco"),
    ):
        shutil.copytree(ROOT / of, folder / copy)
    return folder


TRACED, MEASURED = set(), []


class ReadyError(Exception):
    """A training has all it needs: only compiling its program and running it are left."""


def zeros_alone(init_state):
    """`init_state`, which reads and checks its files, but makes zeros for runs that no other command reads."""

    def zeros(x):
        bits = jnp.zeros((*x.shape, 2), jnp.uint32)
        return jax.random.wrap_key_data(bits) if checkpoints.is_key(x) else jnp.zeros(x.shape, x.dtype)

    def made(args, *rest, **parts):
        if args.run_dir in READ:
            return init_state(args, *rest, **parts)
        return jax.tree.map(zeros, jax.eval_shape(lambda: init_state(args, *rest, **parts)))

    return made


@pytest.fixture
def quick(monkeypatch):
    """Trainings whose results no other command reads end before they are compiled; no picture is drawn.

    Each kind of program is traced once. Evaluations, which have tests of their own, find robots that do not move.
    """
    compile, size, measure = Run.compile, (render.WIDTH, render.HEIGHT), walks.evaluate

    def compile_if_read(self, function, *inputs):
        if self.args.run_dir in READ:
            return compile(self, function, *inputs)
        kind = type(self.args), getattr(self.args, "network", None), getattr(self.args, "num_seeds", 1), self.config
        if repr(kind) not in TRACED:
            function.lower(*inputs)
            TRACED.add(repr(kind))
        raise ReadyError

    def evaluate(env, net, params, episodes, level=None):
        like = jax.eval_shape(env.reset, jax.random.key(0)).replace(key=None)
        start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
        return {}, start, jnp.zeros((env.episode_steps, env.engine.model.nq))

    def measure_once(*args, **few):
        MEASURED[:] = MEASURED or [measure(*args, **few)]
        return MEASURED[0]

    for script in (ppo_finetune, ppo_explore):
        monkeypatch.setattr(script, "init_state", zeros_alone(script.init_state))
    monkeypatch.setattr(Run, "compile", compile_if_read)
    monkeypatch.setattr(play, "evaluate", evaluate)
    monkeypatch.setattr(walks, "evaluate", measure_once)
    monkeypatch.setattr(render, "draw", lambda spec, qpos, size=size: [Image.new("RGB", size) for _ in qpos])


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_run(command, workplace, quick, monkeypatch, capsys):
    words = shlex.split(command)
    if words[0] == "make":
        assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text()
        return
    if words[0] == "#SBATCH":
        return
    python, script, *words = words[words[0] == "srun" :]
    assert python == "python" and (ROOT / script).exists()
    for word in {script, *words} & FORMS.keys():
        pytest.importorskip(FORMS[word])
    module = importlib.import_module(script.removesuffix(".py").replace("/", "."))
    small = [] if "--eval" in words else SMALL.get(script, "").split()
    small += ["--epochs", "2", "--patience", "1"] if "--patience" in words else []
    if script == "play.py":
        words += [] if "--set" in words else ["--set"]
        words.insert(words.index("--set") + 1, "episode_seconds=2.0")
    args = tyro.cli(module.Args, args=[*words, *small])
    if {*words} & {*NEED_A_PERSON} or script in WRITES_HERE:
        return
    if getattr(args, "distributed", False):
        args = dataclasses.replace(args, distributed=False)  # test_devices.py runs several processes
    monkeypatch.chdir(workplace)
    with contextlib.suppress(ReadyError):
        module.main(args)
    assert capsys.readouterr().out, "it says what it did"
    if "--out" in words:
        recorded = "results/tasks/go1_loco/eval.json"
        assert (Path(args.out) / "eval.json").exists() and Path(recorded).read_text() == (ROOT / recorded).read_text()


def test_python_blocks_run():
    for kind, body in BLOCKS:
        if kind == "python":
            exec(compile(body, "docs", "exec"), {})


# --- Names, links and form ---


def test_readme_is_short():
    assert len(README.splitlines()) <= 200


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for target, anchor in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", PAGES[page]):
        path = (ROOT / page).parent / target if target else ROOT / page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path.read_text()), f"{target}#{anchor}"


def test_every_page_is_linked_from_the_readme():
    assert all(f"]({page})" in README for page in PAGES if page != "README.md")


def test_files_of_the_tree_exist():
    tree = next(body for kind, body in BLOCKS if not kind)
    names = [line.split()[0] for line in tree.splitlines()]
    assert {"play.py", "envs/", "tools/"} <= {*names} and all((ROOT / name).exists() for name in names)
    tools = re.search(r"^tools/ +(.*)$", tree, re.M).group(1).split(", ")
    assert {*tools} == {path.stem for path in ROOT.glob("tools/*.py")} - {"__init__"}


@pytest.mark.parametrize("script", SCRIPTS)
def test_pages_of_scripts_have_the_same_headings(script):
    assert re.findall(r"^## (.*)", DOCS[script], re.M) == HEADINGS


@pytest.mark.parametrize("script", SCRIPTS)
def test_implementation_details_name_what_there_is(script):
    module, details = importlib.import_module(script), section(script, "Implementation details")
    names = re.findall(r"^\d+\. (`.*?):", details, re.M)
    assert len(names) == len(re.findall(r"^\d+\.", details, re.M)) >= 4
    for name in re.findall(r"`(\w+)`", " ".join(names)):
        assert hasattr(module, name), name


@pytest.mark.parametrize("script", SCRIPTS)
def test_arguments_exist(script):
    names = re.findall(r"`--([\w-]+)", section(script, "Arguments"))
    fields = {field.name for field in dataclasses.fields(importlib.import_module(script).Args)}
    assert len(names) > 3 and {name.replace("-", "_") for name in names} <= fields


def test_code_to_change_is_where_the_readme_says():
    table = section("README", "To change one thing, go here")
    for name, script in re.findall(r"`(\w+)` (?:in|of) \[(\w+)\.py\]", table):
        assert hasattr(importlib.import_module(script), name), name


# --- Records ---


@pytest.mark.parametrize("task", envs.TASKS)
def test_task_table_is_what_was_recorded(task):
    """Scale, minutes and result in the README are those of the committed run."""
    row = next(line for line in README.splitlines() if line.startswith(f"| `{task}` |"))
    if task not in RECORDED:
        assert row.endswith("| not recorded yet |")
        return
    run = ROOT / "results/tasks" / task
    args, report, last = read(run, "args.json"), read(run, "eval.json"), last_row(run)
    scale = f"{args['num_envs']} x {args['num_steps']}, {float(last['env_steps']) / 1e6:.1f} M steps"
    minutes = f"{float(last['seconds']) / 60:.1f} min"
    if "level" in last:
        result = f"{100 * report['level 9']['episode_success']:.0f}%"
    else:
        unit, error = ("m", "foot_error") if "foot_error" in last else ("m/s", "lin_vel_error")
        result = f"{report['task'][error]:.2f} {unit}, {100 * report['task']['falls']:.0f}%"
    assert row.endswith(f"| {scale} | {minutes}, {result} |")
    assert args["network"] == "mlp"


@pytest.mark.parametrize("task", [task for task in RECORDED if "skill" in dir(envs.TASKS[task][1])])
def test_success_table_is_what_was_recorded(task):
    report = read(f"tasks/{task}", "eval.json")
    row = [f"{100 * report[f'level {level}']['episode_success']:.0f}" for level in range(10)]
    assert f"| `{task}` | {' | '.join(row)} |" in DOCS["ppo_finetune"].splitlines()


def test_demo_is_what_was_recorded():
    result = read("tasks/demo", "eval.json")["task"]
    minutes = float(last_row(ROOT / "results/tasks/demo")["seconds"]) / 60
    text = " ".join(README.split())
    assert f"training took {minutes:.1f} minutes" in text
    assert f"to {result['lin_vel_error']:.2f} m/s with {100 * result['falls']:.0f}% falls, in six short" in text
    assert round(read("tasks/demo", "eval.json")["gait"]["stride_frequency"]) == 6


def test_main_use_is_what_was_recorded():
    """Minutes, error and falls of G1 with a pretrained PIDM in the README are those of the study's run."""
    run = "study/batch/g1_loco/pidm_pretrained/seed0"
    row, result = last_row(ROOT / "results" / run), read(run, "eval.json")["task"]
    text = " ".join(README.split())
    assert f"seed 0 ({float(row['env_steps']) / 1e6:.0f} M, 512 environments, PyTorch's initial weights) took" in text
    assert f"took {float(row['seconds']) / 60:.0f} minutes on one core" in text
    assert f"velocity by {result['lin_vel_error']:.2f} m/s and fell in {100 * result['falls']:.0f}% of" in text
    switched = read(run, "eval.json")["gait"]
    said = f"{switched['switches/falls']:.0f} of {switched['switches/episodes']:.0f} when commands change"
    assert said in text


def test_policies_for_use_are_what_was_measured():
    """Every row of the table of robust policies, from the gait.json beside each."""
    found = [read(f"tasks/{robot}_robust", "gait.json") for robot in ("go1", "anymal", "g1")]

    def falls(of, *names):
        each = [f"{name}/" if name else "" for name in names]
        return "; ".join(f"{of[f'{name}falls']:.0f} of {of[f'{name}episodes']:.0f}" for name in each)

    speeds = [[one["commands"][f"forward {x}"]["forward"] for x in (0.8, 1.0)] for one in found]
    of = [one["summary"] for one in found]
    still = ["it marches" if one["still"] < 0.5 else f"{100 * one['still']:.0f}%" for one in of]
    rows = {
        "yaw rate over its command, left and right": [
            f"{a['yaw_slope_left']:.2f}, {a['yaw_slope_right']:.2f}" for a in of
        ],
        "speed [m/s] at 0.8; at 1.0": [f"{slow:.2f}; {fast:.2f}" for slow, fast in speeds],
        "falls at fixed commands; at changing ones": [falls(a, "", "switches") for a in of],
        "reverses from 0.8 to -0.6 m/s": [f"{a['reverse/reversed']:.0f} of {a['reverse/episodes']:.0f}" for a in of],
        "told to stand: drift [m/s], time with still feet": [
            f"{a['drift']:.2f}, {b}" for a, b in zip(of, still, strict=True)
        ],
        "strides a second; feet rise by, at 0.8 m/s": [
            f"{a['stride_frequency']:.1f}; {1000 * a['clearance']:.0f} mm" for a in of
        ],
        "slip per metre, at 0.8 m/s": [f"{a['slip']:.2f}" for a in of],
        "falls with 40 ms of delay; after a push of 1 m/s": [falls(a, "delay of 40 ms", "push of 1.0 m/s") for a in of],
        "falls with 3 kg more; with a friction of 0.3": [falls(a, "3 kg more", "friction 0.3") for a in of],
    }
    for name, cells in rows.items():
        assert f"| {name} | {' | '.join(cells)} |" in README.splitlines()


def test_first_rows_of_a_second_training_are_what_was_recorded():
    rows = csv.DictReader((ROOT / "results/tasks/go1_robust/metrics.csv").read_text().splitlines())
    first, second = (float(row["kl"]) for row, _ in zip(rows, range(2), strict=False))
    assert f"have a mean KL of {first:.1f}, the next ten {second:.3f}." in " ".join(DOCS["ppo_finetune"].split())


def test_robots_from_files_are_what_was_recorded():
    text = " ".join(DOCS["your-robot"].split())
    for name in ("go2", "h1"):
        gait = read(f"your_robot/{name}", "eval.json")["gait"]
        assert f"fell in {gait['falls']:.0f} of {gait['episodes']:.0f} episodes" in text
    task, row = read("your_robot/h1", "eval.json")["task"], last_row(ROOT / "results/your_robot/h1")
    minutes = float(row["seconds"]) / 60
    assert f"After {minutes:.0f} minutes its velocity error was {task['lin_vel_error']:.2f} m/s" in text
    assert f"and {gait['velocity_error']:.2f} over the eleven fixed commands" in text
    assert f"rises by {100 * gait['clearance']:.0f} cm" in text
    assert f"{gait['switches/falls']:.0f} of {gait['switches/episodes']:.0f} at changing ones" in text
    for fault in ("delay of 40 ms", "friction 0.3"):
        assert gait[f"{fault}/falls"] == gait[f"{fault}/episodes"] == 40


@pytest.mark.parametrize("robot", ["anymal_d", "go1", "g1"])
def test_coverage_is_what_was_recorded(robot):
    result = read(f"pidm/{robot}", "coverage.json")
    spaces = [f"{result[name]:.2f}" for name in result if name.startswith("joint space")]
    row = f"| {robot} | {' | '.join(spaces)} |" + " |" * (4 - len(spaces))  # ANYmal D has two such tasks
    assert row in DOCS["ppo_explore"].splitlines()
    seen, novel = (f"{result[f'disagreement, {what}']:.3f}" for what in ("seen", "novel"))
    text = " ".join(DOCS["ppo_explore"].split())
    assert f"{novel} against {seen} on" in text
    near = [f"{100 * x:.0f}% of those of early" for name, x in result.items() if "map, first" in name]
    if len(near) == 2:  # the robot whose map is shown
        assert f"hold {near[0]} walking and {near[1]} pedipulation" in text


@pytest.mark.parametrize("page, folder", [("ppo_explore", "{}/explore"), ("pretrain_pidm", "{}")])
def test_minutes_of_stages_are_what_was_recorded(page, folder):
    text = section(page, "Results")
    for robot, name in (("anymal_d", "ANYmal D"), ("go1", "Go1"), ("g1", "G1")):
        seconds = float(last_row(ROOT / "results/pidm" / folder.format(robot))["seconds"])
        assert re.search(rf"{seconds / 60:.1f} (minutes )?\({name}\)", " ".join(text.split())), name


def test_pidm_table_is_what_was_recorded():
    for robot in envs.EXPLORE:
        result = read(f"pidm/{robot}", "validation.json")
        figures = [f"{result[name]:.3f}" for name in ("error", "error_rad", "normalized_error", "error_over_change")]
        figures += [f"{result[name]:.2f}" for name in ("mean_action_error", "last_action_error")]
        assert f"| {robot} | {' | '.join(figures)} |" in DOCS["pretrain_pidm"].splitlines()


def test_large_pidm_is_what_was_recorded():
    """Errors, features, the returns of walking after as many iterations, and the sizes of the set."""
    folder = ROOT / "results/pidm_large"
    page = (folder / "README.md").read_text()
    compared = read("pidm_large", "compared.json")
    del compared["weights"]
    for data, errors in compared.items():
        assert f"| {data} | {errors['shipped']:.3f} | {errors['large']:.3f} |" in page
    for at in (50, 100, 150, 200, 250):
        cells = []
        for which in ("shipped", "large"):
            rows = list(csv.DictReader((folder / f"walk_{which}/metrics.csv").read_text().splitlines()))
            cells += [f"{float(row['episode_return']):.1f}" for row in rows if float(row["iteration"]) == at]
        assert f"| {at} | {' | '.join(cells)} |" in page
    size = "features in anymal_loco, root mean square, loaded"
    assert f"mean square of {read('pidm_large', 'features.json')[size]:.1f} ([features.json]" in " ".join(page.split())
    sizes = [read("pidm_large/sizes", f"{n}_validation.json") for n in (7000, 70000)]
    words = [f"{x['error_rad']:.3f}" for x in (*sizes, read("pidm_large", "validation.json"))]
    assert "{} rad (7 k), {} (70 k) and {} (7 M)".format(*words) in " ".join(page.split())


def test_speed_tables_are_what_was_measured():
    rows = re.findall(r"^\|.*\d{3} \|.*$|^\| .*\| \d.*$", DOCS["speed"], re.M)
    measured = (ROOT / "results/bench/README.md").read_text().splitlines()
    assert len(rows) > 20 and {*rows} <= {*measured}
