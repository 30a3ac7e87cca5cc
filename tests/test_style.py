"""What ruff cannot check: dead arguments, long or nested functions, imports that go upwards, unlisted deviations."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = [path.name for path in ROOT.glob("*.py")]
ENVS = [f"envs/{path.name}" for path in (ROOT / "envs").glob("*.py")]
LAYERS = [
    "records",
    "devices",
    "robots",
    "terrain",
    "engine",
    "base",
    "rewards",
    "locomotion",
    "explore",
]  # each may import what stands before it
FUNCS = (ast.FunctionDef, ast.AsyncFunctionDef)


def tree(name):
    return ast.parse((ROOT / name).read_text())


def imports(name):
    """Modules that a file imports, as dotted names."""
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_argument_is_read(script):
    cls = next(n for n in tree(script).body if isinstance(n, ast.ClassDef) and n.name == "Args")
    fields = {s.target.id for s in cls.body if isinstance(s, ast.AnnAssign)}
    read = {
        n.attr for n in ast.walk(tree(script)) if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "args"
    }
    assert fields == read & fields, f"never read: {sorted(fields - read)}"
    assert not read - fields, f"read but not defined: {sorted(read - fields)}"


@pytest.mark.parametrize("name", SCRIPTS + ENVS)
def test_functions_are_short_and_flat(name):
    def walk(node, depth):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, FUNCS):
                assert child.end_lineno - child.lineno < 60, f"{child.name} is too long"
                assert depth < 2, f"{child.name} is nested too deep"
            walk(child, depth + isinstance(child, FUNCS))

    walk(tree(name), 0)


def test_scripts_import_envs_and_never_each_other():
    for script in SCRIPTS:
        assert not {name.split(".")[0] + ".py" for name in imports(script)} & set(SCRIPTS), script


def test_envs_import_downwards():
    for layer, name in enumerate(LAYERS):
        above = {f"envs.{other}" for other in LAYERS[layer:]}
        used = {name for name in imports(f"envs/{name}.py") if name.startswith("envs")}
        assert not any(name.startswith(tuple(above)) for name in used), name
        assert not used & {script.removesuffix(".py") for script in SCRIPTS}


def test_every_deviation_is_in_the_readme():
    """Each `Deviation:` comment has a line in the README's list, and the list has no others."""
    files = [*SCRIPTS, *ENVS]
    marked = sum((ROOT / name).read_text().count("# Deviation:") for name in files)
    section = (ROOT / "README.md").read_text().split("## Deviations")[1].split("\n## ")[0]
    assert marked == len(re.findall(r"^\d+\. ", section, re.M)) > 0
