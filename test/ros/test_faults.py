"""Floods, bursts and cancels: the node lives, and nobody is left without an answer."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from graspd_msgs.msg import GraspArray, GraspRequest

RESULT_TIMEOUT = 60.0
SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
FEW = {"num_grasps": 1, "preset": "fast", "time_budget": 40.0}
LONG = {"num_grasps": 64, "preset": "accurate", "time_budget": 60.0}

pytestmark = pytest.mark.timeout(180)


def memory_of(pid: int) -> int:
    """Resident memory [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_each_of_200_requests_in_a_burst_is_answered_once(client, node):
    for number in range(200):
        client.send_request(id=f"burst-{number}", **SPHERE, **LONG)
    client.spin_until(lambda: len(client.answers) >= 198, 20.0, "198 refusals")
    client.send_cancel("")
    client.spin_until(lambda: len(client.answers) >= 200, 20.0, "200 answers")
    client.spin_for(0.5)
    assert Counter(answer.request_id for answer in client.answers) == {f"burst-{n}": 1 for n in range(200)}
    ends = Counter(answer.status for answer in client.answers)
    assert ends == {GraspArray.REFUSED: 198, GraspArray.CANCELLED: 2}


def test_a_flood_of_large_clouds_leaves_memory_bounded_and_the_newest_counts(client, node, make_cloud):
    client.set_parameters(num_grasps=64, preset="accurate", cloud_policy="newest")
    cloud = make_cloud(np.random.default_rng(0).normal(size=(850_000, 3)))
    assert len(cloud.data) > 10_000_000
    client.send_request(id="busy", **SPHERE, **LONG)
    client.event(20.0, event="progress", request="busy", stage="optimise")  # what it needs itself it has by now
    memory = []
    for _ in range(2):  # the first fill what holds the newest, the one that waits and the middleware's five
        for _ in range(40):
            cloud.header.stamp = client.node.get_clock().now().to_msg()
            client.send_cloud(cloud)
            client.spin_for(0.01)
        client.spin_for(0.5)
        memory.append(memory_of(node.process.pid))
    print(f"40 more clouds of 10 MB: {(memory[1] - memory[0]) / 1e6:+.0f} MB")
    assert memory[1] - memory[0] < 60e6
    client.set_parameters(cloud_policy="off")
    for attempt in range(20):  # best effort: the last cloud may be lost, and is sent until the node has it
        client.send_cloud(cloud)
        client.spin_for(0.2)
        client.send_request(id=f"probe-{attempt}", source=GraspRequest.LATEST_CLOUD)
        client.event(10.0, event="accepted", request=f"probe-{attempt}")
        client.send_cancel(f"probe-{attempt}")
        if client.answer(f"probe-{attempt}", 10.0).header.stamp == cloud.header.stamp:
            break
    client.send_request(id="latest", source=GraspRequest.LATEST_CLOUD, num_grasps=1, preset="fast")
    client.send_cancel("busy")
    answer = client.answer("latest", RESULT_TIMEOUT)  # noise a metre wide: no object, but an answer about this cloud
    assert answer.header.stamp == cloud.header.stamp


def test_cancelling_is_quick_whatever_the_node_does(client, node):
    waits = {}
    for stage in ("load", "optimise", "verify"):
        client.forget()
        wanted = {"num_grasps": 16, "preset": "fast"} if stage == "verify" else LONG
        client.send_request(id=stage, **SPHERE, **wanted)
        client.spin_until(lambda: [p for p in client.progress if p.stage == stage], 40.0, stage)  # noqa: B023
        begun = time.monotonic()
        client.send_cancel(stage)
        assert client.answer(stage, 10.0).status == GraspArray.CANCELLED
        waits[stage] = time.monotonic() - begun
    print(", ".join(f"{stage} {1e3 * wait:.0f} ms" for stage, wait in waits.items()))
    assert max(waits.values()) < 1.0
