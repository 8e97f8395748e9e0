"""Errors of wrong use. Failing to find a grasp is an `Outcome`, never an exception."""

import difflib
import reprlib
from collections.abc import Iterable

# How alike a name and the one that was meant are at least, of 0 to 1.
_NEAR = 0.65
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict, _SHORT.maxset = 3, 6, 6, 6, 6
_SHORT.maxstring = _SHORT.maxother = 120


def shown(value: object) -> str:
    """Return a value as short text for a message, whatever it holds. One page of YAML can stand for gigabytes."""
    try:
        return _SHORT.repr(value)
    # An integer of more than 4300 digits has no decimal form.
    except ValueError:
        return f"a huge {type(value).__name__}"


def choices(name: object, valid: Iterable[str], more: str = "") -> str:
    """Return the end of a message about an unknown name: the valid one that is near, else all, and what `more` is."""
    names = [*valid]
    # A file may hold any value as a name.
    near = difflib.get_close_matches(name, names, 1, _NEAR) if isinstance(name, str) else ()
    return f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(names)}{more}"


class GraspdError(Exception):
    """Base of every error graspd raises on purpose: one line that names the culprit and the valid choices."""


class MeshError(GraspdError):
    """A mesh cannot be read or holds no usable surface."""


class CloudError(GraspdError):
    """A point cloud cannot be read or shows no usable object."""


class NoObjectError(CloudError):
    """A scene was seen well enough, but does not hold the object asked for."""


class BagError(GraspdError):
    """A bag cannot be read, or lacks what was asked of it."""


class HandError(GraspdError):
    """A hand description cannot be found, read or used."""


class ConfigError(GraspdError):
    """A setting is unknown, of the wrong type or out of range."""


class FormatError(GraspdError):
    """A grasps file is not in the format or version that this reader knows."""


class TransformError(GraspdError):
    """Where one frame stands in another is not known, not at that time, or makes no sense."""


class ResourceError(GraspdError):
    """The machine has too little memory for what was asked."""


class SimulatorError(GraspdError):
    """A trial needs a simulator that is not installed, or that cannot take the scene."""


class Extra:
    """Report a missing library of an extra in one line: `with Extra("clouds"): import open3d`.

    Raises ConfigError: the library is not installed. The line names the command that installs the extra.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        """Begin."""

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, ModuleNotFoundError):
            raise ConfigError(f"{error.name} is not installed; run: pip install 'graspd[{self.name}]'") from None
