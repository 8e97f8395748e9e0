"""Write the table of what an installation brings: `python scripts/dependencies.py PAGE`.

Run by the interpreter of an environment that holds graspd with all of `EXTRAS`. Files are measured, and licences read,
in this environment. What a library is for is its comment in pyproject.toml.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from importlib.metadata import distribution, version
from pathlib import Path
from xml.etree import ElementTree

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# Greatest number of packages named as users of a package.
_MOST_USERS = 3
EXTRAS = ("clouds", "view", "bench", "dataset", "cell", "ros")
PAGE = """# What an installation brings

Made by `make sbom` for graspd {graspd} on Python {python} with torch {torch}.
Without extras, {core} packages take {core_mb:.0f} MB. {extras}
A package that several extras bring stands in the first of them. graspd ships no files of others: its hands and arms
were written for it. requirements.lock has the versions of graspd[clouds].

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


def licence(name: str) -> str:
    """Return the licence that a package states: in package.xml of ROS, as an expression, or as a classifier."""
    ros = Path(sys.prefix) / "share" / name.removeprefix("ros-").replace("-", "_") / "package.xml"
    if name.startswith("ros-") and ros.is_file():
        return ", ".join(sorted({element.text or "" for element in ElementTree.parse(ros).iter("license")}))
    about = distribution(name).metadata.json
    classifiers = [row for row in about.get("classifier", ()) if row.startswith("License ::")]
    stated = about.get("license_expression") or "".join(classifiers[:1]) or about.get("license") or ""
    return str(stated).strip().splitlines()[0].split(" :: ")[-1] if str(stated).strip() else "not stated"


def main(page: Path) -> None:
    """Write the page."""
    comments = re.findall(r'^    "([\w-]+).*",  # (.+)$', Path("pyproject.toml").read_text(), re.MULTILINE)
    purposes, brought, users = dict(comments), {"graspd": ""}, defaultdict(set)
    for extra in ("", *EXTRAS):
        for name, needed_by in users_of(extra).items():
            if brought.setdefault(name, extra) == extra:
                users[name] |= needed_by
    sizes = {name: megabytes(name) for name in brought}
    rows = []
    for name in sorted(sizes, key=lambda name: -sizes[name]):
        purpose = purposes.get(name) or ", ".join(sorted(users[name])[:_MOST_USERS])
        rows.append(f"| {name} | {sizes[name]:.1f} | {brought[name]} | {purpose} | {licence(name)} |")
    own = {extra: [size for name, size in sizes.items() if brought[name] == extra] for extra in ("", *EXTRAS)}
    more = ", ".join(f"`{extra}` {len(own[extra])} ({sum(own[extra]):.0f} MB)" for extra in EXTRAS)
    numbers = {"core": len(own[""]), "core_mb": sum(own[""]), "extras": f"The extras bring more: {more}."}
    versions = {"graspd": version("graspd"), "torch": version("torch"), "python": "{}.{}".format(*sys.version_info)}
    page.write_text(PAGE.format(**numbers, **versions, rows="\n".join(rows)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
