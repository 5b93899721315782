import json
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from app.domain.errors import BadFrameError, BadMessageError, KinecastError
from app.domain.motion import Severity, Timing, VersionStamp
from app.live.codec import Codec
from app.live.protocol import (
    INCOMING,
    JSON,
    MSGPACK,
    Bye,
    Configure,
    Forecast,
    Observation,
    Rejected,
    Reset,
)

CODECS = {name: Codec(name, joints=20) for name in (JSON, MSGPACK)}
EITHER = pytest.mark.parametrize("name", [JSON, MSGPACK])
anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
TAGS = [str(kind.__struct_config__.tag) for kind in INCOMING]


def write(name: str, message: object) -> str | bytes:
    return msgspec.msgpack.encode(message) if name == MSGPACK else json.dumps(message)


def check(message: object) -> None:
    """Whatever came, it is a message of ours or a refusal that the client is told."""
    if isinstance(message, Rejected):
        assert isinstance(message.error, KinecastError)
        assert message.error.message
    elif isinstance(message, Observation):
        assert math.isfinite(message.t)
        assert message.joints is None or message.joints.shape == (20, 3)
    else:
        assert isinstance(message, INCOMING)


@EITHER
@given(data=st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_read_or_refused(name: str, data: bytes) -> None:
    check(CODECS[name].decode(data))
    check(CODECS[name].decode(data.decode("utf-8", "replace")))


@EITHER
@given(
    tag=st.sampled_from([*TAGS, "forecast", ""]),
    fields=st.dictionaries(
        st.sampled_from(["seq", "t", "joints", "confidence", "replay", "id", "coverage", "key"]),
        anything,
        max_size=5,
    ),
)
@settings(max_examples=200, deadline=None)
def test_any_fields_are_read_or_refused(name: str, tag: str, fields: dict[str, object]) -> None:
    check(CODECS[name].decode(write(name, {"type": tag} | fields)))


@EITHER
@given(message=anything)
@settings(max_examples=100, deadline=None)
def test_any_value_is_read_or_refused(name: str, message: object) -> None:
    check(CODECS[name].decode(write(name, message)))


@EITHER
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_message_that_is_cut_off_is_broken(name: str, data: st.DataObject) -> None:
    whole = write(name, {"type": "configure", "coverage": 0.5, "version": "base"})
    cut = data.draw(st.integers(0, len(whole) - 1))
    message = CODECS[name].decode(whole[:cut])
    assert isinstance(message, Rejected)
    assert isinstance(message.error, BadMessageError)


@given(pose=arrays(np.float32, (20, 3), elements=st.floats(-99, 99, width=32)))
@settings(max_examples=60, deadline=None)
def test_both_forms_carry_the_same_frame(pose: np.ndarray) -> None:
    pose[4] = np.nan
    lists = [None if np.isnan(joint).any() else joint.tolist() for joint in pose]
    frame = {"type": "frame", "seq": 7, "t": 1.7e9 + 1 / 30}
    sure = np.linspace(0, 1, 20, dtype=np.float32)
    as_json = write(JSON, frame | {"joints": lists, "confidence": sure.tolist()})
    as_bytes = {"joints": pose.tobytes(), "confidence": sure.tobytes()}
    one = CODECS[JSON].decode(as_json)
    other = CODECS[MSGPACK].decode(write(MSGPACK, frame | as_bytes))
    assert isinstance(one, Observation)
    assert isinstance(other, Observation)
    assert (
        (one.seq, one.t, one.replay) == (other.seq, other.t, other.replay) == (7, frame["t"], False)
    )
    np.testing.assert_array_equal(one.joints, other.joints)
    np.testing.assert_array_equal(one.confidence, other.confidence)


REFUSED = {
    "nothing": ("", "bad_message"),
    "a list": ("[]", "bad_message"),
    "a number": ("3", "bad_message"),
    "deep nesting": ("[" * 100_000, "bad_message"),
    "deep nesting in a field": ('{"type":"frame","joints":' + "[" * 100_000, "bad_message"),
    "deep nesting with NaN": ("[" * 100_000 + "NaN", "bad_message"),
    "bytes": (b"{}", "bad_message"),
    "no type": ("{}", "invalid_request"),
    "a message of the server": ('{"type":"forecast","seq":1}', "invalid_request"),
    "no seq": ('{"type":"frame","t":0,"joints":null}', "bad_frame"),
    "no joints": ('{"type":"frame","t":0,"seq":3}', "bad_frame"),
    "a fraction as seq": ('{"type":"frame","t":0,"seq":1.5,"joints":null}', "bad_frame"),
    "a huge seq": ('{"type":"frame","t":0,"seq":1e30,"joints":null}', "bad_frame"),
    "a huge number": ('{"type":"frame","t":1e999,"seq":1,"joints":null}', "bad_frame"),
    "true as coordinate": (
        '{"type":"frame","t":0,"seq":1,"joints":[[true,0,0]]}',
        "bad_frame",
    ),
    "null as coordinate": ('{"type":"frame","t":0,"seq":1,"joints":[[null,0,0]]}', "bad_frame"),
    "one joint": ('{"type":"frame","t":0,"seq":1,"joints":[[1,0,0]]}', "wrong_joint_count"),
    "NaN": ('{"type":"frame","t":0,"seq":1,"joints":[[NaN,0,0]]}', "nan_in_json"),
    "-Infinity": ('{"type":"frame","t":-Infinity,"seq":1,"joints":null}', "nan_in_json"),
    "unknown field": ('{"type":"reset","hard":true}', "unknown_field"),
    "coverage of 1": ('{"type":"configure","coverage":1}', "bad_configure"),
    "text as setting": ('{"type":"configure","forecast_every":"2"}', "bad_configure"),
    "another version": ('{"type":"configure","version":"best"}', "bad_configure"),
    "a control character in a label": (
        '{"type":"trial.start","label":"a\\u0085b"}',
        "invalid_request",
    ),
    "ping without a time": ('{"type":"ping","id":1}', "invalid_request"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_named(case: str) -> None:
    data, code = REFUSED[case]
    message = CODECS[JSON].decode(data)
    assert isinstance(message, Rejected)
    assert message.error.code == code


def test_the_frame_that_was_wrong_is_named() -> None:
    for bad in ('"joints":[[1]]', '"joints":[[NaN,1,1]]', '"joints":null,"x":1', '"joints":7'):
        message = CODECS[JSON].decode('{"type":"frame","seq":41,"t":0,' + bad + "}")
        assert isinstance(message, Rejected)
        assert message.seq == 41


def test_lists_in_msgpack_are_refused_with_a_hint() -> None:
    frame = {"type": "frame", "seq": 1, "t": 0.0, "joints": [[0.0, 0.0, 0.0]] * 20}
    message = CODECS[MSGPACK].decode(write(MSGPACK, frame))
    assert isinstance(message, Rejected)
    assert isinstance(message.error, BadFrameError)
    assert "float32" in message.error.message


def test_what_is_left_out_stays_unset() -> None:
    message = CODECS[JSON].decode('{"type":"configure","coverage":0.5}')
    assert isinstance(message, Configure)
    assert message.forecast_every is msgspec.UNSET
    assert isinstance(CODECS[JSON].decode('{"type":"reset"}'), Reset)


def make_forecast() -> Forecast:
    random = np.random.default_rng(1)
    return Forecast(
        seq=3,
        t=1.7e9,
        age_ms=1.5,
        frames=random.normal(size=(15, 20, 3)).astype(np.float32),
        t_out=1.7e9 + np.arange(1, 16) / 30,
        radius=random.uniform(size=(15, 20)).astype(np.float32),
        coverage=0.9,
        version=VersionStamp(0, "base", "ab"),
        quality=("gap",),
        severity=Severity.DEGRADED,
        filled=("head",),
        skipped=1,
        not_due=2,
        timing=Timing(1.0, 2.0, 3.0),
    )


def test_a_forecast_in_msgpack_has_bare_little_endian_arrays() -> None:
    forecast = make_forecast()
    sent = msgspec.msgpack.decode(CODECS[MSGPACK].encode(forecast))
    assert sent["type"] == "forecast"
    assert (len(sent["frames"]), len(sent["radius"]), len(sent["t_out"])) == (180 * 20, 1200, 120)
    np.testing.assert_array_equal(np.frombuffer(sent["t_out"], "<f8"), forecast.t_out)
    frames = np.frombuffer(sent["frames"], "<f4").reshape(15, 20, 3)
    np.testing.assert_array_equal(frames, forecast.frames)


def test_a_forecast_in_json_has_lists_and_exact_times() -> None:
    forecast = make_forecast()
    sent = json.loads(CODECS[JSON].encode(forecast))
    assert np.shape(sent["frames"]) == (15, 20, 3)
    assert np.shape(sent["radius"]) == (15, 20)
    np.testing.assert_allclose(sent["frames"], forecast.frames, atol=6e-7)
    assert sent["t_out"] == forecast.t_out.tolist()
    assert sent["version"] == {
        "number": 0,
        "kind": "base",
        "sha256": "ab",
        "requested": "active",
        "share": 0.0,
        "fallback": None,
    }
    assert sent["severity"] == "degraded"


def test_a_radius_that_is_not_calibrated_is_null() -> None:
    message = msgspec.structs.replace(make_forecast(), radius=None)
    assert json.loads(CODECS[JSON].encode(message))["radius"] is None
    assert msgspec.msgpack.decode(CODECS[MSGPACK].encode(message))["radius"] is None
    assert json.loads(CODECS[JSON].encode(Bye("draining", 1.0)))["type"] == "bye"


BESIDE_NAN = (
    b'{"type":"frame","seq":1,"ts":1,"t":1,"joints":[[NaN,0,0]]}',
    b'{"type":"frame","seq":1.0,"t":1,"joints":[[NaN,0,0]]}',
    b'{"type":"frame","seq":1,"t":"1","joints":[[NaN,0,0]]}',
)


@pytest.mark.parametrize("raw", BESIDE_NAN)
def test_nan_beside_another_mistake_does_not_close_the_stream(raw: bytes) -> None:
    rejected = CODECS[JSON].decode(raw.decode())
    assert isinstance(rejected, Rejected)
    assert rejected.error.code == "nan_in_json"


def test_a_number_out_of_range_is_a_bad_frame() -> None:
    raw = b'{"type":"frame","seq":1e400,"t":1,"joints":null}'
    rejected = CODECS[JSON].decode(raw.decode())
    assert isinstance(rejected, Rejected)
    assert rejected.error.code == "bad_frame"


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        ('{"type":"frame","seq":1,"t":0,"joints":[["\\ud800",1,2]]}', BadFrameError, "escape"),
        ('\ufeff{"type":"frame","seq":1,"t":0,"joints":null}', BadMessageError, "no JSON"),
    ],
)
def test_text_that_only_lenient_readers_take_is_called_what_it_is(
    text: str, kind: type[KinecastError], words: str
) -> None:
    answer = Codec("kinecast.v1.json", joints=20).decode(text)
    assert isinstance(answer, Rejected)
    assert isinstance(answer.error, kind)
    assert words in str(answer.error)
