"""Recordings outlive databases that go away, replicas that are killed and streams that leave."""

import asyncio
import re
import subprocess
import sys
from datetime import timedelta
from uuid import uuid4

import numpy as np
import pytest
from sqlalchemy import update

from app.live.sweeper import GRACE_S, Sweeper
from app.storage.tables import TrialRow, utc_now
from tests.conftest import ROOT
from tests.integration.test_live_recording import (
    begin,
    expect_state,
    expect_stored,
    list_jobs,
    read_trial,
    show,
    stop,
)
from tests.live_support import RealServer, StreamClient, serve
from tests.outage import cuttable
from tests.support import ADMIN_KEY, open_database

pytestmark = pytest.mark.asyncio


async def be_patient(client: StreamClient) -> None:
    """A busy machine shows and answers frames more slowly than their times say."""
    await client.send(type="configure", max_age_ms=60_000)


async def show_live(client: StreamClient, seqs: range) -> None:
    for seq in seqs:
        await show(client, range(seq, seq + 1))
        await asyncio.sleep(1 / 30)


async def test_frames_wait_for_a_database_that_is_away(settings) -> None:
    with cuttable(settings) as (own, outage), serve(own) as server:
        server.add_user()
        async with server.stream() as client:
            await be_patient(client)
            trial = (await begin(client))["trial"]
            await show_live(client, range(20))
            await client.expect("forecast")
            with outage:
                await show_live(client, range(20, 65))
                assert (await client.expect("error"))["code"] == "trial_unavailable"
                await show_live(client, range(65, 70))
                while (await client.expect("forecast"))["seq"] < 69:
                    pass
            await show_live(client, range(70, 80))
            told = await stop(client)
    found, clips = await read_trial(settings, trial)
    assert (told["stored_seq"], told["clips_dropped"]) == (79, 0)
    assert [clip.frames for clip in found.clips] == [80]
    assert np.concatenate([clip.t for clip in clips]).tolist() == [i / 30 for i in range(80)]
    assert len(await list_jobs(settings)) == 1


async def test_a_trial_that_is_stopped_during_an_outage_is_stored_after_it(settings) -> None:
    with cuttable(settings) as (own, outage), serve(own) as server:
        server.add_user()
        async with server.stream() as client:
            await be_patient(client)
            await begin(client)
            with outage:
                await show(client, range(40))
                await client.send(type="trial.stop")
                assert (await client.expect("error"))["code"] == "trial_unavailable"
            told = await expect_state(client, "stored")
    assert told["stored_seq"] == 39
    assert [str(job.id) for job in await list_jobs(settings)] == [told["job"]["id"]]
    assert (await read_trial(settings, told["trial"]))[0].frames == 40


async def test_a_stream_that_leaves_in_an_outage_is_stored_if_that_is_short(settings) -> None:
    with cuttable(settings) as (own, outage), serve(own) as server:
        server.add_user()
        async with server.stream() as client:
            await be_patient(client)
            trial = (await begin(client))["trial"]
            with outage:
                await show(client, range(40))
                await client.send(type="trial.stop")
                assert (await client.expect("error"))["code"] == "trial_unavailable"
                await client.socket.close()
                await asyncio.sleep(2.0)
        async with asyncio.timeout(10):
            while len(server.app.state.registry):  # noqa: ASYNC110 - of another thread
                await asyncio.sleep(0.05)
    found, clips = await read_trial(settings, trial)
    assert (found.state, found.frames) == ("stored", 40)
    assert [len(clip) for clip in clips] == [40]
    assert len(await list_jobs(settings)) == 1


@pytest.fixture
def doomed(settings):
    """A replica in a process of its own, which may be killed."""
    environment = {
        "PATH": "/usr/bin:/bin",
        "KINECAST_DATA_DIR": str(settings.data_dir),
        "KINECAST_ADMIN_KEY": ADMIN_KEY,
        **({"KINECAST_DATABASE_URL": settings.database_url} if settings.database_url else {}),
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "app.cli", "serve", "--port", "0", "--no-worker"],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        port = int(re.search(r"http://\S+:(\d+)", process.stdout.readline())[1])
        yield RealServer(None, None, port), process
    finally:
        process.kill()
        process.wait(10)
        process.stdout.close()


async def test_a_replica_killed_in_mid_trial_costs_no_frame(settings, doomed) -> None:
    trial = str(uuid4())
    dying, process = doomed
    dying.add_user()
    async with dying.stream(query="?session=robot") as client:
        await begin(client, trial=trial)
        await show(client, range(30))
        await expect_stored(client, 29)
        await show_live(client, range(30, 50))
        process.kill()
        client.socket.transport.abort()
    with serve(settings) as replica:
        async with replica.stream(query="?session=robot") as client:
            await client.send(type="trial.resume", trial=trial)
            stored = (await client.expect("trial"))["stored_seq"]
            assert stored >= 29
            await show(client, range(stored - 17, 70), replay=True)
            await show(client, range(70, 80))
            told = await stop(client)
    found, clips = await read_trial(settings, trial)
    assert told["stored_seq"] == 79
    assert [clip.frames for clip in found.clips] == [80]
    assert np.concatenate([clip.t for clip in clips]).tolist() == [i / 30 for i in range(80)]


async def leave_recording(settings) -> str:
    """Have a stream vanish in the middle of a trial, a minute ago."""
    with serve(settings) as server:
        server.add_user()
        async with server.stream() as client:
            await be_patient(client)
            trial = (await begin(client))["trial"]
            await show(client, range(40))
            await client.expect("forecast")
    return trial


async def let_a_minute_pass(database) -> None:
    async with database.write() as tx:
        await tx.execute(update(TrialRow).values(touched_at=utc_now() - timedelta(seconds=61)))


async def test_a_recording_whose_stream_does_not_come_back_is_stored(settings) -> None:
    trial = await leave_recording(settings)
    now = 0.0
    async with open_database(settings) as database:
        sweeper = Sweeper(database, abandoned_s=60.0, clock=lambda: now)
        assert await sweeper.sweep() == 0
        now = GRACE_S
        assert await sweeper.sweep() == 0
        await let_a_minute_pass(database)
        assert await sweeper.sweep() == 1
        assert await sweeper.sweep() == 0
    found, _ = await read_trial(settings, trial)
    assert (found.state, found.finetune, found.frames) == ("stored", False, 40)
    assert await list_jobs(settings) == []


async def test_after_an_outage_streams_get_time_to_say_that_they_are_there(settings) -> None:
    now = 0.0
    await leave_recording(settings)
    async with open_database(settings) as database:
        await let_a_minute_pass(database)
    with cuttable(settings) as (own, outage):
        async with open_database(own) as database:
            sweeper = Sweeper(database, abandoned_s=60.0, clock=lambda: now)
            await sweeper.sweep()
            now = GRACE_S + 1
            with outage:
                assert await sweeper.sweep() == 0
                assert sweeper._reached_since is None
            await sweeper.sweep()
            assert sweeper._reached_since == now
            assert await sweeper.sweep() == 0
            now += GRACE_S
            assert await sweeper.sweep() == 1


async def test_a_stop_whose_answer_was_lost_is_answered_on_the_next_stream(settings) -> None:
    trial = str(uuid4())
    with serve(settings) as server:
        server.add_user()
        async with server.stream(query="?session=robot") as client:
            await begin(client, trial=trial)
            await show(client, range(45))
            told = await stop(client)
        for kind in ("trial.start", "trial.resume"):
            async with server.stream(query="?session=robot") as client:
                await client.send(type=kind, trial=trial)
                assert await client.expect("trial", "error") == told
                await client.send(type="trial.stop")
                assert await client.expect("trial", "error") == told
                again = await begin(client)
                assert (again["state"], again["trial"] != trial) == ("recording", True)
                await client.send(type="trial.cancel")
                cancelled = await expect_state(client, "cancelled")
        async with server.stream() as client:
            await client.send(type="trial.resume", trial=cancelled["trial"])
            assert await client.expect("trial", "error") == cancelled
    assert len(await list_jobs(settings)) == 1


async def test_a_start_is_repeated_by_a_stream_without_a_name_too(settings) -> None:
    trial = str(uuid4())
    with serve(settings) as server:
        server.add_user()
        async with server.stream() as client:
            await begin(client, trial=trial)
            await show(client, range(30))
            await expect_stored(client, 29)
            client.socket.transport.abort()
        async with server.stream() as client:
            told = await begin(client, trial=trial)
            assert (told["state"], told["stored_seq"]) == ("recording", 29)
            await show(client, range(30, 50))
            assert (await stop(client))["stored_seq"] == 49
