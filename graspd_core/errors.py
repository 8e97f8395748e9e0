"""Exceptions for bad input. A run that finds no grasp reports an `Outcome` and raises nothing."""

import difflib
import reprlib
from collections.abc import Iterable

# Least similarity, from 0 to 1, at which a valid name is suggested for an unknown one.
_NEAR = 0.65
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict, _SHORT.maxset = 3, 6, 6, 6, 6
_SHORT.maxstring = _SHORT.maxother = 120


def short_repr(value: object) -> str:
    """Return a short text of any value, for messages. The text of a huge value is cut."""
    try:
        return _SHORT.repr(value)
    # An integer of more than 4300 digits has no decimal form.
    except ValueError:
        return f"a huge {type(value).__name__}"


def first_line(error: BaseException) -> str:
    """Return the first line of a library's error, at most 200 characters, or the error's type if it has no text."""
    return next(iter(str(error).splitlines()), "")[:200] or type(error).__name__


def choices(name: object, valid: Iterable[str], more: str = "") -> str:
    """Return the hint for an unknown name: the most similar valid name, else all valid names followed by `more`."""
    names = [*valid]
    # A file may hold any value as a name.
    near = difflib.get_close_matches(name, names, 1, _NEAR) if isinstance(name, str) else ()
    return f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(names)}{more}"


class GraspdError(Exception):
    """Base class of all graspd errors. The message is one line that names the culprit and the valid values."""


class MeshError(GraspdError):
    """A mesh cannot be read or has no usable surface."""


class CloudError(GraspdError):
    """A point cloud cannot be read or shows no usable object."""


class NoObjectError(CloudError):
    """The views of a scene are usable, but do not show the requested object."""


class BagError(GraspdError):
    """A bag cannot be read, or does not contain the requested data."""


class HandError(GraspdError):
    """A hand description cannot be found, read or used."""


class ConfigError(GraspdError):
    """A setting is unknown, of the wrong type or out of range."""


class FormatError(GraspdError):
    """A grasps file has an unknown format or version."""


class TransformError(GraspdError):
    """A transform between two frames is unknown, not available at the requested time, or not valid."""


class ResourceError(GraspdError):
    """The machine has too little memory for the request."""


class SimulatorError(GraspdError):
    """A trial needs a simulator that is not installed, or that cannot load the scene."""


class Extra:
    """Context that reports a missing optional library: `with Extra("clouds"): import open3d`.

    Raises ConfigError: the library is not installed. The message names the command that installs the extra.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        """Enter the context. Nothing is set up."""

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, ModuleNotFoundError):
            raise ConfigError(f"{error.name} is not installed; run: pip install 'graspd[{self.name}]'") from None
