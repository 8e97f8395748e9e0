"""graspd_msgs as built: every type imports, keeps what it carries, and matches its definition.

The oracle for bytes and type hashes is rosbags, which shares no code with rosidl.
"""

import itertools
import os
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from ament_index_python.packages import get_package_share_directory
from graspd_msgs.msg import Grasp, GraspRequest
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_parser.definition import AbstractNestedType, AbstractString, Array, BasicType, NamespacedType

SOURCES = Path(__file__).parents[2] / "msg_defs"
MESSAGES = sorted(path.stem for path in SOURCES.glob("msg/*.msg"))

# Values that each type keeps exactly: never zero, so that a field left behind is seen.
INTEGERS = {"uint8": 2**8, "int8": 2**7, "uint16": 2**16, "int32": 2**31, "uint32": 2**32, "int64": 2**63}


def message_class(name: str) -> Any:
    return getattr(import_module("graspd_msgs.msg"), name)


def filled(cls: Any, count: Iterator[int]) -> Any:
    """A message in which every field differs from every other, three elements in each sequence."""

    def value(kind: Any) -> Any:
        if isinstance(kind, AbstractNestedType):
            return [value(kind.value_type) for _ in range(kind.size if isinstance(kind, Array) else 3)]
        if isinstance(kind, NamespacedType):
            return filled(getattr(import_module(".".join(kind.namespaces)), kind.name), count)
        if isinstance(kind, AbstractString):
            return f"τεχτ {next(count)}"
        assert isinstance(kind, BasicType)
        if kind.typename == "boolean":
            return True
        number = next(count)
        if kind.typename == "float":
            return 1 / 2 ** (number % 100)
        # The largest of its kind, less a running number: a narrower type on the way would cut it.
        return 1 / number if kind.typename == "double" else (INTEGERS[kind.typename] - 1 - number % 100)

    names = cls.get_fields_and_field_types()
    return cls(**{name: value(kind) for name, kind in zip(names, cls.SLOT_TYPES, strict=True)})


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_keeps_every_field_and_another_implementation_reads_the_same_bytes(name: str, typestore, agree):
    message = filled(message_class(name), itertools.count(2))
    data = serialize_message(message)
    assert deserialize_message(data, message_class(name)) == message != message_class(name)()
    assert agree(typestore.deserialize_cdr(data, f"graspd_msgs/msg/{name}"), message)


def test_the_defaults_ask_for_the_nodes_own_settings():
    request, grasp = GraspRequest(), Grasp()
    assert (request.source, request.seed, request.num_grasps, request.time_budget) == (GraspRequest.CLOUD, -1, 0, 0.0)
    assert (request.mesh_scale, request.hand, request.preset, request.use_target_point) == (1.0, "", "", False)
    assert grasp.verdict == Grasp.UNVERIFIED
    assert (grasp.metrics, grasp.trials) == ([], [])


def test_what_is_installed_is_what_the_definitions_say(monkeypatch: pytest.MonkeyPatch):
    # the wheels do not set it; a sourced workspace does
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.environ.get("AMENT_PREFIX_PATH", sys.prefix))
    share = Path(get_package_share_directory("graspd_msgs"))
    paths = [path.relative_to(SOURCES) for kind in ("msg", "srv", "action") for path in SOURCES.glob(f"{kind}/*.*")]
    assert {path.stem for path in share.glob("*/*.idl")} == {path.stem for path in paths}
    for path in paths:
        assert (share / path).read_text() == (SOURCES / path).read_text(), f"{path} changed: run `make setup`"


@pytest.mark.parametrize("name", MESSAGES)
def test_the_compiled_type_hash_is_that_of_the_definition(name: str, client: Any, typestore: Any):
    publisher = client.node.create_publisher(message_class(name), f"hash/{name.lower()}", 1)
    find = lambda: client.node.get_publishers_info_by_topic(publisher.topic_name)  # noqa: E731
    (endpoint,) = client.spin_until(find, "publisher")
    compiled = endpoint.topic_type_hash
    expected = typestore.hash_rihs01(f"graspd_msgs/msg/{name}")
    assert f"RIHS0{compiled.version}_{bytes(compiled.value).hex()}" == expected
    client.node.destroy_publisher(publisher)
