"""What a caller cannot mean is refused at once."""

import math

import httpx
import msgspec
import numpy as np
import pytest
from kinecast_client import Client, Clip, FrameError, calls
from kinecast_client.address import find_stream_url, is_loopback, read_url
from kinecast_client.answers import follow, read_answer, read_single_forecast
from kinecast_client.checks import check_label, check_settings, check_trial
from kinecast_client.errors import AnswerError, ApiError, BusyError, InvalidError
from kinecast_client.frames import read_confidence, read_joints, read_time
from kinecast_client.messages import Settings

URL = "http://127.0.0.1:9"


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("http://127.0.0.1:8000/", "http://127.0.0.1:8000"),
        ("ws://robot:80", "http://robot:80"),
        ("WSS://robot/base/", "https://robot/base"),
        (" https://[::1]:8000 ", "https://[::1]:8000"),
    ],
)
def test_addresses_are_read(given, read):
    assert read_url(given) == read


@pytest.mark.parametrize("url", ["", "127.0.0.1:8000", "http://", "ftp://a", "http://a:99999"])
def test_what_is_no_address_is_refused(url):
    with pytest.raises(ValueError, match="no address"):
        Client(url, "key")


def test_streams_are_found_behind_any_user_and_parameter():
    assert (
        find_stream_url("https://a/b", "a/b?c", {"session": "s t", "version": 3})
        == "wss://a/b/v1/users/a%2Fb%3Fc/stream?session=s+t&version=3"
    )


@pytest.mark.parametrize("url", ["http://127.0.0.1:1", "http://localhost", "http://[::1]:8"])
def test_this_machine_is_known(url):
    assert is_loopback(url)
    assert not is_loopback("http://192.168.1.2")


@pytest.mark.parametrize("key", ["", "two words", "line\n", "schlüssel", None])
def test_what_is_no_key_is_refused(key):
    with pytest.raises(ValueError, match="key"):
        Client(URL, key)


@pytest.mark.parametrize(
    "settings",
    [
        Settings(forecast_every=0),
        Settings(forecast_every=601),
        Settings(forecast_every=True),
        Settings(forecast_every=1.5),
        Settings(coverage=0.0),
        Settings(coverage=1.0),
        Settings(coverage=math.nan),
        Settings(version="newest"),
        Settings(version=-1),
        Settings(version=[1]),
        Settings(max_age_ms=0.0),
        Settings(max_age_ms=math.nan),
        Settings(max_age_ms=60_001.0),
    ],
)
def test_settings_that_no_service_accepts_are_refused(settings):
    with pytest.raises(ValueError, match="must be"):
        check_settings(settings)


@pytest.mark.parametrize(
    "options",
    [{"hold_s": 0.0}, {"hold_s": math.nan}, {"form": "xml"}, {"session": "a b"}, {"coverage": 2}],
)
def test_streams_that_cannot_be_are_refused_before_anything_is_dialled(options):
    with Client(URL, "key") as client, pytest.raises(ValueError, match="must be"):
        client.stream("ada", **options)


def test_a_closed_client_opens_no_stream():
    client = Client(URL, "key")
    client.close()
    with pytest.raises(RuntimeError, match="closed"):
        client.stream("ada")


@pytest.mark.parametrize("label", ["", "x" * 201, "a\nb"])
def test_what_is_no_label_is_refused(label):
    with pytest.raises(ValueError, match="label"):
        check_label(label)


def test_ids_of_trials_are_written_as_the_service_writes_them():
    trial = "0B2F7A0E6F0E4B0E9D570E6A3C1D9F10"
    assert check_trial(trial) == "0b2f7a0e-6f0e-4b0e-9d57-0e6a3c1d9f10"
    with pytest.raises(ValueError, match="UUID"):
        check_trial("garden")


@pytest.mark.parametrize(
    ("frames", "t"),
    [
        (np.zeros((15, 20)), None),
        (np.zeros((15, 20, 2)), None),
        (np.zeros((0, 20, 3)), None),
        ([None] * 15, None),
        ("frames", None),
        (np.zeros((15, 20, 3)), 3.0),
    ],
)
def test_what_are_no_frames_is_refused_before_anything_is_sent(frames, t):
    with Client(URL, "key") as client, pytest.raises(FrameError):
        client.forecast("ada", frames, t)
    with pytest.raises(FrameError):
        calls.upload_trial(
            "ada", [Clip(frames, t)], label=None, finetune=True, idempotency_key=None
        )


def answer(status: int, content: bytes, **headers: str) -> int:
    read = msgspec.json.Decoder(int).decode
    return read_answer(status, httpx.Headers(headers), content, read)


def test_answers_become_values_or_exceptions():
    assert answer(200, b"3") == 3
    with pytest.raises(AnswerError):
        answer(200, b"<html>")
    with pytest.raises(BusyError) as busy:
        answer(503, b'{"code": "overloaded", "detail": "Busy."}', **{"Retry-After": "7"})
    assert (busy.value.code, busy.value.detail, busy.value.retry_after_s) == (
        "overloaded",
        "Busy.",
        7.0,
    )
    with pytest.raises(InvalidError) as invalid:
        answer(422, b'{"code": "bad_frame", "errors": [{"loc": ["t"], "msg": "m"}, 3]}')
    assert invalid.value.errors == ({"loc": ["t"], "msg": "m"},)


@pytest.mark.parametrize("content", [b"", b"<html>", b"[1]", b"\xff", b'{"errors": 3}'])
def test_what_another_server_says_is_an_error_with_its_status(content):
    with pytest.raises(ApiError) as raised:
        answer(502, content)
    assert (raised.value.status, raised.value.code, raised.value.errors) == (502, "http", ())


@pytest.mark.parametrize("name", ["..", ".", "a/b", "a?b#c", "ä"])
def test_no_name_leads_to_another_route(name):
    path = calls.get_user(name).path
    assert path.startswith("/v1/users/")
    url = httpx.URL("http://host").join(path)
    assert url.raw_path.count(b"/") == 3


@pytest.mark.parametrize("label", ["\ud800", "wave \udcff"])
def test_half_a_character_is_no_label_and_no_user(label):
    with pytest.raises(ValueError, match="half"):
        check_label(label)
    with Client(URL, "key") as client, pytest.raises(ValueError, match="cannot be the id"):
        client.stream(label)


class Odd:
    """An array of a library that does not give its numbers away."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("call detach first")


@pytest.mark.parametrize("joints", [Odd(), [[10**400, 0, 0]], np.ones((2, 3), complex)])
def test_whatever_is_no_array_of_numbers_is_a_frame_error(joints):
    with pytest.raises(FrameError):
        read_joints(joints, None)
    with pytest.raises(FrameError):
        read_time(10**400)


def test_numbers_beyond_single_precision_warn_nobody():
    with np.errstate(all="raise"):
        assert np.isinf(read_joints(np.full((2, 3), 1e300), 2)).all()
        assert (read_confidence(np.full(2, 1e300), 2) == 1).all()


def pack_forecast(**changes) -> bytes:
    def pack(array, dtype):
        return {"shape": array.shape, "dtype": dtype, "data": array.astype(dtype).tobytes()}

    t = np.arange(1, 16) / 30
    told = {
        "frames": pack(changes.pop("frames", np.zeros((15, 2, 3))), "<f8"),
        "t": pack(changes.pop("t", t), "<f8"),
        "radius": pack(changes.pop("radius", np.full((15, 2), 0.1)), "<f4"),
        "coverage": 0.9,
        "version": {"number": 0, "kind": "base", "sha256": None},
        "quality": [],
        "severity": "info",
        "filled": [],
        "timing": {"queue_ms": 0.1, "compute_ms": 0.1, "total_ms": 0.2},
    }
    return msgspec.msgpack.encode(told | changes)


def read(content: bytes):
    return read_answer(
        200,
        {},
        content,
        lambda body: read_single_forecast(body, joints=2, t_observed=0.0, sent_at=0.0),
    )


def test_a_forecast_of_an_unknown_severity_is_not_used():
    assert read(pack_forecast()).severity == "info"
    assert not read(pack_forecast(severity="bogus")).is_usable


@pytest.mark.parametrize(
    "changes",
    [
        {"frames": np.full((15, 2, 3), 1e300)},
        {"frames": np.zeros((15, 3, 3))},
        {"frames": np.zeros((0, 2, 3)), "t": np.zeros(0)},
        {"t": -np.arange(1, 16) / 30},
        {"t": np.zeros(15)},
        {"radius": np.full((15, 2), np.nan)},
        {"radius": np.full((15, 2), -1.0)},
        {"coverage": 7.5},
    ],
)
def test_a_forecast_that_makes_no_sense_is_never_handed_out(changes):
    with pytest.raises(AnswerError):
        read(pack_forecast(**changes))


def test_odd_headers_and_lists_in_a_circle_are_answers_without_sense():
    with pytest.raises(ApiError) as raised:
        read_answer(503, {"retry-after": "\u00b2"}, b"", lambda body: body)
    assert raised.value.retry_after_s is None
    assert (follow(None, "a"), follow("a", "b"), follow("b", None)) == ("a", "b", None)
    with pytest.raises(AnswerError, match="circle"):
        follow("a", "a")
