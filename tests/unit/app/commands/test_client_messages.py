"""The client's reading and writing, held against the service's own codec."""

from uuid import UUID

import msgspec
import numpy as np
import pytest

from app.commands.client import messages
from app.commands.client.messages import JSON, MSGPACK, Forecast, Other, Wire
from app.commands.client.stream import find_stream_url, is_loopback
from app.domain.motion import Severity, Timing, VersionStamp
from app.live import protocol
from app.live.codec import Codec

JOB = UUID(int=5)
BOTH = pytest.mark.parametrize("subprotocol", [JSON, MSGPACK])
RANDOM = np.random.default_rng(0)
POSE = RANDOM.normal(size=(20, 3)).astype(np.float32)


def say(message: protocol.ServerMessage, subprotocol: str) -> messages.Message:
    """What the client makes of a message of the service."""
    data = Codec(subprotocol, joints=20).encode(message)
    return Wire(subprotocol).decode(data if subprotocol == MSGPACK else data.decode())


def make_forecast(**changes: object) -> protocol.Forecast:
    fields = {
        "seq": 7,
        "t": 1.5e9,
        "age_ms": 3.5,
        "frames": RANDOM.normal(size=(15, 20, 3)).astype(np.float32),
        "t_out": 1.5e9 + np.arange(1, 16) / 30,
        "radius": np.full((15, 20), 0.25, np.float32),
        "coverage": 0.9,
        "version": VersionStamp(0, "base", "a" * 64),
        "quality": ("uncalibrated",),
        "severity": Severity.INFO,
        "filled": (),
        "skipped": 2,
        "not_due": 0,
        "timing": Timing(1.0, 2.0, 3.0),
    }
    return protocol.Forecast(**(fields | changes))


@BOTH
def test_forecast_arrives_as_it_was_sent(subprotocol) -> None:
    sent = make_forecast()
    got = say(sent, subprotocol)
    assert isinstance(got, Forecast)
    np.testing.assert_allclose(got.frames, sent.frames, atol=1e-6)
    np.testing.assert_array_equal(got.t_out, sent.t_out)
    np.testing.assert_allclose(got.radius, sent.radius)
    assert (got.seq, got.skipped, got.severity) == (7, 2, "info")
    assert (got.version.number, got.version.kind, got.version.sha256) == (0, "base", "a" * 64)
    assert got.timing.compute_ms == 2.0


@BOTH
def test_forecast_without_a_radius_has_none(subprotocol) -> None:
    assert say(make_forecast(radius=None), subprotocol).radius is None


@BOTH
def test_forecast_whose_arrays_do_not_fit_is_refused(subprotocol) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        say(make_forecast(frames=np.zeros((15, 4), np.float32)), subprotocol)


@BOTH
@pytest.mark.parametrize("confidence", [None, np.linspace(0, 1, 20)])
def test_service_reads_the_frames_of_the_client(subprotocol, confidence) -> None:
    pose = POSE.copy()
    pose[4] = np.nan
    data = Wire(subprotocol).encode_frame(3, 12.25, pose, confidence, replay=True)
    frame = Codec(subprotocol, joints=20).decode(data)
    assert isinstance(frame, protocol.Observation)
    assert (frame.seq, frame.t, frame.replay) == (3, 12.25, True)
    np.testing.assert_allclose(frame.joints, pose, atol=1e-6)
    if confidence is None:
        assert frame.confidence is None
    else:
        np.testing.assert_allclose(frame.confidence, confidence, atol=1e-6)


@BOTH
def test_frame_without_the_person_has_no_joints(subprotocol) -> None:
    frame = Codec(subprotocol, joints=20).decode(Wire(subprotocol).encode_frame(0, 0.0, None))
    assert frame.joints is None


@BOTH
def test_every_message_of_the_service_is_known(subprotocol) -> None:
    known = [
        (protocol.WaitingMessage(1, 0.5, "warm_up", 0.1, 0.45), messages.Waiting),
        (protocol.Pong("a", 1.0, 2.0, 3.0), messages.Pong),
        (protocol.ServerPing(1, 2.0), messages.Ping),
        (protocol.ErrorMessage("bad_frame", "No.", False, 4), messages.Error),
        (protocol.Bye("draining", 0.5), messages.Bye),
        (protocol.VersionMessage(VersionStamp(1, "personal", "cd"), "x"), messages.VersionChanged),
        (protocol.TrialMessage("recording", JOB, 0, None, 0), messages.Trial),
        (protocol.JobMessage(JOB, "running", {"step": 1}), messages.Job),
        (
            protocol.Configured(protocol.StreamSettings(1, 0.9, "active", 200.0), 5),
            messages.Configured,
        ),
    ]
    for message, kind in known:
        assert isinstance(say(message, subprotocol), kind)


@BOTH
def test_news_from_a_later_service_are_kept_and_not_feared(subprotocol) -> None:
    form = msgspec.msgpack if subprotocol == MSGPACK else msgspec.json
    news = Wire(subprotocol).decode(form.encode({"type": "weather", "state": "fine"}))
    assert news == Other("weather", {"type": "weather", "state": "fine"})
    bye = Wire(subprotocol).decode(form.encode({"type": "bye", "reason": "x", "mood": "good"}))
    assert bye == messages.Bye("x")
    with pytest.raises(ValueError, match=r"."):
        Wire(subprotocol).decode(form.encode([1, 2]))


def test_addresses_of_streams() -> None:
    assert find_stream_url("http://h:1/", "a b") == "ws://h:1/v1/users/a%20b/stream"
    assert find_stream_url("https://h", "a", {"version": 2}).startswith("wss://h/v1/users/a/")
    assert find_stream_url("ws://h", "a", {"version": 2}).endswith("?version=2")


@pytest.mark.parametrize(
    ("url", "here"),
    [
        ("http://127.0.0.1:8000", True),
        ("ws://[::1]:8000", True),
        ("http://localhost", True),
        ("https://example.org", False),
        ("http://10.0.0.7:8000", False),
    ],
)
def test_addresses_of_this_machine(url, here) -> None:
    assert is_loopback(url) is here
