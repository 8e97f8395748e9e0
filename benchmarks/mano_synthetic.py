"""Write a synthetic hand in MANO's file format. It is plausible, depends only on the seed, and needs no licence.

    python benchmarks/mano_synthetic.py OUT.pkl [--seed 0]

Bones have an adult's proportions and lie in capsules of flesh. One smooth surface covers all, open at the wrist.
Lengths and breadths are round numbers. Blend shapes are small and random. Tests and `make bench` use the hand.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

BODIES = 16
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
# A right hand in MANO's axes: fingers point along -x, the palm faces -y, the thumb is on the side of +z. For each
# finger (index, middle, little, ring): position of the knuckle, lengths of the three bones, and their radii [mm].
_KNUCKLES = ((-88, 0, 24), (-92, 2, 3), (-74, -1, -36), (-85, 1, -17))
_LENGTHS = ((42, 25, 20), (46, 29, 21), (33, 19, 18), (43, 27, 20))
_RADII = ((10.0, 9.0, 8.0), (10.5, 9.0, 8.0), (8.5, 7.5, 7.0), (9.5, 8.5, 7.5))
_SPREAD = (0.06, 0.0, -0.16, -0.07)
_THUMB = ((-22, -14, 22), (-52, -22, 46), (-78, -24, 63), (-101, -24, 76))
_THUMB_RADII = (13.0, 11.0, 9.5)
_ORIGIN = np.array([0.09, 0.006, 0.006])
# Grid spacing, width of blends, distance of the cut behind the wrist joint, width of skinning across a joint [m].
_CELL, _BLEND, _STUB, _SKIN = 0.003, 0.004, 0.012, 0.004
_FACES = 1560


def synthetic_model(seed: int = 0) -> dict[str, Any]:
    """Return the entries of a MANO file, as numpy arrays."""
    from scipy.sparse import csc_matrix

    rng = np.random.default_rng(seed)
    segments, joints = _bones()
    vertices, faces = _surface(segments)
    weights = _weights(segments, vertices)
    count = len(vertices)
    shapes = 0.01 * np.einsum("vi,sij->vjs", vertices - joints[0], rng.normal(size=(10, 3, 3)))
    shapes[..., 0] = 0.02 * (vertices - joints[0])
    # Pose blend shapes move the skin of a rotated body by up to a millimetre.
    pose = 3e-4 * np.einsum("vb,bfc->vcbf", weights[:, 1:], rng.normal(size=(15, 9, 3))).reshape(count, 3, 135)
    mean = np.zeros((15, 3))
    mean[:12, 2] = 0.35
    mean[12:] = [0.0, 0.15, 0.15]
    return {
        "v_template": vertices,
        "shapedirs": shapes,
        "posedirs": pose,
        "J_regressor": csc_matrix(_regressor(vertices, joints)),
        "J": joints,
        "weights": weights,
        "f": faces.astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(BODIES)], dtype=np.int64),
        "hands_components": np.linalg.qr(rng.normal(size=(45, 45)))[0],
        "hands_mean": mean.ravel(),
        "hands_coeffs": rng.normal(size=(20, 45)),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def write_synthetic(path: Path, seed: int = 0) -> dict[str, Any]:
    """Write a synthetic hand as a MANO file. Return the entries of the file."""
    model = synthetic_model(seed)
    path.write_bytes(mano_pickle(model))
    return model


def mano_pickle(model: dict[str, Any]) -> bytes:
    """Return the entries as a pickle of protocol 2. `shapedirs` is a chumpy expression, as in the licensed files.

    The package chumpy is not needed, because stand-ins for its classes exist while the pickle is written.
    """
    modules = {name: ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    leaf = type("Ch", (), {"__module__": "chumpy.ch"})
    select = type("Select", (), {"__module__": "chumpy.reordering"})
    vars(modules["chumpy.ch"])["Ch"] = leaf
    vars(modules["chumpy.reordering"])["Select"] = select
    shapes = model["shapedirs"]
    source, chosen = leaf(), select()
    # As in the licensed files, the basis is longer than needed. Flat indices select its first ten shapes.
    vars(source).update(x=np.concatenate([shapes, np.zeros_like(shapes)], axis=-1), _dirty_vars={"x"})
    numbers = np.arange(shapes.size * 2).reshape(*shapes.shape[:2], -1)[..., : shapes.shape[-1]]
    vars(chosen).update(a=source, idxs=numbers.ravel(), preferred_shape=shapes.shape, _status="new")
    saved = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        return pickle.dumps({**model, "shapedirs": chosen}, protocol=2)
    finally:
        for name, module in saved.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _bones() -> tuple[list[tuple[int, np.ndarray, np.ndarray, float]], np.ndarray]:
    """Return the segments (body, start, end, radius) and the positions of the sixteen joints [m]."""
    joints = np.zeros((BODIES, 3))
    segments: list[tuple[int, np.ndarray, np.ndarray, float]] = []
    wrist = np.zeros(3)
    for finger, knuckle in enumerate(_KNUCKLES):
        start = 1e-3 * np.array(knuckle, dtype=float)
        # The palm consists of capsules from the wrist to each knuckle. The wrist is half as broad as the palm.
        root = np.array([0.02, 0.0, 0.35 * start[2]])
        segments.append((0, root, start * [0.98, 1.0, 1.0], 0.0125))
        along = np.array([-np.cos(_SPREAD[finger]), 0.0, np.sin(_SPREAD[finger])])
        for number in range(3):
            joints[1 + 3 * finger + number] = start
            radius = 1e-3 * _RADII[finger][number]
            end = start + 1e-3 * _LENGTHS[finger][number] * along
            segments.append((1 + 3 * finger + number, start, end, radius))
            start = end
    points = 1e-3 * np.array(_THUMB, dtype=float)
    for number in range(3):
        joints[13 + number] = points[number]
        segments.append((13 + number, points[number], points[number + 1], 1e-3 * _THUMB_RADII[number]))
    segments.append((0, np.array([0.02, -0.002, 0.012]), points[0], 0.0125))
    joints[0] = wrist
    return [(body, a + _ORIGIN, b + _ORIGIN, radius) for body, a, b, radius in segments], joints + _ORIGIN


def _depths(segments: list[tuple[int, np.ndarray, np.ndarray, float]], points: np.ndarray) -> np.ndarray:
    """Return the signed distance of points to every segment's capsule [m]."""
    distances = []
    for _, a, b, radius in segments:
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        distances.append(np.linalg.norm(points - a - share[:, None] * (b - a), axis=1) - radius)
    return np.stack(distances, -1)


def _surface(segments: list[tuple[int, np.ndarray, np.ndarray, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m] and faces of one smooth surface around the segments. It is open at the wrist."""
    import fast_simplification
    import igl

    ends = np.array([point for _, a, b, _ in segments for point in (a, b)])
    low, high = ends.min(0) - 0.02, ends.max(0) + 0.02
    axes = [np.arange(a, b, _CELL) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    points = grid.reshape(-1, 3)
    # Quilez' exponential smooth minimum joins the capsules. The plane of the wrist cuts the surface.
    flesh = -_BLEND * np.log(np.exp(-_depths(segments, points) / _BLEND).sum(-1))
    cut = _ORIGIN[0] + _STUB
    field = np.maximum(flesh, points[:, 0] - cut)
    marching: Any = igl.marching_cubes
    simplify: Any = fast_simplification.simplify
    columns = points.reshape(grid.shape).transpose(2, 1, 0, 3).reshape(-1, 3)
    values = field.reshape(grid.shape[:3]).ravel(order="F")
    found = marching(values, columns, *grid.shape[:3], 0.0)
    vertices, faces = found[0], found[1]
    fine = np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.int32)
    vertices, faces = (np.asarray(a) for a in simplify(*fine, target_count=_FACES))
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    corners = vertices[faces]
    if np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        faces = faces[:, ::-1]
    lid = (corners[..., 0] > cut - 0.6 * _CELL).all(1)
    used, compact = np.unique(faces[~lid], return_inverse=True)
    return vertices[used], compact.reshape(-1, 3)


def _weights(segments: list[tuple[int, np.ndarray, np.ndarray, float]], vertices: np.ndarray) -> np.ndarray:
    """Return skinning weights. A vertex follows the nearest body, near joints also its parent and children."""
    depths = _depths(segments, vertices)
    nearest = np.full((len(vertices), BODIES), np.inf)
    for column, (body, *_) in enumerate(segments):
        nearest[:, body] = np.minimum(nearest[:, body], depths[:, column])
    owner = nearest.argmin(1)
    related = np.eye(BODIES, dtype=bool)
    for body in range(1, BODIES):
        related[body, PARENTS[body]] = related[PARENTS[body], body] = True
    weights = np.exp(-(nearest - nearest.min(1, keepdims=True)) / _SKIN) * related[owner]
    return weights / weights.sum(1, keepdims=True)


def _regressor(vertices: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the joint regressor. A row weights the 40 vertices nearest to a joint, with sum one and least norm."""
    rows = np.zeros((BODIES, len(vertices)))
    for row, joint in zip(rows, joints, strict=True):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1))[:40]
        system = np.vstack([vertices[near].T, np.ones(len(near))])
        row[near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    model = write_synthetic(options.out, options.seed)
    print(f"{options.out}: {len(model['v_template'])} vertices, {len(model['f'])} faces")


if __name__ == "__main__":
    main()
