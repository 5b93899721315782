"""The Python client against a real server."""

import time

import pytest
from kinecast_client import Client
from kinecast_client.samples import waving_person

from tests.live_support import serve
from tests.support import ADMIN_KEY, make_settings


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serve(make_settings(tmp_path_factory.mktemp("service"))) as running:
        running.add_user("ada")
        yield running


def test_a_stream_gives_forecasts_of_what_is_sent(server):
    with Client(server.http, ADMIN_KEY) as client, client.stream("ada") as stream:
        for pose in waving_person(seconds=1):
            seq = stream.send(pose)
            time.sleep(1 / 30)
        forecast = stream.latest()
    assert forecast is not None
    assert forecast.frames.shape == (15, 20, 3)
    assert forecast.seq == seq
