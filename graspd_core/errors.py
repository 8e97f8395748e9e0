"""Define the exceptions for bad input. Planning that finds no grasp raises no exception, but returns an `Outcome`."""

import argparse
import difflib
import re
import reprlib
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, NoReturn

# Least similarity, from 0 to 1, of an unknown name to the valid name that is suggested.
_NEAR = 0.65
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict, _SHORT.maxset = 3, 6, 6, 6, 6
_SHORT.maxstring = _SHORT.maxother = 120


def short_repr(value: object) -> str:
    """Return the text of any value for a message. The text of a large value is shortened."""
    try:
        return _SHORT.repr(value)
    # Python refuses to print an integer of more than 4300 digits.
    except ValueError:
        return f"a huge {type(value).__name__}"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, at most 200 characters. Return the error's type if there is no text."""
    return next(iter(str(error).splitlines()), "")[:200] or type(error).__name__


def choices(name: object, valid: Iterable[str], more: str = "") -> str:
    """Return a hint for an unknown name: the most similar valid name, or if none is similar, all names and `more`."""
    names = [*valid]
    # In a file, a name may be any value, not only text.
    near = difflib.get_close_matches(name, names, 3, _NEAR) if isinstance(name, str) else []
    near.sort(key=lambda other: sorted(other) != sorted(str(name)))  # swapped letters first
    return f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(names)}{more}"


class GraspdError(Exception):
    """Base class of all graspd errors. The message is one line with the wrong input, its value and the valid values."""


class MeshError(GraspdError):
    """A mesh cannot be read or has no usable surface."""


class CloudError(GraspdError):
    """A point cloud cannot be read or shows no usable object."""


class NoObjectError(CloudError):
    """The clouds of a scene are usable, but do not show the requested object."""


class BagError(GraspdError):
    """A bag, which is a ROS recording, cannot be read or does not contain the requested data."""


class HandError(GraspdError):
    """A hand description cannot be found, read or used."""


class ConfigError(GraspdError):
    """A setting is unknown, of the wrong type or out of range."""


class FormatError(GraspdError):
    """A file of grasps, results or records is damaged, or has an unknown format or version."""


class TransformError(GraspdError):
    """A transform between two frames is unknown, not available at the requested time, or not valid."""


class ResourceError(GraspdError):
    """The machine has too little memory for the request."""


class SimulatorError(GraspdError):
    """A trial needs a simulator that is not installed, or that cannot load the scene."""


class Extra:
    """Context manager for importing a library that a pip extra installs, e.g. `with Extra("clouds"): import open3d`.

    Raises ConfigError: a library is not installed. The message has the pip command that installs the extra.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        """Do nothing. Python requires this method of a context manager."""

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, ModuleNotFoundError):
            raise ConfigError(f"{error.name} is not installed; run: pip install 'graspd[{self.name}]'") from None


class Parser(argparse.ArgumentParser):
    """Argument parser with `--version`. For an invalid option, it raises ConfigError and does not print its usage."""

    def __init__(self, **settings: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        super().__init__(**settings)
        with suppress(PackageNotFoundError):
            text = f"{self.prog.split()[0]} {version('graspd')}"
            self.add_argument("--version", action="version", version=text)

    def error(self, message: str) -> NoReturn:
        if found := re.fullmatch(r"(.*): invalid choice: '(.*)' \(choose from (.*)\)", message):
            where, given, valid = found.groups()
            message = f"{where}: {given!r}; {choices(given, valid.replace(chr(39), '').split(', '))}"
        raise ConfigError(f"{message} (see {self.prog} --help)")
