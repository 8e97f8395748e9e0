"""Read point clouds from files: point formats, arrays, and depth images with their camera.

Open3D reads only xyz and compressed pcd files in graspd. For a ply or pcd file that is cut short, Open3D would return
uninitialised memory. Formats: "The PLY Polygon File Format" (Turk, 1994) and "The PCD file format", version 0.7 (Point
Cloud Library).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError, Extra, first_line
from graspd_core.mesh.mesh_files import refuse_path
from graspd_core.perception.cloud.camera import camera_from_calibration, cloud_from_depth, depth_in_metres
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector, is_rigid
from graspd_core.perception.cloud.viewpoint_check import seen_from

# LZF, the compression of pcd files, expands one byte to at most this many bytes: three bytes make 264.
_DENSEST = 88
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
RECORDINGS = ("mcap", "db3", "bag")
CLOUD_ENDINGS = ("npy", "npz", "pcd", "ply", "xyz")

_LONGEST_HEADER = 2**20  # of a ply file [bytes]
_ROTATION_TOLERANCE = 1e-4
_ALMOST = 0.85  # least similarity of a misspelt name. Other arrays are often called like points_rgb.
# Maximum size of an unpacked archive [bytes]. 100 depth images of two million 16-bit pixels take a fifth of this limit.
_MAX_UNPACKED_BYTES = 2**31


@dataclass
class _Element:
    """One element of a ply header. `codes` holds each property's NumPy type, or "" if the property is a list."""

    name: str
    count: int
    names: list[str] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)


def read_ply_points(data: bytes) -> Points:
    """Read the vertices of a ply file, text or binary in either byte order. NaN is kept.

    Raises ValueError: not a ply file, no x, y or z, a file cut short, or list properties in or before the vertices.
    """
    # The header ends where end_header starts a line. A comment may contain the same word.
    head, *more = re.split(rb"[\r\n]end_header", data, maxsplit=1)
    rest = more[0] if more else b""
    body = rest[rest.find(b"\n") + 1 :]
    order, elements = _ply_header(head.decode("ascii", errors="replace").splitlines())
    start = 0
    for element in elements:
        if "" in element.codes:
            raise ValueError(f"element {element.name!r} has a list property; valid: only after element 'vertex'")
        if element.name == "vertex":
            break
        start += element.count * sum(np.dtype(code).itemsize if order else 1 for code in element.codes)
    else:
        raise ValueError("it has no element 'vertex'")
    missing = [name for name in "xyz" if name not in element.names]
    if missing:
        raise ValueError(f"element 'vertex' has no property {missing[0]!r}; needed: x, y, z")
    places = [element.names.index(name) for name in "xyz"]
    if not order:
        return _numbers_of_text(body, start, element.count, len(element.names))[:, places]
    sizes = [np.dtype(code).itemsize for code in element.codes]
    return _rows(body, _packed([order + element.codes[k] for k in places], places, sizes), element.count, start)


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Return a pcd file's header as a list of words for each key, and the byte offset of the points."""
    header: dict[str, list[str]] = {}
    file = BytesIO(data)
    while "DATA" not in header and (line := file.readline()):
        words = line.decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, file.tell()


def _pcd_points(data: bytes, header: dict[str, list[str]], at: int) -> Points | None:
    """Read the points of a pcd file, text or binary, from byte `at` on. Keep NaN. Return None for compressed data.

    Raises ValueError if the header is incomplete or inconsistent, or if the file is cut short.
    """
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA") if not header.get(key)]
    if missing:
        raise ValueError(f"its header has no {missing[0]}")
    fields = header["FIELDS"]
    # POINTS repeats WIDTH times HEIGHT, and some writers leave it out.
    points = int(header["POINTS"][0]) if header.get("POINTS") else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(fields))]
    if {len(counts), len(header["SIZE"]), len(header["TYPE"])} != {len(fields)} or min(counts) < 1 or points < 0:
        raise ValueError("its header needs SIZE, TYPE and COUNT (1 or more) for all FIELDS, and POINTS of 0 or more")
    lost = [name for name in "xyz" if name not in fields]
    if lost:
        raise ValueError(f"its points have no {lost[0]!r}")
    places = [fields.index(name) for name in "xyz"]
    if header["DATA"][0] == "ascii":
        columns = [sum(counts[:place]) for place in places]
        return _numbers_of_text(data[at:], 0, points, sum(counts))[:, columns]
    if header["DATA"][0] not in ("binary", "binary_compressed"):
        raise ValueError(f"its DATA {header['DATA'][0][:40]!r} is unknown; valid: ascii, binary, binary_compressed")
    # Other words must not reach NumPy: they could be other types, or even expressions that NumPy evaluates.
    odd = [kind for kind in header["TYPE"] if kind.upper() not in ("F", "I", "U")]
    if odd:
        raise ValueError(f"its TYPE {odd[0][:40]!r} is unknown; valid: F, I, U")
    sizes = [int(word) * count for word, count in zip(header["SIZE"], counts, strict=True)]
    if header["DATA"][0] == "binary_compressed":
        _refuse_false_sizes(data[at:], points * sum(sizes))
        return None
    codes = ["<" + header["TYPE"][place].lower() + header["SIZE"][place] for place in places]
    return _rows(data, _packed(codes, places, sizes), points, at)


def _refuse_false_sizes(packed: bytes, needed: int) -> None:
    size, unpacked = np.frombuffer(packed[:8].ljust(8, b"\0"), "<u4").tolist()
    if unpacked != needed or size > len(packed) - 8 or unpacked > _DENSEST * size:
        there = f"{unpacked} bytes, packed as {size}, and the file has {max(len(packed) - 8, 0)} packed bytes"
        raise ValueError(f"its header declares {needed} bytes of points, but its data declares {there}")


def _ply_header(lines: list[str]) -> tuple[str, list[_Element]]:
    """Return the byte order ("" for a text file) and the elements, in the order of the header."""
    order, elements = None, []
    for words in (line.split() for line in lines[1:]):
        match words:
            case ["format", kind, *_]:
                order = _ORDERS.get(kind)
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
                if elements[-1].count < 0:
                    raise ValueError(f"element {name!r} has a count of {count}; valid: 0 or more")
            case ["property", "list", _, _, name] if elements:
                elements[-1].names.append(name)
                elements[-1].codes.append("")
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].names.append(name)
                elements[-1].codes.append(_TYPES[kind])
            case [("property" | "element"), *_]:
                raise ValueError(f"header line {' '.join(words)[:80]!r} is not understood")
    if not lines or lines[0].strip() != "ply" or order is None:
        raise ValueError("it has no valid ply header")
    return order, elements


def _packed(codes: list[str], places: list[int], sizes: list[int]) -> np.dtype:
    starts = [sum(sizes[:place]) for place in places]
    return np.dtype({"names": list("xyz"), "formats": codes, "offsets": starts, "itemsize": sum(sizes)})


def _rows(data: bytes, dtype: np.dtype, count: int, start: int) -> Float[np.ndarray, "count 3"]:
    there = max(len(data) - start, 0) // dtype.itemsize
    if there < count:
        raise ValueError(f"cut short: {there} of {count} points")
    rows = np.frombuffer(data, dtype, count, start)
    # Signalling NaNs stay NaN. NumPy would warn of them.
    with np.errstate(invalid="ignore"):
        return np.stack([rows[name].astype(float) for name in "xyz"], axis=1)


def _numbers_of_text(body: bytes, start: int, rows: int, width: int) -> Float[np.ndarray, "rows width"]:
    words = body.split()
    there = max(len(words) - start, 0) // width
    if not 0 <= rows <= there:
        raise ValueError(f"cut short: {there} of {rows} points")
    return np.array(words[start : start + rows * width], dtype=float).reshape(rows, width)


def is_cloud_file(path: str | Path) -> bool:
    """Return True if a path has the ending of a point cloud file. A ply counts only if its header declares no faces."""
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if ending == "ply":
        return path.is_file() and not _ply_has_faces(path)
    return ending in CLOUD_ENDINGS


def load_views(path: str | Path, viewpoint: Vector | None = None, scale: float = 1.0) -> tuple[PointCloud, ...]:
    """Read the views of one or several cameras from a file, in one frame.

    For a file of points, `viewpoint` [m] replaces the camera's position in the file. With depth, `viewpoint` is an
    error. `scale` is the metres per unit of the points and the viewpoint in the file, or of depths. Poses are always in
    metres. With a scale of 1, the file has the units below.

    * ply, xyz, npy (n×3 or h×w×3): points [m], seen from the origin.
    * pcd: points [m], seen from its `VIEWPOINT`. The format does not give the camera's direction.
    * npz with `points`, and optionally `viewpoint` [m] and `forward` (the direction of the optical axis).
    * npz with `depth` (h×w, integers in millimetres, floats in metres) and the camera matrix `K` (3×3), and optionally
      `distortion` (up to k1 k2 p1 p2 k3 k4 k5 k6) and the camera's pose `T_world_camera` (4×4).
    * npz with `depths` (views×h×w), `K`, `poses` (views×4×4, each `T_world_camera`), and optionally `distortion`.

    Raises CloudError: the file is missing, has an unknown ending, is unreadable, or holds none of the listed content.
    """
    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    if ending in RECORDINGS and path.is_file():
        raise CloudError(f"{path}: {recording_message(path)}")
    refuse_path(path, "cloud", CLOUD_ENDINGS, CloudError)
    said = None if viewpoint is None else np.asarray(viewpoint, dtype=float) / scale
    if ending not in ("npy", "npz"):
        return (_scaled(_read_points(path, ending, said), scale),)
    arrays = read_numpy(path)
    try:
        if "depth" in arrays or "depths" in arrays:
            if viewpoint is not None:
                raise CloudError("view_point: given with depth, which has its own camera pose; valid with points")
            return _depth_views(arrays, scale)
        return (_scaled(_points_view(arrays, said), scale),)
    except CloudError as error:
        raise CloudError(f"{path}: {error}") from None


def _scaled(view: PointCloud, scale: float) -> PointCloud:
    return replace(view, points=view.points * scale, viewpoint=view.viewpoint * scale)


def recording_message(path: Path) -> str:
    """Return the end of an error message for a ROS recording: its kind, and the command that reads or converts it."""
    if path.suffix.lower() != ".bag":
        return f"is a recording of ROS 2; read it with graspd replay {path.name}"
    return f"is a bag of ROS 1; convert it first: rosbags-convert --src {path.name} --dst {path.stem}"


def refuse_near_names(given: Collection[str], optional: Sequence[str], kind: str) -> None:
    """Raise CloudError if an optional name is missing, but a similar name is given, which nothing would read."""
    plain = {name.lower().replace("_", ""): name for name in given}
    for name in optional:
        near = difflib.get_close_matches(name.lower().replace("_", ""), plain, 1, _ALMOST)
        if near and name not in given:
            raise CloudError(f"unknown {kind} {plain[near[0]]!r}; did you mean {name!r}?")


def _points_view(arrays: Mapping[str, np.ndarray], said: Vector | None) -> PointCloud:
    if "points" not in arrays:
        raise CloudError(f"holds no array called 'points', 'depth' or 'depths'; it has: {', '.join(arrays) or 'none'}")
    refuse_near_names(arrays, ("viewpoint", "forward"), "array")
    points = _numbers(arrays, "points")
    viewpoint = _numbers(arrays, "viewpoint") if "viewpoint" in arrays else np.zeros(3)
    viewpoint = viewpoint if said is None else said
    forward = _numbers(arrays, "forward") if "forward" in arrays else None
    pixels = points if points.ndim == 3 else points[None]
    if points.ndim == 2 and points.shape[1] in (4, 6, 7):
        told = "colours or normals" if points.shape[1] > 4 else "an intensity"
        raise CloudError(f"shape {points.shape}: {told} after x, y, z? save only the coordinates, points[:, :3]")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or viewpoint.shape != (3,):
        raise CloudError(f"points of shape {points.shape}, viewpoint {viewpoint.shape}; (n, 3) and (3,) are needed")
    if not np.isfinite(viewpoint).all():
        raise CloudError("'viewpoint' is NaN or infinite")
    if forward is not None:
        largest = np.abs(forward).max(initial=0.0)
        if forward.shape != (3,) or not 0 < largest < np.inf:
            raise CloudError("'forward' is not a direction; 3 finite numbers are needed, not all zero")
        forward = forward / largest
        forward = forward / np.linalg.norm(forward)
    return seen_from(pixels, viewpoint, forward)


def _depth_views(arrays: Mapping[str, np.ndarray], scale: float) -> tuple[PointCloud, ...]:
    several = "depths" in arrays
    name, place = ("depths", "poses") if several else ("depth", "T_world_camera")
    for needed in ("K", place) if several else ("K",):
        if needed not in arrays:
            raise CloudError(f"holds {name!r} but no {needed!r}; it has: {', '.join(arrays)}")
    refuse_near_names(arrays, ("distortion",) if several else ("distortion", place), "array")
    images, poses = arrays[name], arrays.get(place)
    if not several:
        images, poses = images[None], None if poses is None else poses[None]
    if images.ndim != 3 or images.size == 0:
        raise CloudError(f"{name!r} has shape {arrays[name].shape}; {'views × ' * several}height × width is needed")
    if poses is not None and poses.shape != (len(images), 4, 4):
        raise CloudError(f"{place!r} has shape {arrays[place].shape}; {f'{len(images)} × ' * several}4 × 4 is needed")
    matrix = _numbers(arrays, "K")
    if matrix.shape != (3, 3):
        raise CloudError(f"'K' has shape {matrix.shape}; 3 × 3 is needed")
    distortion = _numbers(arrays, "distortion").reshape(-1).tolist() if "distortion" in arrays else ()
    _, height, width = images.shape
    model = "plumb_bob" if len(distortion) <= 5 else "rational_polynomial"
    camera = camera_from_calibration(width, height, matrix.reshape(-1).tolist(), distortion, model)
    views = []
    for index, image in enumerate(images):
        pose = None if poses is None else rigid(poses[index], place)
        views.append(cloud_from_depth(_metres(image, name, scale), camera, pose))
    return tuple(views)


def _metres(image: np.ndarray, name: str, scale: float) -> Float[np.ndarray, "height width"]:
    if image.dtype.kind in "iu" and image.dtype.itemsize < 2:
        raise CloudError(f"{name!r} holds {image.dtype}: cut to 8 bits; 16 bits (mm) or floats (m) are needed")
    if scale != 1.0 and image.dtype.kind in "iuf":
        image = image.astype(float) * scale
    if image.dtype.kind in "iu":
        return depth_in_metres(image.astype(float).clip(0, 2**16 - 1).astype(np.uint16), "16UC1")
    if image.dtype.kind == "f":
        # Values too large for float32 become infinite, which means missing depth.
        with np.errstate(over="ignore", invalid="ignore"):
            return depth_in_metres(image.astype(np.float32), "32FC1")
    raise CloudError(f"{name!r} holds {image.dtype}; integers (mm) or floats (m) are needed")


def rigid(pose: np.ndarray, name: str) -> Float[np.ndarray, "4 4"]:
    pose = _numbers({name: pose}, name)
    if not is_rigid(pose, _ROTATION_TOLERANCE):
        raise CloudError(
            f"{name!r} is not a rigid transform: its upper left 3 × 3 must be a rotation, its last row 0 0 0 1"
        )
    return pose


def _numbers(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if arrays[name].dtype.kind not in "biuf":
        raise CloudError(f"{name!r} is not readable as numbers: it holds {str(arrays[name].dtype)[:80]}")
    # Signalling NaNs stay NaN. NumPy would warn of them.
    with np.errstate(invalid="ignore", over="ignore"):
        return arrays[name].astype(float)


def read_numpy(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an npz by name, or the array of an npy as `points`."""
    try:
        # If NumPy is given the path, it leaves a broken file open.
        with path.open("rb") as file:
            stored = np.load(file, allow_pickle=False)
            if isinstance(stored, np.ndarray):
                return {"points": stored}
            unpacked = sum(entry.file_size for entry in stored.zip.infolist())
            if unpacked > _MAX_UNPACKED_BYTES:
                raise ValueError(f"{unpacked} bytes when unpacked; at most {_MAX_UNPACKED_BYTES} are allowed")
            return {name: stored[name] for name in stored.files}
    # For a broken file, NumPy and the readers that it uses may raise any exception. A header that promises too much
    # raises MemoryError.
    except Exception as error:
        told = first_line(error)
        if "allow_pickle" in told:
            told = "it holds a pickled Python object, which is not loaded for safety; use np.savez(path, points=points)"
        raise CloudError(f"{path}: not readable as numbers ({told})") from error


def _ply_has_faces(path: Path) -> bool:
    with path.open("rb") as file:
        # Some writers put a whole scene description into the comments of a header.
        header = re.split(rb"[\r\n]end_header", file.read(_LONGEST_HEADER), maxsplit=1)[0]
    faces = [words for line in header.splitlines() if (words := line.split())[:2] == [b"element", b"face"]]
    return any(len(words) > 2 and words[2] != b"0" for words in faces)


def _read_points(path: Path, ending: str, viewpoint: Vector | None) -> PointCloud:
    """Read a ply, pcd or xyz file. The camera is at `viewpoint`, else at a pcd file's VIEWPOINT, else at the origin."""
    data, points, header = path.read_bytes(), None, {}
    try:
        if ending == "ply":
            points = read_ply_points(data)
        elif ending == "pcd":
            header, at = _pcd_header(data)
            viewpoint = _pcd_viewpoint(path, header) if viewpoint is None else viewpoint
            points = _pcd_points(data, header, at)
    except (ValueError, TypeError) as error:
        raise CloudError(f"{path}: not a readable {ending} cloud ({first_line(error)})") from error
    points = _read_open3d(path) if points is None else points
    if len(points) == 0 and ending == "xyz" and b"," in data[:4096]:
        raise CloudError(f"{path}: commas separate its numbers; valid: spaces; convert the file: tr , ' '")
    if len(points) == 0:
        raise CloudError(f"{path}: empty, or not a readable {ending} cloud")
    rows = header.get("HEIGHT", [""])[0]
    height = int(rows) if rows.isdigit() and int(rows) > 0 and len(points) % int(rows) == 0 else 1
    return seen_from(points.reshape(height, -1, 3), np.zeros(3) if viewpoint is None else viewpoint)


def _pcd_viewpoint(path: Path, header: Mapping[str, list[str]]) -> Vector:
    """Return the sensor's position [m] from the header, or the origin if the header has none."""
    words = header.get("VIEWPOINT", [])[:3] or ["0"] * 3
    try:
        place = np.array([float(word) for word in words])
    except ValueError:
        place = np.zeros(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise CloudError(f"{path}: its VIEWPOINT begins with {' '.join(words)}; valid: 3 finite numbers [m]")
    return place


def _read_open3d(path: Path) -> Points:
    with Extra("clouds"):
        import open3d as o3d

    # For a broken file, Open3D prints errors and returns no points. Printing is off: the caller raises an error.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            cloud = o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
        except (MemoryError, RuntimeError) as error:
            raise CloudError(f"{path}: not a readable cloud ({first_line(error)})") from error
    return np.array(cloud.points).reshape(-1, 3)
