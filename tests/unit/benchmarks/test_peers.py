"""The side by side with other servers: its loop, its table, and what it does without them."""

import asyncio
import json
import os

import numpy as np
import pytest

from benchmarks.peers import report, rows
from benchmarks.peers.__main__ import main
from benchmarks.peers.clients import (
    HttpClient,
    PeerError,
    make_kinecast_form,
    make_litserve_form,
    make_ray_form,
)
from benchmarks.peers.effort import measure_effort
from benchmarks.peers.load import run_closed
from benchmarks.peers.people import from_bytes, invent_people, to_bytes
from benchmarks.peers.report import explain_missing, list_versions, summarise_runs, tabulate
from benchmarks.peers.rows import check, list_rows


def make_run(rate, p50, p99, count=10):
    return {
        "forecasts_per_s": rate,
        "latency_ms": {"p50": p50, "p99": p99, "count": count},
        "processor_ms": p50 and 2.0,
    }


def make_row(way, rate):
    runs = [make_run(rate, 5.0, 9.0), make_run(rate * 2, 6.0, 8.0), make_run(rate * 3, 7.0, 7.0)]
    return {"way": way, "people": 8, "clients": 8, **summarise_runs(runs)}


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    return invent_people(2, tmp_path_factory.mktemp("people"))


def test_runs_are_told_by_their_median_and_their_extremes():
    told = summarise_runs([make_run(10.0, 3.0, 9.0), make_run(30.0, 1.0, 7.0)])
    assert told["forecasts_per_s"] == {"median": 20.0, "lowest": 10.0, "highest": 30.0}
    assert told["p99_ms"] == {"median": 8.0, "lowest": 7.0, "highest": 9.0}


def test_runs_without_an_answer_have_no_latency():
    told = summarise_runs([make_run(0.0, None, None, count=0)])
    assert told["p50_ms"] is None
    row = {"way": "nothing", "people": 8, "clients": 8, **told}
    assert tabulate([row]).endswith("| 0.00 (0.00 to 0.00) |  |  |  |  |")


def test_table_holds_every_row_against_the_last_of_as_many_people():
    lines = tabulate([make_row("one", 10.0), make_row("two", 100.0)]).splitlines()
    assert lines[2].startswith("| 8 | 8 | one | 20.0 (10.0 to 30.0) | 6.00 (5.00 to 7.00) |")
    assert lines[2].endswith("| 10.0 |")
    assert lines[3].endswith("| 1.0 |")
    assert len({line.count("|") for line in lines}) == 1


def test_what_is_not_installed_is_said_with_how_to_install_it():
    assert explain_missing(None) is None
    assert explain_missing("numpy") is None
    told = explain_missing("no_such_package")
    assert told is not None
    assert "no_such_package is not installed" in told
    assert "'.[peers]'" in told
    assert list_versions(["numpy", "no_such_package"]) == {
        "numpy": np.__version__,
        "no_such_package": None,
    }


def test_without_the_peers_their_rows_are_left_out(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(report, "find_spec", lambda _: None)
    kept = [row for row in list_rows(1) if row.package or row.open is rows.open_eager]
    monkeypatch.setattr("benchmarks.peers.__main__.list_rows", lambda _: kept)
    file = tmp_path / "peers.json"
    length = ["--people", "2", "--seconds", "0.05", "--warm-up", "0", "--repeats", "2"]
    assert main([*length, "--json", str(file)]) == 0
    told = json.loads(file.read_text())
    assert [row["way"] for row in told["rows"]] == ["PyTorch in process, one after the other"]
    assert len(told["rows"][0]["runs"]) == 2
    assert told["rows"][0]["runs"][0]["processor_ms"] > 0
    assert len(told["left_out"]) == len(kept) - 1 == 3
    assert "Left out: Ray Serve" in capsys.readouterr().out


def test_effort_is_that_of_a_process_and_all_that_it_has_started(tmp_path):
    tick = os.sysconf("SC_CLK_TCK")
    for pid, parent, ticks in ((10, 1, 1), (20, 10, 2), (30, 20, 4), (40, 1, 64)):
        (tmp_path / str(pid)).mkdir()
        told = f"{pid} (a) b) S {parent} {'0 ' * 9}{ticks * tick} {tick} 0 {tick} 9 9"
        (tmp_path / str(pid) / "stat").write_text(told)
    assert measure_effort(10, tmp_path) == 1 + 2 + 4 + 3 * 2
    assert measure_effort(50, tmp_path) is None


def test_every_person_has_a_decoder_of_their_own(people):
    for one in people:
        assert one.window.shape == one.expected.shape == (15, 20, 3)
        assert np.array_equal(one.motion[:15], one.window)
        check(one.expected.copy(), one.expected)
        with pytest.raises(PeerError, match="mm off"):
            check(one.expected, one.expected_of_base)


def test_an_answer_of_another_shape_or_with_a_hole_is_no_forecast(people):
    expected = people[0].expected
    with pytest.raises(PeerError, match="instead of"):
        check(expected[:3], expected)
    with pytest.raises(PeerError, match="off"):
        check(np.full_like(expected, np.nan), expected)


def test_requests_carry_the_window_and_who_it_is(people):
    person = people[1]
    ray, litserve = make_ray_form().write(person), make_litserve_form().write(person)
    assert np.array_equal(from_bytes(ray.body), person.window)
    assert ray.headers["serve_multiplexed_model_id"] == "user-1"
    assert json.loads(litserve.body)["user"] == "user-1"
    assert make_kinecast_form("k").write(person).path == "/v1/users/user-1/forecast"


async def answer_with(content, person):
    """Ask a server that always gives the same answer."""

    async def serve(reader, writer):
        head = await reader.readuntil(b"\r\n\r\n")
        length = int(head.split(b"Content-Length: ")[1].split(b"\r\n")[0])
        await reader.readexactly(length)
        writer.write(content)
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        client = HttpClient(person, make_ray_form(), "127.0.0.1", reader, writer)
        try:
            return await client.ask()
        finally:
            writer.close()
            await writer.wait_closed()


@pytest.mark.asyncio
async def test_an_answer_is_read_to_its_end(people):
    body = to_bytes(people[0].expected)
    head = f"HTTP/1.1 200 OK\r\nserver: x\r\nContent-length: {len(body)}\r\n\r\n".encode()
    assert np.array_equal(await answer_with(head + body, people[0]), people[0].expected)


@pytest.mark.asyncio
async def test_a_refusal_says_what_the_server_said(people):
    refusal = b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 4\r\n\r\nbusy"
    with pytest.raises(PeerError, match=r"503 Service Unavailable.*busy"):
        await answer_with(refusal, people[0])


@pytest.mark.asyncio
async def test_a_closed_loop_asks_again_after_each_answer_and_ends_by_itself(people):
    asked = 0

    async def ask():
        nonlocal asked
        asked += 1
        await asyncio.sleep(0.01)
        return people[0].expected

    run = await run_closed([ask, ask], 0.2)
    told = run.as_json()
    assert 2 <= told["latency_ms"]["count"] <= asked <= 42
    assert told["latency_ms"]["p50"] >= 9.0
    assert told["forecasts_per_s"] == pytest.approx(told["latency_ms"]["count"] / 0.2, abs=0.1)
