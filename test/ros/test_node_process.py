"""How the node starts and ends: signals, bad parameters, crashes of its work, kills."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from action_msgs.msg import GoalStatus
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspRequest
from grasping_msgs.action import GraspPlanning
from grasping_msgs.msg import Object
from shape_msgs.msg import SolidPrimitive

from graspd_ros.node import main

SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
FEW = {"num_grasps": 1, "preset": "fast", "time_budget": 100.0}
LONG = {"num_grasps": 256, "preset": "accurate", "time_budget": 600.0}
SABOTEUR = Path(__file__).with_name("saboteur.py")
SLOW_START = Path(__file__).with_name("slow_start.py")
# Starts the node again and again in one process, each time with other arguments, until one does not end at once.
STARTS = """
import contextlib, io, json, sys
from graspd_ros.node import main

for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as told:
        status = main(["--ros-args", *arguments])
    print(json.dumps([status, told.getvalue()]), flush=True)
"""

pytestmark = pytest.mark.timeout(300)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_busy_node_cleanly(client, shared_node, number):
    process = shared_node.process()
    client.forget()
    actions = client.actions(SynthesizeGrasps, "synthesize")
    goal = SynthesizeGrasps.Goal(request=GraspRequest(id="goal", **SPHERE, **LONG))
    asked = client.send_goal(actions, goal).get_result_async()
    client.event(event="progress", stage="optimise")
    status, log = process.stop(number)
    assert status == 0
    assert "Traceback" not in log
    ended = client.done(asked, "result of the goal")
    assert ended.result.result.status == GraspArray.CANCELLED
    assert client.answer("goal").status == GraspArray.CANCELLED
    actions.destroy()


def wait_for_signal_handler(pid: int) -> None:
    """Until a process has taken SIGTERM into its own hands, as the node does before its imports."""
    status, caught = Path(f"/proc/{pid}/status"), 0
    while not caught >> (signal.SIGTERM - 1) & 1:
        time.sleep(0.01)
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("SigCgt:")]
        caught = int(line.split()[1], 16)


def test_a_signal_during_the_imports_ends_the_node_cleanly(start_node):
    process = start_node(ready=False)
    wait_for_signal_handler(process.process.pid)
    status, log = process.stop()
    assert status == 0
    assert "Traceback" not in log


def test_a_signal_during_the_warm_up_ends_the_node_cleanly(client, start_node):
    """The warm-up of this node has no end of its own (slow_start.py): it is not ready, however late it is heard of."""
    client.forget()
    process = start_node(ready=False, module=SLOW_START)
    wait_for_signal_handler(process.process.pid)
    client.spin_until(lambda: "graspd" in client.node.get_node_names(), "node")
    assert not [event for event in client.events if event["event"] == "ready"]
    status, log = process.stop()
    assert status == 0
    assert "Traceback" not in log


def refusals(folder: Path, domain: int, starts: list[list[str]]) -> list[str]:
    """The one line in which each start was refused."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder)}
    command = [sys.executable, "-c", STARTS, json.dumps(starts)]
    ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert "Traceback" not in ended.stderr, ended.stderr
    found = [json.loads(line) for line in ended.stdout.splitlines()]
    assert [status for status, _ in found] == [2] * len(starts), ended.stderr
    lines = [[line for line in told.splitlines() if line.startswith("graspd_node:")] for _, told in found]
    assert [len(of_a_start) for of_a_start in lines] == [1] * len(starts)
    return [line for (line,) in lines]


def test_a_bad_parameter_or_argument_ends_the_start_with_one_line(tmp_path, domain):
    cases = {
        "no_such_hand": ["-p", "hand:=no_such_hand"],
        "reject, queue, replace": ["-p", "busy_policy:=perhaps"],
        "no_such_preset": ["-p", "preset:=no_such_preset"],
        "abacus": ["-p", "device:=abacus"],
        "num_grasps": ["-p", "num_grasps:=0"],
        "deadline": ["-p", "deadline:=soon"],
        # What ROS itself cannot read.
        "foo": ["-p", "foo"],
        "unknown ROS arguments: 'num_grasps:=2', '--bar'; valid: -p NAME:=VALUE": ["num_grasps:=2", "--bar"],
        "none": ["--params-file", "none.yaml"],
    }
    for line, culprit in zip(refusals(tmp_path, domain, list(cases.values())), cases, strict=True):
        assert culprit in line


def test_an_argument_that_is_not_for_ros_is_refused(capsys):
    assert main(["--hand", "leap_right"]) == 2
    assert "unrecognized arguments: --hand leap_right (see graspd_node --help)" in capsys.readouterr().err
    for option, told in (("--help", "--ros-args"), ("--version", "graspd_node 0.")):
        with pytest.raises(SystemExit) as ended:
            main([option])
        assert ended.value.code == 0
        assert told in capsys.readouterr().out


def test_a_request_whose_work_blows_up_is_answered_and_the_next_is_served(client, start_node, shared_node):
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
        answer = client.answer(f"boom-{seed}")
        assert (answer.status, answer.error_code) == (GraspArray.FAILED, code)
        assert culprit in answer.message
    client.send_request(id="fine", seed=6, **SPHERE, **FEW)
    assert client.answer("fine").status == GraspArray.SUCCEEDED
    client.spin_for(0.3)
    assert len(client.answers) == 6
    assert process.alive()
    # Doubted grasps are some for a client that reads their verdicts, and none for MoveIt.
    client.send_request(id="doubted", seed=7, **SPHERE, **FEW)
    answer = client.answer("doubted")
    assert (answer.status, answer.grasps[0].verdict) == (GraspArray.PARTIAL, Grasp.UNVERIFIED)
    client.set_parameters(seed=7, num_grasps=1, preset="fast")
    solid = SolidPrimitive(type=SolidPrimitive.BOX, dimensions=[0.05, 0.05, 0.12])
    planning = client.actions(GraspPlanning, "grasp_planning")
    handle = client.send_goal(planning, GraspPlanning.Goal(object=Object(primitives=[solid])))
    ended = client.done(handle.get_result_async(), "result")
    assert (ended.status, list(ended.result.grasps)) == (GoalStatus.STATUS_ABORTED, [])
    planning.destroy()
    client.send_request(id="orphan", seed=6, **SPHERE, **LONG)
    client.spin_until(lambda: [p for p in client.progress if p.request_id == "orphan"], "progress")
    process.stop(signal.SIGKILL)
    # Its shared memory is still there; a new one starts beside it, and serves the same client.
    shared_node.process()
    client.send_request(id="after", **SPHERE, **FEW)
    assert client.answer("after").status == GraspArray.SUCCEEDED
