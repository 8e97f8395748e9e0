"""Where the arm stands that carries the hand: the restriction by its reach, from parameters and /tf."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from graspd_core import Arm, Reach, load_arm
from graspd_ros.inputs.frames import pose_of_matrix
from graspd_ros.inputs.requests import Request


def reach_of(request: Request, lookup: Callable[[str, str], Float[np.ndarray, "4 4"]]) -> tuple[Reach, ...]:
    """The restriction, in the frame of the request's object; none where the node has no arm.

    Args:
        request: its settings name the arm and the frame of its base.
        lookup: `T_target_source` of two frames when the object was seen; may raise a TransformError.
    """
    settings = request.settings
    if not settings.arm:
        return ()
    arm = _arm(settings.arm)
    base = settings.arm_base_frame or arm.chain.base_link
    T = np.eye(4) if base == request.frame else lookup(request.frame, base)
    if request.T_frame_object is not None:
        T = np.linalg.inv(request.T_frame_object) @ T
    turn = pose_of_matrix(T).orientation
    x, y, z = map(float, T[:3, 3])
    return (Reach(arm, (x, y, z), (turn.w, turn.x, turn.y, turn.z)),)


# What is known of an arm takes a tenth of a second to make, and is kept with it.
@lru_cache(maxsize=2)
def _arm(name: str) -> Arm:
    return load_arm(name)
