"""Trials recorded through a real WebSocket, on both databases."""

import asyncio
import time
from collections.abc import Iterator
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from app.domain.recordings import RawFrames, unpack_frames
from app.settings import Settings
from app.storage import jobs, trials, users
from app.storage.tables import utc_now
from tests.live_support import BOTH, RealServer, StreamClient, serve
from tests.personal_support import claim, finish
from tests.support import open_database, watch_person
from tests.versions import BASE_SHA256, dump, make_net, make_net_decoders, make_personal

pytestmark = pytest.mark.asyncio
PERSON = watch_person(6.0)


@pytest.fixture
def server(settings: Settings) -> Iterator[RealServer]:
    with serve(settings) as running:
        running.add_user()
        yield running


async def show(client: StreamClient, seqs: range, *, since: float = 0.0, **fields: Any) -> None:
    for seq in seqs:
        await client.frame(seq, since + seq / 30, PERSON[seq % len(PERSON)], **fields)


async def begin(client: StreamClient, **fields: Any) -> dict[str, Any]:
    await client.send(type="trial.start", **fields)
    return await client.expect("trial")


async def expect_state(client: StreamClient, state: str) -> dict[str, Any]:
    while (told := await client.expect("trial"))["state"] != state:
        pass
    return told


async def expect_stored(client: StreamClient, seq: int) -> dict[str, Any]:
    while (told := await client.expect("trial"))["stored_seq"] != seq:
        pass
    return told


async def stop(client: StreamClient, **fields: Any) -> dict[str, Any]:
    await client.send(type="trial.stop", **fields)
    return await expect_state(client, "stored")


async def read_trial(settings: Settings, trial: str) -> tuple[Any, list[RawFrames]]:
    async with open_database(settings) as database, database.read() as tx:
        user = await users.get(tx, "ada")
        found = (await trials.list_all(tx, user))[-1]
        assert str(found.id) == trial
        clips = await trials.read_clips(tx, found.id)
    return found, [unpack_frames(clip.chunks) for clip in clips]


async def list_jobs(settings: Settings) -> list[Any]:
    async with open_database(settings) as database, database.read() as tx:
        return await jobs.list_of_user(tx, (await users.get(tx, "ada")).uuid)


@pytest.mark.parametrize("subprotocol", BOTH)
async def test_recorded_frames_are_those_that_were_sent(server, settings, subprotocol) -> None:
    async with server.stream(subprotocol=subprotocol) as client:
        told = await begin(client, label="kitchen")
        assert (told["state"], told["clip"], told["stored_seq"]) == ("recording", 0, None)
        await client.send(type="clip.start", action="wave")
        await show(client, range(45))
        await client.send(type="clip.stop")
        await show(client, range(45, 60))
        await client.send(type="clip.start", action="short")
        await show(client, range(60, 70))
        told = await stop(client)
        job = await client.expect("job")
    assert (told["stored_seq"], told["clip"], told["clips_dropped"]) == (69, None, 0)
    trial, clips = await read_trial(settings, told["trial"])
    assert (trial.state, trial.label, trial.finetune) == ("stored", "kitchen", True)
    assert [(clip.action, clip.flaw) for clip in trial.clips] == [
        ("wave", None),
        ("short", "too_short"),
    ]
    assert [len(clip) for clip in clips] == [45, 10]
    np.testing.assert_allclose(clips[0].joints, PERSON[:45], atol=1e-6)
    assert clips[0].t.tolist() == [seq / 30 for seq in range(45)]
    assert (job["id"], job["state"]) == (told["job"]["id"], "queued")
    (stored,) = await list_jobs(settings)
    assert (str(stored.id), stored.reason) == (job["id"], "trial")


async def test_trials_without_finetuning_or_without_frames_ask_for_no_job(server, settings) -> None:
    async with server.stream() as client:
        await begin(client)
        await show(client, range(40))
        assert (await stop(client, finetune=False))["job"] is None
        await begin(client)
        assert (await stop(client))["job"] is None
        await begin(client)
        await show(client, range(40, 60))
        await client.send(type="trial.cancel")
        told = await expect_state(client, "cancelled")
    assert "job" not in told
    assert (await read_trial(settings, told["trial"]))[0].frames == 0
    assert await list_jobs(settings) == []


async def test_the_stream_is_told_once_a_second_how_the_recording_stands(server) -> None:
    async with server.stream() as client:
        await begin(client)
        await show(client, range(10))
        began = time.monotonic()
        await expect_stored(client, 9)
        assert time.monotonic() - began < 1.5
        for _ in range(2):
            began = time.monotonic()
            await client.expect("trial")
            assert time.monotonic() - began < 1.3


async def test_a_lost_stream_costs_no_frame_when_another_replica_goes_on(server, settings) -> None:
    trial = str(uuid4())
    with serve(settings) as replica:
        async with server.stream(query="?session=robot") as client:
            await begin(client, trial=trial)
            await show(client, range(50))
            client.socket.transport.abort()
        async with replica.stream(query="?session=robot") as client:
            await client.send(type="trial.resume", trial=trial)
            stored = (await client.expect("trial"))["stored_seq"]
            first = 0 if stored is None else stored + 1
            await show(client, range(max(0, first - 18), 80), replay=True)
            await show(client, range(80, 100))
            assert (await client.expect("forecast", "error"))["type"] == "forecast"
            told = await stop(client)
    found, clips = await read_trial(settings, trial)
    assert told["stored_seq"] == 99
    assert [clip.frames for clip in found.clips] == [100]
    assert np.concatenate([clip.t for clip in clips]).tolist() == [i / 30 for i in range(100)]


async def test_frames_that_are_replayed_twice_are_stored_once(server, settings) -> None:
    async with server.stream(query="?session=robot") as client:
        trial = (await begin(client))["trial"]
        await show(client, range(30))
        await expect_stored(client, 29)
    async with server.stream() as client:  # of no name: another session goes on
        await client.send(type="trial.resume", trial=trial)
        assert (await client.expect("trial"))["stored_seq"] == 29
        await show(client, range(20, 40), replay=True)
        await show(client, range(60, 70))
        told = await stop(client)
    found, _ = await read_trial(settings, trial)
    assert told["stored_seq"] == 69
    assert [clip.frames for clip in found.clips] == [40, 10]  # a hole begins a new clip


async def test_the_older_of_two_streams_of_a_session_records_nothing_more(server, settings) -> None:
    with serve(settings) as replica:
        async with server.stream(query="?session=robot") as old:
            trial = (await begin(old))["trial"]
            await show(old, range(20))
            await expect_stored(old, 19)
            async with replica.stream(query="?session=robot") as new:
                await show(old, range(20, 60))
                code, _ = await old.expect_close()
                await new.send(type="trial.resume", trial=trial)
                assert (await new.expect("trial"))["stored_seq"] == 19
                await show(new, range(20, 50))
                await stop(new)
    assert code == 4409
    found, clips = await read_trial(settings, trial)
    assert found.frames == 50
    assert np.concatenate([clip.t for clip in clips]).tolist() == [i / 30 for i in range(50)]


async def test_what_does_not_fit_is_told_and_forecasts_go_on(server) -> None:
    async with server.stream() as client:
        for message, code in (
            ({"type": "clip.start"}, "trial_conflict"),
            ({"type": "trial.stop"}, "trial_conflict"),
            ({"type": "trial.resume", "trial": str(uuid4())}, "unknown_trial"),
            ({"type": "trial.start", "trial": "mine"}, "invalid_request"),
            ({"type": "clip.start", "action": "a\0b"}, "invalid_request"),
        ):
            await client.send(**message)
            assert (await client.expect("error"))["code"] == code
        await show(client, range(15))
        assert (await client.expect("forecast"))["seq"] == 14


async def test_a_key_without_the_scope_does_not_record(server) -> None:
    key = server.add_key("predict")["key"]
    async with server.stream(key=key) as client:
        await client.send(type="trial.start")
        assert (await client.expect("error"))["code"] == "forbidden"


async def test_erasing_the_person_ends_the_recording(server) -> None:
    async with server.stream() as client:
        await begin(client)
        await show(client, range(20))
        assert server.call("DELETE", "/v1/users/ada").status_code == 204
        await show(client, range(20, 40))
        code, _ = await client.expect_close()
    assert code == 4410


async def test_a_server_that_drains_stores_what_it_has(settings) -> None:
    with serve(settings) as server:
        server.add_user()
        async with server.stream() as client:
            trial = (await begin(client))["trial"]
            await show(client, range(15))
            await client.expect("forecast")
            server.server.handle_exit(15, None)
            assert (await client.expect_close())[0] == 1001
    found, _ = await read_trial(settings, trial)
    assert (found.state, found.frames) == ("recording", 15)


async def test_the_version_that_a_recording_makes_arrives_on_its_stream(settings) -> None:
    base = make_net()
    mine = make_personal(base, 1)
    with serve(settings, make_net_decoders(base)) as server:
        server.add_user()
        async with server.stream() as client, open_database(settings) as database:
            await begin(client)
            await show(client, range(40))
            told = await stop(client)
            held = await claim(database, now=utc_now(), base_sha256=BASE_SHA256)
            await finish(database, held, now=utc_now(), blob=dump(mine), base_sha256=BASE_SHA256)
            heard = {}
            while "version" not in heard or heard["job"]["state"] != "succeeded":
                message = await client.expect("job", "version")
                heard[message["type"]] = message
            # their times go on where they stopped, so the first count as old as the job took
            await show(client, range(40, 160))
            forecast = await client.expect("forecast")
    version, job = heard["version"], heard["job"]
    assert job["id"] == told["job"]["id"]
    assert job["metrics"] == {"before": [1.0], "after": [0.5]}
    assert (version["version"]["number"], version["reason"]) == (1, "promoted")
    assert forecast["version"]["sha256"] == version["version"]["sha256"]


async def test_every_open_stream_of_the_person_hears_of_the_job(server, settings) -> None:
    async with server.stream() as one, server.stream() as other:
        await begin(one)
        await show(one, range(40))
        told = await stop(one)
        heard = [await client.expect("job") for client in (one, other)]
        answer = await asyncio.to_thread(
            server.call, "POST", f"/v1/admin/jobs/{told['job']['id']}/cancel"
        )
        assert answer.status_code == 200
        ended = [await client.expect("job") for client in (one, other)]
    assert {job["state"] for job in heard} == {"queued"}
    assert {(job["id"], job["state"]) for job in ended} == {(told["job"]["id"], "cancelled")}
