"""How the node starts and ends: signals, bad parameters, crashes of its work, kills."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.action.client import ActionClient

RESULT_TIMEOUT = 60.0
SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
FEW = {"num_grasps": 1, "preset": "fast", "time_budget": 40.0}
LONG = {"num_grasps": 64, "preset": "accurate", "time_budget": 60.0}
AT_ONCE = 8.0  # seconds: 3 at most on a quiet machine
SABOTEUR = Path(__file__).with_name("saboteur.py")

pytestmark = pytest.mark.timeout(120)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_busy_node_cleanly(client, start_node, number):
    process = start_node()
    actions = ActionClient(client.node, SynthesizeGrasps, "/graspd/synthesize")
    client.spin_until(actions.server_is_ready, 10.0, "action server")
    sent = actions.send_goal_async(SynthesizeGrasps.Goal(request=GraspRequest(id="goal", **SPHERE, **LONG)))
    goal = client.spin_until(lambda: sent.done() and sent.result(), 10.0, "answer to a goal").get_result_async()
    client.event(20.0, event="progress", stage="optimise")
    status, seconds, log = process.stop(number)
    assert status == 0
    assert seconds < AT_ONCE
    assert "Traceback" not in log
    ended = client.spin_until(lambda: goal.done() and goal.result(), 5.0, "result of the goal")
    assert ended.result.result.status == GraspArray.CANCELLED
    assert client.answer("goal", 5.0).status == GraspArray.CANCELLED
    actions.destroy()


@pytest.mark.parametrize(
    "delay", [0.8, 4.0]
)  # seconds: in the imports; in the warm-up, or in the imports of a slow machine
def test_a_signal_during_the_start_ends_the_node_cleanly(start_node, delay):
    process = start_node(ready=False)
    time.sleep(delay)
    status, seconds, log = process.stop()
    assert status == 0
    assert seconds < AT_ONCE
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


@pytest.mark.parametrize(("arguments", "culprit"), [(["-p", "foo"], "foo"), (["--params-file", "none.yaml"], "none")])
def test_arguments_that_ros_cannot_read_end_the_start_with_one_line(tmp_path, arguments, culprit):
    command = [sys.executable, "-m", "graspd_ros.node", "--ros-args", *arguments]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    (line,) = [line for line in ended.stderr.splitlines() if line.startswith("graspd_node:")]
    assert culprit in line


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
