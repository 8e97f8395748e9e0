"""The node's health as a diagnostic message."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from graspd_ros.diagnostics import Health, health_message, resident_memory

GOOD = Health(name="/graspd", hand="allegro_right", ready=True, worker_alive=True, queue_size=4)


def status(health: Health, memory: int = 300_000_000) -> DiagnosticStatus:
    message = health_message(health, Time(sec=9), memory)
    assert message.header.stamp.sec == 9
    (found,) = message.status
    return found


def values(health: Health, memory: int = 300_000_000) -> dict[str, str]:
    return {pair.key: pair.value for pair in status(health, memory).values}


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        ({}, DiagnosticStatus.OK, "waits for requests"),
        ({"running": "mesh-3"}, DiagnosticStatus.OK, "works on mesh-3"),
        ({"ready": False}, DiagnosticStatus.WARN, "warming up"),
        ({"waiting": 4}, DiagnosticStatus.WARN, "the queue is full: 4 wait"),
        ({"waiting": 3}, DiagnosticStatus.OK, "waits for requests"),
        ({"queue_size": 0}, DiagnosticStatus.OK, "waits for requests"),
        ({"failed_in_a_row": 1, "last_error": "no such file"}, DiagnosticStatus.WARN, "the last request failed: no su"),
        ({"failed_in_a_row": 3}, DiagnosticStatus.WARN, "the last 3 requests failed"),
        ({"counts": {"requests failed": 9}}, DiagnosticStatus.OK, "waits for requests"),  # long past
        ({"worker_alive": False, "ready": False}, DiagnosticStatus.ERROR, "restart the node"),
    ],
)
def test_the_level_is_that_of_the_worst_that_holds(change: dict, level: bytes, said: str):
    found = status(dataclasses.replace(GOOD, **change))
    assert found.level == level
    assert said in found.message


def test_the_status_names_node_and_hand():
    found = status(GOOD)
    assert found.name == "graspd: grasp synthesis"  # diagnostic_aggregator groups by what comes before the colon
    assert found.hardware_id == "allegro_right"


def test_every_field_is_told():
    """Change one field at a time: something in the message changes with it."""
    other = {int: 7, bool: False, str: "other", float: 1.25, dict: {"clouds received": 1}}
    before = status(GOOD)
    for field in dataclasses.fields(Health):
        value = getattr(GOOD, field.name)
        changed = other[float] if value is None else other[type(value)]
        changed = not value if isinstance(value, bool) else changed
        assert status(dataclasses.replace(GOOD, **{field.name: changed})) != before, field.name


def test_figures_are_readable_and_absent_where_unknown():
    found = values(
        dataclasses.replace(GOOD, last_latency=2.34567, counts={"grasps verified": 12, "clouds superseded": 5})
    )
    assert found["last latency [s]"] == "2.346"
    assert found["last first verified [s]"] == ""
    assert (found["grasps verified"], found["clouds superseded"]) == ("12", "5")
    assert found["memory [MB]"] == "300"
    assert values(GOOD, memory=0)["memory [MB]"] == ""


WORDS = st.text(st.characters(codec="utf-8", exclude_characters="\0"))  # DDS strings end at a zero


@given(st.builds(Health, name=WORDS, hand=WORDS, running=WORDS, last_error=WORDS))
def test_any_health_goes_through_the_middleware(health: Health):
    message = health_message(health, Time(), 1)
    assert deserialize_message(serialize_message(message), DiagnosticArray) == message


def test_memory_is_that_of_a_process_and_its_children():
    # In fresh processes: the heap of this one depends on the tests before.
    holds = "ballast = b'x' * 60_000_000; print(flush=True); input()"
    starts = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {holds!r}])"
    with subprocess.Popen([sys.executable, "-c", starts], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        memory = resident_memory(child.pid)
        assert 65_000_000 < memory < 120_000_000  # two interpreters beside it
        assert resident_memory() > memory + 10_000_000
        child.communicate(b"\n")
    assert resident_memory(child.pid) == 0
