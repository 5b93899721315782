"""Recordings of streams: what is read is what was written, bit by bit, and Foxglove can draw it."""

import copy
import json
import struct
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from kinecast_client.interop import foxglove
from kinecast_client.interop.body import KINECT_V1, find_body, to_ros
from kinecast_client.interop.tape_file import (
    CHANNELS,
    FORECASTS,
    About,
    Frame,
    TapeError,
    TapeReader,
    TapeWriter,
)
from kinecast_client.samples import waving_person
from mcap.reader import make_reader

from tests.unit.clients.robots import NOW, make_forecast

ABOUT = About("ada", KINECT_V1)
POSE = waving_person(1.0)[0]
SINGLE = st.floats(-100, 100, width=32)
PLACE = {"skeleton": KINECT_V1, "up": "y", "frame_id": "sensor"}


def write(path, *items, about=ABOUT):
    with TapeWriter(path, about, clock=lambda: NOW) as tape:
        for item in items:
            (tape.write_frame if isinstance(item, Frame) else tape.write_forecast)(item)
    return TapeReader(path)


def read_topics(path):
    topics = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            found = topics.setdefault(channel.topic, [])
            found.append((schema.name, message.log_time, json.loads(message.data)))
    return topics


def same(one, other):
    return one.dtype == other.dtype and one.tobytes() == other.tobytes()


@settings(max_examples=25, deadline=None)
@given(
    frames=arrays(np.float32, (15, 20, 3), elements=SINGLE),
    radius=st.none() | arrays(np.float32, (15, 20), elements=st.floats(0, 2, width=32)),
    t=st.floats(0, 2e9),
)
def test_forecasts_come_back_bit_by_bit(tmp_path_factory, frames, radius, t):
    forecast = make_forecast(frames, t=t)
    object.__setattr__(forecast, "radius", radius)
    [found] = write(tmp_path_factory.mktemp("tape") / "a.mcap", forecast).forecasts()
    assert same(found.frames, frames)
    assert same(found.t, forecast.t)
    assert (found.radius is None) if radius is None else same(found.radius, radius)
    assert found.t_observed == t
    assert found.version == forecast.version
    assert found.timing == forecast.timing
    for name in ("coverage", "quality", "severity", "filled", "joints", "seq", "server_age_ms"):
        assert getattr(found, name) == getattr(forecast, name)


@settings(max_examples=25, deadline=None)
@given(
    joints=arrays(np.float64, (20, 3), elements=st.floats(-100, 100) | st.just(np.nan)),
    confidence=st.none() | arrays(np.float64, 20, elements=st.floats(0, 1)),
    t=st.floats(0, 2e9),
)
def test_frames_come_back_bit_by_bit(tmp_path_factory, joints, confidence, t):
    frame = Frame(t, joints, confidence, 7)
    [found] = write(tmp_path_factory.mktemp("tape") / "a.mcap", frame).frames()
    np.testing.assert_array_equal(found.joints, joints)  # any NaN is a NaN
    assert (found.confidence is None) if confidence is None else same(found.confidence, confidence)
    assert struct.pack("<d", found.t) == struct.pack("<d", t)
    assert found.seq == 7


def test_frame_without_the_person_stays_one(tmp_path):
    [found] = write(tmp_path / "a.mcap", Frame(NOW, None)).frames()
    assert (found.joints, found.confidence, found.seq) == (None, None, None)


def test_tape_says_whose_it_is(tmp_path):
    about = About("bob.7", KINECT_V1, up="-y", frame_id="camera")
    assert write(tmp_path / "a.mcap", about=about).about == about


def test_frames_are_read_in_the_order_of_their_times(tmp_path):
    written = [Frame(NOW + k / 30, POSE, None, k) for k in range(40)]
    assert [one.seq for one in write(tmp_path / "a.mcap", *written).frames()] == list(range(40))


def test_messages_are_timed_by_capture_on_the_wall_clock(tmp_path):
    before = time.time_ns()
    write(tmp_path / "a.mcap", Frame(NOW + 0.5, POSE), make_forecast(t=NOW + 0.5))
    for messages in read_topics(tmp_path / "a.mcap").values():
        [(_, at, _)] = messages
        assert 0 <= at - before - 5e8 < 5e9


def test_foxglove_gets_scenes_and_frames_under_its_own_names(tmp_path):
    write(tmp_path / "a.mcap", Frame(NOW, POSE), make_forecast())
    topics = read_topics(tmp_path / "a.mcap")
    names = {topic: messages[0][0] for topic, messages in topics.items()}
    assert names == {
        "/kinecast/frames": "kinecast.Frame",
        "/kinecast/forecasts": "kinecast.Forecast",
        "/observed": "foxglove.SceneUpdate",
        "/forecast": "foxglove.SceneUpdate",
        "/tf": "foxglove.FrameTransforms",
    }


def conforms(value, schema):
    """Hold a value against the part of JSON Schema that is used, with nothing left out."""
    kind = schema.get("type")
    if kind == "object":
        parts = schema.get("properties")
        return isinstance(value, dict) and (
            parts is None
            or (set(value) == set(parts) and all(conforms(value[k], parts[k]) for k in parts))
        )
    if kind == "array":
        return isinstance(value, list) and all(conforms(one, schema["items"]) for one in value)
    expected = {"number": float, "integer": int, "string": str, "boolean": bool}[kind]
    return type(value) is expected


def can_be_read(schema):
    """Tell whether Foxglove's reader of JSON Schema takes this object, by its rules."""
    for part in schema["properties"].values():
        inner = part["items"] if part["type"] == "array" else part
        if inner["type"] == "array" or (inner["type"] == "object" and not can_be_read(inner)):
            return False
    return schema["type"] == "object"


@pytest.mark.parametrize("topic", sorted(CHANNELS))
def test_schemas_keep_to_what_foxglove_can_read(topic):
    assert can_be_read(CHANNELS[topic])


def test_schemas_that_foxglove_cannot_read_are_noticed():
    numbers = {"type": "array", "items": {"type": "number"}}
    assert not can_be_read({"type": "object", "properties": {"a": numbers | {"items": numbers}}})
    with pytest.raises(KeyError):
        can_be_read({"type": "object", "properties": {"a": {"type": "object"}}})


def test_messages_have_every_field_of_their_schemas_and_no_other(tmp_path):
    write(tmp_path / "a.mcap", Frame(NOW, POSE, np.ones(20), 1), make_forecast(server_age_ms=2.0))
    for topic, [(_, _, message)] in read_topics(tmp_path / "a.mcap").items():
        schema = CHANNELS[topic]
        if topic == FORECASTS:  # no fallback is null
            assert message["version"].pop("fallback") is None
            version = schema["properties"]["version"]["properties"]
            schema = copy.deepcopy(schema)
            del schema["properties"]["version"]["properties"]["fallback"]
            assert "fallback" in version
        assert conforms(message, schema), topic


def test_pictures_have_every_field_of_their_schemas_and_no_other():
    scenes = [
        foxglove.make_observed_scene(POSE, 10**18, **PLACE),
        foxglove.make_forecast_scene(make_forecast(), 10**18, **PLACE),
    ]
    assert all(conforms(scene, foxglove.SCENE_UPDATE) for scene in scenes)
    frames = foxglove.make_frame_transforms(POSE, 10**18, body="ada", **PLACE)
    assert conforms(frames, foxglove.FRAME_TRANSFORMS)
    assert not conforms(frames | {"more": 1}, foxglove.FRAME_TRANSFORMS)


def test_scene_draws_bones_that_are_seen_and_the_radius_where_it_may_be_used():
    pose = POSE.copy()
    pose[11] = np.nan
    [seen] = foxglove.make_observed_scene(pose, 0, **PLACE)["entities"]
    assert len(seen["lines"][0]["points"]) == 2 * (len(KINECT_V1.bones) - 1)
    [shown] = foxglove.make_forecast_scene(make_forecast(), 0, **PLACE)["entities"]
    assert (len(shown["lines"]), len(shown["spheres"])) == (5, 20)
    assert shown["spheres"][0]["size"]["x"] == pytest.approx(0.14)
    unsafe = make_forecast(severity="unsafe")
    [grey] = foxglove.make_forecast_scene(unsafe, 0, **PLACE)["entities"]
    assert grey["spheres"] == []


def test_body_is_a_frame_below_the_sensor_and_left_out_when_it_is_hidden():
    sensor, body = foxglove.make_frame_transforms(POSE, 0, body="ada", **PLACE)["transforms"]
    assert (sensor["parent_frame_id"], sensor["child_frame_id"]) == ("world", "sensor")
    assert (body["parent_frame_id"], body["child_frame_id"]) == ("sensor", "body_ada")
    place = find_body(to_ros(POSE, "y"), KINECT_V1).origin
    assert list(body["translation"].values()) == pytest.approx(place)
    hidden = POSE.copy()
    hidden[KINECT_V1.role("l_hip")] = np.nan
    assert len(foxglove.make_frame_transforms(hidden, 0, body="ada", **PLACE)["transforms"]) == 1


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"no tape")
    with pytest.raises(TapeError, match="no recording"):
        TapeReader(tmp_path / "a.mcap")


def write_until_it_breaks(path):
    with TapeWriter(path, ABOUT) as tape:
        tape.write_frame(Frame(1.0, POSE))
        raise RuntimeError("unplugged")


def test_tape_can_be_read_after_an_error_while_it_was_written(tmp_path):
    with pytest.raises(RuntimeError):
        write_until_it_breaks(tmp_path / "a.mcap")
    assert len(list(TapeReader(tmp_path / "a.mcap").frames())) == 1
