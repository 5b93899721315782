import pytest

from app.domain.motion import FLAGS
from app.main import drain
from models.skeleton import SKELETONS
from tests.support import make_settings, run_service

pytestmark = pytest.mark.asyncio


async def test_fresh_service_is_alive_and_ready(service):
    for path in ("/healthz", "/readyz"):
        assert (await service.call("GET", path, key=None)).status_code == 200


async def test_readiness_tells_how_hints_fare_and_does_not_depend_on_them(tmp_path, service):
    assert (await service.call("GET", "/readyz", key=None)).json()["hints"] == "off"
    lonely = make_settings(tmp_path / "lonely", redis_url="redis://127.0.0.1:1/0")
    async with run_service(lonely) as other:
        answer = await other.call("GET", "/readyz", key=None)
    assert (answer.status_code, answer.json()["hints"]) == (200, "away")


async def test_draining_service_is_alive_but_not_ready(service):
    await drain(service.app)
    assert (await service.call("GET", "/healthz", key=None)).status_code == 200
    answer = await service.call("GET", "/readyz", key=None)
    assert (answer.status_code, answer.json()["code"]) == (503, "draining")


async def test_service_whose_engine_stopped_is_not_ready(service):
    service.app.state.engine.stop()
    answer = await service.call("GET", "/readyz", key=None)
    assert (answer.status_code, answer.json()["code"]) == (503, "not_ready")


async def test_service_without_a_database_is_alive_but_not_ready(tmp_path):
    settings = make_settings(tmp_path / "data")
    async with run_service(settings) as service:
        await service.database.close()
        settings.data_dir.rename(tmp_path / "elsewhere")
        for path, status in (("/healthz", 200), ("/readyz", 503), ("/v1/users", 503)):
            assert (await service.call("GET", path)).status_code == status


async def test_metrics_are_prometheus_text(service):
    answer = await service.call("GET", "/metrics", key=None)
    assert answer.headers["content-type"].startswith("text/plain")
    assert "# TYPE kinecast_forecasts_total counter" in answer.text


async def test_reference_tells_what_a_client_must_know(service):
    limits = (await service.call("GET", "/v1/limits", key=None)).json()
    assert (limits["max_message_bytes"], limits["forecast_frames"]) == (262_144, 600)
    assert "forecast" in limits["features"]
    quality = (await service.call("GET", "/v1/quality", key=None)).json()["items"]
    assert [flag["name"] for flag in quality] == [flag.name for flag in FLAGS]
    formats = (await service.call("GET", "/v1/skeletons", key=None)).json()["items"]
    assert {one["name"] for one in formats} == set(SKELETONS)
    kinect = next(one for one in formats if one["name"] == "kinect_v1")
    assert kinect["joints"][0] == {"name": "head", "parent": 1, "forecast": "net"}
    assert [joint["parent"] for joint in kinect["joints"]].count(None) == 1


async def test_pages_link_on_and_load_nothing_from_elsewhere(service):
    home = await service.call("GET", "/", key=None)
    assert home.status_code == 200
    assert 'href="docs"' in home.text
    docs = await service.call("GET", "/docs", key=None)
    assert "POST /v1/users/{user}/forecast" in docs.text
    assert "<script" not in docs.text
    for page in (home, docs):
        assert "http://" not in page.text
        assert "https://" not in page.text
        assert page.headers["x-content-type-options"] == "nosniff"
