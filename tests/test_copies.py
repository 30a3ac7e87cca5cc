"""Scripts that must stand alone carry copies of some code.

    pytest tests/test_copies.py               # fails with a diff when a copy has drifted
    python tests/test_copies.py               # rewrites every copy from its owner

Each must match the one in its owner, byte for byte.
"""

import ast
import difflib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
STAGES = ("ppo_explore.py", "pretrain_pidm.py", "ppo_finetune.py")
SCRIPTS = (*STAGES, "tools/play_onnx.py", "tools/viewer.py")
# Only primitives are copied. What a reader changes to try an idea differs freely between the scripts.
BLOCKS = {"mlp", "pidm", "sizes", "actor_critic", "rollout", "gae", "update", "keys"}
OWN = {"Args", "TrainState", "init_state", "iteration", "main", "merge", "ppo_loss", "predict", "rollout", "update"}
BLOCK = re.compile(r"^# >>> copy: (\w+) \(owner: ([\w/]+\.py)\)\n(.*?)^# <<< copy: \1$", re.M | re.S)


def blocks(script):
    """(name, owner, body) of every marked block in a script."""
    return BLOCK.findall((ROOT / script).read_text())


def owned():
    """name -> body, as the owning script has it."""
    return {name: body for script in SCRIPTS for name, owner, body in blocks(script) if owner == script}


def definitions(text):
    """Functions and classes at the top level."""
    return [node for node in ast.parse(text).body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]


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
    assert set(seen) == set(owned()) == BLOCKS
    for name in BLOCKS:
        assert seen.count(name) > 1, f"block {name} has no copy: drop its markers"


def test_no_other_file_has_a_block():
    """A copy in a file that is not listed above would be compared with nothing."""
    others = [path for path in ROOT.glob("*.py") if path.name not in SCRIPTS]
    others += [path for path in ROOT.glob("[a-z]*/*.py") if str(path.relative_to(ROOT)) not in SCRIPTS]
    others.remove(Path(__file__).resolve())
    assert len(others) > 30 and not [path for path in others if "# >>> copy:" in path.read_text()]


@pytest.mark.parametrize("script", STAGES)
def test_copies_hold_primitives_only(script):
    """A reader can change a loss or an update of one script without touching another."""
    copied = {node.name for _, _, body in blocks(script) for node in definitions(body)}
    assert copied and not copied & OWN


def test_same_name_means_same_code():
    """Outside the names that differ by design, a top-level name shared by two scripts has one text."""
    seen = {}
    for script in SCRIPTS:
        for node in definitions((ROOT / script).read_text()):
            if node.name not in OWN:
                text = ast.dump(node)
                where, first = seen.setdefault(node.name, (script, text))
                assert text == first, f"{node.name} differs between {where} and {script}: rename one or mark the copy"


if __name__ == "__main__":
    for path in (ROOT / s for s in SCRIPTS):
        text = path.read_text()
        path.write_text(BLOCK.sub(lambda m: f"{m[0].splitlines()[0]}\n{owned()[m[1]]}# <<< copy: {m[1]}", text))
