"""How the node starts and ends: signals, bad parameters, crashes of its work, kills."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from graspd_msgs.msg import GraspArray, GraspRequest

RESULT_TIMEOUT = 60.0
SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
FEW = {"num_grasps": 1, "preset": "fast", "time_budget": 40.0}
LONG = {"num_grasps": 64, "preset": "accurate", "time_budget": 60.0}
SABOTEUR = Path(__file__).with_name("saboteur.py")

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


def test_a_request_whose_work_blows_up_is_answered_and_the_next_is_served(client, start_node):
    """The planner of this node is rigged (saboteur.py): it raises what the seed says."""
    process = start_node(module=SABOTEUR)
    for seed, code, culprit in [
        (1, "OUT_OF_MEMORY", "MemoryError"),
        (2, "OUT_OF_MEMORY", "can't allocate memory"),
        (3, "INTERNAL", "RuntimeError: shapes differ"),
        (4, "INTERNAL", "SystemExit"),
        (5, "INTERNAL", "no reason at all"),
    ]:
        client.send_request(id=f"boom-{seed}", seed=seed, **SPHERE, **FEW)
        answer = client.answer(f"boom-{seed}", 10.0)
        assert (answer.status, answer.error_code) == (GraspArray.FAILED, code)
        assert culprit in answer.message
    client.send_request(id="fine", seed=6, **SPHERE, **FEW)
    assert client.answer("fine", RESULT_TIMEOUT).status == GraspArray.SUCCEEDED
    client.spin_for(0.3)
    assert len(client.answers) == 6
    assert process.alive()
    client.send_request(id="orphan", seed=6, **SPHERE, **LONG)
    client.spin_until(lambda: [p for p in client.progress if p.request_id == "orphan"], 10.0, "progress")
    process.stop(signal.SIGKILL)
    # Its shared memory is still there; a new one starts beside it, and serves the same client.
    start_node(num_grasps=1, preset="fast")
    client.send_request(id="after", **SPHERE, **FEW)
    assert client.answer("after", RESULT_TIMEOUT).status == GraspArray.SUCCEEDED
