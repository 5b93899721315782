import httpx
import pytest

from app.api.middleware import BodyLimit


async def echo(scope, receive, send):
    """Answer with the length of the body, and with what the connection says afterwards."""
    body = b""
    while True:
        message = await receive()
        body += message["body"]
        if not message["more_body"]:
            break
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": str(len(body)).encode()})


async def post(**request):
    app = BodyLimit(echo, limit=lambda path: 10 if path == "/small" else 100)
    async with httpx.AsyncClient(
        transport=httpx.ASGITransport(app), base_url="http://test"
    ) as client:
        return await client.post(**request)


async def chunks(*parts):
    for part in parts:
        yield part


@pytest.mark.asyncio
@pytest.mark.parametrize(("size", "status"), [(0, 200), (10, 200), (11, 413)])
async def test_body_is_read_up_to_the_limit(size, status):
    answer = await post(url="/small", content=b"x" * size)
    assert answer.status_code == status
    if status == 200:
        assert answer.text == str(size)


@pytest.mark.asyncio
async def test_limit_depends_on_the_path():
    assert (await post(url="/large", content=b"x" * 11)).text == "11"


@pytest.mark.asyncio
async def test_body_without_a_length_is_counted():
    assert (await post(url="/small", content=chunks(b"123456", b"1234"))).text == "10"
    assert (await post(url="/small", content=chunks(b"123456", b"123456"))).status_code == 413


@pytest.mark.asyncio
async def test_refusal_is_a_problem_and_closes_the_connection():
    answer = await post(url="/small", content=b"x" * 11)
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["connection"] == "close"
    assert answer.json()["code"] == "too_large"


@pytest.mark.asyncio
async def test_length_that_is_no_number_is_refused():
    answer = await post(url="/small", content=b"x", headers={"content-length": "-1"})
    assert answer.status_code == 413
