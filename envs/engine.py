"""Physics engines behind one interface: `step(physics, ctrl)` advances one simulation by one control step.

    c     MuJoCo's own C code on a thread pool (mujoco.batch), called from inside jit; for CPUs
    mjx   MuJoCo rewritten in JAX; for GPUs and TPUs
    warp  MuJoCo rewritten in NVIDIA Warp, called through MJX; for NVIDIA GPUs, and for tests on CPUs

All are pure functions of a `Physics` and may be vmapped, to any depth. The contact solver starts each control step
cold: joint targets have just jumped, so its last solution is no better a first guess.
"""

import copy
import functools
import importlib.util
import math
import os
import threading
from functools import partial
from pathlib import Path

import flax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

# A callback reads its arguments on the threads that also run the computation waiting for it. With asynchronous dispatch
# and large arguments the two deadlock (jax-ml/jax#24255; seen with 512 G1). This must be set before JAX starts.
jax.config.update("jax_cpu_enable_async_dispatch", False)


def cpu_count():
    """CPUs this process may use: those of its affinity, within the quotas of the containers it runs in."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([count, *(math.ceil(quota) for quota in cpu_quotas(Path("/")))]))


def cpu_quotas(root):
    """CPUs that Linux control groups, version 1 or 2, allow this process, as found below the folder `root`."""
    groups = root / "sys/fs/cgroup"
    try:
        entries = [line.split(":", 2) for line in (root / "proc/self/cgroup").read_text().splitlines()]
        paths = [path.strip("/") for _, kinds, path in entries if kinds == "" or "cpu" in kinds.split(",")]
    except (OSError, ValueError):
        paths = []
    for folder in {groups / part for path in ["", *paths] for part in [Path(path), *Path(path).parents]}:
        for base in (folder, groups / "cpu" / folder.relative_to(groups)):
            try:
                if (base / "cpu.max").exists():
                    quota, period = (base / "cpu.max").read_text().split()
                else:
                    quota, period = ((base / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
                if quota != "max" and float(quota) > 0:
                    yield float(quota) / float(period)
            except (OSError, ValueError, ZeroDivisionError):
                pass


@flax.struct.dataclass
class Physics:
    """One simulation in float32. nq, nv, nu, nbody as in MuJoCo; S sensor values, M mocap bodies."""

    # state
    qpos: jax.Array  # (nq,) base position (world), base quaternion wxyz, joint angles
    qvel: jax.Array  # (nv,) base velocity (world), base angular velocity (base frame), joint velocities
    # set by tasks and randomisation
    mocap_pos: jax.Array  # (M, 3) [m]
    mocap_quat: jax.Array  # (M, 4)
    wrench: jax.Array  # (nbody, 6) force [N] and torque [N m] on each body, world frame
    friction: jax.Array  # () sliding coefficient of all the robot's geoms
    mass_scale: jax.Array  # (nbody,) factor on mass and inertia
    strength: jax.Array  # (nu,) factor on kp
    joint_friction: jax.Array  # () [N m] dry friction of the joints that have any in the model
    # measured in the last step
    qacc: jax.Array  # (nv,) of the last physics step
    torque: jax.Array  # (nu,) [N m] kp part from the last physics step, kd part from the present velocities
    sensors: jax.Array  # (S,) present site poses and velocities, contact forces of the last physics step
    overflow: jax.Array  # () bool: a bounded engine dropped contacts or constraints in the last control step


RANDOMISED = ("friction", "mass_scale", "strength", "joint_friction")  # fields of Physics, drawn once an episode


class Engine:
    """The parts that all engines share: the compiled model, the randomised fields and the sensor layout."""

    many_devices = True  # its simulations can be spread over several devices
    bounded = False  # it has room for a fixed number of contacts, and drops the rest

    def __init__(self, spec, decimation):
        self.model, self.decimation = spec.compile(), decimation
        self.robot_geoms = self.model.geom_contype > 0
        self.rubbing = self.model.dof_frictionloss > 0

    def initial(self, qpos, qvel, **randomised):
        """Physics at a given state, with nothing measured yet. randomised: values of the fields in RANDOMISED."""
        m = self.model
        return Physics(
            **randomised,
            qpos=qpos,
            qvel=qvel,
            mocap_pos=jnp.zeros((m.nmocap, 3)),
            mocap_quat=jnp.tile(jnp.array([1.0, 0, 0, 0]), (m.nmocap, 1)),
            wrench=jnp.zeros((m.nbody, 6)),
            qacc=jnp.zeros(m.nv),
            torque=jnp.zeros(m.nu),
            sensors=jnp.zeros(m.nsensordata),
            overflow=jnp.zeros((), bool),
        )

    def sensor(self, *names):
        """Indices into `Physics.sensors`, (len(names), width). ValueError for a name that the MJCF lacks."""
        for name in names:
            if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SENSOR, name) < 0:
                known = [self.model.sensor(i).name for i in range(self.model.nsensor)]
                known = [other for other in known if other.endswith(f"_{name.rpartition('_')[2]}")]
                has = f"; it has {', '.join(known)}" if known else ""
                raise ValueError(f"the robot's MJCF has no sensor {name!r}{has}")
        found = [self.model.sensor(name) for name in names]
        return np.array([np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in found]) if names else np.zeros((0, 3), int)

    def joint_torque(self, qfrc_actuator, qvel):
        """PD torque (nu,) [N m]: the limited kp part, and the kd part that the MJCF holds as joint damping."""
        return qfrc_actuator[6:] - self.model.dof_damping[6:] * qvel[6:]

    def randomised(self, xp, friction, mass_scale, strength, joint_friction):
        """Model fields of simulations with any leading dimensions; xp is numpy or jax.numpy."""
        m = self.model
        sliding = xp.where(self.robot_geoms, friction[..., None], m.geom_friction[:, 0])
        rest = xp.broadcast_to(m.geom_friction[:, 1:], (*sliding.shape, 2))
        # Constants of the constraint regularisation that depend on mass (mj_setConst) keep their nominal values, and so
        # does body_subtreemass, which only moves the point about which spatial vectors are taken.
        return {
            "geom_friction": xp.concatenate([sliding[..., None], rest], -1),
            "body_mass": m.body_mass * mass_scale,
            "body_inertia": m.body_inertia * mass_scale[..., None],
            "actuator_gainprm": m.actuator_gainprm * strength[..., None],
            "actuator_biasprm": m.actuator_biasprm * strength[..., None],
            # In MJX a joint with friction 0 is held, as if nothing limited its friction.
            "dof_frictionloss": xp.where(self.rubbing, xp.maximum(joint_friction[..., None], 1e-6), 0.0),
        }


class CEngine(Engine):
    """MuJoCo C on all CPU threads. Results do not depend on the number of threads."""

    many_devices = False  # one callback takes the arrays of all simulations
    INPUTS = ("qpos", "qvel", "mocap_pos", "mocap_quat", "wrench", *RANDOMISED)
    OUTPUTS = ("qpos", "qvel", "qacc", "sensors", "qfrc_actuator")
    # field of Physics -> that of MjData, where the names differ
    MUJOCO = {"wrench": "xfrc_applied", "sensors": "sensordata"}

    def __init__(self, spec, decimation):
        super().__init__(spec, decimation)
        try:
            from mujoco.batch import Batch  # new in MuJoCo 3.17
        except ImportError:
            raise ImportError(f"engine c needs mujoco >= 3.17, this is {mujoco.__version__}") from None
        self.make_batch = Batch
        self.batches = {}  # number of simulations -> Batch
        self.lock = threading.Lock()  # only one thread may use a Batch at a time

    def step(self, physics, ctrl):
        """Advance by `decimation` physics steps with joint targets ctrl (nu,) [rad]."""
        m = self.model
        sizes = dict.fromkeys(self.OUTPUTS, m.nv) | {"qpos": m.nq, "sensors": m.nsensordata}
        shapes = {name: jax.ShapeDtypeStruct((size,), jnp.float32) for name, size in sizes.items()}
        inputs = {name: getattr(physics, name) for name in self.INPUTS}
        out = jax.pure_callback(self.run, shapes, inputs, ctrl, vmap_method="broadcast_all")
        torque = self.joint_torque(out.pop("qfrc_actuator"), out["qvel"])
        return physics.replace(**out, torque=torque)

    def run(self, inputs, ctrl):
        """The callback: numpy in, numpy out, any leading dimensions. Calling JAX here would deadlock."""
        inputs = {name: np.asarray(value) for name, value in inputs.items()}
        ctrl = np.asarray(ctrl)
        lead = ctrl.shape[:-1]
        count = int(np.prod(lead))
        with self.lock:
            batch = self.batch(count)
            fields = self.randomised(np, *(inputs.pop(name) for name in RANDOMISED))
            for name, value in fields.items():
                per_sim = batch.expand(name)
                per_sim[:] = value.reshape(per_sim.shape)
            for name, value in (inputs | {"ctrl": ctrl}).items():
                row = batch.bind(self.MUJOCO.get(name, name))
                row[:] = value.reshape(row.shape)
            batch.bind("qacc_warmstart")[:] = 0.0
            batch.step(nstep=self.decimation, stage=mujoco.mjtStage.mjSTAGE_VEL)
            return {
                name: batch.bind(self.MUJOCO.get(name, name)).astype(np.float32).reshape(*lead, -1)
                for name in self.OUTPUTS
            }

    def batch(self, count):
        """The Batch of `count` simulations, made once. Its outputs are bound, so that each step copies them out."""
        if count not in self.batches:
            self.batches[count] = self.make_batch(self.model, count, nthread=cpu_count())
            for name in self.OUTPUTS:
                self.batches[count].bind(self.MUJOCO.get(name, name))
        return self.batches[count]


class MjxEngine(Engine):
    """MJX in JAX. It lacks net-force contact sensors, so its model goes without them and they are computed here.

    It finds all contacts that any two geoms could have, hundreds beside slabs, and solves the deepest of them.
    """

    bounded = True

    def __init__(self, spec, decimation):
        super().__init__(spec, decimation)
        try:  # imported here, because MJX is slow to import and prints warnings about missing packages
            from mujoco import mjx
            from mujoco.mjx._src import support  # contact_force_dim has no public name; mujoco-mjx is pinned
        except ImportError:
            raise ImportError("engine mjx needs the package mujoco-mjx, in the version of mujoco") from None
        self.mjx, self.contact_force_dim = mjx, support.contact_force_dim
        self.touching = self.contact_sensors()  # (contact sensors, ngeom)
        spec = spec.copy()
        for sensor in [s for s in spec.sensors if s.type == mujoco.mjtSensor.mjSENS_CONTACT]:
            spec.delete(sensor)
        geoms = np.sum((self.model.geom_contype > 0) & (self.model.geom_bodyid > 0))
        self.contacts = 2 * int(geoms)  # a lying capsule touches at both ends, and few lie at once
        spec.add_numeric(name="max_contact_points", data=[self.contacts])
        device = jax.local_devices()[0]  # MJX's default is the first of all devices, which may be another host's
        self.mjx_model = mjx.put_model(spec.compile(), device=device, impl="jax")
        self.mjx_data = mjx.make_data(self.mjx_model, device=device, impl="jax")

    def contact_sensors(self):
        """Geoms that each contact sensor covers, (sensors, ngeom) of 0 and 1. These sensors come last in the MJCF."""
        m, rows = self.model, []
        for i in np.flatnonzero(m.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT):
            covers_body = m.sensor_reftype[i] == mujoco.mjtObj.mjOBJ_BODY
            rows.append((m.geom_bodyid if covers_body else np.arange(m.ngeom)) == m.sensor_refid[i])
        first = m.nsensordata - 3 * len(rows)
        if rows and first != m.sensor_adr[m.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT][0]:
            raise ValueError("contact sensors must come after all other sensors in the MJCF")
        return np.array(rows, np.float32).reshape(-1, m.ngeom)

    def step(self, physics, ctrl):
        """Advance by `decimation` physics steps with joint targets ctrl (nu,) [rad]."""
        model, data = self.load(self.mjx_model, self.mjx_data, physics, ctrl)
        data = self.advance(model, data)
        depths = data._impl.contact.dist
        overflow = jnp.all(depths < 0) & (len(depths) == self.contacts)  # no room is left, so some may be lost
        return self.measure(physics, model, data, self.net_forces(model, data)).replace(overflow=overflow)

    def load(self, model, data, physics, ctrl):
        """The model with the randomised fields of a simulation, and the data at its state."""
        fields = self.randomised(jnp, *(getattr(physics, name) for name in RANDOMISED))
        return model.tree_replace(fields), data.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            mocap_pos=physics.mocap_pos,
            mocap_quat=physics.mocap_quat,
            xfrc_applied=physics.wrench,
            ctrl=ctrl,
        )

    def advance(self, model, data):
        """Make `decimation` physics steps."""
        return jax.lax.scan(lambda d, _: (self.mjx.step(model, d), None), data, None, self.decimation)[0]

    def measure(self, physics, model, data, forces):
        """Physics after a step: sites from the new state, contact forces as given. model and data are MJX's own."""
        mjx = self.mjx
        now = mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        sites = mjx.sensor_vel(model, mjx.sensor_pos(model, now)).sensordata
        return physics.replace(
            qpos=data.qpos,
            qvel=data.qvel,
            qacc=data.qacc,
            torque=self.joint_torque(data.qfrc_actuator, data.qvel),
            sensors=jnp.concatenate([sites, forces.ravel()]),
        )

    def net_forces(self, model, data):
        """Net contact force (sensors, 3) [N] on the geoms of each contact sensor, world frame."""
        contact = data._impl.contact
        force, index = self.contact_force_dim(model, data, 3)  # in the contact frame
        world = jnp.einsum("cij,ci->cj", contact.frame[index], force[:, :3])
        geom1, geom2 = contact.geom[index].T
        touching = jnp.asarray(self.touching)
        return (touching[:, geom2] - touching[:, geom1]) @ world


class WarpEngine(MjxEngine):
    """MuJoCo Warp through MJX. Its memory is fixed: per simulation `contacts` on average, and `rows` of constraints.

    The feet are measured as in MJX, because a second forward pass would solve the contacts again.
    """

    many_devices = False  # one kernel takes all simulations, on one device

    def __init__(self, spec, decimation):
        super().__init__(spec, decimation)
        if importlib.util.find_spec("warp") is None:
            raise ImportError("engine warp needs the package warp-lang: pip install -r requirements-gpu.txt")
        # Four sides of a friction pyramid, joint limits, and joints with dry friction.
        self.rows = 4 * self.contacts + self.model.nu + int(self.rubbing.sum())
        self.plain_model = copy.copy(self.model)
        # Warp never resets by itself, and refuses a model with the bit that says so.
        self.plain_model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        model = self.mjx.put_model(self.plain_model, device=jax.local_devices()[0], impl="warp")
        self.warp_model = model.tree_replace({"opt._impl.warn_overflow": 0})  # `Physics.overflow` reports it
        self.step = one_batch(self.step_all)

    def step_all(self, physics, ctrl):
        """`step` of N simulations, leading axis N on all arrays. N sets the memory for contacts."""
        data = self.empty_data(len(ctrl))
        return jax.vmap(partial(self.step_one, data))(physics, ctrl)

    def step_one(self, data, physics, ctrl):
        """`step` of one of many simulations. All share `data`, which holds the contacts."""
        model, data = self.load(self.warp_model, data, physics, ctrl)
        data = self.advance(model, data)
        model, mjx_data = self.load(self.mjx_model, self.mjx_data, physics, ctrl)
        mjx_data = mjx_data.replace(**{name: getattr(data, name) for name in self.MEASURED})
        forces = data.sensordata[-3 * len(self.touching) :]
        physics = self.measure(physics, model, mjx_data, forces)
        return physics.replace(overflow=jnp.any(data._impl.overflow & self.NO_ROOM != 0))

    NO_ROOM = 0xFF  # bits of mujoco_warp's OverflowType that report memory, not solver iterations
    MEASURED = ("qpos", "qvel", "qacc", "qfrc_actuator")

    def empty_data(self, count):
        """MJX data with room for the contacts of `count` simulations."""
        sizes = {"naconmax": count * self.contacts, "njmax": self.rows}
        with jax.ensure_compile_time_eval():
            data = self.mjx.make_data(self.plain_model, device=jax.local_devices()[0], impl="warp", **sizes)
            all_zero = jax.tree.map(lambda x: not np.asarray(x).any(), data)
        # Rebuild arrays of zeros inside jit, so that XLA does not embed them in the compiled program.
        return jax.tree.map(lambda x, zero: jnp.zeros(x.shape, x.dtype) if zero else x, data, all_zero)


def one_batch(step_all):
    """A step of one simulation that, under vmaps of any depth, calls `step_all` once on all simulations."""

    @jax.custom_batching.custom_vmap
    def step(physics, ctrl):
        lead = ctrl.shape[:-1]
        count = math.prod(lead)
        flat = jax.tree.map(lambda x: x.reshape(count, *x.shape[len(lead) :]), (physics, ctrl))
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), step_all(*flat))

    @step.def_vmap
    def vmapped(axis_size, batched, physics, ctrl):
        inputs = jax.tree.map(
            lambda x, has: x if has else jnp.broadcast_to(x, (axis_size, *x.shape)), (physics, ctrl), tuple(batched)
        )
        stepped = step(*inputs)
        return stepped, jax.tree.map(lambda _: True, stepped)

    return step


ENGINES = {"c": CEngine, "mjx": MjxEngine, "warp": WarpEngine}


@functools.cache
def say_once(text):
    """Print a line, once a process."""
    print(text)


def best_engine():
    """Name of the default: c on a CPU, warp on one GPU where it is installed, else mjx."""
    if jax.default_backend() == "cpu":
        return "c"
    if jax.default_backend() != "gpu" or jax.device_count() > 1:
        return "mjx"
    if importlib.util.find_spec("warp"):
        return "warp"
    say_once("using engine mjx; warp is many times as fast on an NVIDIA GPU: pip install -r requirements-gpu.txt")
    return "mjx"


def make_engine(name, spec, decimation):
    """Build an engine; "auto" means `best_engine`. ValueError for an unknown name."""
    name = best_engine() if name == "auto" else name
    if name not in ENGINES:
        raise ValueError(f"unknown engine {name!r}; choose one of auto, {', '.join(ENGINES)}")
    return ENGINES[name](spec, decimation)
