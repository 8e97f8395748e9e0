"""Jobs to records on disk, a file each, and from there to the shares that a picture shows."""

from __future__ import annotations

import json
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path

from graspd_core.bench.failure_maps.map_job import Job, Place, job_key, record_of, run_job
from graspd_core.bench.failure_maps.map_registry import MAPS, METHODS, jobs_of
from graspd_core.bench.measurements.run_measurement import finite
from graspd_core.bench.result_store import Record, kept_record
from graspd_core.formats.grasps_json import save_text


def job_file(job: Job) -> str:
    """Name of the file that a job's record is kept in: for the eye, then for certain."""
    where = "-".join(str(place) for place in (job.across, *job.up[:1]))
    return f"{job.map}-{job.preset}-{job.thing}-{where}-{job_key(job)[:12]}.json"


def read_job(folder: Path, job: Job, code: str | None) -> Record | None:
    """The record of a job that finished without error under `code` (None: under any); None where there is none."""
    return kept_record(folder / job_file(job), job_key(job), code)


def run_missing(jobs: Iterable[Job], folder: Path, code: str, *, any_code: bool = False) -> Iterator[Record]:
    """Run those jobs that have no record yet, and yield each new record, which is on disk by then.

    What a job raises is written down in its record, and it is run again the next time: one bad cell ends no map.
    """
    for job in jobs:
        if read_job(folder, job, None if any_code else code) is not None:
            continue
        began = time.process_time()
        try:
            done = run_job(MAPS[job.map].run, job)
            record = record_of(job, done, code, time.process_time() - began)
        except Exception as error:
            where = "".join(traceback.format_exception(error))
            record = {"key": job_key(job), "code": code, **asdict(job), "error": str(error), "traceback": where}
        save_text(folder / job_file(job), json.dumps(finite(record), indent=1, allow_nan=False) + "\n")
        yield record


def finished(folder: Path, name: str, method: str, code: str | None = None) -> list[Record]:
    """Records of all finished jobs of a map with one method."""
    records = (read_job(folder, job, code) for job in jobs_of(name, method))
    return [record for record in records if record is not None]


def shares(records: Sequence[Record]) -> dict[tuple[Place, Place], float]:
    """Share of the grasps asked for that held, all objects together, by place across and up."""
    held, asked = Counter[tuple[Place, Place]](), Counter[tuple[Place, Place]]()
    for record in records:
        for cell in record["cells"]:
            held[record["across"], cell["up"]] += cell["held"]
            asked[record["across"], cell["up"]] += record["count"]
    return {place: held[place] / asked[place] for place in asked}


def reasons(records: Sequence[Record]) -> dict[tuple[Place, Place], Counter[str]]:
    """Why grasps failed, by place across and up."""
    found: dict[tuple[Place, Place], Counter[str]] = {}
    for record in records:
        for cell in record["cells"]:
            found.setdefault((record["across"], cell["up"]), Counter()).update(cell["reasons"])
    return found


def report(folder: Path) -> str:
    """Of every map and method the failures by reason, those of each cell below, as Markdown."""
    lines = []
    for name, drawn in MAPS.items():
        for method in METHODS:
            found = reasons(finished(folder, name, method))
            total = sum(found.values(), Counter[str]())
            lines += ["", f"**{drawn.title}, {method}**: {_counts(total)}", ""]
            cells = product(drawn.up.places, drawn.across.places)
            failed = [(up, across) for up, across in cells if found.get((across, up))]
            lines += [f"* {across}, {up}: {_counts(found[across, up])}" for up, across in failed]
    return "\n".join(lines).strip()


def _counts(why: Counter[str]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in why.most_common()) or "no failure"
