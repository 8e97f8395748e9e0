"""The help inside the page."""

from __future__ import annotations

from graspd_core.metrics.metric_registry import METRICS

_KEYS = """
**Keys.** N next grasp, P previous grasp, R run and play the trial. Drag turns the scene, the right button moves it, the
wheel zooms.

**Colours.** The object is orange; where a camera did not see it and its shape was guessed, mauve. Blue arrows are the
object's normals at the contacts. Red arrows are forces on the object, 8 mm for a newton: as planned for the squeeze,
and as MuJoCo measured them while a trial plays. Purple is the push that the grasp resists least, yellow the axis of the
turn that goes with it. In a slice of the signed distance blue is inside.

**Verdicts.** A grasp is *verified* when it passed every physics trial, *failed* when it did not: press R to see when
and why. One that is *less sure* holds on the likeliest shape of an object that cameras saw, and fails under too
much else that may be true; the share beside it is how probably it holds. *Unverified* grasps were not tried.

**Trials.** In the hold trial the hand closes on the free object, which is then pulled along six axes. In the lift trial
it comes from a retreat, closes on the object on its support, and lifts it.

**While planning.** Every line figure is a hand: blue while it is searched for, grey while it waits for its trial, then
green or red; one that is less sure stays grey.

**Slow?** A browser that draws without a graphics card does so twice as fast with
[a quarter of the pixels](/?fixedDpr=0.5).

**Figures.**
"""


def _help() -> str:
    figures = "\n".join(f"* *{row.title}*: {row.description}" for row in METRICS.values())
    return f"{_KEYS}\n{figures}\n\nMore in docs/viewer.md, docs/metrics.md and docs/method.md of graspd."


HELP = _help()
