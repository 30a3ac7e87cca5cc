"""Many devices, on one host or several. Environments are split over all of them, and each has a copy of the rest.

The scripts read as for one device. The compiler adds the communication where these shardings ask for it: gradients and
statistics are means over all environments, and minibatches are shuffled within each device's block of them.
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiment import records

PIECE = 2048  # samples whose activations fit the cache of a CPU core


def join(distributed):
    """Join the other processes with --distributed. All but the first print nothing.

    SLURM and Open MPI tell a process who it is, and JAX gives it one GPU there. Elsewhere it has all of its host: set
    JAX_COORDINATOR_ADDRESS (host:port of process 0), JAX_NUM_PROCESSES and JAX_PROCESS_ID. UserError if nothing does,
    or if JAX finds no device.
    """
    if distributed:
        count, number = (os.environ.get(f"JAX_{name}") for name in ("NUM_PROCESSES", "PROCESS_ID"))
        try:
            jax.distributed.initialize(num_processes=count and int(count), process_id=number and int(number))
        except (ValueError, RuntimeError) as error:
            raise records.UserError(
                f"--distributed: {str(error).rstrip('.')}; see experiment/devices.py for what to set"
            ) from None
    find()
    if not is_first():
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, for the rest of the process


def find():
    """Start JAX's devices. UserError if the platform that JAX_PLATFORMS names is not here."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        platform = os.environ.get("JAX_PLATFORMS")
        if not platform:
            raise records.UserError(f"JAX finds no device: {str(error).splitlines()[0]}") from None
        jax.config.update("jax_platforms", None)
        here = jax.devices()[0].platform
        raise records.UserError(
            f"JAX_PLATFORMS={platform}: no such device here; unset it, or set it to {here}"
        ) from None


def is_first():
    """True in the process that prints and writes files."""
    return jax.process_index() == 0


def any_process(asked):
    """True if any process asks to stop: all have to stop after the same row."""
    if jax.process_count() == 1:
        return asked
    from jax.experimental import multihost_utils

    return bool(np.any(multihost_utils.process_allgather(np.array(asked))))


def check_engine(engine):
    """Raise ValueError if this engine cannot use the present devices."""
    name = type(engine).__name__.removesuffix("Engine").lower()
    if jax.device_count() > 1 and not engine.many_devices:
        way = "choose --engine mjx, or set CUDA_VISIBLE_DEVICES=0"
        raise ValueError(f"engine {name} works on one device, here are {jax.device_count()}; {way}")
    if name == "warp" and jax.default_backend() != "gpu":
        raise ValueError("engine warp needs an NVIDIA GPU, here is none that JAX sees; choose --engine c")


def mesh():
    """All devices of all hosts in a row."""
    return Mesh(np.array(jax.devices()), ("devices",))


def replicated():
    """Sharding of an array of which every device has a copy."""
    return NamedSharding(mesh(), PartitionSpec())


def split(axis):
    """Sharding of an array of which every device has a part of this axis."""
    return NamedSharding(mesh(), PartitionSpec(*[None] * axis, "devices"))


def of_state(state, axis):
    """Shardings of a TrainState: its environments, on this axis of `env_state`, are split."""
    return jax.tree.map(lambda _: replicated(), state).replace(
        env_state=jax.tree.map(lambda _: split(axis), state.env_state)
    )


def place(tree, shardings):
    """Lay arrays, the same in every process, out over the devices by a tree of shardings."""

    def put(x, sharding):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(x), sharding))
        whole = np.asarray(x)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(put, tree, shardings)


def mean_in_pieces(function, batch):
    """Return function(batch), which is a mean over samples; on a CPU, piece by piece, a large batch takes less time.

    Leaves of batch are (B, ...). It is halved until a piece has at most PIECE samples, or an odd number.
    """
    size = len(jax.tree.leaves(batch)[0])
    alone = jax.default_backend() == "cpu" and jax.device_count() == 1
    count = 1
    while alone and size // count > PIECE and size % (2 * count) == 0:
        count *= 2
    pieces = jax.tree.map(lambda x: x.reshape(count, size // count, *x.shape[1:]), batch)
    zero = jax.tree.map(jnp.zeros_like, jax.eval_shape(function, jax.tree.map(lambda x: x[0], pieces)))

    def add(total, piece):
        return jax.tree.map(jnp.add, total, function(piece)), None

    return jax.tree.map(lambda x: x / count, jax.lax.scan(add, zero, pieces)[0])
