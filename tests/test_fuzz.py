"""Files from strangers: thousands of damaged checkpoints, states, run folders and collections end in clean errors.

A damaged file is either refused by a UserError or read as what it says; nothing else is raised, little memory is taken.
"""

import dataclasses
import json
import random
import resource
import shutil
import sys

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ppo_finetune
import pretrain_pidm
from envs.base import PROP
from experiment import arguments, checkpoints, records
from results import tables

MUTATIONS = 1_000  # of each format
JUNK = (None, True, -1, 0, 1e308, 2**63, "", "x" * 99, [], {}, [[]], {"a": {}}, "../../etc", float("nan"))


def damage(rng, blob):
    """A file with bytes changed, lost, repeated or exchanged."""
    blob, kind = bytearray(blob), rng.randrange(5)
    at = rng.randrange(len(blob))
    if kind == 0:
        for _ in range(rng.randrange(1, 9)):
            blob[rng.randrange(len(blob))] = rng.randrange(256)
    elif kind == 1:
        del blob[at:]
    elif kind == 2:
        del blob[at : at + rng.randrange(1, 64)]
    elif kind == 3:
        blob[at:at] = blob[: rng.randrange(1, 64)]
    else:
        blob[at : at + 8] = rng.randbytes(8)
    return bytes(blob)


def spoil(rng, tree):
    """A JSON-like tree in which one value is junk, or one key is gone or another."""
    tree = json.loads(json.dumps(tree))
    node = tree
    while True:
        name = rng.choice(list(node))
        if not (isinstance(node[name], dict) and node[name] and rng.random() < 0.7):
            break
        node = node[name]
    kind = rng.randrange(3)
    if kind == 0:
        node[name] = rng.choice(JUNK)
    elif kind == 1:
        del node[name]
    else:
        node[rng.choice(["", "é", "0", "__class__", "__msgpack_chunked_array__"])] = node.pop(name)
    return tree


def survive(read):
    """Call a reader; whether it took the file. Anything but a UserError fails the test."""
    try:
        read()
        return True
    except records.UserError as error:
        assert str(error) and "\n" not in str(error), error
        return False


@pytest.fixture(autouse=True)
def little_memory():
    """No reader may take a gigabyte."""
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit - before < 1e9


PARAMS = {"params": {"actor": {"Dense_0": {"kernel": np.ones((3, 2), np.float32), "bias": np.zeros(2, np.float32)}}}}


def test_checkpoints(tmp_path):
    path, rng, taken = tmp_path / "policy.msgpack", random.Random(0), 0
    meta = {"task": "go1_loco", "args": dataclasses.asdict(ppo_finetune.Args())}
    checkpoints.save(path, PARAMS, meta)
    whole = path.read_bytes()
    like = jax.tree.map(jnp.asarray, PARAMS)

    def read():
        params, _ = checkpoints.load(path, "policy")
        checkpoints.check_shapes(path, params, like)

    assert survive(read)
    for i in range(MUTATIONS):
        if i % 2:
            path.write_bytes(damage(rng, whole))
        else:
            content = {"params": jax.tree.map(lambda x: x.tolist(), PARAMS), "meta": json.dumps(spoil(rng, meta))}
            path.write_bytes(flax.serialization.msgpack_serialize(spoil(rng, content)))
        taken += survive(read)
    assert taken < MUTATIONS / 2


def test_states(tmp_path):
    rng, state = random.Random(1), {"key": jax.random.key(0), "w": jnp.ones((2, 3)), "n": jnp.int32(4)}
    checkpoints.save_state(tmp_path, state, [{"iteration": 1, "reward": 0.5}])
    path = tmp_path / records.STATE
    whole = path.read_bytes()
    assert survive(lambda: checkpoints.load_state(tmp_path, state))
    for _ in range(MUTATIONS):
        path.write_bytes(damage(rng, whole))
        survive(lambda: checkpoints.load_state(tmp_path, state))


def test_arguments_of_a_run(tmp_path):
    rng, path = random.Random(2), tmp_path / "args.json"
    record = dataclasses.asdict(ppo_finetune.Args(num_envs=4, hidden=(8, 8))) | {"config": {}, "versions": {}}
    args, taken = ppo_finetune.Args(resume=str(tmp_path)), 0

    def read():
        found = arguments.resumed(args)
        ppo_finetune.merge(found, ppo_finetune.envs.TASKS["go1_loco"][1].ppo)

    path.write_text(json.dumps(record))
    assert survive(read)
    for i in range(MUTATIONS):
        blob = json.dumps(spoil(rng, record)).encode() if i % 2 else damage(rng, json.dumps(record).encode())
        path.write_bytes(blob)
        taken += survive(read)
    assert taken < MUTATIONS


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    """A collection of made-up numbers: 2 rollouts of 8 steps of 4 Go1."""
    folder, rng = tmp_path_factory.mktemp("data"), np.random.default_rng(0)
    shape = (2, 8, 4)
    for name, width in (("x", 30), ("action", 12), ("lin_vel", 3)):
        np.save(folder / f"{name}.npy", rng.normal(size=(*shape, width)).astype(np.float32))
    first = np.zeros(shape, bool)
    first[0, 0] = True
    np.save(folder / "first.npy", first)
    np.save(folder / "rough.npy", np.zeros(shape, bool))
    meta = {"robot": "go1", "iterations": 2, "num_steps": 8, "num_envs": 4, "history": 2, "validation_envs": [3]}
    meta |= {"layout": list(PROP), "transitions": 64, "args": {}, "versions": {}}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def test_collections(collection, tmp_path):
    rng, folder, taken = random.Random(3), tmp_path / "data", 0
    shutil.copytree(collection, folder)
    files = {path: path.read_bytes() for path in sorted(folder.iterdir())}
    meta = folder / "meta.json"

    def read():
        data = pretrain_pidm.Dataset(folder)
        with np.errstate(all="ignore"):  # shifted bytes are strange numbers
            data.windows(data.train[:4])

    assert survive(read)
    for i in range(MUTATIONS):
        path = rng.choice(list(files))
        if path == meta and i % 2:
            path.write_text(json.dumps(spoil(rng, json.loads(files[path]))))
        else:
            header = min(len(files[path]), 160)  # what is behind it are numbers, right or wrong
            path.write_bytes(damage(rng, files[path][:header]) + files[path][header:])
        taken += survive(read)
        path.write_bytes(files[path])
    assert taken < MUTATIONS


def test_run_folders(tmp_path, capsys):
    """The report names a damaged run and leaves it out."""
    rng, folder, left_out = random.Random(4), tmp_path / "seed0", 0
    folder.mkdir()
    record = {"num_envs": 2, "num_steps": 5, "total_steps": 40, "lr": 1.0, "num_epochs": 5, "mirror_coef": 0.1}
    record |= {"config": {}, "seed": 0, "versions": {"machine": "m", "device": "d"}}
    texts = {"args.json": json.dumps(record), "eval.json": '{"task": {"falls": 0.0}}'}
    texts["metrics.csv"] = "iteration,env_steps,episode_return\n" + "".join(f"{i},{10 * i},1.5\n" for i in range(1, 5))
    for name, text in texts.items():
        (folder / name).write_text(text)
    assert tables.load_run(folder)
    for i in range(MUTATIONS):
        name = rng.choice(list(texts))
        blob = texts[name].encode()
        spoilt = json.dumps(spoil(rng, json.loads(blob))).encode() if name.endswith("json") and i % 2 else None
        (folder / name).write_bytes(spoilt or damage(rng, blob))
        left_out += tables.load_run(folder) is None
        (folder / name).write_bytes(blob)
    assert left_out == capsys.readouterr().err.count("left out: ") > MUTATIONS / 4
