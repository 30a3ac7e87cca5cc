"""Walks of a policy under fixed commands on flat ground, then with a delay, a push, a load and on a slippery floor.

    by_command, summary = walks.evaluate(*play.load_nominal(path)[:3])

Legend: T control steps, N episodes side by side.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from envs.rotations import in_heading, inverse, rotate, yaw_of
from experiment import gait

NOMINAL = {  # the task without what makes a training robust; starts still differ
    "friction": (0.7, 0.7),
    "added_mass": (0.0, 0.0),
    "link_mass": (1.0, 1.0),
    "push_velocity": 0.0,
    "spawn_joints": (0.9, 1.1),
    "spawn_velocity": 0.0,
    "action_delay": (0.0, 0.0),
    "motor_strength": (1.0, 1.0),
    "joint_friction": (0.0, 0.0),
    "sensor_lag": (0.0, 0.0),
}
DELAY, PUSH, SLIPPERY = 0.04, 1.0, 0.3  # [s], [m/s], coefficient of friction
LOAD, SHARE = 3.0, 0.25  # [kg], of the robot's mass, whichever is less
PUSH_AT = 0.4  # of an episode


# --- Motion ---


def body(env):
    """Facts of the environment's robot, as gait.Body."""
    m = env.model
    low, high = m.jnt_range[1:].T
    limit = m.actuator_forcerange[:, 1]
    return gait.Body(float(m.body_mass.sum()), limit, low, high, env.robot.feet, env.robot.sole)


def drive(env, net, params, state, commands, kicks):
    """Follow commands (T, N, 3), with kicks (T, N, 2) [m/s] to the base. What `observed` returns, as (T, N, ...)."""

    def step(state, inputs):
        command, kick = inputs
        physics = state.physics.replace(qvel=state.physics.qvel.at[:, :2].add(kick))
        state = jax.vmap(env.with_command)(state.replace(physics=physics), command)
        action = net.apply(params, net.inputs(state.obs, state.history), method=net.mean)
        state = jax.vmap(env.step)(state, action)
        return state, jax.vmap(partial(observed, env))(state, action)

    return jax.lax.scan(step, state, (commands, kicks))[1]


def observed(env, state, action):
    """Fields of gait.Recording of one robot, and whether it fell."""
    p, yaw = state.physics, yaw_of(state.physics.qpos[3:7])
    up = rotate(inverse(p.qpos[3:7]), jnp.array([0.0, 0, 1]))
    return {
        "lin_vel": in_heading(yaw, p.qvel[:3]),
        "yaw_rate": rotate(p.qpos[3:7], p.qvel[3:6])[2],
        "height": p.qpos[2],
        "roll": jnp.arctan2(up[1], up[2]),
        "pitch": jnp.arcsin(jnp.clip(-up[0], -1, 1)),
        "joint_pos": p.qpos[7:],
        "joint_vel": p.qvel[6:],
        "torque": p.torque,
        "action": action,
        **{f"foot_{kind}": p.sensors[index] for kind, index in env.foot_sensors.items()},
        "fell": state.terminated,
    }


# --- All episodes at once ---


def pushes(steps, count):
    """Kicks (T, N, 2) [m/s]: one in each episode, in a direction drawn with a fixed seed."""
    angle, kicks = np.random.default_rng(1).uniform(0, 2 * np.pi, count), np.zeros((steps, count, 2))
    kicks[round(PUSH_AT * steps)] = PUSH * np.stack([np.cos(angle), np.sin(angle)], -1)
    return kicks


def run(env, net, params, commands, changes):
    """Recordings by name, of one batch of episodes.

    commands: name -> (T, N, 3). changes: name -> what differs there: `kicks` (T, N, 2), `friction`, `load` [kg],
    `delay` [s].
    """
    kicks = [changes.get(name, {}).get("kicks", np.zeros((*c.shape[:2], 2))) for name, c in commands.items()]
    stops = np.cumsum([c.shape[1] for c in commands.values()])
    parts = {name: slice(stop - c.shape[1], stop) for (name, c), stop in zip(commands.items(), stops, strict=True)}
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), stops[-1]))
    friction, mass, delay = (np.array(x) for x in (state.physics.friction, state.physics.mass_scale, state.delay))
    base = 1  # the first body after the world
    for name, change in changes.items():
        friction[parts[name]] = change.get("friction", friction[parts[name]])
        mass[parts[name], base] += change.get("load", 0.0) / env.model.body_mass[base]
        delay[parts[name]] += change.get("delay", 0.0) / env.dt
    physics = state.physics.replace(friction=jnp.array(friction), mass_scale=jnp.array(mass))
    state = state.replace(physics=physics, delay=jnp.array(delay))
    inputs = [np.concatenate(arrays, 1).astype(np.float32) for arrays in (list(commands.values()), kicks)]
    # A computation whose inputs are still being copied runs on the threads that the engine's callback waits for: on
    # one core that never ends.
    ready = jax.block_until_ready(jax.device_put((params, state, *inputs)))
    out = jax.device_get(jax.jit(partial(drive, env, net))(*ready))
    out["command"], out["alive"] = inputs[0], ~np.logical_or.accumulate(out.pop("fell"))  # a fall is also a new start
    return {name: gait.Recording(env.dt, **{key: x[:, part] for key, x in out.items()}) for name, part in parts.items()}


def evaluate(env, net, params, starts=20, seconds=gait.SECONDS):
    """Numbers of each command and sequence by name, and their summary, as gait.measure and gait.summary.

    env: a locomotion task with the fields of NOMINAL and longer episodes than `seconds`. starts: episodes of a command;
    tests of robustness have twice as many.
    """
    steps, facts = round(seconds / env.dt), body(env)
    commands = {name: gait.schedule(name, env.dt, starts, seconds) for name in (*gait.COMMANDS, *gait.SEQUENCES)}
    tested = gait.schedule(gait.USUAL, env.dt, 2 * starts, seconds)
    added = min(LOAD, round(SHARE * facts.mass, 2))
    late, known = f"delay of {1000 * DELAY:.0f} ms", (env.config.history - 1) * env.dt  # [s] of past actions
    changes = {
        late: {"delay": DELAY},
        f"push of {PUSH} m/s": {"kicks": pushes(steps, 2 * starts)},
        f"{added:g} kg more": {"load": added},
        f"friction {SLIPPERY}": {"friction": SLIPPERY},
    }
    if env.config.action_delay[1] + DELAY > known + 1e-9:
        del changes[late]
    motions = run(env, net, params, commands | dict.fromkeys(changes, tested), changes)
    warm_up = gait.WARM_UP * seconds / gait.SECONDS
    by_command = {name: gait.measure(motions[name], facts, warm_up) for name in commands}
    by_command["reverse"]["reversed"] = gait.reversals(motions["reverse"])
    fell = {name: (float(gait.fallen(motions[name]).sum()), 2.0 * starts) for name in changes}
    return by_command, gait.summary(by_command, dict.fromkeys((late,)) | fell)
