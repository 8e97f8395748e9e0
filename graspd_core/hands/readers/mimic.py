"""Coupled joints: `<mimic joint="..." multiplier="..." offset="..."/>`, chains resolved to actuated joints."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

from graspd_core.errors import HandError
from graspd_core.hands.readers.joint_limits import Coupling
from graspd_core.hands.readers.xml_values import read_numbers

_DEFAULTS = (("multiplier", "1"), ("offset", "0"))
# No joint of a hand moves so much farther than another, nor starts so far off.
_LARGEST = 1e6


def read_couplings(path: Path, joints: Sequence[ET.Element]) -> dict[str, Coupling]:
    """The couplings of all joints with a `<mimic>`, by name; each leader is an actuated joint.

    A fixed joint has no value to give, so its own `<mimic>` is not looked at.

    Raises:
        HandError: a joint follows itself, one that is not there or one that is fixed, or has a bad number.
    """
    moving = {str(joint.get("name")): joint for joint in joints if joint.get("type") != "fixed"}
    direct: dict[str, Coupling] = {}
    for name, joint in moving.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        leader = mimic.get("joint")
        if leader not in moving:
            raise HandError(
                f"{path}: joint {name!r} mimics {leader!r}, which is no movable joint; choose from {', '.join(moving)}"
            )
        multiplier, offset = (read_numbers(path, mimic, key, 1, text)[0] for key, text in _DEFAULTS)
        direct[name] = Coupling(leader, float(multiplier), float(offset))
    return resolved_couplings(path, direct)


def resolved_couplings(path: Path, direct: Mapping[str, Coupling]) -> dict[str, Coupling]:
    """Couplings as written, each led back to the actuated joint at the end of its chain.

    Raises:
        HandError: joints follow each other in a circle, or by a number that is no hand's.
    """
    return {name: _resolved(path, name, direct) for name in direct}


def _resolved(path: Path, name: str, direct: Mapping[str, Coupling]) -> Coupling:
    """The coupling to the actuated joint at the end of the chain: m₁(m₂ q + o₂) + o₁ = m₁m₂ q + m₁o₂ + o₁."""
    coupling, seen = direct[name], [name]
    while coupling.leader in direct:
        if coupling.leader in seen:
            raise HandError(f"{path}: joints mimic each other in a circle: {' -> '.join([*seen, coupling.leader])}")
        seen.append(coupling.leader)
        further = direct[coupling.leader]
        coupling = Coupling(
            further.leader,
            coupling.multiplier * further.multiplier,
            coupling.multiplier * further.offset + coupling.offset,
        )
    if not max(abs(coupling.multiplier), abs(coupling.offset)) <= _LARGEST:
        raise HandError(
            f"{path}: joint {name!r} mimics {coupling.leader!r} with multiplier {coupling.multiplier:g} and offset "
            f"{coupling.offset:g}; the largest that is taken is {_LARGEST:g}"
        )
    return coupling
