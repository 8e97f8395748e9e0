"""Read, check, clean and write mesh files, and compute mass properties. Lengths are in metres.

If a file holds no mesh or only a part of one, the error says what the file holds. Messages guess the unit of a file.
The guess is never applied.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Sequence
from math import ceil, log, log10
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch.quasirandom import SobolEngine

from graspd_core.errors import GraspdError, MeshError
from graspd_core.mesh import topology
from graspd_core.mesh.collada import read_dae
from graspd_core.mesh.components import drop_small_components, face_components, keep_cavities
from graspd_core.mesh.surface_queries import winding_inside
from graspd_core.types import TriangleMesh

# A mesh's longest side must lie in this range [m]. Outside it, the unit of the file is wrong.
SMALLEST, LARGEST = 0.002, 2.0
# A longest side outside this range [m] is accepted with a warning.
SMALL, LARGE = 0.008, 0.5
# Usual size of a graspable object [m], and the largest usual factor between an object's size and the usual size.
USUAL, SPREAD = 0.12, 6.0

# Scales that may turn a file's coordinates into metres: as words for users, and as a factor.
REMEDIES = {
    "scale 0.001 (from mm)": 1e-3,
    "scale 0.01 (from cm)": 1e-2,
    "scale 0.0254 (from inches)": 0.0254,
    "scale 0.1": 0.1,
}


def unit_advice(size: float, scale: float = 1.0) -> str:
    """Return advice on the scales that turn `size` [m] into the size of a graspable object, likeliest first.

    Args:
        scale: the scale that `size` already includes. The advised scales replace it.
    """
    # The size is limited, so that the ratio of absurd numbers does not overflow.
    given = min(max(size / scale, 1e-200), 1e200)
    remedies = REMEDIES if scale == 1 else {"scale 1": 1.0} | REMEDIES
    likely = sorted(remedies, key=lambda option: _strangeness(given * remedies[option]))
    kept = {option: remedies[option] for option in likely if _strangeness(given * remedies[option]) < log(SPREAD)}
    if not kept:
        # No usual unit fits, so the nearest power of ten is advised.
        factor = 10.0 ** ceil(log10(USUAL / given) - 0.5)
        kept = {f"scale {factor:g}": factor}
    return ", ".join(f"{option} makes it {_length(given * factor)}" for option, factor in kept.items())


def _strangeness(size: float) -> float:
    return abs(log(size / USUAL))


def _length(size: float) -> str:
    return f"{1000 * size:.3g} mm" if size < 1 else f"{size:.3g} m"


# First bytes of other kinds of file that are found under a mesh's file name.
_OTHERS = (
    (b"version https://git-lfs", "a git-LFS pointer to the mesh, not the mesh; `git lfs pull` fetches it"),
    (b"\x89PNG", "a PNG picture, not a mesh"),
    (b"\xff\xd8\xff", "a JPEG picture, not a mesh"),
    (b"GIF8", "a GIF picture, not a mesh"),
    (b"%PDF", "a PDF document, not a mesh"),
    (b"PK\x03\x04", "a ZIP archive, not a mesh; unpack it first"),
    (b"\x1f\x8b", "a gzip archive, not a mesh; unpack it first"),
    (b"<!doctype html", "a page of HTML, not a mesh"),
    (b"<html", "a page of HTML, not a mesh"),
)
# Number of bytes that are inspected at each end of a file.
_LOOK = 4096
# Binary STL: bytes of the header with the triangle count, bytes per triangle, and the greatest plausible count.
_HEADER, _TRIANGLE, _MOST_TRIANGLES = 84, 50, 10**8


def refuse_broken(path: Path) -> None:
    """Raise MeshError if a file is empty, is another kind of file, or is an STL, OBJ, PLY or OFF that is cut off."""
    data = path.read_bytes()
    head, tail = data[:_LOOK], data[-_LOOK:]
    if not data:
        raise MeshError(f"{path}: the file is empty")
    for begins, what in _OTHERS:
        if head.lstrip()[: len(begins)].lower() == begins.lower():
            raise MeshError(f"{path}: {what}")
    ending = path.suffix.lower()
    cut = _cut_stl(head, tail, len(data)) if ending == ".stl" else _cut_obj(tail) if ending == ".obj" else ""
    cut = _cut_rows(data, ending == ".ply") if ending in (".ply", ".off") else cut
    if cut:
        raise MeshError(f"{path}: cut off: {cut}")


def _cut_stl(head: bytes, tail: bytes, size: int) -> str:
    if head.lstrip().lower().startswith(b"solid") and (b"facet" in head or size < _HEADER):
        return "" if b"endsolid" in tail.lower() else "it has no endsolid"
    if size < _HEADER:
        return f"{size} bytes, less than the header of an STL"
    triangles = int.from_bytes(head[_HEADER - 4 : _HEADER], "little")
    there = (size - _HEADER) // _TRIANGLE
    return f"{there} of {triangles} triangles are there" if there < triangles <= _MOST_TRIANGLES else ""


def _cut_obj(tail: bytes) -> str:
    """Return a description of an unfinished last line, empty if the last line is complete."""
    line = tail.replace(b"\r", b"\n").rpartition(b"\n")[2].decode("utf-8", errors="replace")
    words = line.split()
    if not words or words[0] not in ("v", "vn", "f"):
        return ""
    whole = len(words) >= 4 and (words[0] == "f" or all(map(_is_number, words[1:])))
    return "" if whole else f"it ends in the middle of a line, {line.strip()[:60]!r}"


def _cut_rows(text: bytes, ply: bool) -> str:
    """Return text that tells how many rows an OFF or a text PLY lacks, empty if none."""
    head, _, body = text.partition(b"end_header" if ply else b"OFF")
    body = re.sub(rb"#.*", b"", body)
    counts = re.findall(rb"(?m)^element +\S+ +(\d+)", head) if b"format ascii" in head else []
    if not ply and (found := re.match(rb"\s*(\d+)\s+(\d+).*", body)):
        counts, body = list(found.groups()), body[found.end() :]
    rows, asked = [row for row in body.splitlines() if row.strip()], sum(map(int, counts))
    # A last row without a line end may lack some of the corners that its first number states.
    words = rows[-1].split() if rows and not body.endswith((b"\n", b"\r")) else [b"0"]
    there = len(rows) - (words[0].isdigit() and len(words) <= int(words[0]))
    return f"{there} of {asked} rows are there" if there < asked else ""


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


MESH_ENDINGS = ("dae", "glb", "obj", "off", "ply", "stl")

# Number of sample points that measure a mesh that is not one closed body, to about 1 % of volume in 0.3 s. The points
# are a Sobol sequence, because a lattice parallel to a wall misjudges the wall. Powers of two spread most evenly.
SPREAD_POINTS = 2**15


def load_mesh(path: str | Path, *, scale: float = 1.0) -> TriangleMesh:
    """Read a mesh file. Join the parts of its scene at their poses, and multiply coordinates by `scale`.

    Raises:
        MeshError: the file is missing, has an unknown ending or no whole mesh of finite size, or the scale is invalid.
    """
    return read_mesh(path, scale=scale)[0]


def read_mesh(path: str | Path, *, scale: float = 1.0) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Read a mesh file like `load_mesh`. Return the mesh and warnings about its defects, one sentence each."""
    path = Path(path)
    refuse_path(path, "mesh", MESH_ENDINGS, MeshError)
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(f"scale {scale!r} for {path}: must be a positive number")
    vertices, faces = _read(path)
    text = b"\n" + path.read_bytes() if path.suffix.lower() == ".obj" else b""
    named = text.count(b"\nv ")
    if named and not len(faces):
        raise MeshError(f"{path}: {named} vertices and no face: cut off before its faces, or not a mesh")
    mesh, warnings = _without_strays(TriangleMesh(vertices, faces), str(path))
    # The OBJ reader drops unused vertices silently, so they are counted in the text.
    warnings += _stray_warnings(str(path), named - len(vertices))
    torn = text and not text.endswith((b"\n", b"\r")) and np.ptp(mesh.vertices, axis=0).max() < 1e6
    if torn and not topology.is_closed(TriangleMesh(*topology.merge_vertices(mesh))):
        warnings += (f"{path}: the last line has no line end and the surface is not closed: the file may be cut off",)
    return TriangleMesh(mesh.vertices * scale, mesh.faces), warnings


def save_mesh(path: str | Path | TriangleMesh, mesh: TriangleMesh | str | Path) -> None:
    """Write a mesh in the format of the path's ending. Raises MeshError for an ending that cannot be written.

    Version 0.1 took the mesh first. This order still works until 0.3, with a DeprecationWarning.
    """
    import trimesh

    if isinstance(path, TriangleMesh):
        warnings.warn("save_mesh(mesh, path) is removed in version 0.3; pass the path first", DeprecationWarning, 2)
        path, mesh = mesh, path
    path, mesh = Path(cast(str, path)), cast(TriangleMesh, mesh)
    ending = path.suffix.lower().lstrip(".")
    writable = [e for e in MESH_ENDINGS if e != "dae"]
    if ending not in writable:
        raise MeshError(f"{path}: cannot write ending {path.suffix!r}; valid endings: {', '.join(writable)}")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)


def check_mesh(
    mesh: TriangleMesh, source: str, most_faces: int | None = None, *, scale: float = 1.0, dusty: bool = False
) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Clean a mesh. Return the clean mesh, and warnings about the defects, one sentence each.

    Cleaning drops unused vertices, merges coincident vertices, drops degenerate and repeated faces, and makes the
    winding consistent. It does not move or scale the mesh.

    Args:
        most_faces: meshes with more faces are simplified to about this many. None never simplifies.
        scale: factor by which the file's coordinates were already multiplied. Advice on the unit replaces this factor.
        dusty: whether to drop tiny pieces that touch nothing else.

    Raises:
        MeshError: no face is usable, a face's vertex is not finite, or the longest side is outside 2 mm to 2 m.
    """
    mesh, strays = _without_strays(mesh, source)
    _doubted_size(mesh, source, scale)
    warnings = list(strays)
    mesh, dropped, repeated = _distinct(mesh, source)
    if dropped:
        warnings.append(f"{source}: dropped {dropped} faces without area")
    if repeated:
        warnings.append(f"{source}: dropped {repeated} repeated faces")
    # Meshes are simplified before any check of neighbours, because each check takes seconds for a million faces.
    given = mesh
    if most_faces is not None and len(mesh.faces) > most_faces:
        warnings.append(f"{source}: simplified from {len(mesh.faces)} to {most_faces} faces")
        mesh, _, _ = _distinct(simplify(mesh, most_faces), source)
    if dusty:
        # Tiny pieces are dropped first. Otherwise, the size and the holes reported below could be theirs.
        mesh, small = drop_small_components(mesh)
        if small:
            warnings.append(f"{source}: dropped {small} tiny pieces that touch nothing else")
    faces = mesh.faces
    if not topology.is_oriented(faces):
        faces = keep_cavities(mesh, topology.orient(mesh.vertices, faces))
        warnings.append(f"{source}: neighbouring faces had opposite winding; all faces now agree")
    clean, _ = topology.drop_strays(TriangleMesh(mesh.vertices, faces))
    # Simplifying can tear a surface. That is no defect of the input, and the winding number tolerates it.
    if not topology.is_closed(clean) and not topology.is_closed(given):
        warnings.append(f"{source}: the surface is not closed; the winding number decides what is inside")
    return clean, (*_doubted_size(clean, source, scale), *warnings)


def simplify(mesh: TriangleMesh, faces: int, *, aggressiveness: int = 7) -> TriangleMesh:
    """Reduce a mesh to about `faces` faces by quadric edge collapse. A low `aggressiveness` is slow but tears less."""
    import fast_simplification

    if len(mesh.faces) <= faces:
        return mesh
    centre = mesh.vertices.mean(0)
    points, triangles = (mesh.vertices - centre).astype(np.float32), mesh.faces.astype(np.int32)
    vertices, triangles, *_ = fast_simplification.simplify(points, triangles, target_count=faces, agg=aggressiveness)
    return TriangleMesh(vertices.astype(float) + centre, triangles.astype(np.int64))


def content_hash(mesh: TriangleMesh) -> str:
    """Return the SHA-256 of the vertices (float64) and faces (int64) as a hexadecimal string."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()


def mass_properties(mesh: TriangleMesh) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the enclosed solid's volume [m³], centre of mass [m], and inertia [m⁵] about that centre at unit density.

    The result is exact for one closed, consistently wound body. For other surfaces, sample points give the result, with
    errors of about 1 % of the volume. A surface that encloses nothing counts as its solid bounding box.
    """
    far = topology.far_centre(mesh.vertices)
    if far.any():
        # Moments about the origin would lose all digits.
        volume, centre, inertia = mass_properties(topology.moved_mesh(mesh, -far))
        return volume, centre + far, inertia
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    if topology.is_closed(mesh) and topology.is_oriented(mesh.faces) and not face_components(mesh).any():
        solid = _solid_moments(mesh)
        # A closed sheet encloses nothing but rounding errors.
        if solid[0] > 1e-9 * (high - low).max() ** 3:
            return solid
    # A flat sheet still needs a box of some thickness for its inertia to be positive.
    size = np.maximum(high - low, 1e-3)
    spread = SobolEngine(3, scramble=True, seed=0).draw(SPREAD_POINTS, dtype=torch.float64).numpy()
    points = (spread - 0.5) * size + (low + high) / 2
    inside = winding_inside(mesh, points)
    volume = float((inside.mean() or 1.0) * size.prod())
    points = points[inside] if inside.any() else points
    centre = points.mean(0)
    second = (points - centre).T @ (points - centre) * (volume / len(points))
    return volume, centre, np.trace(second) * np.eye(3) - second


def surface_samples(
    mesh: TriangleMesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, "count 3"]]:
    """Return surface points [m] spread evenly by area, and the unit normals of their faces."""
    rng = np.random.default_rng(seed)
    cross = topology.scaled_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(cross, axis=1)
    # Each of `count` equal slices of the total area gets one random point. Independent draws would leave more gaps.
    slices = (np.arange(count) + rng.random(count)) / count * area.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(area), slices), len(area) - 1)
    root, along = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = mesh.vertices[mesh.faces[chosen]].transpose(1, 0, 2)
    points = (1 - root) * a + root * ((1 - along) * b + along * c)
    return points, cross[chosen] / np.maximum(area[chosen], 1e-300)[:, None]


def _read(path: Path):
    import trimesh

    refuse_broken(path)
    try:
        collada = path.suffix.lower() == ".dae"
        mesh = read_dae(path) if collada else trimesh.load_scene(path, process=False).to_mesh()
    except (MemoryError, KeyboardInterrupt):
        raise
    # The readers behind trimesh may raise any exception, from KeyError to struct.error.
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if isinstance(error, IndexError) and "out of bounds" in reason:
            reason = f"a face names a vertex that the file does not hold: {reason}"
        if "expected length" in reason:
            uneven = ", or faces with different numbers of corners" if "unexpected" in reason else ""
            reason = f"cut off{uneven}: {reason}"
        if "string multiply" in reason:
            reason = "faces with more than four corners; triangulate them"
        raise MeshError(f"{path}: not a readable {path.suffix.lstrip('.')} mesh ({reason})") from error
    return np.array(mesh.vertices, dtype=float).reshape(-1, 3), np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)


def refuse_path(path: Path, kind: str, endings: Sequence[str], error: type[GraspdError]) -> None:
    """Raise `error` if there is no file, or its ending is not in `endings`. `kind` is a word for the file's content."""
    if path.is_dir():
        raise error(f"{path}: is a directory; give a {kind} file ({', '.join(endings)})")
    if not path.exists():
        raise error(f"{path}: no such {kind} file")
    if path.suffix.lower().lstrip(".") not in endings:
        raise error(f"{path}: unknown {kind} ending {path.suffix!r}; valid endings: {', '.join(endings)}")


def _without_strays(mesh: TriangleMesh, source: str) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Drop unused vertices, with a warning. Raises MeshError if the mesh is empty, or an index or a vertex is bad."""
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise MeshError(f"{source}: empty mesh ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces)")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise MeshError(f"{source}: faces name vertices outside 0 to {len(mesh.vertices) - 1}")
    mesh, strays = topology.drop_strays(mesh)
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices).all(1)).sum())
        raise MeshError(f"{source}: {bad} of {len(mesh.vertices)} vertices are NaN or infinite")
    return mesh, _stray_warnings(source, strays)


def _stray_warnings(source: str, strays: int) -> tuple[str, ...]:
    return (f"{source}: dropped {strays} stray vertices that no face uses",) if strays > 0 else ()


def _doubted_size(mesh: TriangleMesh, source: str, scale: float) -> list[str]:
    """Return a warning if the size is outside `SMALL` to `LARGE`. Raises MeshError outside `SMALLEST` to `LARGEST`."""
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST <= size <= LARGEST:
        advice = unit_advice(size, scale) if size > 0 else "its vertices all lie in one point"
        raise MeshError(f"{source}: {size:.4g} m across, outside {SMALLEST} to {LARGEST} m; {advice}")
    if SMALL <= size <= LARGE:
        return []
    odd = "large" if size > LARGE else "small"
    cause = "not in metres" if scale == 1 else "in another unit"
    return [f"{source}: {size:.3g} m across, {odd} for a hand; if the file is {cause}, {unit_advice(size, scale)}"]


def _distinct(mesh: TriangleMesh, source: str) -> tuple[TriangleMesh, int, int]:
    """Merge coincident vertices. Return the mesh, and how many degenerate and how many repeated faces were dropped."""
    vertices, faces = topology.merge_vertices(mesh)
    distinct = topology.drop_degenerate(vertices, faces)
    unique = topology.drop_repeated(distinct)
    if len(unique) == 0:
        raise MeshError(f"{source}: no face has an area; a triangle mesh with a surface is needed")
    return TriangleMesh(vertices, unique), len(faces) - len(distinct), len(distinct) - len(unique)


def _solid_moments(mesh: TriangleMesh) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return volume, centre and inertia of a closed body of either winding, by tetrahedra with a corner at zero."""
    corners = mesh.vertices[mesh.faces]
    sixfold = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total, middle = sixfold.sum(), corners.sum(1)
    centre = sixfold @ middle / (4 * (total or 1.0))
    # A tetrahedron with corners c and a corner at zero has the second moment det/120 · (Σ c cᵀ + (Σ c)(Σ c)ᵀ).
    second = np.einsum("f,fki,fkj->ij", sixfold, corners, corners) + np.einsum("f,fi,fj->ij", sixfold, middle, middle)
    spread = np.sign(total) * (second / 120 - total / 6 * np.outer(centre, centre))
    # Rounding noise is set to zero. Otherwise it would choose the principal axes of a symmetric body.
    spread[np.abs(spread) < 1e-9 * np.trace(spread)] = 0.0
    centre[np.abs(centre) < 1e-12 * np.abs(corners).max()] = 0.0
    return float(abs(total) / 6), centre, np.trace(spread) * np.eye(3) - spread
