"""Recordings over a stream: what is kept, sent again and told."""

import pytest

from tests.unit.clients.rig import Rig

TRIAL = "0b2f7a0e-6f0e-4b0e-9d57-0e6a3c1d9f10"
RECORDING = ("trial.start", "trial.resume", "trial.stop", "trial.cancel", "clip.start", "clip.stop")


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.connect()
    return rig


def start(rig: Rig, label: str | None = None):
    return rig.core.outgoing.start_recording(TRIAL, label, rig.moment())


def collect(rig: Rig, count: int = 1) -> list:
    """Stream frames; gives what was sent: kinds of messages and numbers of frames."""
    sent = []
    for _ in range(count):
        rig.now += 1 / 30
        rig.offer()
        sent += show(rig)
    return sent


def show(rig: Rig) -> list:
    return [
        message["seq"] if message["type"] == "frame" else message["type"]
        for message in rig.drain()
        if message["type"] == "frame" or message["type"] in RECORDING
    ]


def told(rig: Rig, state: str = "recording", **fields):
    return rig.hear("trial", **({"state": state, "trial": TRIAL, "clips_dropped": 0} | fields))


def test_messages_have_their_place_among_the_frames(rig):
    rig.offer()
    start(rig, "kitchen")
    rig.now += 1 / 30
    rig.offer()
    rig.core.outgoing.start_clip("wave")
    rig.now += 1 / 30
    rig.offer()
    rig.core.outgoing.stop_clip()
    rig.core.outgoing.end_recording("trial.stop", finetune=False)
    messages = rig.drain()
    assert [message.get("seq", message["type"]) for message in messages] == [
        0,
        "trial.start",
        1,
        "clip.start",
        2,
        "clip.stop",
        "trial.stop",
    ]
    assert messages[1] == {"type": "trial.start", "trial": TRIAL, "label": "kitchen"}
    assert messages[3] == {"type": "clip.start", "action": "wave"}
    assert messages[-1] == {"type": "trial.stop", "finetune": False}


def test_its_states_are_those_that_the_service_tells(rig):
    taking = start(rig)
    assert taking.status.state == "starting"
    told(rig, clip=0)
    assert (taking.status.state, taking.status.clip) == ("recording", 0)
    rig.core.outgoing.end_recording("trial.stop", finetune=True)
    assert taking.status.state == "ending"
    told(rig)  # sent before it was asked to end
    assert taking.status.state == "ending"
    told(rig, "stored", stored_seq=7, job={"id": "j", "state": "queued"})
    assert taking.status.is_over
    assert (taking.status.state, taking.status.stored_seq) == ("stored", 7)
    assert taking.status.job.id == "j"
    told(rig, "cancelled")
    assert taking.status.state == "stored"


def test_news_of_another_trial_are_not_taken_for_ours(rig):
    taking = start(rig)
    told(rig, "stored", trial="another")
    assert taking.status.state == "starting"


def test_a_reconnect_goes_on_with_what_is_not_stored(rig):
    collect(rig, 30)
    start(rig)
    collect(rig, 60)
    told(rig, stored_seq=39)
    rig.lose()
    rig.connect()
    assert show(rig) == ["trial.resume", *range(40, 90)]
    assert collect(rig) == [90]


def test_a_recording_that_was_never_confirmed_is_started_again(rig):
    collect(rig, 5)
    start(rig)
    collect(rig, 5)
    rig.lose()
    rig.connect()
    assert show(rig) == [0, 1, 2, 3, 4, "trial.start", 5, 6, 7, 8, 9]


def test_frames_of_a_recording_outlive_the_window(rig):
    start(rig)
    told(rig, stored_seq=None)
    rig.lose()
    for _ in range(90):  # three seconds without a connection
        rig.now += 1 / 30
        rig.offer()
    rig.connect()
    assert show(rig) == ["trial.resume", *range(90)]
    assert rig.statistics.unrecorded == 0


def test_what_a_recording_may_keep_is_bounded_and_counted(rig, monkeypatch):
    monkeypatch.setattr("kinecast_client.tape.KEEP_ITEMS", 50)
    start(rig)
    rig.lose()
    for _ in range(80):
        rig.now += 1 / 30
        rig.offer()
    rig.connect()
    assert show(rig) == ["trial.start", *range(30, 80)]
    assert rig.statistics.unrecorded == 30


def test_clips_are_told_again_where_they_may_have_been_lost(rig):
    start(rig)
    collect(rig, 3)
    told(rig, stored_seq=2)
    rig.core.outgoing.stop_clip()
    collect(rig, 2)  # forecast, not recorded
    rig.core.outgoing.start_clip("wave")
    collect(rig, 2)
    rig.lose()
    rig.connect()
    assert show(rig) == [
        "trial.resume",
        0,
        1,
        2,
        "clip.stop",
        3,
        4,
        "clip.start",
        5,
        6,
    ]


def test_clips_whose_frames_are_stored_are_not_told_again(rig):
    start(rig)
    rig.core.outgoing.start_clip("wave")
    collect(rig, 3)
    told(rig, stored_seq=2)
    rig.lose()
    rig.connect()
    assert show(rig) == ["trial.resume", 0, 1, 2]


def test_frames_between_clips_are_not_kept(rig):
    start(rig)
    collect(rig, 2)
    told(rig, stored_seq=1)
    rig.core.outgoing.stop_clip()
    collect(rig, 90)
    rig.lose()
    rig.connect()
    sent = show(rig)
    assert sent[:2] == ["trial.resume", "clip.stop"]
    assert sent[2:] == list(range(92 - 19, 92))


def test_an_end_that_was_not_confirmed_is_asked_for_again(rig):
    taking = start(rig)
    collect(rig, 2)
    told(rig)
    rig.core.outgoing.end_recording("trial.stop", finetune=True)
    assert show(rig) == ["trial.stop"]
    rig.lose()
    rig.connect()
    assert show(rig) == ["trial.resume", 0, 1, "trial.stop"]
    told(rig, "stored", stored_seq=1)
    assert taking.status.state == "stored"
    rig.lose()
    rig.connect()
    assert show(rig) == [0, 1]  # the window; nothing of the recording


def test_a_service_that_says_nothing_of_it_is_asked(rig):
    start(rig)
    assert collect(rig) == ["trial.start", 0]
    told(rig)
    for _ in range(4):
        rig.wait(1.0)
        rig.hear("waiting", seq=0, t=0.0, reason="warm_up", have_s=0.0, need_s=0.45)
    assert "trial.resume" in show(rig)


@pytest.mark.parametrize("code", ["forbidden", "trial_conflict", "unknown_trial"])
def test_a_refusal_ends_it_with_the_code(rig, code):
    taking = start(rig)
    rig.hear("error", code=code, message="No.", retryable=False, seq=None)
    assert taking.status.state == "failed"
    assert taking.status.error == "No."
    assert taking.code == code
    collect(rig, 3)
    rig.lose()
    rig.connect()
    assert "trial.start" not in show(rig)


@pytest.mark.parametrize("code", ["trial_limit", "trial_unavailable"])
def test_other_errors_are_told_and_it_goes_on(rig, code):
    taking = start(rig)
    told(rig)
    rig.hear("error", code=code, message="Hm.", retryable=False, seq=None)
    assert (taking.status.state, taking.status.error) == ("recording", "Hm.")


def test_numbers_go_on_above_those_of_another_program(rig):
    start(rig)
    collect(rig, 2)
    told(rig, stored_seq=500)
    assert collect(rig) == [501]


def test_a_second_recording_begins_afresh(rig):
    start(rig)
    collect(rig, 3)
    told(rig, "stored", stored_seq=2)
    other = "11111111-6f0e-4b0e-9d57-0e6a3c1d9f10"
    rig.core.outgoing.start_recording(other, None, rig.moment())
    assert collect(rig) == ["trial.start", 3]
    rig.lose()
    rig.connect()
    assert show(rig) == [0, 1, 2, "trial.start", 3]
