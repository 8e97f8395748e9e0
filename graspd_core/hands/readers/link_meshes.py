"""Find the mesh files of a hand, and compute their convex hulls."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float

from graspd_core.errors import MeshError
from graspd_core.hands.readers.xml_io import wrong
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.mesh.mesh_files import load_mesh
from graspd_core.mesh.shapes import file_state
from graspd_core.types import TriangleMesh

# Greatest number of corners of a hull. For a sphere of radius 12 mm, the hull is up to 0.3 mm below the surface.
_CORNERS = 200
# Greatest number of corners of all hulls of a hand together, and least number that every hull may have.
_ALL_CORNERS, _FEWEST_CORNERS = 12_800, 48
# Greatest valid size of a part of a hand, and least valid size of a mesh [m]. A mesh in metres that a file scales by
# 0.001 is smaller.
LARGEST_SIZE, SMALLEST_MESH = 2.0, 3e-4


def resolve_mesh(urdf: Path, shape: ET.Element, filename: str) -> Path:
    """Find a mesh file of a URDF. `filename` is a `package://`, `model://` or `file://` address, or a path.

    Packages are searched by folder name or by the name in package.xml: first in ROS_PACKAGE_PATH and AMENT_PREFIX_PATH,
    then above the URDF and beside the URDF's package. Relative paths start at the URDF's folder or any folder above it.
    Raises HandError: the file does not exist or is on the network.
    """
    scheme, rest = _address(filename)
    if scheme in ("http", "https", "ftp"):
        raise wrong(urdf, shape, f"mesh {filename!r} is not fetched from the network; name a local file")
    parents = urdf.resolve().parents
    if scheme in ("package", "model"):
        # An unpacked archive often has another name than the package. So the path after the package name is tried too.
        folders, rest = [*_package_folders(rest.partition("/")[0], parents), *parents], rest.partition("/")[2]
    else:
        folders = list(parents)
    for folder in folders:
        # `isfile` returns False for an invalid name. The method of pathlib may raise.
        if os.path.isfile(folder / rest):
            return folder / rest
    where = "in any package path, nor " if scheme in ("package", "model") else ""
    raise wrong(urdf, shape, f"mesh {filename!r} was not found {where}in the file's folder or its parent folders")


def _address(filename: str) -> tuple[str, str]:
    """Return the scheme of a mesh address (empty for a plain path), and the remaining path."""
    scheme, separator, rest = filename.replace("\\", "/").partition("://")
    if not separator:
        return "", scheme
    return scheme, unquote(rest.removeprefix("localhost") if scheme == "file" else rest)


def missing_packages(urdf: Path, meshes: Iterable[ET.Element]) -> tuple[str, ...]:
    """Return warnings about packages that were not found. Their meshes are searched beside the URDF and above it."""
    addresses = (_address(mesh.get("filename") or "") for mesh in meshes)
    named = {rest.partition("/")[0] for scheme, rest in addresses if scheme in ("package", "model")}
    parents = urdf.resolve().parents
    lost = sorted(name for name in named if not any(map(os.path.isdir, _package_folders(name, parents))))
    return tuple(f"package {name!r} was not found; meshes are searched beside the file and above it" for name in lost)


def corners_each(meshes: int) -> int:
    """Return the number of corners that each hull may have in a hand with `meshes` meshes."""
    return int(np.clip(_ALL_CORNERS // max(meshes, 1), _FEWEST_CORNERS, _CORNERS))


def mesh_hull(
    urdf: Path, shape: ET.Element, filename: str, scale: Float[np.ndarray, "3"], corners: int = _CORNERS
) -> TriangleMesh:
    """Return the convex hull [m] of a mesh file scaled along each axis, with at most `corners` corners.

    A negative factor mirrors the mesh. Raises HandError: the file does not exist, is not a mesh, or has a wrong size.
    """
    path = resolve_mesh(urdf, shape, filename)
    try:
        hull = _hull(path, file_state(str(path)), tuple(scale.tolist()), corners)
    except (MeshError, OSError) as error:
        raise wrong(urdf, shape, f"mesh {filename!r} cannot be read as a collision mesh: {error}") from error
    extent = float(np.ptp(hull.vertices, axis=0).max())
    if extent > LARGEST_SIZE:
        raise wrong(
            urdf, shape, f"mesh {filename!r} is {extent:.3g} m across: if it is in millimetres, scale it by 0.001"
        )
    if extent < SMALLEST_MESH:
        told = f"mesh {filename!r} is {1e3 * extent:.3g} mm across; valid: {1e3 * SMALLEST_MESH:g} mm or more"
        raise wrong(urdf, shape, f"{told}; if its file is in metres, scale it by 1")
    return hull


def whole_mesh(urdf: Path, shape: ET.Element, filename: str, scale: Float[np.ndarray, "3"]) -> TriangleMesh:
    """Read a mesh file and scale it along each axis [m]. Raises HandError: the file is missing or not a mesh."""
    try:
        mesh = load_mesh(resolve_mesh(urdf, shape, filename))
    except (MeshError, OSError) as error:
        raise wrong(urdf, shape, f"mesh {filename!r} cannot be read as a visual mesh: {error}") from error
    # A mirrored mesh needs reversed faces, so that they still face outwards.
    return TriangleMesh(mesh.vertices * scale, mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces)


@lru_cache(maxsize=2048)
def _hull(path: Path, state: tuple[int, ...], scale: tuple[float, float, float], corners: int) -> TriangleMesh:
    del state
    mesh = load_mesh(path)
    # Scale the points before computing the hull, because mirroring a hull would turn the hull inside out.
    points = mesh.vertices[np.unique(mesh.faces)] * np.array(scale)
    return limited_hull(points, corners)


def _package_folders(package: str, parents) -> list[Path]:
    """Return the folders that may contain a package, most likely first."""
    named = [Path(entry) for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if entry]
    installed = [Path(entry) / "share" for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry]
    found = [folder for folder in named if folder.name == package or _package_name(folder) == package]
    found += [folder / package for folder in (*named, *installed, *parents)]
    found += [folder for folder in parents if _package_name(folder) == package]
    # In a workspace other packages lie beside the URDF's own package.
    for folder in list(parents)[:4]:
        try:
            beside = sorted(folder.glob("*/package.xml"))
        except OSError:
            continue
        found += [file.parent for file in beside if _package_name(file.parent) == package]
    return found


def _package_name(folder: Path) -> str | None:
    try:
        text = (folder / "package.xml").read_text(encoding="utf-8", errors="replace")
    except (OSError, ValueError):
        return None
    found = re.search(r"<name>\s*([\w.-]+)\s*</name>", text)
    return found.group(1) if found else None
