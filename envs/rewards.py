"""Reward terms that several tasks use. Each takes true (noise-free) quantities of one environment and returns ().

Terms are unweighted and per second. `Env.step` multiplies them by the task's weights and by the control step.
"""

import jax.numpy as jnp


def track_lin_vel(command, lin_vel):
    """Gaussian kernel of width 0.5 m/s on the error of the horizontal velocity, (2,) each [m/s]."""
    return jnp.exp(-jnp.sum((command - lin_vel) ** 2) / 0.25)


def track_yaw_rate(command, yaw_rate):
    """Gaussian kernel of width 0.5 rad/s on the error of the turning rate, () each [rad/s]."""
    return jnp.exp(-((command - yaw_rate) ** 2) / 0.25)


def square(x):
    """Sum of squares, of torques, accelerations, action rates, unwanted velocities or tilts."""
    return jnp.sum(x**2)


def air_time(landed_after, threshold, command):
    """Flight time beyond a threshold [s], counted when a foot lands; landed_after (F,) [s] is 0 for other feet."""
    return jnp.sum(jnp.where(landed_after > 0, landed_after - threshold, 0.0)) * moving(command)


def hasty_steps(landed_after, threshold):
    """Flight time missing to a threshold [s], counted when a foot lands; landed_after (F,) [s] as in `air_time`."""
    return jnp.sum(jnp.where(landed_after > 0, jnp.maximum(threshold - landed_after, 0.0), 0.0))


def in_step(contact, stance):
    """Share of the feet that are on the ground or off it as the gait's clock asks; contact and stance (F,) bool."""
    return jnp.mean(contact == stance)


def foot_path(height, target):
    """Gaussian kernel of width 5 cm on the feet's heights above the ground, (F,) each [m]."""
    return jnp.exp(-jnp.sum((height - target) ** 2) / 0.05**2)


def impact(force, weight):
    """Forces on the feet beyond 1.5 times the robot's weight, in weights; force (F, 3) [N], weight [N]."""
    return jnp.sum(jnp.maximum(jnp.linalg.norm(force, axis=-1) / weight - 1.5, 0.0))


def power(torque, joint_vel, weight):
    """Mechanical power that the motors give or take, over the weight [m/s]; (A,) [N m], (A,) [rad/s], [N]."""
    return jnp.sum(jnp.abs(torque * joint_vel)) / weight


def moving(command):
    """True () if the command (3,) asks for more than 0.1 m/s or 0.1 rad/s: standing still needs no steps."""
    return (jnp.linalg.norm(command[:2]) > 0.1) | (jnp.abs(command[2]) > 0.1)


def slip(foot_vel, contact):
    """Horizontal speed [m/s] of the feet on the ground; foot_vel (F, 3), contact (F,)."""
    return jnp.sum(jnp.linalg.norm(foot_vel[:, :2], axis=-1) * contact)


def touching(force):
    """Number of bodies with a contact force above 1 N; force (B, 3)."""
    return jnp.sum(jnp.linalg.norm(force, axis=-1) > 1.0)


def beyond(joint_pos, low, high):
    """Sum of joint angles beyond their limits [rad]; (A,) each."""
    return jnp.sum(jnp.maximum(low - joint_pos, 0) + jnp.maximum(joint_pos - high, 0))
