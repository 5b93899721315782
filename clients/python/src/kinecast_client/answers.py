"""Answers over HTTP: good ones become values, problems become exceptions."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from kinecast_client.errors import AnswerError, ApiError, find_api_error
from kinecast_client.forecasts import Forecast, Timing, Version, is_distance, read_severity

Answer = TypeVar("Answer")
Real = TypeVar("Real", np.float32, np.float64)
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


def follow(cursor: str | None, following: str | None) -> str | None:
    """Give where a list goes on, None where it ends.

    Raises:
        AnswerError: it goes on where it was.
    """
    if following is not None and following == cursor:
        raise AnswerError("The list goes round in a circle.")
    return following


def read_single_forecast(
    content: bytes, *, joints: int, t_observed: float, sent_at: float
) -> Forecast:
    """Read the answer to a forecast request that was sent at `sent_at` (monotonic, seconds).

    Raises:
        ValueError: it makes no sense.
    """
    answer = msgspec.msgpack.decode(content, type=_SingleForecast)
    frames, t = _read_array(answer.frames, np.float32), _read_array(answer.t, np.float64)
    radius = None if answer.radius is None else _read_array(answer.radius, np.float32)
    if frames.shape != (len(t), joints, 3) or not len(t):
        raise ValueError("the frames do not fit to their times or to the joints that were sent")
    if not np.isfinite(frames).all():
        raise ValueError("a coordinate is not finite")
    if not (t[0] > t_observed and (np.diff(t) > 0).all() and np.isfinite(t).all()):
        raise ValueError("the times are not those of what comes next")
    if radius is not None and (radius.shape != frames.shape[:2] or not is_distance(radius)):
        raise ValueError("the radius does not fit to the frames")
    if not 0 < answer.coverage < 1:
        raise ValueError("the coverage is no probability")
    return Forecast(
        frames=frames,
        t=t,
        radius=radius,
        coverage=answer.coverage,
        version=answer.version,
        quality=answer.quality,
        severity=read_severity(answer.severity),
        filled=answer.filled,
        timing=answer.timing,
        t_observed=t_observed,
        _age=lambda: time.monotonic() - sent_at,
    )


def _read_array(array: _Array, kind: type[Real]) -> npt.NDArray[Real]:
    if array.dtype not in _DTYPES:
        raise ValueError(f"an array of {array.dtype!r}")
    with np.errstate(all="ignore"):  # what is too large becomes infinite, which is looked for
        return np.frombuffer(array.data, array.dtype).reshape(array.shape).astype(kind)


def _read_problem(status: int, headers: Mapping[str, str], content: bytes) -> ApiError:
    problem: Any = None
    with suppress(msgspec.DecodeError, UnicodeError, RecursionError):
        problem = msgspec.json.decode(content)
    if not isinstance(problem, dict):
        problem = {}
    retry_after = headers.get("retry-after", "")
    is_seconds = retry_after.isascii() and retry_after.isdigit()
    given = problem.get("errors")
    errors = (
        [entry for entry in given if isinstance(entry, dict)] if isinstance(given, list) else []
    )
    return find_api_error(status)(
        status,
        str(problem.get("code", "http")),
        str(problem.get("detail", f"HTTP status {status}")),
        errors=tuple(errors),
        retry_after_s=float(retry_after) if is_seconds else None,
    )
