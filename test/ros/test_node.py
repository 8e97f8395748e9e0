"""The node in its own process, over DDS: objects in, grasps and events out; floods, bursts and cancels."""

import json
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from graspd_msgs.msg import GraspArray, GraspRequest
from rcl_interfaces.srv import GetParameters

from graspd_ros.convert import array_of, wxyz_of

FEW = {"num_grasps": 2, "preset": "fast", "deadline": 100.0, "busy_policy": "queue"}
# Work that is still going on when the next request arrives.
LONG = {"num_grasps": 256, "preset": "accurate", "deadline": 600.0, "busy_policy": "queue"}
HAND_LENGTH = 0.25  # metres; the base of a hand that holds something is within this of it

pytestmark = pytest.mark.timeout(300)
EXAMPLE = Path(__file__).parents[2] / "examples" / "ros_client.py"
SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
UNENDING = {"num_grasps": 256, "preset": "accurate", "time_budget": 600.0}


def test_a_mesh_becomes_progress_and_a_grasp(client, node):
    client.set_parameters(**FEW)
    client.send_mesh("sphere.obj")
    accepted = client.event(event="accepted", source="mesh")
    progress = client.event(event="progress", request=accepted["request"])
    assert 0.0 <= progress["fraction"] <= 1.0
    result = client.event(event="result", request=accepted["request"])
    assert result["outcome"] == "succeeded"
    assert result["verified"] == 2
    assert result["best"]["verdict"] == "verified"
    written = json.loads((node.directory / result["file"]).read_text())
    assert written["frame"] == "object"
    assert written["stamp"] > 0
    client.spin_until(lambda: client.joints and client.poses, "grasp messages")
    (joints,), (pose,) = client.joints, client.poses
    assert len(joints.name) == len(joints.position) == 16
    assert pose.header.frame_id == "object"
    assert np.linalg.norm(array_of(pose.pose.position)) < HAND_LENGTH
    assert wxyz_of(pose.pose.orientation) == pytest.approx(result["best"]["quaternion_wxyz"])
    order = [e["event"] for e in client.events if e.get("request") == accepted["request"]]
    assert order == ["accepted", *["progress"] * (len(order) - 2), "result"]


def test_the_answer_says_what_the_object_weighed_and_whether_anybody_said_so(client, node):
    client.set_parameters(**FEW)
    client.send_request(id="light", mass=0.07, **SPHERE)
    told = client.answer("light")
    assert (told.status, told.mass, told.mass_assumed) == (GraspArray.SUCCEEDED, pytest.approx(0.07), False)
    figures = {metric.name: metric.value for metric in told.grasps[0].metrics}
    assert figures["payload"] > 0.07
    event = client.event(event="result", request="light")
    assert (event["mass"], event["mass_assumed"]) == (pytest.approx(0.07), False)
    client.send_request(id="unknown", **SPHERE)
    unknown = client.answer("unknown")
    assert unknown.mass_assumed
    assert unknown.mass > 0.1


def test_bad_input_is_named_and_the_node_lives_on(client, node, make_cloud):
    client.set_parameters(**FEW)
    (node.directory / "junk.obj").write_text("this is no mesh")
    empty = make_cloud(np.zeros((0, 3)))
    empty.header.stamp = client.now()  # by its stamp the node drops the copy that comes while it changes the QoS
    cases = [
        (lambda: client.send_mesh("../outside.obj"), "outside mesh_roots"),
        (lambda: client.send_mesh("junk.obj"), "junk.obj"),
        (lambda: client.send_cloud(empty), "empty: width=0"),
        (lambda: client.send_cancel("mesh-99"), "no request 'mesh-99'"),
    ]
    for send, culprit in cases:
        client.forget()
        send()
        # Refused before any work, or found out at it.
        told = lambda: next((e for e in client.events if e["event"] in ("refused", "error")), None)  # noqa: E731
        error = client.spin_until(told, culprit)
        assert culprit in error["message"]
        assert "\n" not in error["message"]
    assert (error["event"], error["code"]) == ("error", "NOT_FOUND")
    assert node.alive()
    client.forget()
    client.send_mesh("sphere.obj")
    assert client.event(event="result")["verified"] == 2
    log = node.log.read_text()
    assert "Traceback" not in log
    assert "mesh-99" not in log, "a late cancel is no error"


def test_only_the_newest_cloud_waits_and_the_others_are_counted(client, node, make_cloud, seen_ball):
    client.set_parameters(**LONG)
    cloud = make_cloud(seen_ball)
    client.send_cloud(cloud)
    running = client.event(event="progress", source="cloud")["request"]
    # A camera's clouds are sent once: the node may miss some.
    while int(client.health()["clouds received"]) < 4:
        client.send_cloud(cloud)
    client.send_cancel(running)
    last = client.spin_until(
        lambda: [e for e in client.events if e["event"] == "accepted" and e["request"] != running], "second cloud"
    )
    assert len(last) == 1
    health = client.health()
    # All but the one that ran and the last.
    superseded = int(health["clouds received"]) - 2
    assert int(health["clouds superseded"]) == superseded
    assert sum(e["count"] for e in client.events if e["event"] == "superseded") == superseded


def test_callbacks_answer_while_the_node_works(client, node):
    """Neither the optimiser nor the trials keep a caller waiting: benchmarks/soak.py tells how long it waits."""
    service = client.node.create_client(GetParameters, "/graspd/get_parameters")
    client.spin_until(service.service_is_ready, "parameter service")
    for stage, preset in (("optimise", "accurate"), ("verify", "fast")):
        client.forget()
        client.set_parameters(**LONG | {"preset": preset})
        client.send_mesh("mug.obj")
        request = client.event(event="progress", stage=stage)["request"]
        # Callbacks that wait for the end of the work would answer after it.
        for _ in range(5):
            client.done(service.call_async(GetParameters.Request(names=["seed"])), "answer")
        assert not [event for event in client.events if event["event"] == "result"]
        client.send_cancel(request)
        client.event(event="cancelled", request=request)


def test_the_client_prints_verified_grasps(node, client):
    done = client.run(EXAMPLE, "sphere.obj")
    assert done.returncode == 0, done.stderr
    assert "verified" in done.stdout
    assert "#0 " in done.stdout
    assert "pressing towards" in done.stdout


def test_the_client_says_why_there_is_none(node, client):
    done = client.run(EXAMPLE, "nothing.obj")
    assert done.returncode == 1
    assert "nothing.obj" in done.stdout + done.stderr


def memory_of(pid: int) -> int:
    """Resident memory [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_each_of_200_requests_in_a_burst_is_answered_once(client, node):
    for number in range(200):
        client.send_request(id=f"burst-{number}", **SPHERE, **UNENDING)
    client.spin_until(lambda: len(client.answers) >= 198, "198 refusals")
    client.send_cancel("")
    client.spin_until(lambda: len(client.answers) >= 200, "200 answers")
    client.spin_for(0.5)
    assert Counter(answer.request_id for answer in client.answers) == {f"burst-{n}": 1 for n in range(200)}
    ends = Counter(answer.status for answer in client.answers)
    assert ends == {GraspArray.REFUSED: 198, GraspArray.CANCELLED: 2}


def test_a_flood_of_large_clouds_leaves_memory_bounded_and_the_newest_counts(client, node, make_cloud):
    client.set_parameters(cloud_policy="newest", cloud_max_age=0.0)
    cloud = make_cloud(np.ones((850_000, 3)))
    assert len(cloud.data) > 10_000_000
    client.send_request(id="busy", **SPHERE, **UNENDING)
    client.event(event="progress", request="busy", stage="optimise")  # what it needs itself it has by now
    received, memory = 0, {}
    while received < 50:
        for _ in range(10):
            cloud.header.stamp = client.now()
            client.send_cloud(cloud)
            client.spin_for(0.01)
        received = int(client.health()["clouds received"])
        memory[received] = memory_of(node.process.pid)
    # The first fill what holds the newest, the one that waits and the middleware's five; who kept all kept 400 MB more.
    settled = min(count for count in memory if count >= 10)
    assert received - settled >= 20
    assert memory[received] - memory[settled] < 10e6 * (received - settled) / 2
    client.set_parameters(cloud_policy="off")
    client.show(lambda: client.send_cloud(cloud), cloud.header)
    client.send_request(id="latest", source=GraspRequest.LATEST_CLOUD, num_grasps=1, preset="fast")
    client.send_cancel("busy")
    answer = client.answer("latest")
    assert (answer.error_code, answer.header) == ("BAD_CLOUD", cloud.header)
    assert "in one place" in answer.message


def test_cancelling_is_quick_whatever_the_node_does(client, node):
    """An answer of CANCELLED: nobody waits for the end of the work, which would be another answer."""
    for stage in ("load", "optimise", "verify"):
        client.forget()
        wanted = {"num_grasps": 16, "preset": "fast"} if stage == "verify" else UNENDING
        client.send_request(id=stage, **SPHERE, **wanted)
        client.spin_until(lambda: [p for p in client.progress if p.stage == stage], stage)  # noqa: B023
        client.send_cancel(stage)
        assert client.answer(stage).status == GraspArray.CANCELLED
