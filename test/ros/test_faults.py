"""Floods, bursts and cancels: the node lives, and nobody is left without an answer."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from graspd_msgs.msg import GraspArray, GraspRequest

SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
LONG = {"num_grasps": 256, "preset": "accurate", "time_budget": 600.0}

pytestmark = pytest.mark.timeout(300)


def memory_of(pid: int) -> int:
    """Resident memory [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_each_of_200_requests_in_a_burst_is_answered_once(client, node):
    for number in range(200):
        client.send_request(id=f"burst-{number}", **SPHERE, **LONG)
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
    client.send_request(id="busy", **SPHERE, **LONG)
    client.event(event="progress", request="busy", stage="optimise")  # what it needs itself it has by now
    received, memory = 0, {}
    while received < 50:
        for _ in range(10):
            cloud.header.stamp = client.node.get_clock().now().to_msg()
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
        wanted = {"num_grasps": 16, "preset": "fast"} if stage == "verify" else LONG
        client.send_request(id=stage, **SPHERE, **wanted)
        client.spin_until(lambda: [p for p in client.progress if p.stage == stage], stage)  # noqa: B023
        client.send_cancel(stage)
        assert client.answer(stage).status == GraspArray.CANCELLED
