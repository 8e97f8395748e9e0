"""What an object stands on, as a message says it: a plane in the frame of its header."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from shape_msgs.msg import Plane as PlaneMessage

from graspd_core import Scene
from graspd_core.types import Plane
from graspd_ros.outputs.error_codes import ErrorCode, RequestError


def plane_of(surface: PlaneMessage, T_object_frame: Float[np.ndarray, "4 4"] | None = None) -> Plane | None:
    """The support surface, in the object's frame where that is another one; None where all of its numbers are 0.

    Raises:
        RequestError: it is no plane.
    """
    a, b, c, d = map(float, surface.coef)
    if not any((a, b, c, d)):
        return None
    length = float(np.linalg.norm([a, b, c]))
    if not (np.isfinite([a, b, c, d]).all() and length > 0):
        told = f"surface: {[a, b, c, d]} is no plane; its first three numbers are the normal"
        raise RequestError(ErrorCode.BAD_REQUEST, told)
    normal, offset = np.array([a, b, c]) / length, -d / length
    if T_object_frame is not None:
        normal = T_object_frame[:3, :3] @ normal
        offset += float(normal @ T_object_frame[:3, 3])
    return Plane(normal, offset)


def with_support(load: Callable[[], Scene], plane: Plane | None) -> Callable[[], Scene]:
    """The scene with what the object stands on; its free side is where the object is."""

    def loaded() -> Scene:
        scene = load()
        if plane is None:
            return scene
        above = float(plane.normal @ scene.object.mesh.vertices.mean(0)) > plane.offset
        return replace(scene, support=plane if above else Plane(-plane.normal, -plane.offset))

    return loaded
