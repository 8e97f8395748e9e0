"""Things far from the origin, as in the coordinates of a map: float32 would round them, so they are moved near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.mesh.sdf import GridSDF
from graspd_core.types import Contact, Grasp, Plane, Posture


def moved_sdf(sdf: GridSDF, offset: Float[np.ndarray, "3"]) -> GridSDF:
    """The signed distance elsewhere; itself where the offset is zero."""
    if not offset.any():
        return sdf
    origin = sdf.origin.double() + torch.as_tensor(offset, device=sdf.origin.device)
    return GridSDF(sdf.field, origin.to(sdf.origin), sdf.spacing, sdf.half)


def moved_plane(plane: Plane, offset: Float[np.ndarray, "3"]) -> Plane:
    """The plane elsewhere; itself where the offset is zero."""
    return Plane(plane.normal, plane.offset + float(plane.normal @ offset)) if offset.any() else plane


def moved_grasp(grasp: Grasp, offset: Float[np.ndarray, "3"]) -> Grasp:
    """The grasp of the object elsewhere; itself where the offset is zero."""
    if not offset.any():
        return grasp

    def posture(given: Posture) -> Posture:
        return replace(given, position=given.position + offset)

    def contact(given: Contact) -> Contact:
        x, y, z = (np.array(given.position) + offset).tolist()
        return replace(given, position=(x, y, z))

    postures = {name: posture(getattr(grasp, name)) for name in ("pregrasp", "grasp", "squeeze")}
    return replace(grasp, **postures, contacts=tuple(map(contact, grasp.contacts)))
