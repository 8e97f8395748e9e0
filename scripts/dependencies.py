"""Write the table of what an installation brings: `python scripts/dependencies.py SBOM PAGE`.

Run by the interpreter of an environment that holds graspd[clouds], whose files are measured. Licences are those of the
CycloneDX file SBOM. What a library is for is its comment in pyproject.toml.
"""

from __future__ import annotations

import json
import re
import sys
from collections import defaultdict
from importlib.metadata import distribution, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PAGE = """# What an installation brings

Made by `make sbom` for graspd {graspd} on Python {python} with torch {torch}.
Without extras, {core} packages take {core_mb:.0f} MB. The extra `clouds` brings {more} more, {more_mb:.0f} MB.
graspd ships no files of others: its hands and arms were written for it. requirements.lock has the versions.

| package | MB | extra | needed for | licence |
|---|---|---|---|---|
{rows}
"""


def users_of(extra: str) -> dict[str, set[str]]:
    """Return who needs each package that an installation of graspd with an extra (or "") brings."""
    users, left = defaultdict(set), [("graspd", frozenset({"", extra}))]
    seen = set(left)
    while left:
        name, extras = left.pop()
        for needed in map(Requirement, distribution(name).requires or ()):
            if needed.marker and not any(needed.marker.evaluate({"extra": chosen}) for chosen in extras):
                continue
            new = (canonicalize_name(needed.name), frozenset({"", *needed.extras}))
            users[new[0]] |= {name} - {new[0]}
            if new not in seen:
                seen.add(new)
                left.append(new)
    return users


def megabytes(name: str) -> float:
    """Return the size of the files of an installed package [MB]."""
    paths = {Path(str(file.locate())).resolve() for file in distribution(name).files or ()}
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def licence(component: dict) -> str:
    """Return the licence that a package states."""
    for entry in component.get("licenses", ()):
        stated = entry.get("expression") or entry["license"].get("id") or entry["license"]["name"]
        return stated.split(" :: ")[-1].splitlines()[0]
    return "not stated"


def main(sbom: Path, page: Path) -> None:
    """Write the page."""
    licences: dict[str, str] = {
        canonicalize_name(row["name"]): licence(row) for row in json.loads(sbom.read_text())["components"]
    }
    comments = re.findall(r'^    "([\w-]+).*",  # (.+)$', Path("pyproject.toml").read_text(), re.MULTILINE)
    purposes, core, users = dict(comments), {"graspd": set(), **users_of("")}, users_of("clouds")
    sizes = {name: megabytes(name) for name in {*core, *users}}
    rows = []
    for name in sorted(sizes, key=lambda name: -sizes[name]):
        purpose = purposes.get(name) or ", ".join(sorted(users[name]))
        extra = "" if name in core else "clouds"
        rows.append(f"| {name} | {sizes[name]:.1f} | {extra} | {purpose} | {licences[name]} |")
    core_mb = sum(sizes[name] for name in core)
    numbers = {"core_mb": core_mb, "more": len(sizes) - len(core), "more_mb": sum(sizes.values()) - core_mb}
    versions = {"graspd": version("graspd"), "torch": version("torch"), "python": "{}.{}".format(*sys.version_info)}
    page.write_text(PAGE.format(core=len(core), **numbers, **versions, rows="\n".join(rows)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
