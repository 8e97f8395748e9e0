"""Mesh names stay inside the allowed roots, whatever they are spelled like."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.errors import MeshError
from graspd_ros.inputs.request_builder import MOST_MESH_BYTES, resolve_mesh


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "root"
    (root / "sub dir").mkdir(parents=True)
    (root / "mug.obj").write_text("")
    (root / "sub dir" / "cup.obj").write_text("")
    (tmp_path / "secret.obj").write_text("")
    (root / "link.obj").symlink_to(tmp_path / "secret.obj")
    (root / "inner.obj").symlink_to(root / "mug.obj")
    return root


def test_every_form_finds_the_file(root: Path, monkeypatch: pytest.MonkeyPatch):
    prefix = root / "prefix"
    share = prefix / "share" / "things"
    share.mkdir(parents=True)
    (share / "pan.obj").write_text("")
    (prefix / "share" / "ament_index" / "resource_index" / "packages").mkdir(parents=True)
    (prefix / "share" / "ament_index" / "resource_index" / "packages" / "things").write_text("")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    mug, cup = root / "mug.obj", root / "sub dir" / "cup.obj"
    found = {
        "mug.obj": mug,
        "./sub dir/../mug.obj": mug,
        " mug.obj\n": mug,
        str(mug): mug,
        f"file://{mug}": mug,
        f"file://localhost{root}/sub%20dir/cup.obj": cup,
        "inner.obj": mug,
        "package://things/pan.obj": share / "pan.obj",
    }
    assert {uri: resolve_mesh(uri, [str(root)]) for uri in found} == found
    assert resolve_mesh("package://things/pan.obj", ["package://things"]) == share / "pan.obj"


@pytest.mark.parametrize(
    ("uri", "culprit"),
    [
        ("", "empty"),
        ("../secret.obj", "outside the allowed mesh_roots"),
        ("link.obj", "outside the allowed mesh_roots"),
        ("file:///etc/hostname", "outside the allowed mesh_roots"),
        ("/etc/hostname", "outside the allowed mesh_roots"),
        ("file://elsewhere/mug.obj", "unknown form"),
        ("https://elsewhere/mug.obj", "unknown form"),
        ("package://nothing/mug.obj", "'nothing' is not installed"),
        ("missing.obj", "no such file"),
        ("sub dir", "a directory"),
        ("mug\0.obj", "not a usable path"),
        ("m" * 300, "not a usable path"),
        ("m" * 5000, "5000 characters long"),
    ],
)
def test_what_may_not_be_read_is_refused_by_name(root: Path, uri: str, culprit: str):
    with pytest.raises(MeshError) as refused:
        resolve_mesh(uri, [str(root)])
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)


def test_without_a_usable_root_nothing_may_be_read(root: Path):
    with pytest.raises(MeshError, match="names no directory"):
        resolve_mesh("mug.obj", [str(root / "nowhere"), "package://nothing"])


PARTS = st.sampled_from(["..", ".", "root", "sub dir", "mug.obj", "secret.obj", "link.obj", "", "/", "~", "%2e%2e"])


@given(st.sampled_from(["", "file://", "file:///", "package://"]), st.lists(PARTS, max_size=8))
def test_no_spelling_leads_out(tmp_path_factory: pytest.TempPathFactory, scheme: str, parts: list[str]):
    base = tmp_path_factory.getbasetemp() / "spellings"
    root = base / "root"
    if not root.exists():
        (root / "sub dir").mkdir(parents=True)
        (root / "mug.obj").write_text("")
        (base / "secret.obj").write_text("")
        (root / "link.obj").symlink_to(base / "secret.obj")
    try:
        found = resolve_mesh(scheme + "/".join(parts), [str(root)])
    except MeshError:
        return
    assert found == root / "mug.obj"


def test_a_mesh_too_large_to_read_is_refused_before_it_is_read(root: Path):
    with (root / "huge.obj").open("wb") as file:
        file.truncate(MOST_MESH_BYTES + 1)
    with pytest.raises(MeshError, match="at most 100 MB"):
        resolve_mesh("huge.obj", [str(root)])
