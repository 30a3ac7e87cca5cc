"""The three robots: joint order, default pose, action scale, feet and mirror symmetries.

Masses, shapes and PD gains are in the robot's MJCF under assets/.
Legend: A joints (and actions), F feet.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

ASSETS = Path(__file__).resolve().parent.parent / "assets"

# A reflection negates one component of a polar vector (velocity, gravity, foot position) and the other two
# of an axial one (angular velocity, joint axis).
POLAR = {"left_right": np.array([1, -1, 1]), "front_back": np.array([-1, 1, 1])}
AXIAL = {"left_right": np.array([-1, 1, -1]), "front_back": np.array([1, -1, -1])}


@dataclass(frozen=True)
class Robot:
    """Facts about a robot beside its MJCF. Tuples (A,) follow `joints`, the actuator order of the MJCF."""

    name: str  # also the file assets/<name>.xml
    joints: tuple[str, ...]
    axes: str  # (A,) letters x, y or z: axis of each joint in the base frame at q = 0
    default_pose: tuple[float, ...]  # (A,) [rad] joint targets of action zero
    action_scale: tuple[float, ...]  # (A,) [rad] change of the joint target per unit of action
    feet: tuple[str, ...]  # (F,) sites; sensors <foot>_pos, <foot>_vel and <foot>_force
    gait: tuple[float, ...]  # (F,) share of a step by which a foot is ahead; every mirror image is half a step ahead
    sole: float  # [m] height of a foot's site above the ground it stands on
    mirrors: dict[str, dict[str, str]]  # symmetry -> first part of a name -> its image

    @property
    def xml(self):
        """Path of the MJCF."""
        return ASSETS / f"{self.name}.xml"

    @property
    def like(self):
        """Name of the shipped robot whose networks fit this one."""
        return self.name

    def spec(self):
        """MjSpec of the robot alone."""
        return mujoco.MjSpec.from_file(str(self.xml))

    def exchange(self, mirror, name):
        """Name of the joint or foot that is the mirror image of `name`."""
        parts = self.mirrors[mirror]
        for part, other in parts.items():
            if name.startswith(part):
                return other + name[len(part) :]
        return name

    def mirror_joints(self, mirror):
        """perm (A,), sign (A,): mirrored[i] = sign[i] * original[perm[i]], for positions, velocities and actions."""
        perm = [self.joints.index(self.exchange(mirror, joint)) for joint in self.joints]
        return np.array(perm), np.array([AXIAL[mirror]["xyz".index(axis)] for axis in self.axes])

    def mirror_feet(self, mirror):
        """perm (F,): mirrored[i] = original[perm[i]], for feet."""
        return np.array([self.feet.index(self.exchange(mirror, foot)) for foot in self.feet])


def pairs(*names):
    """Map each name to the other of its pair: ('LF', 'RF') -> {'LF': 'RF', 'RF': 'LF'}."""
    return {a: b for i in range(0, len(names), 2) for a, b in (names[i : i + 2], names[i : i + 2][::-1])}


# Pose: Isaac Lab's ANYMAL_D_CFG.
ANYMAL_D = Robot(
    name="anymal_d",
    joints=tuple(f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")),
    axes="xyy" * 4,
    default_pose=(0.0, 0.4, -0.8) * 2 + (0.0, -0.4, 0.8) * 2,
    action_scale=(0.5,) * 12,
    feet=("LF_foot", "RF_foot", "LH_foot", "RH_foot"),
    gait=(0.0, 0.5, 0.5, 0.0),
    sole=0.031455,
    mirrors={
        "left_right": pairs("LF", "RF", "LH", "RH"),
        "front_back": pairs("LF", "LH", "RF", "RH"),
    },
)

# Pose: MuJoCo Menagerie's "home". Front-back is no symmetry here, since all knees bend the same way.
# Deviation (Go1 pose): Isaac Lab's (thighs 0.8 and 1.0, calves -1.5) lets the hind feet trail.
GO1 = Robot(
    name="go1",
    joints=tuple(f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")),
    axes="xyy" * 4,
    default_pose=(0.0, 0.9, -1.8) * 4,
    action_scale=(0.25,) * 12,
    feet=("FR_foot", "FL_foot", "RR_foot", "RL_foot"),
    gait=(0.0, 0.5, 0.5, 0.0),
    sole=0.023,
    mirrors={"left_right": pairs("FR", "FL", "RR", "RL")},
)

G1_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
G1_WAIST = ("waist_yaw", "waist_roll", "waist_pitch")
G1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")

# Deviation (G1 action scale): Isaac Lab's is 0.5 for every joint, which asks arms for 1.5 times their torque limit per
# unit of action. As in mjlab a unit asks for a quarter of the limit, 0.25 limit / kp, but never for more than 0.5 rad.
G1_SCALE = (
    *(0.293, 0.463, 0.293, 0.463, 0.5, 0.5) * 2,
    *(0.293, 0.167, 0.167),
    *(0.083, 0.083, 0.083, 0.083, 0.5, 0.5, 0.5) * 2,
)

# Pose: MuJoCo Playground's "knees bent".
G1 = Robot(
    name="g1",
    joints=(
        *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in G1_LEG),
        *(f"{joint}_joint" for joint in G1_WAIST),
        *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in G1_ARM),
    ),
    axes="yxzyyx" * 2 + "zxy" + "yxzyxyz" * 2,
    default_pose=(
        *(-0.312, 0.0, 0.0, 0.669, -0.363, 0.0) * 2,
        *(0.0, 0.0, 0.073),
        *(0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0),
        *(0.2, -0.2, 0.0, 0.6, 0.0, 0.0, 0.0),
    ),
    action_scale=G1_SCALE,
    feet=("left_foot", "right_foot"),
    gait=(0.0, 0.5),
    sole=0.0,
    mirrors={"left_right": pairs("left", "right")},
)

ROBOTS = {robot.name: robot for robot in (ANYMAL_D, GO1, G1)}
