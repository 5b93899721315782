"""Real recordings through a running service: its errors are those of `kinecast evaluate`."""

from pathlib import Path

import numpy as np
import pytest

from app.commands.client.messages import JSON, MSGPACK
from app.settings import load_settings
from benchmarks.replay import ask_single, compare, gather, pick, replay_clips, select_answered
from models.checkpoint import SHIPPED, load_checkpoint
from models.data.clips import load_clips
from models.data.windows import cut_windows
from models.spec import MotionSpec
from tests.flows.conftest import add_user

TOLERANCE = 1e-3
SPEED = 100 / 30
"""Frames leave at 100 a second, below the limit of 120; their times stay those of 30 Hz."""
CLIPS = 4


@pytest.fixture(scope="module")
def clips(utd_mhad: Path):
    return load_clips(utd_mhad, subjects=["2"], trials=["2"])[:CLIPS]


@pytest.fixture(scope="module")
def predictor():
    return load_checkpoint(load_settings().model or SHIPPED).predictor


@pytest.mark.recordings
@pytest.mark.asyncio
@pytest.mark.parametrize("subprotocol", [JSON, MSGPACK])
async def test_streamed_recordings_err_as_evaluated(served, clips, predictor, subprotocol) -> None:
    user = add_user(served, subprotocol)
    replay = await replay_clips(
        clips,
        url=served.url,
        key=served.key,
        user=user,
        subprotocol=subprotocol,
        speed=SPEED,
    )
    windows = select_answered(clips, replay)
    assert replay.unanswered == 0
    assert replay.errors == []
    assert replay.sent == len(replay.forecasts) + replay.skipped + replay.covered
    assert replay.covered == 14 * len(clips)
    assert set(windows.clip) == set(range(len(clips)))
    _, _, difference = compare(gather(windows, replay), windows, predictor)
    assert difference < TOLERANCE


@pytest.mark.recordings
@pytest.mark.asyncio
@pytest.mark.parametrize("form", ["json", "msgpack"])
async def test_single_requests_err_as_evaluated(served, clips, predictor, form) -> None:
    user = add_user(served, form)
    windows = cut_windows(clips, MotionSpec())
    chosen = pick(windows, np.arange(0, len(windows), 5))
    answers = await ask_single(chosen, url=served.url, key=served.key, user=user, form=form)
    _, _, difference = compare(answers, chosen, predictor)
    assert difference < TOLERANCE
