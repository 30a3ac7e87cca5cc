"""Rotations as unit quaternions (..., 4) in the order w, x, y, z."""

import jax.numpy as jnp


def rotate(quat, vec):
    """Turn vectors (..., 3) from the frame of quat (..., 4) to its parent frame."""
    w, u = quat[..., :1], quat[..., 1:]
    return vec + 2 * jnp.cross(u, jnp.cross(u, vec) + w * vec)


def multiply(p, q):
    """Hamilton product (..., 4) of two quaternions: the rotation q, then p."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    real = pw * qw - jnp.sum(pv * qv, -1, keepdims=True)
    return jnp.concatenate([real, pw * qv + qw * pv + jnp.cross(pv, qv)], -1)


def axis_angle(axis, angle):
    """Quaternion (..., 4) of a turn by angle (...) [rad] about a unit axis (..., 3)."""
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1)


def inverse(quat):
    """Conjugate (..., 4), the inverse of a unit quaternion."""
    return quat * jnp.array([1.0, -1, -1, -1])


def in_heading(yaw, vec):
    """World vector (3,) in the frame that is turned by yaw () [rad] about the vertical alone."""
    return rotate(inverse(axis_angle(jnp.array([0.0, 0, 1]), yaw)), vec)


def yaw_of(quat):
    """Heading () [rad] of an orientation (4,)."""
    w, x, y, z = quat
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrap(angle):
    """Angle [rad] in [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
