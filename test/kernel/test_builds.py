"""Which build is loaded, and what is said where none is."""

import ctypes

import pytest
import torch

from graspd_core.errors import ConfigError
from graspd_core.optimize.kernel import builds


def test_the_best_build_that_runs_here_is_taken(monkeypatch):
    monkeypatch.delenv("GRASPD_KERNEL", raising=False)
    runs = [name for name, needed in builds.BUILDS.items() if not needed - builds._instructions()]
    assert builds.kernel().name == runs[0]
    assert runs[-1] == "baseline"


def test_a_build_is_chosen_by_name_or_path(monkeypatch, tmp_path):
    monkeypatch.setenv("GRASPD_KERNEL", "baseline")
    assert builds.kernel().name == "baseline"
    monkeypatch.setenv("GRASPD_KERNEL", "off")
    assert (builds.kernel().library, builds.kernel().reason) == (None, "GRASPD_KERNEL is off")
    other = tmp_path / "other.so"
    other.write_bytes(b"not a library")
    monkeypatch.setenv("GRASPD_KERNEL", str(other))
    assert builds.kernel().library is None
    assert "other.so" in builds.kernel().reason
    monkeypatch.setenv("GRASPD_KERNEL", torch._C.__file__)
    assert builds.kernel().reason == "built from other sources: install graspd again"


def test_a_build_that_does_not_exist_is_refused(monkeypatch):
    monkeypatch.setenv("GRASPD_KERNEL", "v9")
    with pytest.raises(ConfigError, match=r"GRASPD_KERNEL: 'v9'; valid: off, v4, v3, baseline"):
        builds.kernel()


def test_a_machine_without_the_instructions_gets_the_baseline(monkeypatch):
    monkeypatch.setattr(builds, "_instructions", frozenset)
    assert builds._kernel.__wrapped__("").name == "baseline"
    assert builds._kernel.__wrapped__("v3").reason.startswith("v3: no ")


def test_other_structures_are_noticed(monkeypatch):
    class Grown(ctypes.Structure):
        _fields_ = [*builds.Weights._fields_, ("more", ctypes.c_float)]

    changed = tuple(Grown if s is builds.Weights else s for s in builds.STRUCTURES)
    monkeypatch.setattr(builds, "STRUCTURES", changed)
    assert builds.load("baseline").reason == "built from other sources: install graspd again"


def test_a_build_that_lacks_a_function_is_noticed(monkeypatch):
    monkeypatch.setitem(builds._ARGUMENTS, "graspd_of_tomorrow", [])
    assert builds.load("baseline").reason == "built from other sources: install graspd again"


def test_a_build_that_was_not_made_says_so():
    assert builds.load("none").reason.startswith("not built")
