"""A person's own version answers as soon as it is active, and says so."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
import torch
from sqlalchemy import update

from app.settings import Settings
from app.storage.database import Database
from app.storage.tables import WeightsRow
from models.baselines import Forecaster
from tests.live_support import BOTH, RealServer, StreamClient, serve
from tests.support import open_database, watch_person
from tests.versions import (
    BASE_SHA256,
    add_version,
    centre,
    forecast_offline,
    know,
    make_net,
    make_net_decoders,
    make_personal,
)

PERSON = watch_person(6.0)
BASE = make_net()
MINE, OTHER = make_personal(BASE, 1), make_personal(BASE, 2)


@pytest.fixture
def server(settings: Settings) -> Iterator[RealServer]:
    with serve(settings, make_net_decoders(BASE)) as running:
        running.add_user()
        yield running


class Watcher:
    """Shows a person at 30 Hz and keeps everything that the server says."""

    def __init__(self, client: StreamClient) -> None:
        self.client = client
        self.heard: list[dict[str, Any]] = []
        self.seq = 0

    async def show_for_ever(self) -> None:
        while self.seq < len(PERSON):
            await self.client.frame(self.seq, self.seq / 30, PERSON[self.seq])
            self.seq += 1
            await asyncio.sleep(1 / 30)

    async def listen(self, until: Any) -> dict[str, Any]:
        while True:
            message = await self.client.receive()
            self.heard.append(message)
            if until(message):
                return message

    async def hear_version(self) -> dict[str, Any]:
        return await self.listen(lambda message: message["type"] == "version")

    async def hear_forecasts(self, number: int) -> None:
        for _ in range(number):
            await self.listen(lambda message: message["type"] == "forecast")


@asynccontextmanager
async def watching(server: RealServer, **options: Any) -> AsyncIterator[Watcher]:
    async with server.stream(**options) as client:
        # a busy machine shows frames more slowly than their times say, and they seem to grow old
        await client.send(type="configure", max_age_ms=60_000)
        watcher = Watcher(client)
        task = asyncio.create_task(watcher.show_for_ever())
        yield watcher
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def decide(server: RealServer, what: str) -> None:
    answer = server.call("POST", f"/v1/admin/users/ada/{what}", json={})
    assert answer.status_code == 200, answer.text


def check_forecasts(heard: list[dict[str, Any]], known: dict[str, Forecaster]) -> None:
    """Every frame is accounted for, and every forecast is by the version that was announced."""
    announced = BASE_SHA256
    last_seq = 13
    for message in heard:
        if message["type"] == "version":
            announced = message["version"]["sha256"]
        assert message["type"] != "error", message
        if message["type"] != "forecast":
            continue
        seq = message["seq"]
        assert message["not_due"] == 0
        assert seq == last_seq + 1 + message["skipped"]
        last_seq = seq
        assert message["version"]["sha256"] == announced
        frames = np.asarray(message["frames"]).reshape(15, 20, 3)
        window = PERSON[seq - 14 : seq + 1]
        for sha256, forecaster in known.items():
            off = np.abs(forecast_offline(forecaster, window) - frames).max()
            assert (off < 1e-5) == (sha256 == announced), (seq, sha256, off)


@pytest.mark.asyncio
@pytest.mark.parametrize("subprotocol", BOTH)
async def test_versions_take_over_a_running_stream(server, settings, subprotocol) -> None:
    async with (
        open_database(settings) as database,
        watching(server, subprotocol=subprotocol) as watcher,
    ):
        await watcher.hear_forecasts(10)
        first = await add_version(database, "ada", MINE)
        told = [await watcher.hear_version()]
        await watcher.hear_forecasts(10)
        second = await add_version(database, "ada", OTHER)
        told.append(await watcher.hear_version())
        await watcher.hear_forecasts(5)
        await asyncio.to_thread(decide, server, "rollback")
        told.append(await watcher.hear_version())
        await watcher.hear_forecasts(5)
        await asyncio.to_thread(decide, server, "versions/0/promote")
        told.append(await watcher.hear_version())
        await watcher.hear_forecasts(10)
    assert [(m["version"]["number"], m["reason"]) for m in told] == [
        (1, "promoted"),
        (2, "promoted"),
        (1, "rolled_back"),
        (0, "by_hand"),
    ]
    known = {BASE_SHA256: BASE, first.sha256: MINE, second.sha256: OTHER}
    check_forecasts(watcher.heard, known)
    changes = [m for m in watcher.heard if "version_changed" in m.get("quality", ())]
    assert len(changes) == 4
    personal = next(m for m in changes if m["version"]["number"] == 1)
    assert personal["version"]["kind"] == "personal"
    assert personal["version"]["share"] == 1.0
    assert personal["radius"] is None
    assert "uncalibrated" in personal["quality"]


def ask(server: RealServer, version: Any = "active") -> dict[str, Any]:
    body = {"frames": PERSON[:15].tolist(), "version": version}
    return server.call("POST", "/v1/users/ada/forecast", json=body).json()


@pytest.mark.asyncio
async def test_single_requests_get_the_version_that_they_ask_for(server, settings) -> None:
    async with open_database(settings) as database:
        await add_version(database, "ada", MINE)
        await add_version(database, "ada", OTHER)
    expected = {"active": OTHER, 2: OTHER, 1: MINE, 0: BASE, "base": BASE}
    for requested, forecaster in expected.items():
        answer = await asyncio.to_thread(ask, server, requested)
        offline = forecast_offline(forecaster, PERSON[:15])
        np.testing.assert_allclose(answer["frames"], offline, atol=1e-5)
        assert answer["version"]["requested"] == requested
        assert (answer["version"]["kind"] == "personal") == (forecaster is not BASE)
    assert (await asyncio.to_thread(ask, server, 3))["code"] == "version_unavailable"


@pytest.mark.asyncio
async def test_a_stream_may_pin_a_version_that_is_not_active(server, settings) -> None:
    async with open_database(settings) as database:
        pinned = await add_version(database, "ada", MINE)
        await add_version(database, "ada", OTHER)
        async with server.stream(query="?version=1") as client:
            assert client.hello["version"]["sha256"] == pinned.sha256
            for seq in range(15):
                await client.frame(seq, seq / 30, PERSON[seq])
            forecast = await client.expect("forecast")
            np.testing.assert_allclose(
                forecast["frames"], forecast_offline(MINE, PERSON[:15]), atol=1e-5
            )
            await client.send(type="configure", version=2, max_age_ms=60_000.0)
            await client.expect("configured")
            await client.frame(15, 15 / 30, PERSON[15])
            assert (await client.expect("forecast"))["version"]["number"] == 2
            await client.send(type="configure", version=9)
            assert (await client.expect("error", "configured"))["code"] == "unknown_version"


async def damage(database: Database, sha256: str) -> None:
    async with database.write() as tx:
        rows = update(WeightsRow).where(WeightsRow.sha256 == sha256)
        await tx.execute(rows.values(blob=b"rotten"))


@pytest.mark.asyncio
async def test_damaged_weights_are_never_used(server, settings) -> None:
    async with open_database(settings) as database:
        version = await add_version(database, "ada", MINE, wins=False)
        await damage(database, version.sha256)
        async with watching(server) as watcher:
            await watcher.hear_forecasts(3)
            await asyncio.to_thread(decide, server, "versions/1/promote")
            told = await watcher.hear_version()
            forecast = await watcher.listen(lambda message: message["type"] == "forecast")
    assert (told["version"]["number"], told["reason"]) == (0, "weights_missing")
    assert forecast["version"]["fallback"] == "weights_missing"
    assert "fallback" in forecast["quality"]
    check_forecasts(watcher.heard, {BASE_SHA256: BASE})
    answer = await asyncio.to_thread(ask, server)
    assert answer["version"]["fallback"] == "weights_missing"
    np.testing.assert_allclose(answer["frames"], forecast_offline(BASE, PERSON[:15]), atol=1e-5)
    assert (await asyncio.to_thread(ask, server, 1))["code"] == "version_unavailable"


@pytest.mark.asyncio
async def test_behind_damaged_weights_the_version_before_answers(server, settings) -> None:
    async with open_database(settings) as database:
        first = await add_version(database, "ada", MINE)
        second = await add_version(database, "ada", OTHER)
        await damage(database, second.sha256)
    answer = await asyncio.to_thread(ask, server)
    stamp = answer["version"]
    assert (stamp["number"], stamp["sha256"]) == (1, first.sha256)
    assert (stamp["kind"], stamp["fallback"]) == ("personal", "previous_version")
    np.testing.assert_allclose(answer["frames"], forecast_offline(MINE, PERSON[:15]), atol=1e-5)
    assert answer["severity"] == "degraded"


@pytest.mark.asyncio
async def test_an_erased_person_leaves_no_decoder_behind(server, settings) -> None:
    async with open_database(settings) as database:
        await add_version(database, "ada", MINE)
    await asyncio.to_thread(ask, server)
    loaded = server.app.state.library.loaded
    assert len(loaded()) == 1
    await asyncio.to_thread(server.call, "DELETE", "/v1/users/ada")
    async with asyncio.timeout(2):
        while loaded():  # noqa: ASYNC110 - it waits for another thread
            await asyncio.sleep(0.05)


@pytest.mark.asyncio
async def test_behind_a_decoder_that_keeps_failing_the_version_before_answers(server, settings):
    wild = make_personal(BASE, 3, scale=1e4)
    async with open_database(settings) as database:
        first = await add_version(database, "ada", MINE)
        async with watching(server) as watcher:
            await watcher.hear_forecasts(2)
            second = await add_version(database, "ada", wild)
            await watcher.hear_version()
            after = len(watcher.heard)

            def comes_from_the_first(message: dict[str, Any]) -> bool:
                return message.get("version", {}).get("sha256") == first.sha256

            await watcher.listen(comes_from_the_first)
            await watcher.hear_forecasts(3)
    answers = [m for m in watcher.heard[after:] if m["type"] == "forecast"]
    assert not any(m["type"] in {"version", "error"} for m in watcher.heard[after:])
    told = [(m["version"]["number"], m["version"]["fallback"]) for m in answers]
    assert told == sorted(told)  # the base at once, and soon the version before
    assert set(told) == {(0, "guard"), (1, "previous_version")}
    assert all("fallback" in m["quality"] and m["severity"] == "degraded" for m in answers)
    assert answers[-1]["seq"] - answers[0]["seq"] < 60
    by_the_first = next(m for m in answers if m["version"]["number"] == 1)
    seq = by_the_first["seq"]
    np.testing.assert_allclose(
        by_the_first["frames"], forecast_offline(MINE, PERSON[seq - 14 : seq + 1]), atol=1e-5
    )
    assert server.metric("kinecast_decoder_trips_total") == 1
    answer = await asyncio.to_thread(ask, server)
    assert (answer["version"]["number"], answer["version"]["fallback"]) == (1, "previous_version")
    assert (await asyncio.to_thread(ask, server, 2))["code"] == "version_unavailable"
    assert second.number == 2


@pytest.mark.asyncio
async def test_every_answer_says_how_personal_it_is(server, settings) -> None:
    windows = np.stack([PERSON[i : i + 15] for i in range(0, 60, 5)])
    familiarity = know(BASE, windows, half=0.3, width=0.2)
    personal = make_personal(BASE, 4, familiarity=familiarity)
    async with open_database(settings) as database:
        await add_version(database, "ada", personal)
    shares = []
    for start in range(0, 160, 20):
        window = PERSON[start : start + 15]
        body = {"frames": window.tolist()}
        answer = await asyncio.to_thread(
            lambda body=body: server.call("POST", "/v1/users/ada/forecast", json=body).json()
        )
        share = answer["version"]["share"]
        shares.append(share)
        np.testing.assert_allclose(answer["frames"], forecast_offline(personal, window), atol=1e-5)
        with torch.inference_mode():
            expected = float(personal.share(BASE.encode(centre(window[None])).z)[0])
        assert share == pytest.approx(expected, abs=2e-4)
        assert answer["version"]["kind"] == "personal"
        assert ("blended" in answer["quality"]) == (0 < share < 1)
        assert ("unfamiliar" in answer["quality"]) == (share < 0.5)
    assert len(set(shares)) > 3


@pytest.mark.asyncio
async def test_a_decoder_that_fails_gives_way_to_the_base(server, settings) -> None:
    wild = make_personal(BASE, 3, scale=1e4)
    async with open_database(settings) as database:
        await add_version(database, "ada", wild)
    answer = await asyncio.to_thread(ask, server)
    assert (answer["version"]["kind"], answer["version"]["fallback"]) == ("base", "guard")
    np.testing.assert_allclose(answer["frames"], forecast_offline(BASE, PERSON[:15]), atol=1e-5)
    assert (await asyncio.to_thread(ask, server, 1))["code"] == "version_unavailable"
