"""A mesh named by a message, confined to the directories that the node's owner allows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from graspd_core.errors import MeshError

MOST_MESH_BYTES = 10**8  # an OBJ of some 1.5 million faces; reading more takes minutes and gigabytes
MOST_PATH = 4096
_FORMS = "a path, file:///path or package://package/path"


def resolve_mesh(uri: str, roots: Sequence[str]) -> Path:
    """The file that `uri` names: a plain path, `file://` or `package://`; relative paths start at the first root.

    Links are followed before the file is compared with the roots, so a link inside a root does not lead out of it.
    A root may itself be a `package://` name; one whose package is not installed is left out.

    Raises:
        MeshError: an empty or unknown form, a package that is not installed, a path outside every root, no such
            file, a file too large.
    """
    uri = uri.strip()
    if len(uri) > MOST_PATH:
        raise MeshError(f"the mesh path is {len(uri)} characters long; at most {MOST_PATH} are looked at")
    if not uri:
        raise MeshError(f"the mesh path is empty; give {_FORMS}")
    allowed = allowed_roots(roots)
    if not allowed:
        raise MeshError(f"{uri}: no mesh may be read, since mesh_roots {list(roots)} names no directory")
    try:
        path = (allowed[0] / _local_path(uri)).resolve()
        if not any(path.is_relative_to(root) for root in allowed):
            raise MeshError(f"{uri}: outside the allowed mesh_roots: {', '.join(map(str, allowed))}")
        if not path.is_file():
            kind = "a directory, not a mesh file" if path.is_dir() else "no such file"
            raise MeshError(f"{uri}: {kind} (looked at {path})")
        if (size := path.stat().st_size) > MOST_MESH_BYTES:
            raise MeshError(f"{uri}: {size / 1e6:.0f} MB; at most {MOST_MESH_BYTES / 1e6:.0f} MB are read")
    except (OSError, ValueError) as error:
        raise MeshError(f"{uri!r}: not a usable path: {error}") from None
    return path


def allowed_roots(roots: Sequence[str]) -> list[Path]:
    """The directories behind `mesh_roots`, links followed; those that do not exist are left out."""
    found = []
    for root in roots:
        try:
            path = _local_path(root).expanduser().resolve()
        except MeshError:
            continue  # a package that is not installed holds nothing to read
        if path.is_dir():
            found.append(path)
    return found


def _local_path(uri: str) -> Path:
    if "://" not in uri:
        return Path(uri)
    parts = urlsplit(uri)
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return Path(unquote(parts.path))
    if parts.scheme == "package":
        return _package_share(parts.netloc, uri) / unquote(parts.path).lstrip("/")
    raise MeshError(f"{uri}: unknown form; give {_FORMS}")


def _package_share(package: str, uri: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(package))
    except (PackageNotFoundError, ValueError, OSError):  # ValueError: a malformed name; OSError: no AMENT_PREFIX_PATH
        raise MeshError(f"{uri}: package {package!r} is not installed") from None
