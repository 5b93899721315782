"""Answers over HTTP: good ones become values, problems become exceptions."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
import numpy.typing as npt

from kinecast_client.errors import AnswerError, ApiError, find_api_error
from kinecast_client.forecasts import Forecast, Severity, Timing, Version

Answer = TypeVar("Answer")
_DTYPES = frozenset({"<f4", "<f8"})
LARGEST_ANSWER = 64 * 2**20
"""Bytes, unpacked; no answer of a service comes near it, so what is longer is none."""


class _Array(msgspec.Struct):
    shape: tuple[int, ...]
    dtype: str
    data: bytes


class _SingleForecast(msgspec.Struct):
    frames: _Array
    t: _Array
    radius: _Array | None
    coverage: float
    version: Version
    quality: tuple[str, ...]
    severity: str
    filled: tuple[str, ...]
    timing: Timing


class Content:
    """The body of an answer, as it comes in."""

    def __init__(self) -> None:
        self._parts = bytearray()

    def add(self, part: bytes) -> None:
        """Take the next part.

        Raises:
            AnswerError: it is more than a program should have to hold.
        """
        self._parts += part
        if len(self._parts) > LARGEST_ANSWER:
            raise AnswerError(f"The answer is longer than {LARGEST_ANSWER >> 20} MiB.")

    def __bytes__(self) -> bytes:
        """All of it."""
        return bytes(self._parts)


def read_answer(
    status: int, headers: Mapping[str, str], content: bytes, read: Callable[[bytes], Answer]
) -> Answer:
    """Read the answer to a request.

    Raises:
        ApiError: it is a problem.
        AnswerError: it makes no sense.
    """
    if not 200 <= status < 300:
        raise _read_problem(status, headers, content)
    try:
        return read(content)
    except (msgspec.DecodeError, UnicodeError, ValueError, RecursionError) as error:
        raise AnswerError(f"The answer cannot be read: {error}.") from error


def read_single_forecast(content: bytes, *, t_observed: float, sent_at: float) -> Forecast:
    """Read the answer to a forecast request that was sent at `sent_at` (monotonic, seconds).

    Raises:
        ValueError: it makes no sense.
    """
    answer = msgspec.msgpack.decode(content, type=_SingleForecast)
    frames, t = _read_array(answer.frames), _read_array(answer.t)
    if frames.ndim != 3 or frames.shape[2] != 3 or t.shape != frames.shape[:1]:
        raise ValueError("the frames do not fit to their times")
    if not (np.isfinite(frames).all() and np.isfinite(t).all()):
        raise ValueError("a coordinate is not finite")
    radius = None if answer.radius is None else _read_array(answer.radius).astype(np.float32)
    if radius is not None and radius.shape != frames.shape[:2]:
        raise ValueError("the radius does not fit to the frames")
    return Forecast(
        frames=frames.astype(np.float32),
        t=t.astype(np.float64),
        radius=radius,
        coverage=answer.coverage,
        version=answer.version,
        quality=answer.quality,
        severity=cast("Severity", answer.severity),
        filled=answer.filled,
        timing=answer.timing,
        t_observed=t_observed,
        _age=lambda: time.monotonic() - sent_at,
    )


def _read_array(array: _Array) -> npt.NDArray[Any]:
    if array.dtype not in _DTYPES:
        raise ValueError(f"an array of {array.dtype!r}")
    return np.frombuffer(array.data, array.dtype).reshape(array.shape)


def _read_problem(status: int, headers: Mapping[str, str], content: bytes) -> ApiError:
    problem: Any = None
    with suppress(msgspec.DecodeError, UnicodeError, RecursionError):
        problem = msgspec.json.decode(content)
    if not isinstance(problem, dict):
        problem = {}
    retry_after = headers.get("retry-after", "")
    given = problem.get("errors")
    errors = (
        [entry for entry in given if isinstance(entry, dict)] if isinstance(given, list) else []
    )
    return find_api_error(status)(
        status,
        str(problem.get("code", "http")),
        str(problem.get("detail", f"HTTP status {status}")),
        errors=tuple(errors),
        retry_after_s=float(retry_after) if retry_after.isdigit() else None,
    )
