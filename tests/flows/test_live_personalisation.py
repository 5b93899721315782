"""A person is recorded on a stream, and their version answers on it: nothing is lost on the way."""

import asyncio
from dataclasses import replace

import httpx
import pytest
import torch

from app.commands.client.messages import MSGPACK, Forecast, Job, VersionChanged
from app.commands.own_server import run_own_server
from benchmarks.live.check import (
    TOLERANCE_M,
    compare,
    compare_stored,
    compute_offline,
    count_frames,
    count_strays,
)
from benchmarks.live.story import find_swap, list_stages, measure_errors, measure_latency
from benchmarks.live.take import Script, Take, play
from models.checkpoint import load_checkpoint, load_personal, save_checkpoint
from models.data.clips import Clip
from models.predictor import Predictor
from tests.flows.conftest import add_user, call
from tests.nets import TINY
from tests.personal_support import record_frames

SPEED = 4.0
STEPS = 20
CLIP_S = 2.0


def film(seed: int) -> list[Clip]:
    """Six clips of a person, as a sensor gives them."""
    actions = [action for action in ("wave", "walk", "punch") for _ in "ab"]
    return [
        Clip(record_frames(CLIP_S, seed=seed, action=action).joints, "1", action, "1", "synthetic")
        for action in actions
    ]


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """Everything that was sent and heard, the job, the nets and the export."""
    folder = tmp_path_factory.mktemp("live")
    with torch.random.fork_rng():
        torch.manual_seed(1)
        save_checkpoint(folder / "small.safetensors", Predictor(config=TINY), {})
    base = load_checkpoint(folder / "small.safetensors")
    own = {"model": folder / "small.safetensors", "worker_poll_s": 0.2, "finetune_steps": STEPS}
    with run_own_server(folder, **own) as server:
        add_user(server, "ada")
        script = Script(film(1), film(1)[::-1], speed=SPEED, after_s=0.5, patience_s=60.0)
        stream = {"url": server.url, "key": server.key, "user": "ada", "subprotocol": MSGPACK}
        take = asyncio.run(play(script, **stream))
        told = [message for _, message in take.heard if isinstance(message, Job)]
        job = call(server, "GET", f"/v1/admin/jobs/{told[-1].id}").json()
        weights = call(server, "GET", "/v1/users/ada/versions/1/weights")
        archive = call(server, "GET", "/v1/users/ada/export").content
    assert weights.status_code == httpx.codes.OK, job
    personal = load_personal(weights.content, base.predictor, base_sha256=base.sha256)
    nets = {base.sha256: base.predictor, weights.headers["etag"].strip('"'): personal}
    return take, job, nets, archive


def test_no_frame_is_lost_or_answered_twice(lived) -> None:
    take, *_ = lived
    counts = count_frames(take)
    assert (counts["missing"], counts["twice"]) == (0, 0)
    parts = ("answered", "skipped", "waiting", "refused")
    assert sum(counts[name] for name in parts) == counts["sent"] == len(take.places)
    assert counts["answered"] > 100


def test_every_answer_is_what_the_version_that_it_names_gives(lived) -> None:
    take, job, nets, _ = lived
    assert (job["state"], job["version"]) == ("succeeded", 1)
    told = compare(compute_offline(take, nets))
    assert set(told["forecasts_by_version"]) == {"0", "1"}
    assert max(told["largest_difference_m"].values()) < TOLERANCE_M
    assert told["compared_with_others"] > 0
    assert told["as_near_to_others"] == 0
    assert told["largest_difference_of_share"] < 1e-3
    assert count_strays(take, next(iter(nets))) == 0


def test_the_trial_is_stored_as_it_was_sent(lived) -> None:
    take, _, _, archive = lived
    told = compare_stored(take, archive)
    assert told["equal"]
    assert told["frames"] == told["frames_sent"] == sum(len(clip.poses) for clip in film(1))


def test_the_story_has_every_stage_in_its_order(lived) -> None:
    take, job, nets, _ = lived
    stages = list_stages(take, job, fit_steps=STEPS)
    kinds = [stage.kind for stage in stages]
    assert kinds[:3] == ["recording", "queued", "checking"]
    assert kinds[-1] == "answering"
    assert all(stage.seconds >= 0 for stage in stages)
    swap = find_swap(take, job)
    assert 0 < swap.promoted < swap.told < swap.first
    errors = measure_errors(
        take, compute_offline(take, nets), base_sha256=next(iter(nets)), speed=SPEED
    )
    before = errors.mean(errors.came < swap.told)
    assert before["served_cm2"] == pytest.approx(before["base_cm2"], rel=1e-3)
    assert (measure_latency(take)[1] > 0).all()


def change(take: Take, where: type, **fields: object) -> Take:
    """Change the last message of a kind."""
    place = max(i for i, (_, m) in enumerate(take.heard) if isinstance(m, where))
    at, message = take.heard[place]
    heard = list(take.heard)
    heard[place : place + 1] = [(at, replace(message, **fields))] if fields else []
    return replace(take, heard=heard)


def test_the_checks_see_what_they_are_for(lived) -> None:
    take, _, nets, archive = lived
    last = [m for _, m in take.heard if isinstance(m, Forecast)][-1]
    without = count_frames(change(take, Forecast))
    assert without["missing"] == 1 + last.skipped
    assert count_frames(replace(take, heard=[*take.heard, (0.0, last)]))["twice"] == 1
    moved = change(take, Forecast, frames=last.frames + 2e-5)
    assert compare(compute_offline(moved, nets))["largest_difference_m"]["1"] > TOLERANCE_M
    assert count_strays(change(take, VersionChanged), next(iter(nets))) > 0
    other = list(take.clips)
    other[3] = replace(other[3], poses=other[3].poses + 1e-6)
    assert not compare_stored(replace(take, clips=other), archive)["equal"]
