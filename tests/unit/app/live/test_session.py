from collections.abc import Iterable

import numpy as np
import pytest

from app.domain.errors import BadFrameError, BadMessageError, VersionUnavailableError
from app.domain.limits import Limits
from app.domain.motion import RequestedVersion, Timing, VersionStamp
from app.live.actions import Action, End, Identity, Send, Submit
from app.live.protocol import (
    Auth,
    ClientMessage,
    ClientPong,
    ClipStart,
    Configure,
    Configured,
    ErrorMessage,
    Forecast,
    Observation,
    Ping,
    Pong,
    Rejected,
    Reset,
    ServerPing,
    StreamSettings,
    TrialStart,
    WaitingMessage,
)
from app.live.session import Session
from app.live.telemetry import Telemetry
from app.live.work import EngineResult
from models.data.synthetic import SyntheticPerson
from models.skeleton import KINECT_V1

PERSON = SyntheticPerson(2).record("walk", 10.0).astype(np.float64)
LIMITS = Limits(
    max_message_bytes=262_144,
    max_rate_hz=120.0,
    idle_s=30.0,
    streams_per_key=64,
    streams_per_user=8,
    forecast_frames=600,
    trial_bytes=2**26,
    clips=500,
    frames_per_clip=9000,
)


def resolve(requested: RequestedVersion) -> VersionStamp:
    if requested not in {"active", "base", 0}:
        raise VersionUnavailableError(f"There is no version {requested}.")
    return VersionStamp(0, "base", "ab", requested=requested)


def make_session(*, may_record: bool = True, now: float = 100.0) -> Session:
    identity = Identity(
        user="ada",
        skeleton=KINECT_V1,
        up="y",
        root_relative=False,
        session="s",
        epoch=1,
        may_record=may_record,
    )
    wanted = StreamSettings(forecast_every=1, coverage=0.9, version="active", max_age_ms=200.0)
    return Session(
        identity,
        settings=wanted,
        limits=LIMITS,
        resolve=resolve,
        engine_ms=lambda: 2.5,
        telemetry=Telemetry(),
        now=now,
    )


def result(version: VersionStamp | None = None) -> EngineResult:
    return EngineResult(
        displacement=np.zeros((15, 20, 3), np.float32),
        radius=None,
        coverage=0.9,
        version=version or resolve("active"),
        timing=Timing(0.1, 0.2, 0.3),
        flags=(),
    )


def frame(seq: int, t: float | None = None, *, replay: bool = False, lost: bool = False):
    joints = None if lost else PERSON[seq % len(PERSON)]
    return Observation(seq, seq / 30 if t is None else t, joints, None, replay)


def sent(actions: Iterable[Action]) -> list[object]:
    return [action.message for action in actions if isinstance(action, Send)]


class Stream:
    """A session whose frames come at 30 Hz and are answered at once."""

    def __init__(self, **options: bool) -> None:
        self.session = make_session(**options)
        self.now = 100.0

    def say(self, message: ClientMessage, *, later: float = 1 / 30) -> list[Action]:
        self.now += later
        return self.session.receive(message, self.now)

    def show(self, seqs: Iterable[int], **fields: bool) -> list[object]:
        """Send frames; gives every message that they cause."""
        messages = []
        for seq in seqs:
            for action in self.say(frame(seq, **fields)):
                messages += self.answer(action) if isinstance(action, Submit) else sent([action])
        return messages

    def answer(self, action: Submit, *, later: float = 0.002) -> list[object]:
        return sent(self.session.answer(action.ticket, result(), self.now + later))

    def submit(self, seq: int, **fields: float) -> Submit:
        (action,) = self.say(frame(seq, **fields))
        assert isinstance(action, Submit)
        return action


def test_the_first_message_describes_the_server() -> None:
    hello = make_session().hello()
    assert (hello.protocol, hello.user, hello.session, hello.epoch) == (1, "ada", "s", 1)
    assert (hello.rate_hz, hello.observe, hello.horizon) == (30.0, 15, 15)
    assert hello.joints == KINECT_V1.joints
    assert hello.version.sha256 == "ab"


def test_waiting_is_told_at_once_and_then_every_second() -> None:
    stream = Stream()
    messages = stream.show(range(100), lost=True)
    assert [type(message) for message in messages] == [WaitingMessage] * 4
    assert [message.seq for message in messages] == [0, 30, 60, 90]
    assert {message.reason for message in messages} == {"person_lost"}


def test_frames_are_answered_one_by_one() -> None:
    messages = Stream().show(range(40))
    assert isinstance(messages[0], WaitingMessage)
    assert [message.seq for message in messages[1:]] == list(range(14, 40))
    assert all(message.skipped == message.not_due == 0 for message in messages[1:])


def test_superseded_frames_are_counted() -> None:
    stream = Stream()
    stream.show(range(20))
    tickets = [stream.submit(seq) for seq in range(20, 25)]
    assert stream.answer(tickets[1])[0].skipped == 1
    assert stream.answer(tickets[4])[0].skipped == 2
    assert stream.answer(tickets[3]) == []


def test_frames_that_are_not_due_are_counted() -> None:
    stream = Stream()
    stream.show(range(20))
    (configured,) = sent(stream.say(Configure(forecast_every=4)))
    assert isinstance(configured, Configured)
    assert (configured.from_seq, configured.settings.forecast_every) == (20, 4)
    messages = stream.show(range(20, 29))
    assert [(message.seq, message.not_due) for message in messages] == [(20, 0), (24, 3), (28, 3)]


def test_a_backlog_after_a_stall_gives_errors_instead_of_old_forecasts() -> None:
    stream = Stream()
    stream.show(range(30))
    stream.now += 2.0
    outcomes = {}
    for seq in range(30, 90):
        (action,) = stream.session.receive(frame(seq), stream.now)
        outcomes[seq] = action
    codes = {
        seq: action.message.code for seq, action in outcomes.items() if isinstance(action, Send)
    }
    assert set(codes.values()) == {"stale_frame"}
    # the newest frames of the backlog are as fresh as frames ever were
    fresh = [seq for seq, action in outcomes.items() if isinstance(action, Submit)]
    assert fresh == list(range(fresh[0], 90))
    assert fresh[0] >= 90 - 8


def test_a_frame_that_grows_old_in_the_server_is_no_forecast_either() -> None:
    stream = Stream()
    stream.show(range(20))
    submitted = stream.submit(20)
    (error,) = stream.answer(submitted, later=0.3)
    assert isinstance(error, ErrorMessage)
    assert (error.code, error.seq, error.retryable) == ("stale_frame", 20, True)
    assert stream.answer(stream.submit(21))[0].skipped == 0


def test_late_frames_are_flagged() -> None:
    stream = Stream()
    stream.show(range(20))
    (action,) = stream.say(frame(20), later=1 / 30 + 0.15)
    assert isinstance(action, Submit)
    assert "late_input" in stream.answer(action)[0].quality


def test_age_follows_the_clocks_of_pongs() -> None:
    stream = Stream()
    stream.show(range(160))
    (ping,) = sent(stream.session.tick(stream.now))
    assert isinstance(ping, ServerPing)
    # frame i is captured at i/30 on the client's clock; say that it takes 50 ms to arrive
    offset = stream.now - 159 / 30 - 0.05
    pong = ClientPong(ping.id, ping.server_t, t=stream.now + 0.005 - offset)
    stream.session.receive(pong, stream.now + 0.010)
    age_ms = stream.answer(stream.submit(160), later=0.0)[0].age_ms
    assert age_ms == pytest.approx(50, abs=1)


def test_pongs_of_another_clock_are_ignored() -> None:
    stream = Stream()
    stream.show(range(160))
    (ping,) = sent(stream.session.tick(stream.now))
    for t in (1.7e9, -50.0, float("nan"), float("inf")):
        stream.session.receive(ClientPong(ping.id, ping.server_t, t), stream.now)
    assert stream.answer(stream.submit(160), later=0.0)[0].age_ms < 5


def test_old_forecasts_do_not_survive_a_reset() -> None:
    stream = Stream()
    stream.show(range(20))
    old = stream.submit(20)
    assert stream.say(Reset()) == []
    assert stream.answer(old) == []
    messages = stream.show(range(21, 40))
    assert messages[0].reason == "warm_up"
    assert messages[1].seq == 35
    assert messages[1].skipped == 1


def test_a_new_clock_starts_anew() -> None:
    stream = Stream()
    stream.show(range(20))
    old = stream.submit(20)
    (waiting,) = sent(stream.say(frame(21, -50.0)))
    assert waiting.reason == "clock_restart"
    assert stream.answer(old) == []


def test_replayed_frames_fill_the_window_and_are_not_answered() -> None:
    stream = Stream()
    for seq in range(18):
        assert stream.session.receive(frame(seq, replay=True), stream.now) == []
    (action,) = stream.session.receive(frame(18), stream.now)
    assert isinstance(action, Submit)


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (frame(5), "seq_not_increasing"),
        (frame(99, 5 / 30), "t_not_increasing"),
        (Observation(99, 9.0, np.full((20, 3), 1e3), None, replay=False), "bad_frame"),
        (Observation(99, 9.0, np.zeros((19, 3)), None, replay=False), "wrong_joint_count"),
        (Rejected(BadFrameError("no"), 99), "bad_frame"),
        (Configure(version=3), "unknown_version"),
        (ClipStart(), "trial_conflict"),
        (Auth("key"), "invalid_request"),
    ],
)
def test_mistakes_are_told_and_the_stream_goes_on(message: ClientMessage, code: str) -> None:
    stream = Stream()
    stream.show(range(20))
    (error,) = sent(stream.say(message))
    assert error.code == code
    assert [message.seq for message in stream.show([20])] == [20]


def test_recording_needs_its_scope() -> None:
    (error,) = sent(Stream(may_record=False).say(TrialStart()))
    assert error.code == "forbidden"


def test_broken_framing_ends_the_stream() -> None:
    (end,) = Stream().say(Rejected(BadMessageError("no")))
    assert isinstance(end, End)


def test_too_many_mistakes_end_the_stream_but_not_if_they_are_spread() -> None:
    stream = Stream()
    bad = Rejected(BadFrameError("no"))
    for _ in range(60):
        assert not any(isinstance(action, End) for action in stream.say(bad, later=0.01))
    assert stream.say(bad, later=0.01)[-1].error.code == "too_many_errors"
    patient = Stream()
    for _ in range(200):
        assert not any(isinstance(action, End) for action in patient.say(bad, later=0.2))


def test_a_burst_passes_and_a_flood_does_not() -> None:
    stream = Stream()
    for i in range(240):
        assert not any(isinstance(a, End) for a in stream.say(Ping(i, 0.0), later=0.0))
    assert stream.say(Ping(0, 0.0), later=0.0)[0].error.code == "too_fast"
    steady = Stream()
    for i in range(1000):
        assert not any(isinstance(a, End) for a in steady.say(Ping(i, 0.0), later=1 / 120))


def test_silence_ends_the_stream() -> None:
    session = make_session(now=0.0)
    assert not any(isinstance(action, End) for action in session.tick(30.0))
    assert session.tick(30.1)[0].error.code == "idle"


def test_a_ping_is_answered_with_the_engines_latency() -> None:
    (pong,) = sent(Stream().say(Ping("x", 3.0)))
    assert isinstance(pong, Pong)
    assert (pong.id, pong.t, pong.engine_ms) == ("x", 3.0, 2.5)


def test_a_busy_engine_is_told_of() -> None:
    stream = Stream()
    stream.show(range(20))
    stream.submit(20)
    assert sent(stream.session.tick(stream.now + 0.5)) == []
    (waiting,) = sent(stream.session.tick(stream.now + 1.5))
    assert (waiting.reason, waiting.seq) == ("overloaded", 20)


def test_a_wrong_unit_of_time_is_told_once_a_second() -> None:
    stream = Stream()
    messages = []
    for seq in range(60):
        messages += sent(stream.say(frame(seq, seq * 33.3)))
    codes = [m.code for m in messages if isinstance(m, ErrorMessage)]
    assert codes == ["bad_time_unit"] * 2
    assert not any(isinstance(message, Forecast) for message in messages)


def test_other_weights_are_flagged_once() -> None:
    stream = Stream()
    stream.show(range(20))
    damped = VersionStamp(None, "damped_velocity", None, fallback="engine_error")
    qualities = []
    for seq, version in ((20, damped), (21, damped), (22, resolve("active"))):
        ticket = stream.submit(seq).ticket
        (message,) = sent(stream.session.answer(ticket, result(version), stream.now))
        qualities.append("version_changed" in message.quality)
    assert qualities == [True, False, True]


def test_a_second_wrong_unit_of_time_is_told_even_at_once() -> None:
    stream = Stream()
    told = []
    t = 0.0
    for seq in range(72):
        t += 33.3 if seq % 36 >= 24 else 1 / 30
        told += [m.code for m in sent(stream.say(frame(seq, t))) if isinstance(m, ErrorMessage)]
    assert told.count("bad_time_unit") >= 2
