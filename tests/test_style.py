"""Checks beyond ruff's: size, dead arguments, long or nested functions, imports that go upwards, deviations, faults."""

import ast
import graphlib
import re
from pathlib import Path

import pytest

from tools import mutants

ROOT = Path(__file__).resolve().parent.parent
BUDGET = {  # lines, with blanks and docstrings
    "ppo_finetune.py": 560,
    "ppo_explore.py": 600,
    "pretrain_pidm.py": 470,
    "play.py": 280,
    "README.md": 200,
}
STAGES = ("ppo_explore", "pretrain_pidm", "ppo_finetune")
MODULES = {  # package -> its modules; each may import what stands before it
    "envs": (
        *("gl", "rotations", "config", "anatomy", "reader", "builder", "loader", "robots", "terrain", "engine"),
        *("rewards", "base"),
        "courses",
        *("locomotion", "explore", "newcomers", "pedipulation", "parkour", "render"),
    ),
    "experiment": (
        *("records", "arguments", "checkpoints", "devices", "metrics", "figures", "dataset", "progress", "run"),
        *("gait", "walks"),
    ),
}
BELOW = {  # what a part of the project may import, besides itself
    "envs": set(),
    "experiment": {"envs"},
    **{stage: {"envs", "experiment"} for stage in STAGES},
    "play": {"envs", "experiment", "ppo_finetune", "tools"},
    "tools": {"envs", "experiment", "play", *STAGES},
    "results": {"envs", "experiment", "play", *STAGES},
}
FILES = [path.relative_to(ROOT) for where in ("*.py", "[a-z]*/*.py") for path in sorted(ROOT.glob(where))]
FILES = [path for path in FILES if path.parts[0] != "tests"]
FUNCS = (ast.FunctionDef, ast.AsyncFunctionDef)


def tree(name):
    return ast.parse((ROOT / name).read_text())


def imports(name):
    """Modules that a file imports anywhere in it, as dotted names."""
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def read_arguments(name):
    """Names x of `args.x` and `self.args.x` in a file."""
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("args", "self.args"):
            yield node.attr


def looked_up_arguments(name):
    """Words of the functions that call `getattr(args, ...)`."""
    for node in ast.walk(tree(name)):
        if isinstance(node, FUNCS) and "getattr(args, " in ast.unparse(node):
            yield from (word.value for word in ast.walk(node) if isinstance(word, ast.Constant))


@pytest.mark.parametrize("name", BUDGET)
def test_a_file_is_no_longer_than_its_budget(name):
    assert len((ROOT / name).read_text().splitlines()) <= BUDGET[name]


def fields_of(script):
    """Names of a script's arguments."""
    cls = next(n for n in tree(f"{script}.py").body if isinstance(n, ast.ClassDef) and n.name == "Args")
    return {s.target.id for s in cls.body if isinstance(s, ast.AnnAssign)}


@pytest.mark.parametrize("script", [*STAGES, "play"])
def test_every_argument_is_read(script):
    fields, read = fields_of(script), set(read_arguments(f"{script}.py"))
    around = {name for file in FILES if file.parts[0] == "experiment" for name in read_arguments(file)}
    around |= set(looked_up_arguments(f"{script}.py"))
    assert fields <= read | around, f"never read: {sorted(fields - read - around)}"
    known = fields | (fields_of("ppo_finetune") if script == "play" else set())  # it also reads those of the training
    assert read <= known, f"read but not defined: {sorted(read - known)}"


@pytest.mark.parametrize("name", FILES, ids=str)
def test_functions_are_short_and_flat(name):
    def walk(node, depth):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, FUNCS):
                assert child.end_lineno - child.lineno < 60, f"{child.name} is too long"
                assert depth < 2, f"{child.name} is nested too deep"
            walk(child, depth + isinstance(child, FUNCS))

    walk(tree(name), 0)


@pytest.mark.parametrize("name", FILES, ids=str)
def test_imports_go_down(name):
    """tools, results, play -> scripts -> experiment -> envs; scripts never import each other."""
    part = name.parts[0].removesuffix(".py")
    used = {module.split(".")[0] for module in imports(name)} & BELOW.keys()
    assert used - {part} <= BELOW[part]
    assert part not in STAGES or part not in used


@pytest.mark.parametrize("package", MODULES)
def test_modules_import_downwards(package):
    assert {path.stem for path in (ROOT / package).glob("*.py")} == {"__init__", *MODULES[package]}
    for layer, name in enumerate(MODULES[package]):
        used = {".".join(module.split(".")[:2]) for module in imports(f"{package}/{name}.py")}
        assert not used & {f"{package}.{other}" for other in MODULES[package][layer:]}, name


def test_no_imports_go_in_a_circle():
    """play.py and the tools may import each other, no two files may."""
    names = {".".join(file.with_suffix("").parts): file for file in FILES}
    graph = {
        name: {end for module in imports(file) for end in (module, module.rpartition(".")[0])} & names.keys()
        for name, file in names.items()
    }
    assert graph["play"] >= {"experiment.walks", "tools.viewer"}
    list(graphlib.TopologicalSorter(graph).static_order())  # CycleError


def test_every_deviation_is_listed():
    """Names in `# Deviation (name): ...` comments are the bold titles that docs/deviations.md lists as marked."""
    files = [path for path in FILES if path.parts[0] not in ("tools", "results")]
    comments = [line for path in files for line in re.findall(r"^ *# Deviation.*", (ROOT / path).read_text(), re.M)]
    marked = [re.match(r" *# Deviation \(([\w ]+)\): \S", line) for line in comments]
    assert all(marked), [line for line, match in zip(comments, marked, strict=True) if not match]
    section = (ROOT / "docs/deviations.md").read_text().split("## Marked in the code")[1].split("\n## ")[0]
    listed = [title.lower() for title in re.findall(r"^\d+\. \*\*(.+?)\.?\*\*", section, re.M)]
    assert len(listed) == len(set(listed)) > 0
    assert {match[1].lower() for match in marked} == set(listed)


def test_every_planted_fault_fits_the_code(capsys):
    """tools/mutants.py finds the text of each once; it ends with exit code 2 where code has been changed since."""
    mutants.main(mutants.Args(list=True))
    assert len(capsys.readouterr().out.splitlines()) == sum(map(len, mutants.FAULTS.values()))
