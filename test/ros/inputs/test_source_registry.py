"""One place to add a source of clouds: a row that is added here is planned for, with nothing else edited."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from std_msgs.msg import Header

from graspd_core import load_scene
from graspd_ros.error_codes import ErrorCode, RequestError
from graspd_ros.inputs.request_builder import SOURCES, RequestBuilder, Source, SourceInput
from graspd_ros.parameters import Settings
from graspd_ros.request import Request

NOW, SEEN = Time(sec=1000), Time(sec=999)
SCANNER = 9


@pytest.fixture
def builder() -> RequestBuilder:
    return RequestBuilder("parallel_gripper", lambda: NOW, lambda target, source, stamp: np.eye(4))


def test_every_constant_of_the_message_has_its_row():
    names = {name for name in dir(GraspRequest) if name.isupper() and not name.endswith("__DEFAULT")} - {"SLOT_TYPES"}
    assert {source.name.upper(): number for number, source in SOURCES.items()} == {
        name: getattr(GraspRequest, name) for name in names
    }


def test_a_source_without_a_row_is_refused_and_the_rows_are_named(builder, monkeypatch: pytest.MonkeyPatch):
    request = GraspRequest(source=SCANNER)
    with pytest.raises(
        RequestError, match=r"source: 9; valid: CLOUD=0, MESH=1, LATEST_CLOUD=2, VIEWS=3, KNOWN=4$"
    ) as refused:
        builder.from_message("r", Settings(), request)
    assert refused.value.code is ErrorCode.BAD_REQUEST
    monkeypatch.setitem(SOURCES, 7, replace(SOURCES[GraspRequest.CLOUD], name="lidar"))
    with pytest.raises(RequestError, match=r"LIDAR=7$"):
        builder.from_message("r", Settings(), request)


def test_a_source_is_one_row(builder, monkeypatch: pytest.MonkeyPatch):
    scene, given = load_scene("shape:box", resolution=16), []

    def from_scanner(asked: SourceInput) -> Request:
        given.append((asked.message, asked.settings.num_grasps, asked.now))
        return asked.request("scanner", SEEN, lambda: scene)

    monkeypatch.setitem(SOURCES, SCANNER, Source("scanner", from_scanner))
    message = GraspRequest(source=SCANNER, num_grasps=3, header=Header(frame_id="map"))
    request = builder.from_message("r", Settings(), message)
    assert given == [(message, 3, NOW)]
    assert (request.source, request.frame, request.stamp, request.timeless) == ("scanner", "scanner", SEEN, False)
    assert request.T_frame_object is None
    assert request.settings.num_grasps == 3
    assert request.load() is scene
