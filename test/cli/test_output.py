"""What the common options make of a command's output: --quiet, --json, bars on a terminal, no colours."""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import subprocess
import sys
import termios
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd_core.cli import build_parser, main, output, runnable
from graspd_core.cli.output import answer, busy, print_note, waiting
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_OK, EXIT_PIPE
from graspd_core.io.grasps_json import load_document
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_dataset.inspect_dataset import HandCount

QUICK = ["shape:box", "-n", "1", "--preset", "fast"]
# Commands that serve a page or write a script have no result to give as JSON.
NO_JSON = {"view", "completion"}
ESCAPE = "\x1b"


def on_a_terminal(code: str, **environment: str) -> str:
    """What a Python program writes to a terminal."""
    here, there = pty.openpty()
    termios.tcsetwinsize(there, (24, 100))
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=there, stderr=there, env={**os.environ, **environment}
    )
    os.close(there)
    told = b""
    # The end of a terminal is an error to read.
    try:
        while chunk := os.read(here, 4096):
            told += chunk
    except OSError:
        pass
    os.close(here)
    assert process.wait() == 0, told
    return told.decode()


def test_every_command_has_the_options():
    for parser in runnable(build_parser()):
        known, name = parser._option_string_actions, parser.prog.split()[1]
        assert "--quiet" in known, parser.prog
        assert ("--json" in known) == (name not in NO_JSON), parser.prog


def test_quiet_leaves_the_result_alone(refusal_of, capsys: pytest.CaptureFixture[str]):
    assert main(["synthesize", *QUICK]) == EXIT_OK
    assert "graspd: optimise" in capsys.readouterr().err
    assert main(["synthesize", *QUICK, "--quiet"]) == EXIT_OK
    out, err = capsys.readouterr()
    assert out.startswith("1 of 1 grasps")
    assert "; object of 0.77 kg\n" in out
    assert err == ""
    # What is wrong is told, and the next command speaks again.
    line = refusal_of("synthesize", "shape:bxo", "--quiet")
    assert line == "graspd: unknown shape 'bxo'; did you mean 'box'?\n"
    assert output._settings == output._OutputSettings()


def test_json_of_synthesize_is_the_document_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "grasps.json"
    assert main(["synthesize", *QUICK, "--json", "--out", str(file)]) == EXIT_OK
    out, err = capsys.readouterr()
    assert json.loads(out) == load_document(file)
    assert "1 of 1 grasps" in err
    assert f"written: {file}" in err
    assert main(["synthesize", *QUICK, "--json", "--quiet", "--deadline", "1e-9"]) != EXIT_OK
    out, err = capsys.readouterr()
    assert json.loads(out)["outcome"]["name"] == "DEADLINE"
    assert err == ""


def test_json_of_a_recorded_cloud_names_the_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    np.save(tmp_path / "ball.npy", surface_samples(make_shape("sphere"), 2000, 0)[0])
    mesh = tmp_path / "ball.ply"
    assert main(["reconstruct", str(tmp_path / "ball.npy"), "--out", str(mesh), "--json"]) == EXIT_OK
    document = json.loads(capsys.readouterr().out)
    assert document["file"] == str(mesh)
    assert document["faces"] > 100


def test_json_of_lists(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def document(*words: str) -> Any:
        assert main(list(words)) == EXIT_OK
        return json.loads(capsys.readouterr().out)

    hands = document("hands", "--json", "--quiet")
    assert {k: hands[1][k] for k in list(hands[1])[:3]} == {"name": "allegro_right", "joints": 16, "candidates": 600}
    # The option may stand before the action too.
    for words in (["--json", "inspect", "barrett_like"], ["inspect", "barrett_like", "--json"]):
        hand = document("hands", *words)
        assert [joint["name"] for joint in hand["joints"]]
        assert len(hand["palm_normal"]) == 3
    for command, name in (("methods", "closed_form"), ("presets", "fast"), ("metrics", "epsilon")):
        rows = {row["name"]: row["about"] for row in document(command, "--json")}
        assert rows[name]
        assert all(about and "\n" not in about for about in rows.values())
    library = str(tmp_path / "known.grasps")
    built = document("library", "build", "shape:sphere", "--out", library, "-n", "1", "--preset", "fast", "--json")
    assert built["objects"] == [{"source": "shape:sphere", "scale": 1.0, "grasps": 1}]
    (entry,) = document("library", "list", library, "--json")
    assert (entry["name"], entry["hand"], entry["grasps"]) == ("sphere", "allegro_right", 1)


def test_json_takes_what_commands_hold(capsys: pytest.CaptureFixture[str]):
    with output.output_of(argparse.Namespace(json=True)):
        print("for a person")
        counted = HandCount(verdicts=Counter({"verified": 2}))
        answer({"path": Path("a"), "vector": np.arange(2), "names": {"b", "a"}, "counted": counted})
    out, err = capsys.readouterr()
    counts = {"blocks": 0, "size": 0, "verdicts": {"verified": 2}, "objects": []}
    assert json.loads(out) == {"path": "a", "vector": [0, 1], "names": ["a", "b"], "counted": counts}
    assert err == "for a person\n"


def test_a_pipe_gets_neither_colours_nor_bars():
    words = [sys.executable, "-m", "graspd_core.cli", "synthesize", *QUICK]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "FORCE_COLOR": "1"})
    assert done.returncode == EXIT_OK
    assert ESCAPE not in done.stdout + done.stderr
    assert "\r" not in done.stderr


def test_a_terminal_gets_bars_without_colours():
    words = ["synthesize", *QUICK]
    code = f"from graspd_core.cli import main; main({words!r}); print('Quietly'); main({[*words, '--quiet']!r})"
    told, quietly = on_a_terminal(code, NO_COLOR="1").split("Quietly")
    assert "optimise: " in told
    assert "\r" in told
    assert not re.search(r"\x1b\[[0-9;]*m", told)
    assert "1 of 1 grasps" in quietly
    assert "optimise: " not in quietly


def test_a_wait_is_shown_on_a_terminal_only(capsys: pytest.CaptureFixture[str]):
    code = "import time; from graspd_core.cli.output import busy\nwith busy('load'): time.sleep(2.5)"
    assert re.search(r"load: 00:0[12]", on_a_terminal(code))
    assert "load" not in on_a_terminal(code.replace("2.5", "0.1"))
    began = time.perf_counter()
    with busy("load"):
        print_note("seen")
    assert list(waiting(range(3), "thing", 3)) == [0, 1, 2]
    assert capsys.readouterr().err == "graspd: seen\n"
    assert time.perf_counter() - began < 1.0


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["sy"], ["synthesize"]),
        (["synthesize", "--hand", "al"], ["allegro_left", "allegro_right"]),
        (["synthesize", "--qu"], ["--quiet"]),
        (["hands", "in"], ["inspect"]),
        (["reconstruct", "--out", "clo"], ["cloud.npy"]),
    ],
)
def test_bash_completes_what_was_begun(tmp_path: Path, capsys, words: list[str], offered: list[str]):
    pytest.importorskip("shtab")
    assert main(["completion", "bash"]) == EXIT_OK
    (tmp_path / "cloud.npy").touch()
    last = f"'{words[-1]}' '{['graspd', *words][-2]}'"
    words_of_shell = " ".join(f"'{word}'" for word in ["graspd", *words])
    asked = f"COMP_WORDS=({words_of_shell}); COMP_CWORD={len(words)}; _shtab_graspd graspd {last}"
    script = f"{capsys.readouterr().out}\n{asked}; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == offered, done.stderr


def test_completion_says_what_it_lacks(refusal_of, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    told = "graspd: completion: shtab is not installed; run: pip install shtab\n"
    assert refusal_of("completion", "bash") == told
    assert "'fish'; valid: bash, zsh, tcsh (see graspd completion --help)" in refusal_of("completion", "fish")


@pytest.mark.parametrize(
    ("words", "files", "unbuffered"),
    [
        (["metrics"], [], ""),
        (["--help"], [], ""),
        (["--help"], [], "1"),
        (["hands", "inspect", "parallel_gripper", "--yaml", "hand.yaml"], ["hand.yaml"], "1"),
        (["synthesize", *QUICK, "--json", "--out", "grasps.json"], ["grasps.json"], "1"),
    ],
)
def test_a_reader_that_has_ended_costs_no_file_and_prints_nothing(tmp_path: Path, words, files, unbuffered: str):
    read, write = os.pipe()
    os.close(read)
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    command = [sys.executable, "-m", "graspd_core.cli", *words, *(["--quiet"] if files else [])]
    done = subprocess.run(command, cwd=tmp_path, env=environment, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert [path.name for path in tmp_path.iterdir()] == files
    assert done.stderr == ""
    # Argparse of Python 3.11.7 ignores the ended reader of its help, that of 3.11.2 does not.
    assert done.returncode in ((EXIT_OK, EXIT_PIPE) if words == ["--help"] else (EXIT_PIPE,))


def test_a_full_disk_behind_stdout_is_one_line():
    command = [sys.executable, "-m", "graspd_core.cli", "metrics"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == EXIT_BAD_INPUT
    assert done.stderr == "graspd: [Errno 28] No space left on device\n"
