"""Where the arm has to be: the mount's link, for poses of the hand's base link."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion
from jaxtyping import Float

from graspd_core.hands.model import Mount
from graspd_ros.inputs.frames import matrix_of_pose, pose_of_matrix


def matrix_of_mount(mount: Mount) -> Float[np.ndarray, "4 4"]:
    """`T_parent_base` [m]."""
    (x, y, z), (w, i, j, k) = mount.position, mount.quaternion_wxyz
    return matrix_of_pose(Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w)))


def parent_pose(base: Pose, mount: Mount) -> Pose:
    """The pose of the arm's link when the hand's base link is at `base`, in the same frame."""
    return pose_of_matrix(matrix_of_pose(base) @ np.linalg.inv(matrix_of_mount(mount)))
