"""What moved since an earlier run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from graspd_core.bench.figures import Row, by_name, per_verified, rows, spread
from graspd_core.bench.study import Record

# Figures compared: heading, digits, and the least change worth a line (a share of the old value, or absolute).
FIGURES = {
    "standard": ("held", 3, 0.0, 0.001),
    "hard": ("held hard", 3, 0.0, 0.001),
    "sd_cm": ("SD cm", 2, 0.05, 0.02),
    "penetration_mm": ("penetration mm", 2, 0.05, 0.1),
    "contact_area_cm2": ("contact area cm²", 1, 0.05, 0.5),
    "cpu_per_grasp": ("CPU s per grasp", 3, 0.15, 0.02),
    "cpu_per_verified": ("CPU s per verified", 2, 0.15, 0.1),
    "first_cpu": ("first verified, CPU s", 2, 0.15, 0.3),
}


@dataclass(frozen=True)
class Move:
    """One figure that is not what it was; None where it is not there."""

    kind: str
    name: str
    object: str
    figure: str
    old: float | None
    new: float | None


def moves(old: Sequence[Record], new: Sequence[Record]) -> list[Move]:
    """What moved: for each name over all objects that both runs have ("all"), then object by object."""
    found: list[Move] = []
    for kind in ("raw", "verified"):
        before = {(row.name, row.object): row for row in rows(old, kind)}
        after = {(row.name, row.object): row for row in rows(new, kind)}
        shared = [key for key in after if key in before]
        befores, afters = (by_name(side[key] for key in shared) for side in (before, after))
        for name in afters:
            means = [{f: _mean(side[name], f) for f in FIGURES} for side in (befores, afters)]
            found += _differences(kind, name, "all", *means)
            found += [
                move
                for row in afters[name]
                for move in _differences(kind, name, row.object, before[name, row.object].values, row.values)
            ]
    return found


def _differences(
    kind: str, name: str, thing: str, old: dict[str, float | None], new: dict[str, float | None]
) -> list[Move]:
    pairs = ((figure, old.get(figure), new.get(figure)) for figure in FIGURES)
    return [Move(kind, name, thing, figure, a, b) for figure, a, b in pairs if _moved(figure, a, b)]


def _moved(figure: str, old: float | None, new: float | None) -> bool:
    _, _, share, least = FIGURES[figure]
    if old is None or new is None:
        return (old is None) != (new is None)
    return abs(new - old) > max(share * abs(old), least)


def _mean(group: Sequence[Row], figure: str) -> float | None:
    if figure == "cpu_per_verified":
        return per_verified(group)
    over = spread(group, figure)
    return over.mean if over else None


def comparison(old: Sequence[Record], new: Sequence[Record]) -> str:
    """The moves of cells as a table; what only one of the runs has is named below it."""
    old, new = ([record for record in records if "kind" in record] for records in (old, new))
    lines = [f"{'cells':9} {'preset':32} {'object':22} {'figure':22} {'old':>9} {'new':>9}  change"]
    for move in moves(old, new):
        heading, digits = FIGURES[move.figure][:2]
        a, b = (f"{v:.{digits}f}" if v is not None else "–" for v in (move.old, move.new))
        change = f"{(move.new - move.old) / move.old:+.0%}" if move.old and move.new is not None else ""
        lines.append(f"{move.kind:9} {move.name:32} {move.object:22} {heading:22} {a:>9} {b:>9}  {change}".rstrip())
    if len(lines) == 1:
        lines = ["nothing moved"]
    for text, some, others in (("only in the old run", old, new), ("only in this run", new, old)):
        have = {(r["kind"], r["name"], r["object"]) for r in others}
        missing = dict.fromkeys((r["kind"], r["name"], r["object"]) for r in some)
        if names := [" ".join(key) for key in missing if key not in have]:
            lines.append(f"{text}: {len(names)} ({', '.join(names[:6])}{', …' if len(names) > 6 else ''})")
    return "\n".join(lines)
