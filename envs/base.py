"""The parts that all tasks share: State, one control step, noise, history, randomisation, reset, mirrors.

`env.reset(key) -> State` and `env.step(state, action) -> State` are pure functions of one environment. Scripts vmap
them. A task family subclasses `Env`; pedipulation.py is the shortest.
Legend: A joints and actions, F feet, O observation, X proprioception x_t (6 + 2A), K history length, M obstacles.
"""

import flax
import jax
import jax.numpy as jnp
import numpy as np

from envs import terrain
from envs.anatomy import AXIAL, POLAR, touch
from envs.engine import RANDOMISED, Physics, make_engine
from envs.loader import Robot
from envs.robots import ROBOTS
from envs.rotations import axis_angle, inverse, multiply, rotate, yaw_of

# Half-width of uniform sensor noise, as in Isaac Lab's tasks. Commands and the last action are exact.
NOISE = {"lin_vel": 0.1, "ang_vel": 0.2, "gravity": 0.05, "joint_pos": 0.01, "joint_vel": 1.5}
# Blocks of x_t, in order -> mirror kind.
PROP = {"ang_vel": "axial", "gravity": "polar", "joint_pos": "joint", "joint_vel": "joint"}
# Blocks of an observation about the robot itself -> (mirror kind, fixed scale), as in `Env.OBS`.
# Deviation (input scaling): velocities and commands as in legged_gym, the last action ours. Isaac Lab feeds inputs raw.
BODY = {
    "lin_vel": ("polar", 2.0),
    "ang_vel": ("axial", 0.25),
    "gravity": ("polar", 1.0),
    "joint_pos": ("joint", 1.0),
    "joint_vel": ("joint", 0.05),
    "action": ("joint", 0.5),
}
DIVERGED = 1e3  # [m, m/s, rad/s] out of reach of any sound simulation


@flax.struct.dataclass
class State:
    """One environment after a step. If its episode ended there, an automatic reset has followed.

    `obs` is for the next action, so after a reset it shows the new episode. `final_obs` always shows the old one.
    """

    physics: Physics
    obs: jax.Array  # (O,) scaled, noisy
    history: dict  # prop (K+1, X) in SI units, noisy; action (K, A); oldest first
    reward: jax.Array  # ()
    terminated: jax.Array  # () bool: failure, the return ends here
    truncated: jax.Array  # () bool: time limit, no failure; whether the return goes on: `Env.bootstrap_time_outs`
    final_obs: jax.Array  # (O,)
    final_history: dict
    action: jax.Array  # (A,) of the last step, 0 at the start
    clock: jax.Array  # () control step in the episode's time; an episode may start midway, see `reset`
    push_at: jax.Array  # () clock of the next push
    delay: jax.Array  # () [control steps] from an action to its joint targets
    lag: jax.Array  # () [control steps] age of the readings, 0 to 1
    readings: dict  # true values of NOISE's quantities in the last step
    episode_return: jax.Array  # () sum of rewards so far
    key: jax.Array
    task: flax.struct.PyTreeNode  # state of the task family
    metrics: dict  # name -> (), of this step


@flax.struct.dataclass
class Course:
    """Surroundings of an episode, drawn before it starts. A task family may add to them, such as a goal."""

    mocap_pos: jax.Array  # (M, 3) [m] obstacles
    mocap_quat: jax.Array  # (M, 4)
    curriculum: dict  # carried from episode to episode, such as a level


@flax.struct.dataclass
class Motion:
    """True motion: kinematics from qpos and qvel, forces and feet from the engine's sensors.

    At a reset nothing has been measured: feet, forces, torques and accelerations are 0 then.
    """

    lin_vel: jax.Array  # (3,) base velocity, base frame [m/s]
    ang_vel: jax.Array  # (3,) base frame [rad/s]
    gravity: jax.Array  # (3,) unit vector, base frame
    joint_pos: jax.Array  # (A,) relative to the default pose [rad]
    joint_vel: jax.Array  # (A,) [rad/s]
    joint_acc: jax.Array  # (A,) [rad/s^2]
    base_acc: jax.Array  # (6,) linear (world) [m/s^2], angular (base frame) [rad/s^2]
    torque: jax.Array  # (A,) [N m]
    base_pos: jax.Array  # (3,) world [m]
    quat: jax.Array  # (4,) base orientation
    yaw: jax.Array  # () [rad]
    foot_pos: jax.Array  # (F, 3) world [m]
    foot_vel: jax.Array  # (F, 3) world [m/s]
    foot_force: jax.Array  # (F, 3) world [N]
    foot_contact: jax.Array  # (F,) bool, more than 1 N or, for a robot of less than 5 kg, 2% of its weight
    sensors: jax.Array  # (S,) all readings, among them the contact forces of other bodies
    mocap_pos: jax.Array  # (M, 3) obstacles
    mocap_quat: jax.Array  # (M, 4)


@flax.struct.dataclass
class FootClocks:
    """Time of each foot in the air, for tasks that reward a gait."""

    air_time: jax.Array  # (F,) [s] since the foot left the ground
    landed_after: jax.Array  # (F,) [s] flight that ended in this step, else 0

    @classmethod
    def started(cls, feet, **task):
        """Clocks of `feet` feet at the start of an episode; further fields for a task that adds some."""
        zero = jnp.zeros(feet)
        return cls(zero, zero, **task)

    def tick(self, contact, dt):
        """Advance by one control step; contact (F,) bool."""
        return self.replace(
            landed_after=jnp.where(contact, self.air_time, 0.0),
            air_time=jnp.where(contact, 0.0, self.air_time + dt),
        )


def uniform(key, low, high, shape=()):
    """Uniform sample in [low, high)."""
    return jax.random.uniform(key, shape, minval=low, maxval=high)


def select(condition, yes, no):
    """Choose between two pytrees of the same structure, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


class Env:
    """One robot task. A subclass sets OBS, implements `init_task` and `rewards`, and overrides other hooks as needed.

    Hooks are called in this order. `step` also resets, since every step may end an episode.
        reset: first_curriculum, course, spawn, place, ground_height, init_task, first_clock, sense, task_inputs,
            task_metrics
        step: before_rewards, rewards, failed, task_metrics, next_curriculum, then as in reset without
            first_curriculum, then push, after_rewards, sense, task_inputs
    """

    # block of the observation -> (mirror kind, fixed scale), in the order of the vector
    OBS: dict[str, tuple] = {}
    LEVELS = 0  # difficulty levels; a task that has some also has `at_level`
    bootstrap_time_outs = True  # the return goes on after a time limit; False where the policy sees the time left
    EVALUATION_FIELDS: dict = {}  # config fields for measuring a trained policy
    SHOWCASE_FIELDS: dict = {}  # config fields for filming one
    FILM_WINDOW: dict = {}  # the part of the episode to film; arguments of render.film
    COMMAND_RANGES: dict[str, tuple] = {}  # command of `set_command`: name -> (low, high)

    def __init__(self, config, engine="auto"):
        self.config = config
        self.robot = Robot.of(config.body) if config.body else ROBOTS[config.robot]
        self.dt = config.physics_dt * config.decimation  # [s] control step
        for name, most in (("action_delay", (config.history - 1) * self.dt), ("sensor_lag", self.dt)):
            if not 0 <= getattr(config, name)[0] <= getattr(config, name)[1] <= most:
                raise ValueError(f"{name} must be from 0 to {most:g} s, not {getattr(config, name)}")
        spec = self.scene()
        spec.option.timestep = config.physics_dt
        for joint in spec.joints[1:] if config.joint_friction[1] else ():
            joint.frictionloss = config.joint_friction[1]
        self.engine = make_engine(engine, spec, config.decimation)
        self.model = self.engine.model
        self.episode_steps = round(config.episode_seconds / self.dt)
        if not self.episode_steps:
            raise ValueError(f"episode_seconds must be at least a control step of {self.dt:g} s")
        if (lightest := self.model.body_mass[1] * config.link_mass[0] + config.added_mass[0]) <= 0:
            raise ValueError(f"added_mass and link_mass leave the base with {lightest:.2f} kg")
        self.action_dim = len(self.robot.joints)
        self.default_pose = jnp.array(self.robot.default_pose)
        self.action_scale = jnp.array(self.robot.action_scale)
        self.foot_sensors = {
            kind: self.engine.sensor(*(f"{foot}_{kind}" for foot in self.robot.feet))
            for kind in ("pos", "vel", "force")
        }
        self.end_sensors = self.engine.sensor(*(f"{name}_force" for name in config.contact_ends))
        self.touch = touch(self.model.body_mass.sum())
        self.legs = self.leg_chains()
        self.mirrors = {mirror: self.mirror_tables(mirror) for mirror in self.robot.mirrors}
        self.prop_layout = tuple(PROP)
        self.prop_dim = sum(self.width(kind) for kind in PROP.values())
        self.obs_dim = sum(self.width(kind) for kind, _ in self.OBS.values())

    # --- hooks of a task ---

    def scene(self, visual=False):
        """MjSpec of the robot and its ground; `visual` adds what only a renderer needs."""
        return terrain.flat_scene(self.robot, visual)

    def first_curriculum(self):
        """Curriculum of an environment's first episode."""
        return {}

    def next_curriculum(self, key, task, motion, terminated, truncated):
        """Curriculum of the next episode, if this one ends in this step."""
        return {}

    def first_clock(self, key):
        """Clock at the start of an episode. One above 0 shortens the episode."""
        return 0

    def course(self, key, curriculum):
        """Course of an episode; here it has no obstacles."""
        return Course(jnp.zeros((0, 3)), jnp.zeros((0, 4)), curriculum)

    def init_task(self, key, physics, course):
        """Task state at the start of an episode."""
        raise NotImplementedError

    def ground_height(self, course, xy):
        """Height of the ground [m] at horizontal positions (..., 2)."""
        return jnp.zeros(xy.shape[:-1])

    def place(self, key):
        """Start of an episode: x, y (2,) [m] and yaw () [rad]."""
        k_xy, k_yaw = jax.random.split(key)
        c = self.config
        return uniform(k_xy, -c.spawn_xy, c.spawn_xy, (2,)), uniform(k_yaw, -c.spawn_yaw, c.spawn_yaw)

    def before_rewards(self, task, motion):
        """Update the task state with the motion of this step."""
        return task

    def rewards(self, task, motion, action, last_action, clock):
        """Reward terms by name, unweighted, per second. A term without a weight is ignored."""
        raise NotImplementedError

    def failed(self, task, motion):
        """True () if the episode ends in failure: a forbidden body touches the ground, or the trunk tilts too far."""
        force = jnp.linalg.norm(motion.sensors[self.end_sensors], axis=-1)
        return jnp.any(force > self.touch) | self.tilted(motion)

    def tilted(self, motion):
        """True () if the trunk is more than `max_tilt` from level."""
        return -motion.gravity[2] < jnp.cos(jnp.deg2rad(self.config.max_tilt))

    def after_rewards(self, key, task, motion, clock):
        """Update the task state for the next step: draw commands that are due."""
        return task

    def task_inputs(self, task, motion, clock):
        """Observation blocks of the task by name, such as a command."""
        return {}

    def task_metrics(self, task, motion, truncated):
        """Numbers to log, by name; see `metrics`."""
        return {}

    def markers(self, task):
        """Points (n, 3) [m] to draw into pictures, such as a target."""
        return jnp.zeros((0, 3))

    def set_command(self, task, command):
        """Task state with its command replaced; command has a number for each of COMMAND_RANGES."""
        return task

    # --- reset and step ---

    def reset(self, key, clock=None, curriculum=None):
        """Start an episode. A `clock` above 0 starts it midway, so that a batch's time limits spread out."""
        k_course, k_clock, k_spawn, k_task, k_noise, k_push, k_delay, k_lag, key = jax.random.split(key, 9)
        course = self.course(k_course, self.first_curriculum() if curriculum is None else curriculum)
        physics = self.spawn(k_spawn, course)
        task = self.init_task(k_task, physics, course)
        clock = jnp.asarray(self.first_clock(k_clock) if clock is None else clock, jnp.int32)
        action, motion = jnp.zeros(self.action_dim), self.motion(physics)
        sensed, prop = self.sense(k_noise, motion, task)
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
            delay=uniform(k_delay, *self.config.action_delay) / self.dt,
            lag=uniform(k_lag, *self.config.sensor_lag) / self.dt,
            readings={name: getattr(motion, name) for name in NOISE},
            episode_return=zero,
            key=key,
            task=task,
            metrics=self.metrics(physics, ~no, {name: zero for name in self.config.weights}, task, motion, no),
        )

    def step(self, state, action):
        """Advance by one control step and, if the episode ends there, start the next one. action (A,)."""
        key, k_noise, k_task, k_push, k_curriculum, k_reset = jax.random.split(state.key, 6)
        physics = self.engine.step(state.physics, self.joint_targets(state, action))
        bounded = jnp.concatenate([physics.qpos[2:], physics.qvel])  # a long walk may lead anywhere
        healthy = jnp.all(jnp.abs(bounded) < DIVERGED) & jnp.all(jnp.isfinite(physics.qpos))
        physics = select(healthy, physics, self.standing(state.physics))  # later numbers stay finite

        # rewards and the end of the episode, from the true motion
        motion = self.motion(physics)
        task = self.before_rewards(state.task, motion)
        terms = self.rewards(task, motion, action, state.action, state.clock)
        if unknown := self.config.weights.keys() - terms.keys():
            raise ValueError(f"no reward term {', '.join(sorted(unknown))}; this task has {', '.join(terms)}")
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
        # Under vmap a branch would compute both sides: every environment is reset, and `select` drops most resets.
        curriculum = self.next_curriculum(k_curriculum, task, motion, terminated, truncated)
        next_episode = self.reset(k_reset, curriculum=curriculum)

        # the same episode goes on: a push, new commands, the next observation
        physics, push_at = self.push(k_push, physics, clock, state.push_at)
        motion = self.motion(physics)
        task = self.after_rewards(k_task, task, motion, clock)
        readings = {name: getattr(motion, name) for name in NOISE}
        late = {name: now + state.lag * (state.readings[name] - now) for name, now in readings.items()}
        sensed, prop = self.sense(k_noise, motion.replace(**late), task)
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
            readings=readings,
            episode_return=state.episode_return + reward,
            key=key,
            task=task,
        )
        # Only the curriculum survives a reset. The fields replaced here report the step itself, whatever follows it.
        return select(terminated | truncated, next_episode, stepped).replace(
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_obs=stepped.obs,
            final_history=stepped.history,
            metrics=metrics
            | {"episode_return": stepped.episode_return, "episode_seconds": clock.astype(jnp.float32) * self.dt},
        )

    def joint_targets(self, state, action):
        """Joint targets (A,) [rad] of this control step: those of the action, or of earlier ones if it is delayed.

        A delay that is no whole number of steps mixes two actions, by the share of the step for which each holds.
        """
        actions = jnp.concatenate([state.history["action"], action[None]])[::-1]  # newest first
        whole = state.delay.astype(int)
        older = state.delay - whole
        mixed = (1 - older) * actions[whole] + older * actions[whole + 1]
        return self.default_pose + self.action_scale * mixed

    def metrics(self, physics, healthy, terms, task, motion, truncated):
        """Metrics of one step: weighted reward terms, the task's metrics, faults of the engine, the finished episode.

        Names that start with `episode_` count only where an episode ends, all others in every step.
        """
        report = {f"reward/{name}": value for name, value in terms.items()} | self.task_metrics(task, motion, truncated)
        faults = {"diverged": ~healthy} | ({"overflow": physics.overflow} if self.engine.bounded else {})
        return report | faults | {"episode_return": jnp.zeros(()), "episode_seconds": jnp.zeros(())}

    def spawn(self, key, course):
        """Physics at the start of an episode: near the default pose, at a random place, feet on the ground."""
        c, m = self.config, self.model
        k_place, k_link, k_joint, k_vel, k_friction, k_mass, k_motor, k_rub = jax.random.split(key, 8)
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
        physics = self.engine.initial(
            qpos,
            qvel,
            friction=uniform(k_friction, *c.friction),
            mass_scale=mass_scale,
            strength=uniform(k_motor, *c.motor_strength, (self.action_dim,)),
            joint_friction=uniform(k_rub, *c.joint_friction),
        )
        return physics.replace(mocap_pos=course.mocap_pos, mocap_quat=course.mocap_quat)

    def standing(self, physics):
        """Physics with the robot at rest in its default pose, and the surroundings of `physics`."""
        m = self.model
        qpos = jnp.concatenate([jnp.array([0.0, 0, 1, 1, 0, 0, 0]), self.default_pose])
        drawn = {name: getattr(physics, name) for name in RANDOMISED}
        at_rest = self.engine.initial(qpos, jnp.zeros(m.nv), **drawn)
        return at_rest.replace(mocap_pos=physics.mocap_pos, mocap_quat=physics.mocap_quat)

    def push_interval(self, key):
        """Control steps until the next push."""
        return jnp.round(uniform(key, *self.config.push_seconds) / self.dt).astype(jnp.int32)

    def push(self, key, physics, clock, push_at):
        """Disturb the robot: if a push is due, change the base's velocity. Also returns the clock of the next push."""
        k_vel, k_next = jax.random.split(key)
        due = clock >= push_at
        axes = self.config.push_axes
        kick = uniform(k_vel, -self.config.push_velocity, self.config.push_velocity, (axes,)) * due
        push_at = jnp.where(due, clock + self.push_interval(k_next), push_at)
        return physics.replace(qvel=physics.qvel.at[:axes].add(kick)), push_at

    def motion(self, physics):
        """True motion of a simulation."""
        quat = physics.qpos[3:7]
        down = inverse(quat)
        force = physics.sensors[self.foot_sensors["force"]]
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
            foot_pos=physics.sensors[self.foot_sensors["pos"]],
            foot_vel=physics.sensors[self.foot_sensors["vel"]],
            foot_force=force,
            foot_contact=jnp.linalg.norm(force, axis=-1) > self.touch,
            sensors=physics.sensors,
            mocap_pos=physics.mocap_pos,
            mocap_quat=physics.mocap_quat,
        )

    def sense(self, key, motion, task):
        """Noisy readings by name, and x_t (X,), which is made of them."""
        sensed = {}
        for name, key_one in zip(NOISE, jax.random.split(key, len(NOISE)), strict=True):
            true, width = getattr(motion, name), self.config.noise * NOISE[name]
            sensed[name] = true + uniform(key_one, -width, width, true.shape)
        return sensed, jnp.concatenate([sensed[name] for name in PROP])

    def observe(self, sensed, task, action, motion, clock):
        """Observation (O,) from noisy readings, the task's inputs and the last action."""
        return self.pack(sensed | self.task_inputs(task, motion, clock) | {"action": action})

    def pack(self, blocks):
        """Observation (O,) from its blocks by name in SI units, each times its fixed scale."""
        return jnp.concatenate(
            [jnp.atleast_1d(blocks[name] * jnp.array(scale)) for name, (_, scale) in self.OBS.items()]
        )

    def with_command(self, state, command):
        """State in which a person's command (len(COMMAND_RANGES),) holds and the observation shows it."""
        task, obs = self.set_command(state.task, command), state.obs
        inputs = self.task_inputs(task, self.motion(state.physics), state.clock)
        for name, block in inputs.items():
            obs = obs.at[self.obs_slices()[name]].set(block * jnp.array(self.OBS[name][1]))
        return state.replace(task=task, obs=obs)

    # --- layout of vectors ---

    def width(self, kind):
        """Length of a block."""
        return {"joint": self.action_dim, "scalar": 1, "heading": 2, "phase": 2}.get(kind, 3)

    def obs_slices(self):
        """Slice of `obs` of each block, by name."""
        return self.slices({name: kind for name, (kind, _) in self.OBS.items()})

    def prop_slices(self):
        """Slice of x_t of each block, by name."""
        return self.slices(PROP)

    def slices(self, kinds):
        """Slice of each block, by name, in a vector of blocks of these kinds."""
        stops = np.cumsum([self.width(kind) for kind in kinds.values()]).tolist()
        return {name: slice(start, stop) for name, start, stop in zip(kinds, [0, *stops], stops, strict=False)}

    # --- kinematics ---

    def leg_chains(self):
        """Links from base to foot, each offset (F, 3), turn (F, 4), axis (F, 3), joint (F,); and the sites (F, 3).

        Where a leg has no joint, as at the end of one shorter than others, the joint is A, whose angle is 0.
        """
        sites = [self.model.site(foot) for foot in self.robot.feet]
        chains = [self.chain(site.bodyid[0]) for site in sites]
        none = np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([0, 0, 1.0]), self.action_dim
        chains = [chain + [none] * (max(map(len, chains)) - len(chain)) for chain in chains]
        links = [tuple(map(np.array, zip(*link, strict=True))) for link in zip(*chains, strict=True)]
        return links, np.array([site.pos for site in sites])

    def chain(self, body):
        """Links from the base to a body, each offset (3,), turn (4,), axis (3,) and joint."""
        m, links = self.model, []
        straight, z = np.array([1.0, 0, 0, 0]), np.array([0, 0, 1.0])
        while body != 1:
            offset, turn, part = m.body_pos[body], m.body_quat[body], []
            for joint in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
                anchor = m.jnt_pos[joint]
                if anchor.any():  # the body turns about this point of it
                    offset = offset + np.array(rotate(turn, anchor))
                part.append((offset, turn, m.jnt_axis[joint], joint - 1))
                offset, turn = -anchor, straight
            if not part or offset.any():
                part.append((offset, turn, z, self.action_dim))
            links = part + links
            body = m.body_parentid[body]
        return links

    def feet_in_base(self, joints):
        """Foot sites (F, 3) in the base frame at joint angles (A,). At a reset no sensor has been read yet."""
        links, site = self.legs
        rest = self.model.qpos0[7:]
        if rest.any() or any((joint == self.action_dim).any() for *_, joint in links):
            joints = jnp.append(joints - rest, 0.0)
        pos, quat = jnp.zeros_like(site), jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(site), 1))
        for offset, turn, axis, joint in links:
            pos = pos + rotate(quat, offset)
            quat = multiply(multiply(quat, turn), axis_angle(jnp.asarray(axis), joints[joint]))
        return pos + rotate(quat, site)

    # --- mirrors ---

    def mirror_block(self, mirror, kind):
        """perm, sign of one block."""
        polar, axial = POLAR[mirror], AXIAL[mirror]
        if kind == "joint":
            return self.robot.mirror_joints(mirror)
        signs = {
            "polar": polar,
            "axial": axial,
            "planar": np.array([polar[0], polar[1], axial[2]]),
            "scalar": np.array([1]),
            "heading": np.array([-1, 1]),  # sine, cosine of an angle about z
            "phase": np.array([-1, -1]) if self.swaps_steps(mirror) else np.array([1, 1]),
        }
        return np.arange(len(signs[kind])), signs[kind]

    def swaps_steps(self, mirror):
        """True if a foot and its image are half a step apart, so that sine and cosine of the gait's clock turn over."""
        gait = np.array(self.robot.gait)
        return not np.allclose(gait[self.robot.mirror_feet(mirror)], gait)

    def mirror_tables(self, mirror):
        """perm, sign of `obs`, `prop` and `action` vectors: mirrored = sign * original[perm]."""
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
        """Mirror image of an array (..., width) named obs, prop or action. Mirroring it again gives the original."""
        perm, sign = self.mirrors[mirror][name]
        return array[..., perm] * sign


def joint_indices(robot, *parts):
    """Indices of the joints whose name contains one of `parts`. ValueError if there are none."""
    found = [i for i, joint in enumerate(robot.joints) if any(part in joint for part in parts)]
    if not found:
        raise ValueError(f"no joint of {robot.name} has {' or '.join(map(repr, parts))} in its name")
    return np.array(found)


def soft_limits(model, factor):
    """Joint limits (A,), (A,) scaled about their middle by `factor`."""
    low, high = model.jnt_range[1:].T
    middle, half = (low + high) / 2, (high - low) / 2
    return middle - factor * half, middle + factor * half
