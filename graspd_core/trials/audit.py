"""One verified grasp in fifty is tried once more at full length: are trials that stop early still right?

One of its pulls, by chance, since all of them take as long as the trials of a dozen grasps.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from graspd_core.trials.hold_trial import STOPPED
from graspd_core.trials.trial_registry import TrialContext, grasp_trials
from graspd_core.types import AuditCount, Grasp, StopHook, TrialResult

AUDITED = 50


def audited_trials(
    context: TrialContext, grasp: Grasp, stop: StopHook = lambda: False
) -> tuple[tuple[TrialResult, ...], AuditCount]:
    """Run the trials that apply, up to the first failure; where the grasp is to be audited, once more at full length.

    Results of the full length take the place of those that they contradict. An audit that `stop` ended does not count.
    """
    results = grasp_trials(context, grasp, stop)
    if context.protocol.full_length or not results[-1].passed or not is_audited(grasp):
        return results, AuditCount()
    pulls = context.protocol.pulls
    pull = pulls[_checksum(grasp) // AUDITED % len(pulls)]
    full = replace(context, protocol=replace(context.protocol, full_length=True, pulls=(pull,)))
    again = grasp_trials(full, grasp, stop)
    if again[-1].reason == STOPPED:
        return results, AuditCount()
    agreed = again[-1].passed
    return (results if agreed else again), AuditCount(1, int(not agreed))


def is_audited(grasp: Grasp) -> bool:
    """Whether a grasp is among the one in fifty: by a checksum, so that no order matters."""
    return _checksum(grasp) % AUDITED == 0


def _checksum(grasp: Grasp) -> int:
    """A number by which a grasp draws lots: of its squeeze alone."""
    squeeze = grasp.squeeze
    numbers = np.concatenate([squeeze.position, squeeze.quaternion_wxyz, squeeze.joint_positions])
    return zlib.crc32(np.ascontiguousarray(numbers, dtype="<f8").tobytes())
