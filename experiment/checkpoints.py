"""Weights of policies and PIDMs, and the whole state of a run for --resume, as msgpack files."""

import json
from pathlib import Path

import flax
import jax
import jax.numpy as jnp
import numpy as np

import envs
from experiment import records


def save(path, params, meta):
    """Write weights, and a JSON-able dict about them, as one msgpack file."""
    blob = flax.serialization.msgpack_serialize(
        {
            "params": flax.serialization.to_state_dict(jax.device_get(params)),
            "meta": json.dumps(meta | {"versions": records.versions()}),
        }
    )
    records.replace_bytes(path, blob)


KINDS = {"policy": {"task", "args"}, "PIDM checkpoint": {"robot", "layout", "history"}}  # names in their meta


def load(path, kind):
    """Read what `save` wrote: params and meta. UserError if the file is missing or is not one of that kind."""
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
        params, meta = content["params"], json.loads(content["meta"])
    except OSError as error:
        raise records.UserError(f"cannot read {kind} {path}: {error.strerror}") from None
    except Exception:  # msgpack has no common error class; whatever it says, the file is not ours
        raise records.UserError(f"{path} is not a {kind}, or it is damaged") from None
    if not KINDS[kind] <= meta.keys():
        raise records.UserError(f"{path} is not a {kind}; it holds {', '.join(sorted(meta))}")
    return params, meta


def load_networks(path, like, env):
    """Params of a policy file, but with the action std of `like`. UserError if it lacks the leaves and shapes of that.

    A trained policy has a small std, with which it would hardly explore. UserError also if it is of another robot,
    body, observation or network.
    """
    params, meta = load(Path(path), "policy")
    family, config = (envs.TASKS | envs.OWN).get(meta["task"], (None, None))  # robots from a file differ in body
    if config and config.robot != env.robot.name:
        raise records.UserError(f"{path} is a policy for robot {config.robot}, here is robot {env.robot.name}")
    if family and [*family.OBS] != [*type(env).OBS]:  # of as many numbers, say
        raise records.UserError(f"{path} sees {', '.join(family.OBS)}; this task has {', '.join(type(env).OBS)}")
    here = "pidm" if "normalizer" in like else "mlp"
    network = meta["args"].get("network", here)
    if network != here:
        raise records.UserError(f"{path} has the network {network}; give --network {network}")
    check_body(path, meta, env)
    check_shapes(path, params, like)
    params = jax.tree.map(jnp.asarray, params)
    return params | {"params": params["params"] | {"log_std": like["params"]["log_std"]}}


def load_pidm(path, env, like):
    """Params and normalizer of a PIDM checkpoint, of which the parts in `like` (same keys) are returned.

    UserError if it was made for another robot, body, layout of x, K, action scale or dt, or if a part has other shapes.
    """
    if not path.exists():
        ways = "--pretrained names one; with --load-into none only its input normalisation is used"
        raise records.UserError(f"cannot read PIDM checkpoint {path}: No such file or directory; {ways}")
    content, meta = load(path, "PIDM checkpoint")
    ours = {"robot": env.robot.name, "layout": list(env.prop_layout), "history": env.config.history}
    since = {"action_scale": list(env.robot.action_scale), "dt": env.dt}  # older checkpoints do not say
    for name, here in (ours | {name: x for name, x in since.items() if meta.get(name) is not None}).items():
        if meta[name] != here:
            raise records.UserError(f"{path} was made for {name} {meta[name]}, here is {name} {here}")
    check_body(path, meta, env)
    parts = {kind: {name: x for name, x in content.get(kind, {}).items() if name in like[kind]} for kind in like}
    check_shapes(path, parts, like)
    return parts


def check_body(path, meta, env):
    """UserError if a checkpoint is of another body than the environment's robot, by their digests."""
    theirs, ours = (body.get("digest", "none: a shipped robot") for body in (meta.get("body", {}), env.config.body))
    if theirs != ours:
        raise records.UserError(f"{path} was made for another body: its digest is {theirs}, here it is {ours}")


def check_shapes(path, params, like):
    """UserError unless params has the leaves and shapes of `like`, named after the file `path`."""
    shapes = [{jax.tree_util.keystr(k): jnp.shape(v) for k, v in jax.tree.leaves_with_path(t)} for t in (params, like)]
    for name in sorted(shapes[0].keys() | shapes[1].keys()):
        if shapes[0].get(name) != shapes[1].get(name):
            raise records.UserError(f"{path}: {name} is {shapes[0].get(name)}, this task needs {shapes[1].get(name)}")


def finite(tree):
    """True if every number of a tree of arrays is finite."""
    return all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def save_state(folder, state, rows):
    """Write the whole state of a run, from which it goes on to the same bits, and its rows so far."""
    leaves = jax.device_get([jax.random.key_data(x) if is_key(x) else x for x in jax.tree.leaves(state)])
    blob = flax.serialization.msgpack_serialize(
        {"leaves": {str(i): np.asarray(x) for i, x in enumerate(leaves)}, "rows": json.dumps(rows)}
    )
    records.replace_bytes(folder / records.STATE, blob)


def load_state(folder, like):
    """State and rows that `save_state` wrote. UserError if there are none, or not with the leaves of `like`."""
    path = Path(folder) / records.STATE
    wanted, structure = jax.tree.flatten(like)
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
        leaves, rows = [content["leaves"][str(i)] for i in range(len(content["leaves"]))], json.loads(content["rows"])
        same = len(leaves) == len(wanted)
        leaves = [jax.random.wrap_key_data(x) if is_key(w) else x for x, w in zip(leaves, wanted, strict=False)]
        same &= all(x.shape == w.shape and x.dtype == w.dtype for x, w in zip(leaves, wanted, strict=False))
    except OSError as error:
        raise records.UserError(f"cannot resume from {path}: {error.strerror}") from None
    except (MemoryError, jax.errors.JaxRuntimeError):
        raise
    except Exception:  # msgpack has no common error class; whatever it says, the file is not ours
        raise records.UserError(f"{path} is damaged; start the run again with --force") from None
    if not same:
        raise records.UserError(
            f"{path} was written by other code or settings than these; start the run again with --force"
        )
    return structure.unflatten(leaves), rows


def is_key(x):
    """True for arrays of random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
