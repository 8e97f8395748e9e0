"""Texts into the marked sections of documents; tables in Markdown; where figures come from."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from graspd_core.bench.study import Picture, Record, Sections
from graspd_core.errors import ConfigError
from graspd_core.formats.grasps_json import save_text


def markdown_table(headings: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; cells must not have bars of their own."""
    lines = [headings, ["---"] * len(headings), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("| --- |", "|---|").replace(" --- |", "---|")


def provenance(command: str, records: Sequence[Record]) -> str:
    """One line on where figures come from: the command, the days, the commits, the code, the machine, what it took."""

    def of(name: str) -> str:
        return ", ".join(sorted({str(record.get(name) or "unknown") for record in records}))

    failed = sum(bool(record["error"]) for record in records)
    minutes = sum(record.get("case_cpu", 0.0) for record in records) / 60
    told = f"Made {of('made')} by `{command}` at commit {of('commit')} (code {of('code')}): "
    told += f"{len(records)} cases, {minutes:.0f} CPU minutes on {of('machine')}."
    return told + (f" {failed} cases failed and are in no figure." if failed else "")


def sourced(command: str, records: Sequence[Record], sections: Sections) -> dict[str, Sequence[str | Picture]]:
    """Sections that have anything in them, each with the line that says where its figures come from."""
    filled = {name: [part for part in parts if part] for name, parts in sections.items()}
    return {name: [*parts, provenance(command, records)] for name, parts in filled.items() if parts}


def written(parts: Sequence[str | Picture], document: Path | None = None) -> str:
    """The parts of a section as Markdown; pictures are links from the document, and left out where there is none."""
    texts = []
    for part in parts:
        if isinstance(part, str):
            texts.append(part)
        elif document is not None:
            link = Path(os.path.relpath(part.png.resolve(), document.resolve().parent)).as_posix()
            texts.append(f"![{part.title}]({link})")
    return "\n\n".join(texts)


def fill(document: Path, sections: Mapping[str, Sequence[str | Picture]]) -> list[str]:
    """Rewrite the marked sections of a document; others stay. Returns the names of those rewritten.

    A section stands between `<!-- NAME:begin -->` and `<!-- NAME:end -->`.

    Raises:
        ConfigError: the document cannot be read, or has none of the sections.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{document}: {error.strerror or error}") from None
    filled = []
    for name, parts in sections.items():
        # On lines of their own: a document may also speak of its markers.
        section = re.compile(rf"^(<!-- {name}:begin -->\n).*?^(<!-- {name}:end -->)$", re.DOTALL | re.MULTILINE)
        if section.search(text):
            new = written(parts, document)
            text = section.sub(lambda found, new=new: f"{found[1]}{new}\n{found[2]}", text, count=1)
            filled.append(name)
    if not filled:
        raise ConfigError(f"{document}: has none of the sections {', '.join(sections)}; valid: <!-- bench:begin --> …")
    save_text(document, text)
    return filled
