"""Sizes that a hand's object can have, and guesses at the unit of a file: offered in messages, never applied."""

from __future__ import annotations

from math import ceil, log, log10

# The largest extent that a mesh may have [m]: what lies outside is a mistake of units, not a thing to grasp.
SMALLEST, LARGEST = 0.002, 2.0
# Outside this [m] a size is allowed, and doubted aloud.
SMALL, LARGE = 0.008, 0.5
# A graspable thing is about this large [m], and within this ratio of it.
USUAL, SPREAD = 0.12, 6.0

# What would turn a file's coordinates into metres: the option to pass, and the factor.
REMEDIES = {"--units mm": 1e-3, "--units cm": 1e-2, "--units inch": 0.0254, "--scale 0.1": 0.1}


def unit_advice(size: float) -> str:
    """What to pass so that a thing of `size` [m] across becomes one that a hand can grasp, the likeliest first."""
    if size < USUAL:
        # Every unit that files come in is smaller than a metre: it was scaled down once too often.
        factor = 10 ** ceil(log10(USUAL / size) - 0.5)
        return f"--scale {factor:g} makes it {_length(size * factor)}"
    likely = sorted(REMEDIES, key=lambda option: _strangeness(size * REMEDIES[option]))
    kept = [option for option in likely if _strangeness(size * REMEDIES[option]) < log(SPREAD)] or likely[:1]
    return ", ".join(f"{option} makes it {_length(size * REMEDIES[option])}" for option in kept)


def _strangeness(size: float) -> float:
    return abs(log(size / USUAL))


def _length(size: float) -> str:
    return f"{1000 * size:.3g} mm" if size < 1 else f"{size:.3g} m"
