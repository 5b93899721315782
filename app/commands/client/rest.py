"""The routes over HTTP that the commands use."""

from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self

import httpx
import msgspec
import numpy as np
from jaxtyping import Float, Float32, Float64

from app.commands.client.errors import ApiError, SilenceError, UnreachableError
from app.commands.client.messages import Timing, Version
from app.commands.client.stream import is_loopback

WAIT_S = 10.0
_TYPES = {"json": "application/json", "msgpack": "application/msgpack"}
_DTYPES = ("<f4", "<f8")


@dataclass(frozen=True, slots=True, eq=False)
class SingleForecast:
    """The answer to one request; fields as in `messages.Forecast`."""

    frames: Float32[np.ndarray, "horizon joint 3"]
    t: Float64[np.ndarray, " horizon"]
    radius: Float32[np.ndarray, "horizon joint"] | None
    coverage: float
    version: Version
    quality: tuple[str, ...]
    severity: str
    filled: tuple[str, ...]
    timing: Timing


class Api:
    """An open connection to the service; use it as an async context.

    Args:
        url: of the service.
        key: the API key.
        wait_s: longest wait for an answer.
    """

    def __init__(self, url: str, *, key: str | None, wait_s: float = WAIT_S) -> None:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self.url = _to_http(url)
        self._client = httpx.AsyncClient(
            base_url=self.url,
            headers=headers,
            timeout=wait_s,
            trust_env=not is_loopback(self.url),
        )

    async def __aenter__(self) -> Self:
        """Open it."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        await self._client.aclose()

    async def is_ready(self) -> bool:
        """Whether the service can forecast now.

        Raises:
            UnreachableError: nobody answers there.
            SilenceError: no answer came in time.
        """
        return (await self._send("GET", "/readyz")).status_code == httpx.codes.OK

    async def add_user(self, user: str, **fields: object) -> bool:
        """Create a user; False if there is one of this id already.

        Raises:
            ApiError: the key may not, or the fields are wrong.
            UnreachableError: nobody answers there.
            SilenceError: no answer came in time.
        """
        response = await self._send("POST", "/v1/users", json={"id": user, **fields})
        if response.status_code == httpx.codes.CONFLICT:
            return False
        _check(response)
        return True

    async def delete_user(self, user: str) -> None:
        """Erase a user; raises as `add_user` does."""
        _check(await self._send("DELETE", f"/v1/users/{user}"))

    async def add_trial(
        self, user: str, content: bytes, *, media_type: str, token: str
    ) -> dict[str, Any]:
        """Upload a trial; the same token and content again store nothing. Raises as `add_user`."""
        headers = {
            "Content-Type": media_type,
            "Accept": "application/json",
            "Idempotency-Key": token,
        }
        response = await self._send(
            "POST", f"/v1/users/{user}/trials", content=content, headers=headers
        )
        _check(response)
        answer: dict[str, Any] = response.json()
        return answer

    async def promote(self, user: str, number: int) -> None:
        """Let a version of a user answer from now on. Raises as `add_user`."""
        path = f"/v1/admin/users/{user}/versions/{number}/promote"
        _check(await self._send("POST", path))

    async def get_job(self, job: str) -> dict[str, Any]:
        """Look how far a job is. Raises as `add_user`."""
        response = await self._send("GET", f"/v1/admin/jobs/{job}")
        _check(response)
        answer: dict[str, Any] = response.json()
        return answer

    async def forecast(
        self,
        user: str,
        frames: Float[np.ndarray, "time joint 3"],
        *,
        t: Float[np.ndarray, " time"] | None = None,
        form: Literal["json", "msgpack"] = "msgpack",
        **fields: object,
    ) -> SingleForecast:
        """Ask for one forecast; NaN where a joint is missing. Raises as `add_user` does."""
        body: dict[str, object] = {**fields, "frames": _write_poses(frames, form)}
        if t is not None:
            body["t"] = t.tolist()
        encode = msgspec.msgpack.encode if form == "msgpack" else msgspec.json.encode
        headers = {"Content-Type": _TYPES[form], "Accept": _TYPES[form]}
        response = await self._send(
            "POST", f"/v1/users/{user}/forecast", content=encode(body), headers=headers
        )
        _check(response)
        decode = msgspec.msgpack.decode if form == "msgpack" else msgspec.json.decode
        return _read_forecast(decode(response.content))

    async def _send(self, method: str, path: str, **options: Any) -> httpx.Response:  # noqa: ANN401 - httpx's own
        try:
            return await self._client.request(method, path, **options)
        except httpx.TimeoutException:
            raise SilenceError(f"{self.url} does not answer in time.") from None
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise UnreachableError(f"Nobody answers at {self.url}: {error}.") from error


def _to_http(url: str) -> str:
    base = url.rstrip("/")
    for scheme, plain in (("ws://", "http://"), ("wss://", "https://")):
        if base.startswith(scheme):
            base = plain + base.removeprefix(scheme)
    return base


def _check(response: httpx.Response) -> None:
    if response.is_success:
        return
    try:
        problem = response.json()
        raise ApiError(response.status_code, str(problem["code"]), str(problem["detail"]))
    except (ValueError, KeyError, TypeError):
        raise ApiError(response.status_code, "http", response.reason_phrase) from None


def _write_poses(frames: Float[np.ndarray, "time joint 3"], form: str) -> object:
    if form == "msgpack":
        return {"shape": list(frames.shape), "dtype": "<f4", "data": frames.astype("<f4").tobytes()}
    return [
        [None if np.isnan(joint).any() else joint.tolist() for joint in pose] for pose in frames
    ]


def _read_forecast(answer: dict[str, Any]) -> SingleForecast:
    radius = answer["radius"]
    return SingleForecast(
        frames=_read_array(answer["frames"]).astype(np.float32),
        t=_read_array(answer["t"]).astype(np.float64),
        radius=None if radius is None else _read_array(radius).astype(np.float32),
        coverage=answer["coverage"],
        version=msgspec.convert(answer["version"], Version),
        quality=tuple(answer["quality"]),
        severity=answer["severity"],
        filled=tuple(answer["filled"]),
        timing=msgspec.convert(answer["timing"], Timing),
    )


def _read_array(value: Any) -> Float[np.ndarray, "..."]:  # noqa: ANN401 - of either format
    if not isinstance(value, dict):
        return np.asarray(value, dtype=np.float64)
    if value["dtype"] not in _DTYPES:
        raise ValueError(f"an array of {value['dtype']!r}")
    return np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"])
