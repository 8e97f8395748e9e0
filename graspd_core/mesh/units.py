"""Sizes that a hand's object can have, and guesses at the unit of a file: offered in messages, never applied."""

from __future__ import annotations

from math import ceil, log, log10

# The largest extent that a mesh may have [m]: what lies outside is a mistake of units, not a thing to grasp.
SMALLEST, LARGEST = 0.002, 2.0
# Outside this [m] a size is allowed, and doubted aloud.
SMALL, LARGE = 0.008, 0.5
# A graspable thing is about this large [m], and within this ratio of it.
USUAL, SPREAD = 0.12, 6.0

# What would turn a file's coordinates into metres: the number that library, command line and node take, the option that
# says the same, and the factor.
REMEDIES = {
    "scale 0.001 (--units mm)": 1e-3,
    "scale 0.01 (--units cm)": 1e-2,
    "scale 0.0254 (--units inch)": 0.0254,
    "scale 0.1": 0.1,
}


def unit_advice(size: float, scale: float = 1.0) -> str:
    """What to pass so that a thing of `size` [m] across becomes one that a hand can grasp, the likeliest first.

    Args:
        scale: what was passed already; the advice is to pass something else in its stead.
    """
    # Of absurd numbers, whose ratio overflows, too.
    given = min(max(size / scale, 1e-200), 1e200)
    remedies = REMEDIES if scale == 1 else {"scale 1": 1.0} | REMEDIES
    likely = sorted(remedies, key=lambda option: _strangeness(given * remedies[option]))
    kept = {option: remedies[option] for option in likely if _strangeness(given * remedies[option]) < log(SPREAD)}
    if not kept:
        # No unit that files come in: scaled once too often, or for another purpose.
        factor = 10.0 ** ceil(log10(USUAL / given) - 0.5)
        kept = {f"scale {factor:g}": factor}
    return ", ".join(f"{option} makes it {_length(given * factor)}" for option, factor in kept.items())


def _strangeness(size: float) -> float:
    return abs(log(size / USUAL))


def _length(size: float) -> str:
    return f"{1000 * size:.3g} mm" if size < 1 else f"{size:.3g} m"
