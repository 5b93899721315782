"""Every error, wherever it comes from, has one shape."""

import pytest
import pytest_asyncio
from fastapi import FastAPI
from httpx import ASGITransport, AsyncClient

from app.api import errors as edge
from app.domain import errors
from app.domain.errors import KinecastError
from tests.support import make_settings, run_service, watch_person

MEMBERS = {"type", "title", "status", "detail", "code"}


def every_error(root=KinecastError):
    yield root
    for child in root.__subclasses__():
        yield from every_error(child)


def make(kind):
    is_limit = issubclass(kind, errors.LimitExceededError)
    return kind("why", limit="clips") if is_limit else kind("why")


def assert_is_problem(answer, status, code):
    """The one assert: status, media type, members, and nothing of the inside."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert set(problem) - {"errors", "limit"} == MEMBERS
    assert (problem["status"], problem["code"]) == (status, code)
    assert problem["type"] == f"urn:kinecast:error:{code}"
    assert all(isinstance(problem[name], str) and problem[name] for name in MEMBERS - {"status"})
    assert ("errors" in problem) == (status == 422)
    for error in problem.get("errors", []):
        assert set(error) == {"loc", "msg"}
    assert ("www-authenticate" in answer.headers) == (status == 401)
    assert ("retry-after" in answer.headers) == (status in {429, 503})
    for word in ("Traceback", 'File "', ".py", "sqlalchemy", "0x"):
        assert word not in answer.text


@pytest.mark.asyncio
@pytest.mark.parametrize("kind", list(every_error()), ids=lambda kind: kind.code)
async def test_every_error_of_the_tree_is_a_problem(kind):
    app = FastAPI()
    edge.install(app)

    @app.get("/")
    async def fail():
        raise make(kind)

    async with AsyncClient(transport=ASGITransport(app), base_url="http://test") as client:
        answer = await client.get("/")
    assert_is_problem(answer, edge.find_answer(kind).status, kind.code)


def test_statuses_and_close_codes_are_those_of_the_contract():
    answers = {kind.code: edge.find_answer(kind) for kind in every_error()}
    close_codes = {
        "bad_message": 4400,
        "too_many_errors": 4400,
        "unauthorized": 4401,
        "forbidden": 4403,
        "unknown_user": 4404,
        "unsupported_subprotocol": 4406,
        "idle": 4408,
        "fenced": 4409,
        "user_deleted": 4410,
        "too_large": 4413,
        "too_fast": 4429,
        "draining": 1001,
        "internal_error": 1011,
    }
    assert {code: answers[code].close_code for code in close_codes} == close_codes
    not_fatal = [
        "bad_frame",
        "nan_in_json",
        "wrong_joint_count",
        "seq_not_increasing",
        "t_not_increasing",
        "stale_frame",
        "bad_configure",
        "unknown_version",
        "unknown_field",
    ]
    assert {answers[code].close_code for code in not_fatal} == {None}
    assert {answers[code].status for code in ("too_little_history", "limit_exceeded")} == {422}
    assert all(400 <= answer.status < 600 for answer in answers.values())


@pytest_asyncio.fixture
async def service(tmp_path):
    async with run_service(make_settings(tmp_path)) as running:
        await running.add_user()
        yield running


JSON = {"Content-Type": "application/json"}


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("method", "path", "request_", "status", "code"),
    [
        ("GET", "/nowhere", {}, 404, "not_found"),
        ("GET", "/v1/users/", {}, 404, "not_found"),
        ("PUT", "/v1/users", {}, 405, "method_not_allowed"),
        ("GET", "/v1/users/bob", {}, 404, "unknown_user"),
        ("GET", "/v1/users", {"key": None}, 401, "unauthorized"),
        ("GET", "/v1/users", {"key": "wrong"}, 401, "unauthorized"),
        ("POST", "/v1/users", {"json": {"id": "ada"}}, 409, "user_exists"),
        ("POST", "/v1/users", {"json": {"id": "!"}}, 422, "invalid_request"),
        ("POST", "/v1/users", {"json": {"id": "bob", "x": 1}}, 422, "unknown_field"),
        ("POST", "/v1/users", {"content": b"{", "headers": JSON}, 422, "invalid_request"),
        ("POST", "/v1/users", {"content": b"\xff", "headers": JSON}, 400, "bad_request"),
        ("POST", "/v1/users", {"content": b"id=ada"}, 415, "unsupported_media_type"),
        ("POST", "/v1/users", {"content": b"x" * 20_000}, 413, "too_large"),
        ("POST", "/v1/users/ada/forecast", {"json": {}}, 422, "invalid_request"),
        ("POST", "/v1/users/ada/forecast", {"content": b"["}, 415, "unsupported_media_type"),
        (
            "POST",
            "/v1/users/ada/forecast",
            {"content": b"[", "headers": JSON},
            400,
            "bad_message",
        ),
        ("DELETE", "/v1/admin/keys/x", {}, 422, "invalid_request"),
    ],
)
async def test_every_wrong_request_gets_a_problem(service, method, path, request_, status, code):
    assert_is_problem(await service.call(method, path, **request_), status, code)


@pytest.mark.asyncio
async def test_defect_gets_a_problem_and_tells_nothing(service, caplog):
    def fail(version):
        raise ZeroDivisionError("secret detail")

    service.app.state.decoders.resolve = fail
    answer = await service.call(
        "POST", "/v1/users/ada/forecast", json={"frames": watch_person().tolist()}
    )
    assert_is_problem(answer, 500, "internal_error")
    assert "secret detail" not in answer.text


def test_long_lists_of_errors_are_cut():
    fields = tuple(errors.FieldError(("body", i), "wrong") for i in range(1000))
    problem = edge.describe(errors.InvalidError("wrong", errors=fields))
    assert len(problem["errors"]) == edge.MAX_FIELD_ERRORS
