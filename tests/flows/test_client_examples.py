"""The examples of the Python client, run against a real server as their pages say."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from kinecast_client import Client
from kinecast_client.interop.tape_file import Frame, TapeReader
from kinecast_client.samples import waving_person

from tests.conftest import ROOT
from tests.contract.pages import read_blocks, read_page
from tests.live_support import serve
from tests.support import ADMIN_KEY, make_settings
from tests.unit.clients.examples import load_example

SECONDS = 2.0
EXAMPLES = ("planning", "play", "record", "rerun_view")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve(make_settings(tmp_path_factory.mktemp("service"))) as running:
        running.add_user("ada")
        yield running


@pytest.fixture(scope="module")
def tape(server, tmp_path_factory):
    path = tmp_path_factory.mktemp("tape") / "stream.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KEY", ADMIN_KEY)
        load_example("record").main(["--url", server.http, "--seconds", str(SECONDS), str(path)])
    return TapeReader(path)


@pytest.fixture
def key(monkeypatch):
    monkeypatch.setenv("KEY", ADMIN_KEY)


@pytest.mark.parametrize("name", [*EXAMPLES, "ros2_node"])
def test_every_example_explains_itself(name, capsys):
    example = load_example(name)
    with pytest.raises(SystemExit, match="0"):
        example.main(["--help"])
    assert "--url" in capsys.readouterr().out


def test_an_example_without_a_key_says_where_to_get_one(monkeypatch):
    for name in ("KEY", "KINECAST_KEY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SystemExit, match="quickstart"):
        load_example("planning").main(["--seconds", "1"])


def test_what_goes_wrong_is_told_in_a_line(server, key, tmp_path):
    common, record, play = map(load_example, ("common", "record", "play"))
    words = ["--url", server.http, "--user", "nobody", str(tmp_path / "a.mcap")]
    with pytest.raises(SystemExit, match=r"^unknown_user: There is no user nobody"):
        common.run(lambda: record.main(words))
    (tmp_path / "b.mcap").write_bytes(b"")
    with pytest.raises(SystemExit, match=r"b\.mcap is no recording"):
        play.main([str(tmp_path / "b.mcap")])
    with pytest.raises(SystemExit, match="No such file"):
        play.main([str(tmp_path / "c.mcap")])


def test_recording_has_every_frame_that_was_sent_and_the_forecasts_that_came(tape):
    frames, forecasts = list(tape.frames()), list(tape.forecasts())
    poses = waving_person(SECONDS)
    np.testing.assert_array_equal([frame.joints for frame in frames], poses)
    assert np.diff([frame.t for frame in frames]) == pytest.approx(1 / 30, abs=1e-6)
    assert 1 <= len(forecasts) <= len(poses) - 13
    times = {frame.seq: frame.t for frame in frames}
    assert all(forecast.t_observed == times[forecast.seq] for forecast in forecasts)


def test_recorded_forecasts_are_those_of_the_service(server, tape):
    frames = list(tape.frames())
    some = list(tape.forecasts())[-1]
    past = [frame for frame in frames if frame.t <= some.t_observed][-15:]
    with Client(server.http, ADMIN_KEY) as client:
        asked = client.forecast("ada", [one.joints for one in past], [one.t for one in past])
    assert some.frames == pytest.approx(asked.frames, abs=1e-4)


def test_playing_a_recording_gives_the_same_forecasts_at_the_same_pace(server, tape):
    play = load_example("play")
    with Client(server.http, ADMIN_KEY) as client:
        found = play.play(client, tape, "ada")
    assert found.sent == round(30 * SECONDS)
    assert found.compared >= 1
    assert found.apart_mm < 0.1


def test_play_keeps_the_pace_and_the_gaps_of_a_recording():
    play = load_example("play")
    frames = [Frame(5.0 + t, None) for t in (0.0, 0.05, 0.2)]
    given = [(t, time.monotonic()) for t, _ in play.at_their_pace(frames)]
    assert np.diff([t for t, _ in given]) == pytest.approx([0.05, 0.15], abs=1e-6)
    assert all(came >= t for t, came in given)


def test_planning_live_reaches_goals_with_forecasts_for_nearly_all_frames(server, key):
    planning = load_example("planning")
    robot = load_example("point_robot")
    source = load_example("common").pace(waving_person(4.0))
    with Client(server.http, ADMIN_KEY) as client, client.stream("ada") as stream:
        found = planning.work(source, stream, robot.Constants())
    assert found.goals >= 1
    assert found.closest_m > 0
    assert found.foreseen > 0


def test_planning_runs_blind_without_a_service(capsys):
    load_example("planning").main(["--blind", "--seconds", "1"])
    assert "closest" in capsys.readouterr().out


def test_poses_from_a_file_are_played_and_other_files_refused(tmp_path):
    common = load_example("common")
    parser = common.make_parser("")
    common.add_source(parser)
    np.save(tmp_path / "poses.npy", waving_person(0.5))
    options = parser.parse_args(["--frames", str(tmp_path / "poses.npy")])
    np.testing.assert_array_equal(common.read_poses(options), waving_person(0.5))
    np.save(tmp_path / "poses.npy", np.zeros((3, 20)))
    with pytest.raises(SystemExit, match="expected"):
        common.read_poses(options)


def test_bones_are_those_of_the_streams_joints(server):
    common = load_example("common")
    from kinecast_client.interop.body import KINECT_V1

    found = common.find_skeleton(server.http, KINECT_V1.joints)
    assert {frozenset(bone) for bone in found.bones} == {frozenset(b) for b in KINECT_V1.bones}
    with pytest.raises(LookupError):
        common.find_skeleton(server.http, ["tail"])


@pytest.mark.parametrize("block", read_blocks(read_page("docs/robots.md"), "python"))
def test_every_program_on_the_page_of_robots_runs(server, key, block, tmp_path):
    source = block.replace("127.0.0.1:8000", server.http.removeprefix("http://"))
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", source],
        cwd=tmp_path,
        env=dict(os.environ) | {"PYTHONPATH": str(ROOT / "clients/python/src")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout in {"30 frames\n", "5 markers\n", "25 markers\n"}


def test_rerun_gets_a_file_of_a_stream(server, key, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install rerun-sdk")
    path = tmp_path / "stream.rrd"
    example = load_example("rerun_view")
    example.main(["--url", server.http, "--seconds", "2", "--save", str(path)])
    assert path.stat().st_size > 10_000
