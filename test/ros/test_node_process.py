"""How the node starts and ends: signals, bad parameters."""

from __future__ import annotations

import signal
import time

import pytest

pytestmark = pytest.mark.timeout(120)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_busy_node_cleanly(client, start_node, number):
    process = start_node(num_grasps=64, preset="accurate")
    client.send_mesh("sphere.obj")
    client.event(20.0, event="progress", stage="optimise")
    status, seconds, log = process.stop(number)
    assert status == 0
    assert seconds < 3.0
    assert "Traceback" not in log


@pytest.mark.parametrize(
    "delay", [0.8, 4.0]
)  # seconds: in the imports; in the warm-up, or in the imports of a slow machine
def test_a_signal_during_the_start_ends_the_node_cleanly(start_node, delay):
    process = start_node(ready=False)
    time.sleep(delay)
    status, seconds, log = process.stop()
    assert status == 0
    assert seconds < 3.0
    assert "Traceback" not in log


@pytest.mark.parametrize(
    ("parameter", "value", "culprit"),
    [
        ("hand", "no_such_hand", "no_such_hand"),
        ("busy_policy", "perhaps", "reject, queue, replace"),
        ("preset", "no_such_preset", "no_such_preset"),
        ("device", "abacus", "abacus"),
        ("num_grasps", "0", "num_grasps"),
        ("deadline", "soon", "deadline"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_one_line(start_node, parameter, value, culprit):
    process = start_node(ready=False, **{parameter: value})
    assert process.process.wait(60.0) == 2
    lines = [line for line in process.log.read_text().splitlines() if line.startswith("graspd_node:")]
    assert len(lines) == 1
    assert culprit in lines[0]
