"""Fuzz graspd's own parsers by atheris (libFuzzer), guided by code coverage. This program is not a test.

    python benchmarks/fuzz.py [--minutes 10] [--targets urdf mano ...] [--out results/fuzz] [--seed 1]

A target is one parser. The targets run one after another and share the minutes. An input is a finding if it gives
neither a value nor one clear error, takes more than five seconds, or asks for more than 2 GB. OUT/findings keeps the
bytes and the traceback of one finding for each place in the code. OUT/corpus keeps useful inputs for the next run. The
exit status is 1 if there are findings. The program needs `pip install -e .[fuzz]`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import subprocess
import sys
import time
import traceback
from pathlib import Path

ROOT = Path(__file__).parents[1]
SECONDS_PER_INPUT, MEGABYTES = 5, 2048


def fuzz_here(name: str, seconds: int, out: Path, seed: int) -> None:
    """Fuzz one target in this process until the time is over. The process then ends, so the function never returns."""
    import atheris

    corpus, findings = out / "corpus" / name, out / "findings"
    for folder in (corpus, findings):
        folder.mkdir(parents=True, exist_ok=True)
    # Run the seeds here, so that the modules they import are instrumented and loaded before memory is limited.
    with atheris.instrument_imports(  # pyright: ignore[reportAttributeAccessIssue]
        include=["graspd_core"], enable_loader_override=False
    ):
        from fuzz_targets import TARGETS, scratch, try_input

        target, inputs = TARGETS[name], scratch()

        def one(data: bytes) -> None:
            try:
                try_input(target, data, Path(inputs.name))
            except Exception as error:
                _keep(findings, name, data, error)

        for number, data in enumerate(target.seeds()):
            (corpus / f"seed{number}").write_bytes(data)
            one(data)
    with inputs as folder:
        words = Path(folder) / "words"
        words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
        resource.setrlimit(resource.RLIMIT_AS, (_virtual_memory() + MEGABYTES * 2**20, resource.RLIM_INFINITY))
        options = [f"-max_total_time={seconds}", f"-timeout={SECONDS_PER_INPUT}", "-rss_limit_mb=0", f"-seed={seed}"]
        options += [f"-max_len={target.most}", f"-artifact_prefix={findings}/{name}-", "-print_final_stats=1"]
        options += [f"-dict={words}"] if target.words else []
        atheris.Setup([sys.argv[0], *options, str(corpus)], one)
        atheris.Fuzz()


def _escaped(word: str) -> str:
    return "".join(c if c.isascii() and c.isalnum() else f"\\x{ord(c):02x}" for c in word)


def _virtual_memory() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _keep(findings: Path, name: str, data: bytes, error: Exception) -> None:
    """Write a finding to disk. Keep only the shortest input for each place and kind of error."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "graspd_core" in f.filename]
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "target"
    key = hashlib.sha256(f"{place} {type(error).__name__}".encode()).hexdigest()[:8]
    file = findings / f"{name}-{key}.bin"
    if file.exists() and file.stat().st_size <= len(data):
        return
    file.write_bytes(data)
    told = f"{place} {type(error).__name__}: {error}".replace("\n", " ")[:300]
    file.with_suffix(".txt").write_text(f"{told}\n{traceback.format_exc()}")


def fuzz(name: str, seconds: float, out: Path, seed: int) -> tuple[int, int, float]:
    """Fuzz one target in a child process until the time is over. If an input kills the process, start another one.

    Return the number of inputs, the number of reached edges in the code, and the duration [s].
    """
    inputs, edges, begun = 0, 0, time.monotonic()
    while (left := seconds - (time.monotonic() - begun)) >= 1:
        arguments = ["--child", name, "--seconds", str(int(left)), "--out", str(out), "--seed", str(seed)]
        ended = subprocess.run([sys.executable, __file__, *arguments], capture_output=True, text=True, errors="replace")
        inputs += sum(map(int, re.findall(r"stat::number_of_executed_units:\s+(\d+)", ended.stderr)))
        edges = max([edges, *map(int, re.findall(r" cov: (\d+)", ended.stderr))])
        if ended.returncode == 0:
            break
        told = re.search(r"ERROR: libFuzzer: .*|Fatal Python error.*|\w+Error: .*", ended.stderr)
        reason = told.group(0) if told else ended.stderr[-300:]
        print(f"{name}: a process ended with status {ended.returncode}: {reason}", file=sys.stderr)
        if not inputs:
            sys.exit(f"{name}: does not start:\n{ended.stderr[-2000:]}")
        seed += 1
    return inputs, edges, time.monotonic() - begun


def main() -> int:
    """Fuzz the requested targets, and print a table. Return the exit status."""
    parser = argparse.ArgumentParser(description="Coverage-guided fuzzing of graspd's parsers.")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--targets", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "fuzz")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    out = given.out.resolve()
    if given.child:
        fuzz_here(given.child, given.seconds, out, given.seed)
        return 0
    from fuzz_targets import TARGETS

    unknown = sorted(set(given.targets) - set(TARGETS))
    if unknown:
        parser.error(f"unknown target {unknown[0]!r}; choose from {', '.join(TARGETS)}")
    names = given.targets or list(TARGETS)
    print("| target | inputs | edges | seconds | findings |\n|---|---:|---:|---:|---:|", flush=True)
    for name in names:
        inputs, edges, seconds = fuzz(name, given.minutes * 60 / len(names), out, given.seed)
        # The count includes libFuzzer's own files: inputs that hung or killed the process.
        found = [file for file in (out / "findings").glob(f"{name}-*") if file.suffix != ".txt"]
        print(f"| {name} | {inputs} | {edges} | {seconds:.0f} | {len(found)} |", flush=True)
    left = sorted(file for file in (out / "findings").glob("*") if file.suffix != ".txt")
    for file in left:
        note = file.with_suffix(".txt")
        print(f"{file}: {note.read_text().splitlines()[0] if note.exists() else 'hung or died'}")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
