"""Scripts that must stand alone carry copies of some code. Each must match the one in its owner, byte for byte.

pytest tests/test_copies.py               # fails with a diff when a copy has drifted
python tests/test_copies.py               # rewrites every copy from its owner
"""

import ast
import difflib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = ("ppo_explore.py", "pretrain_pidm.py", "ppo_finetune.py", "results/play_onnx.py", "envs/watch.py")
OWN = {"Args", "TrainState", "evaluate", "init_state", "iteration", "main", "make_env", "merge", "plot", "predict"}
BLOCK = re.compile(r"^# >>> copy: (\w+) \(owner: ([\w/]+\.py)\)\n(.*?)^# <<< copy: \1$", re.M | re.S)


def blocks(script):
    """(name, owner, body) of every marked block in a script."""
    return BLOCK.findall((ROOT / script).read_text())


def owned():
    """name -> body, as the owning script has it."""
    return {name: body for script in SCRIPTS for name, owner, body in blocks(script) if owner == script}


@pytest.mark.parametrize("script", SCRIPTS)
def test_copies_match_owner(script):
    for name, owner, body in blocks(script):
        want = owned()[name]
        diff = difflib.unified_diff(
            want.splitlines(), body.splitlines(), f"{owner} {name}", f"{script} {name}", lineterm=""
        )
        assert body == want, "\n".join(diff)


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_marker_is_paired(script):
    text = (ROOT / script).read_text()
    assert text.count("# >>> copy:") == text.count("# <<< copy:") == len(blocks(script))


def test_every_block_has_an_owner_and_a_copy():
    seen = [name for script in SCRIPTS for name, _, _ in blocks(script)]
    for name in set(seen):
        assert name in owned(), f"no script owns block {name}"
        assert seen.count(name) > 1, f"block {name} has no copy: drop its markers"


def test_same_name_means_same_code():
    """Outside the names that differ by design, a top-level name shared by two scripts has one text."""
    seen = {}
    for script in SCRIPTS:
        for node in ast.parse((ROOT / script).read_text()).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name not in OWN:
                text = ast.dump(node)
                where, first = seen.setdefault(node.name, (script, text))
                assert text == first, f"{node.name} differs between {where} and {script}: rename one or mark the copy"


if __name__ == "__main__":
    for path in (ROOT / s for s in SCRIPTS):
        text = path.read_text()
        path.write_text(BLOCK.sub(lambda m: f"{m[0].splitlines()[0]}\n{owned()[m[1]]}# <<< copy: {m[1]}", text))
