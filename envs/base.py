"""What every task shares: the State, one control step, noise, history, randomisation, automatic reset, mirrors.

`env.reset(key) -> State` and `env.step(state, action) -> State` are pure functions of one environment; scripts vmap
them. A task family subclasses `Env` and says what it observes, rewards and terminates (see locomotion.py).
Legend: A joints and actions, F feet, O observation, X proprioception x_t (6 + 2A), K history length.
"""

import dataclasses
from dataclasses import dataclass

import flax
import jax
import jax.numpy as jnp
import numpy as np

from envs import terrain
from envs.engine import Physics, make_engine
from envs.robots import AXIAL, POLAR, ROBOTS


@dataclass(frozen=True)
class Config:
    """Numbers of a task. Weights are per second, ranges are (low, high)."""

    robot: str
    weights: dict[str, float]  # reward term -> weight
    ppo: dict  # the task's own PPO settings; see ppo_finetune.py
    episode_seconds: float = 20.0
    physics_dt: float = 0.005  # [s]
    decimation: int = 4  # physics steps per control step
    history: int = 5  # K
    noise: float = 1.0  # multiplies the sensor noise of NOISE
    reward_floor: float = -0.5  # per second, on the sum of all terms but termination
    termination_reward: float = 0.0  # once, when an episode ends by failure
    # end of an episode
    contact_ends: tuple[str, ...] = ("base",)  # sensors <name>_force whose contact is a failure
    max_tilt: float = 180.0  # [deg] a steeper trunk is a failure
    # start of an episode
    spawn_xy: float = 0.5  # [m] half-width around the origin
    spawn_yaw: float = np.pi  # [rad] half-width around forward
    spawn_joints: tuple[float, float] = (1.0, 1.0)  # factor on the default pose
    spawn_velocity: float = 0.0  # half-width of all six base velocities [m/s, rad/s]
    # randomisation, drawn once an episode
    friction: tuple[float, float] = (0.7, 0.7)
    added_mass: tuple[float, float] = (0.0, 0.0)  # [kg] on the base
    link_mass: tuple[float, float] = (1.0, 1.0)  # factor on each link's mass and inertia
    push_velocity: float = 0.0  # [m/s, rad/s] half-width of a sudden change of the base's velocity
    push_axes: int = 2  # 2: its horizontal velocity, 6: all six components
    push_seconds: tuple[float, float] = (10.0, 15.0)  # time between pushes


# Half-width of uniform sensor noise (tasks of Isaac Lab); commands and the last action are exact.
NOISE = {"lin_vel": 0.1, "ang_vel": 0.2, "gravity": 0.05, "joint_pos": 0.01, "joint_vel": 1.5}
PROP = {"ang_vel": "axial", "gravity": "polar", "joint_pos": "joint", "joint_vel": "joint"}  # x_t, in order
# Observation blocks of the robot itself -> (mirror kind, fixed scale), as `Env.OBS` lists them.
BODY = {
    "lin_vel": ("polar", 2.0),
    "ang_vel": ("axial", 0.25),
    "gravity": ("polar", 1.0),
    "joint_pos": ("joint", 1.0),
    "joint_vel": ("joint", 0.05),
    "action": ("joint", 0.5),
}
BLOWN_UP = 1e3  # [m, m/s, rad/s] no sound simulation gets here


@flax.struct.dataclass
class State:
    """One environment. `obs` is what follows an automatic reset, `final_obs` what stood before it."""

    physics: Physics
    obs: jax.Array  # (O,) scaled, noisy
    history: dict  # prop (K+1, X) in SI units, action (K, A); oldest first, as the robot logged them
    reward: jax.Array  # ()
    terminated: jax.Array  # () bool: failure, nothing follows
    truncated: jax.Array  # () bool: time limit, V(final_obs) follows
    final_obs: jax.Array  # (O,)
    final_history: dict
    action: jax.Array  # (A,) the last one
    clock: jax.Array  # () control steps since the episode began
    push_at: jax.Array  # () clock of the next push
    episode_return: jax.Array  # () sum of rewards, before the reset
    key: jax.Array
    task: flax.struct.PyTreeNode  # the task family's own state
    metrics: dict  # name -> (), of this step


@flax.struct.dataclass
class Course:
    """What is drawn before an episode starts; a task family may add to it (a goal)."""

    mocap_pos: jax.Array  # (M, 3) [m] obstacles
    mocap_quat: jax.Array  # (M, 4)
    curriculum: dict  # what an environment keeps from episode to episode (its level)


@flax.struct.dataclass
class Motion:
    """True kinematics, computed from qpos and qvel; forces and feet from the engine's sensors."""

    lin_vel: jax.Array  # (3,) base velocity, base frame [m/s]
    ang_vel: jax.Array  # (3,) base frame [rad/s]
    gravity: jax.Array  # (3,) unit vector, base frame
    joint_pos: jax.Array  # (A,) minus the default pose [rad]
    joint_vel: jax.Array  # (A,)
    joint_acc: jax.Array  # (A,)
    base_acc: jax.Array  # (6,) linear (world), angular (base frame)
    torque: jax.Array  # (A,) [N m]
    base_pos: jax.Array  # (3,) world [m]
    quat: jax.Array  # (4,) base orientation
    yaw: jax.Array  # () [rad]
    foot_pos: jax.Array  # (F, 3) world
    foot_vel: jax.Array  # (F, 3) world
    foot_force: jax.Array  # (F, 3) world [N]
    foot_contact: jax.Array  # (F,) bool, more than 1 N
    sensors: jax.Array  # (S,) all readings, for the contact forces of other bodies
    mocap_pos: jax.Array  # (M, 3) obstacles
    mocap_quat: jax.Array  # (M, 4)


@flax.struct.dataclass
class FootClocks:
    """How long each foot has been in the air or on the ground, for tasks that reward a gait."""

    air_time: jax.Array  # (F,) [s] since the foot left the ground
    contact_time: jax.Array  # (F,) [s] since it landed
    landed_after: jax.Array  # (F,) [s] flight that ended in this step, else 0

    def tick(self, contact, dt):
        """One control step later; contact (F,) bool."""
        return self.replace(
            landed_after=jnp.where(contact, self.air_time, 0.0),
            air_time=jnp.where(contact, 0.0, self.air_time + dt),
            contact_time=jnp.where(contact, self.contact_time + dt, 0.0),
        )


def rotate(quat, vec):
    """Vector(s) (..., 3) from the body frame of quat (..., 4) wxyz to its parent frame."""
    w, u = quat[..., :1], quat[..., 1:]
    return vec + 2 * jnp.cross(u, jnp.cross(u, vec) + w * vec)


def multiply(p, q):
    """Hamilton product of quaternions (..., 4) wxyz."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    real = pw * qw - jnp.sum(pv * qv, -1, keepdims=True)
    return jnp.concatenate([real, pw * qv + qw * pv + jnp.cross(pv, qv)], -1)


def axis_angle(axis, angle):
    """Quaternion (..., 4) of a turn by angle (...) about unit axis (..., 3)."""
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1)


def inverse(quat):
    """Conjugate of unit quaternions (..., 4)."""
    return quat * jnp.array([1.0, -1, -1, -1])


def yaw_of(quat):
    """Heading [rad] of a base orientation."""
    w, x, y, z = quat
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrap(angle):
    """Angle in [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def uniform(key, low, high, shape=()):
    """Uniform sample in [low, high)."""
    return jax.random.uniform(key, shape, minval=low, maxval=high)


def select(condition, yes, no):
    """Leaf-wise where over two pytrees of the same structure."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


class Env:
    """One robot task. Subclasses define OBS and the methods below `# --- task ---`."""

    # observation block -> (mirror kind, fixed scale); order is the order of the vector
    OBS: dict[str, tuple] = {}
    bootstrap_time_outs = True  # V(final_obs) follows a time limit; not where the policy sees the time left
    EVALUATION: dict = {}  # config fields for the measures of a trained policy
    SHOWCASE: dict = {}  # and for its pictures
    FILM: dict = {}  # which part of an episode they show; see render.film
    COMMAND: dict[str, tuple] = {}  # what a person who watches may ask for: name -> (low, high); see `tell`

    def __init__(self, config, engine="auto"):
        self.config, self.robot = config, ROBOTS[config.robot]
        spec = self.scene()
        spec.option.timestep = config.physics_dt
        self.engine = make_engine(engine, spec, config.decimation)
        self.model = self.engine.model
        self.dt = config.physics_dt * config.decimation  # [s] control step
        self.episode_steps = round(config.episode_seconds / self.dt)
        self.action_dim = len(self.robot.joints)
        self.default_pose = jnp.array(self.robot.default_pose)
        self.sensors = {
            kind: self.engine.sensor(*(f"{foot}_{kind}" for foot in self.robot.feet))
            for kind in ("pos", "vel", "force")
        }
        self.ends = self.engine.sensor(*(f"{name}_force" for name in config.contact_ends))
        self.legs = self.leg_chains()
        self.mirrors = {mirror: self.mirror_tables(mirror) for mirror in self.robot.mirrors}
        self.prop_layout = tuple(PROP)  # blocks of x_t
        self.prop_dim = sum(self.width(kind) for kind in PROP.values())
        self.obs_dim = sum(self.width(kind) for kind, _ in self.OBS.values())

    # --- task ---

    def scene(self, visual=False):
        """MjSpec of the robot and its ground."""
        return terrain.flat_scene(self.robot, visual)

    def first_curriculum(self):
        """What an environment starts its first episode with."""
        return {}

    def graduate(self, key, task, motion, terminated, truncated):
        """The curriculum after an episode that ends like this."""
        return {}

    def first_clock(self, key):
        """Control steps that have passed when an episode begins; more where episodes have random lengths."""
        return 0

    def course(self, key, curriculum):
        """Obstacles (and goal) of an episode; none here."""
        return Course(jnp.zeros((0, 3)), jnp.zeros((0, 4)), curriculum)

    def init_task(self, key, physics, course):
        """The task's own state at the start of an episode."""
        raise NotImplementedError

    def ground_height(self, course, xy):
        """Height of the ground [m] at horizontal positions (..., 2)."""
        return jnp.zeros(xy.shape[:-1])

    def place(self, key):
        """Where an episode starts: x, y (2,) [m] and yaw () [rad]."""
        k_xy, k_yaw = jax.random.split(key)
        c = self.config
        return uniform(k_xy, -c.spawn_xy, c.spawn_xy, (2,)), uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def track(self, task, motion):
        """Bring the task state up to this step's motion, before rewards."""
        return task

    def rewards(self, task, motion, action, last_action, clock):
        """Reward terms by name, unweighted, per second; those without a weight are ignored."""
        raise NotImplementedError

    def failed(self, task, motion):
        """Whether the episode ends in failure: a body on the ground that should not be, or a fall."""
        force = jnp.linalg.norm(motion.sensors[self.ends], axis=-1)
        return jnp.any(force > 1.0) | (-motion.gravity[2] < jnp.cos(jnp.deg2rad(self.config.max_tilt)))

    def advance(self, key, task, motion, clock):
        """Task state for the next step (commands), after rewards."""
        return task

    def task_metrics(self, task, motion, truncated):
        """Numbers to log, by name."""
        return {}

    def told(self, task, wanted):
        """The task state when a person asks for `wanted`, a number for each name of COMMAND."""
        return task

    # --- shared ---

    def reset(self, key, clock=None, curriculum=None):
        """Start an episode. `clock` (steps) lets a first episode start midway, so that time-outs spread out."""
        k_course, k_clock, k_spawn, k_task, k_sense, k_push, key = jax.random.split(key, 7)
        course = self.course(k_course, self.first_curriculum() if curriculum is None else curriculum)
        physics = self.spawn(k_spawn, course)
        task = self.init_task(k_task, physics, course)
        clock = jnp.asarray(self.first_clock(k_clock) if clock is None else clock, jnp.int32)
        action, motion = jnp.zeros(self.action_dim), self.motion(physics)
        sensed, prop = self.sense(k_sense, motion, task)
        obs = self.observe(sensed, task, action, motion, clock)
        history = {
            "prop": jnp.tile(prop, (self.config.history + 1, 1)),
            "action": jnp.zeros((self.config.history, self.action_dim)),
        }
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        return State(
            physics=physics,
            obs=obs,
            history=history,
            reward=zero,
            terminated=no,
            truncated=no,
            final_obs=obs,
            final_history=history,
            action=action,
            clock=clock,
            push_at=clock + self.push_interval(k_push),
            episode_return=zero,
            key=key,
            task=task,
            metrics=self.metrics(physics, ~no, {name: zero for name in self.config.weights}, task, motion, no),
        )

    def step(self, state, action):
        """One control step of 20 ms, with automatic reset. action (A,)."""
        key, k_sense, k_task, k_push, k_grade, k_reset = jax.random.split(state.key, 6)
        physics = self.engine.step(state.physics, self.default_pose + self.robot.action_scale * action)
        healthy = jnp.all(jnp.abs(physics.qpos) < BLOWN_UP) & jnp.all(jnp.abs(physics.qvel) < BLOWN_UP)  # false for NaN
        physics = select(healthy, physics, self.standing(state.physics))  # a diverged robot must not poison the batch

        # rewards and termination, on the true state
        motion = self.motion(physics)
        task = self.track(state.task, motion)
        terms = self.rewards(task, motion, action, state.action, state.clock)
        terms = {
            name: jnp.asarray(weight * terms[name] * self.dt, jnp.float32)
            for name, weight in self.config.weights.items()
        }
        terminated = self.failed(task, motion) | ~healthy
        reward = jnp.maximum(sum(terms.values()), self.config.reward_floor * self.dt)
        reward += self.config.termination_reward * terminated
        clock = state.clock + 1
        truncated = (clock >= self.episode_steps) & ~terminated
        metrics = self.metrics(physics, healthy, terms, task, motion, truncated)
        fresh = self.reset(k_reset, curriculum=self.graduate(k_grade, task, motion, terminated, truncated))

        # what the robot sees next
        physics, push_at = self.push(k_push, physics, clock, state.push_at)
        motion = self.motion(physics)
        task = self.advance(k_task, task, motion, clock)
        sensed, prop = self.sense(k_sense, motion, task)
        stepped = state.replace(
            physics=physics,
            obs=self.observe(sensed, task, action, motion, clock),
            history={
                "prop": jnp.concatenate([state.history["prop"][1:], prop[None]]),
                "action": jnp.concatenate([state.history["action"], action[None]])[1:],
            },
            action=action,
            clock=clock,
            push_at=push_at,
            episode_return=state.episode_return + reward,
            key=key,
            task=task,
        )
        return select(terminated | truncated, fresh, stepped).replace(
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_obs=stepped.obs,
            final_history=stepped.history,
            metrics=metrics
            | {"episode_return": stepped.episode_return, "episode_seconds": clock.astype(jnp.float32) * self.dt},
        )

    def metrics(self, physics, healthy, terms, task, motion, truncated):
        """What one step reports: weighted reward terms, the task's metrics, faults of the engine, the finished episode.

        Names that start with `episode_` count where an episode ends, all others in every step.
        """
        report = {f"reward/{name}": value for name, value in terms.items()} | self.task_metrics(task, motion, truncated)
        faults = {"diverged": ~healthy} | ({"overflow": physics.overflow} if self.engine.bounded else {})
        return report | faults | {"episode_return": jnp.zeros(()), "episode_seconds": jnp.zeros(())}

    def spawn(self, key, course):
        """Physics at the start of an episode: default pose, random place and heading, feet on the ground."""
        c, m = self.config, self.model
        k_place, k_link, k_joint, k_vel, k_friction, k_mass = jax.random.split(key, 6)
        joints = self.default_pose * uniform(k_joint, *c.spawn_joints, (self.action_dim,))
        low, high = m.jnt_range[1:].T
        joints = jnp.clip(joints, low, high)
        xy, yaw = self.place(k_place)
        quat = axis_angle(jnp.array([0.0, 0, 1]), yaw)
        feet = rotate(quat, self.feet_in_base(joints))
        height = jnp.max(self.ground_height(course, xy + feet[:, :2]) + self.robot.sole - feet[:, 2])
        qpos = jnp.concatenate([xy, height[None], quat, joints])
        base_vel = uniform(k_vel, -c.spawn_velocity, c.spawn_velocity, (6,))
        qvel = jnp.concatenate([base_vel, jnp.zeros(self.action_dim)])
        base = 1  # the first body after the world
        added = uniform(k_mass, *c.added_mass)
        mass_scale = uniform(k_link, *c.link_mass, (m.nbody,)).at[base].add(added / m.body_mass[base])
        physics = self.engine.initial(qpos, qvel, uniform(k_friction, *c.friction), mass_scale)
        return physics.replace(mocap_pos=course.mocap_pos, mocap_quat=course.mocap_quat)

    def standing(self, physics):
        """The same simulation with the robot still, in its default pose: finite whatever it was before."""
        m = self.model
        qpos = jnp.concatenate([jnp.array([0.0, 0, 1, 1, 0, 0, 0]), self.default_pose])
        fresh = self.engine.initial(qpos, jnp.zeros(m.nv), physics.friction, physics.mass_scale)
        return fresh.replace(mocap_pos=physics.mocap_pos, mocap_quat=physics.mocap_quat)

    def push_interval(self, key):
        """Control steps until the next push."""
        return jnp.round(uniform(key, *self.config.push_seconds) / self.dt).astype(jnp.int32)

    def push(self, key, physics, clock, push_at):
        """Disturb the robot: change the horizontal base velocity at once, when it is time."""
        k_vel, k_next = jax.random.split(key)
        now = clock >= push_at
        axes = self.config.push_axes
        kick = uniform(k_vel, -self.config.push_velocity, self.config.push_velocity, (axes,)) * now
        push_at = jnp.where(now, clock + self.push_interval(k_next), push_at)
        return physics.replace(qvel=physics.qvel.at[:axes].add(kick)), push_at

    def motion(self, physics):
        """True kinematics of a simulation."""
        quat = physics.qpos[3:7]
        down = inverse(quat)
        force = physics.sensors[self.sensors["force"]]
        return Motion(
            lin_vel=rotate(down, physics.qvel[:3]),
            ang_vel=physics.qvel[3:6],
            gravity=rotate(down, jnp.array([0.0, 0, -1])),
            joint_pos=physics.qpos[7:] - self.default_pose,
            joint_vel=physics.qvel[6:],
            joint_acc=physics.qacc[6:],
            base_acc=physics.qacc[:6],
            torque=physics.torque,
            base_pos=physics.qpos[:3],
            quat=quat,
            yaw=yaw_of(quat),
            foot_pos=physics.sensors[self.sensors["pos"]],
            foot_vel=physics.sensors[self.sensors["vel"]],
            foot_force=force,
            foot_contact=jnp.linalg.norm(force, axis=-1) > 1.0,
            sensors=physics.sensors,
            mocap_pos=physics.mocap_pos,
            mocap_quat=physics.mocap_quat,
        )

    def sense(self, key, motion, task):
        """Noisy readings by name, and x_t (X,) made of them."""
        sensed = {}
        for name, key_one in zip(NOISE, jax.random.split(key, len(NOISE)), strict=True):
            true, width = getattr(motion, name), self.config.noise * NOISE[name]
            sensed[name] = true + uniform(key_one, -width, width, true.shape)
        return sensed, jnp.concatenate([sensed[name] for name in PROP])

    def observe(self, sensed, task, action, motion, clock):
        """Observation (O,): noisy readings, task inputs and last action."""
        return self.pack(sensed | self.task_inputs(task, motion, clock) | {"action": action})

    def pack(self, blocks):
        """Observation (O,) from its blocks by name, in SI units, each times its fixed scale."""
        return jnp.concatenate(
            [jnp.atleast_1d(blocks[name] * jnp.array(scale)) for name, (_, scale) in self.OBS.items()]
        )

    def task_inputs(self, task, motion, clock):
        """Observation blocks that are the task's own (commands, scans)."""
        return {}

    def tell(self, state, wanted):
        """The state in which a person's command holds and the observation says so. wanted (len(COMMAND),)."""
        task = self.told(state.task, wanted)
        inputs, obs, start = self.task_inputs(task, self.motion(state.physics), state.clock), state.obs, 0
        for name, (kind, scale) in self.OBS.items():
            stop = start + self.width(kind)
            if name in inputs:
                obs = obs.at[start:stop].set(inputs[name] * jnp.array(scale))
            start = stop
        return state.replace(task=task, obs=obs)

    # --- kinematics ---

    def leg_chains(self):
        """Per link from the base to the foot: offset (F, 3), turn (F, 4), axis (F, 3), joint (F,); then the site."""
        m, links = self.model, []
        sites = [m.site(foot) for foot in self.robot.feet]
        body = np.array([site.bodyid[0] for site in sites])
        while body[0] != 1:
            joint = m.body_jntadr[body]
            links.append((m.body_pos[body], m.body_quat[body], m.jnt_axis[joint], joint - 1))
            body = m.body_parentid[body]
        return links[::-1], np.array([site.pos for site in sites])

    def feet_in_base(self, joints):
        """Foot sites (F, 3) in the base frame at joint angles (A,); exact at reset, where no sensor has been read."""
        links, site = self.legs
        pos, quat = jnp.zeros_like(site), jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(site), 1))
        for offset, turn, axis, joint in links:
            pos = pos + rotate(quat, offset)
            quat = multiply(multiply(quat, turn), axis_angle(jnp.asarray(axis), joints[joint]))
        return pos + rotate(quat, site)

    # --- mirrors ---

    def width(self, kind):
        """Length of an observation block."""
        return {"joint": self.action_dim, "scalar": 1, "heading": 2}.get(kind, 3)

    def mirror_block(self, mirror, kind):
        """perm, sign of one block of an observation."""
        polar, axial = POLAR[mirror], AXIAL[mirror]
        if kind == "joint":
            return self.robot.mirror_joints(mirror)
        signs = {
            "polar": polar,
            "axial": axial,
            "planar": np.array([polar[0], polar[1], axial[2]]),
            "scalar": np.array([1]),
            "heading": np.array([-1, 1]),  # sine and cosine of an angle about z
        }
        return np.arange(len(signs[kind])), signs[kind]

    def mirror_tables(self, mirror):
        """perm, sign for `obs`, `prop` and `action` vectors: mirrored = sign * original[perm]."""
        tables = {}
        kinds = {"obs": [kind for kind, _ in self.OBS.values()], "prop": list(PROP.values()), "action": ["joint"]}
        for name, blocks in kinds.items():
            perms, signs, start = [], [], 0
            for kind in blocks:
                perm, sign = self.mirror_block(mirror, kind)
                perms.append(perm + start)
                signs.append(sign)
                start += len(perm)
            tables[name] = np.concatenate(perms), np.concatenate(signs).astype(np.float32)
        return tables

    def mirror(self, mirror, name, array):
        """Mirror image of obs, prop or action arrays (..., width); applying it twice gives the original."""
        perm, sign = self.mirrors[mirror][name]
        return array[..., perm] * sign


def joint_indices(robot, *parts):
    """Indices of the joints whose name contains one of `parts`."""
    return np.array([i for i, joint in enumerate(robot.joints) if any(part in joint for part in parts)])


def soft_limits(model, factor):
    """Joint limits (A,), (A,) shrunk about their middle."""
    low, high = model.jnt_range[1:].T
    middle, half = (low + high) / 2, (high - low) / 2
    return middle - factor * half, middle + factor * half


def replace_checked(config, overrides):
    """A config with some fields replaced; ValueError names a field that does not exist."""
    fields = [field.name for field in dataclasses.fields(config)]
    for name in overrides:
        if name not in fields:
            raise ValueError(f"unknown option {name!r}; choose one of {', '.join(sorted(fields))}")
    return dataclasses.replace(config, **overrides)
