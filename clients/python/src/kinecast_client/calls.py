"""Every request as a value: what is sent, and how the answer is read. Nothing is sent here."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import quote
from uuid import uuid4

import msgspec
import numpy as np
import numpy.typing as npt

from kinecast_client.answers import read_single_forecast
from kinecast_client.errors import FrameError
from kinecast_client.forecasts import Forecast, Version
from kinecast_client.frames import Array
from kinecast_client.values import (
    Clip,
    Job,
    Page,
    PersonalVersion,
    StoredTrial,
    Trial,
    User,
)

Answer = TypeVar("Answer")
JSON_TYPE, MSGPACK_TYPE = "application/json", "application/msgpack"


@dataclass(frozen=True, slots=True)
class Call(Generic[Answer]):
    """One request.

    Attributes:
        method: of HTTP.
        path: with everything quoted.
        read: turns the body of a good answer into a value.
        content: the body.
        files: to be uploaded as a form.
        fields: of that form.
        headers: beside the key.
        query: parameters of the URL; None are left out.
    """

    method: str
    path: str
    read: Callable[[bytes], Answer]
    content: bytes | None = None
    files: tuple[tuple[str, tuple[str, bytes]], ...] = ()
    fields: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    query: Mapping[str, str | int | None] = field(default_factory=dict)

    def to_httpx(self) -> dict[str, Any]:
        """Give it as arguments of `httpx.Client.stream`."""
        return {
            "method": self.method,
            "url": self.path,
            "content": self.content,
            "data": dict(self.fields) or None,
            "files": list(self.files) or None,
            "headers": dict(self.headers),
            "params": {name: value for name, value in self.query.items() if value is not None},
        }


def forecast(
    user: str,
    frames: Array,
    t: Array | None,
    *,
    confidence: Array | None,
    version: str | int,
    coverage: float,
) -> Call[Forecast]:
    """Ask for one forecast."""
    body: dict[str, object] = {"version": version, "coverage": coverage}
    body |= _write_clip(Clip(frames, t, confidence))
    joints = np.asarray(frames).shape[1]
    observed = 0.0 if t is None else float(np.asarray(t, np.float64)[-1])
    sent_at = time.monotonic()
    return Call(
        "POST",
        f"/v1/users/{_quote(user)}/forecast",
        lambda content: read_single_forecast(
            content, joints=joints, t_observed=observed, sent_at=sent_at
        ),
        content=msgspec.msgpack.encode(body),
        headers={"Content-Type": MSGPACK_TYPE, "Accept": MSGPACK_TYPE},
    )


def add_user(user: str, **fields: object) -> Call[User]:
    """Add a user."""
    return _send("POST", "/v1/users", User, {"id": user, **_drop_absent(fields)})


def get_user(user: str) -> Call[User]:
    """Get a user."""
    return _get(f"/v1/users/{_quote(user)}", User)


def list_users(limit: int, cursor: str | None) -> Call[Page[User]]:
    """List users."""
    return _list("/v1/users", Page[User], limit, cursor)


def update_user(user: str, **fields: object) -> Call[User]:
    """Change a user."""
    return _send("PATCH", f"/v1/users/{_quote(user)}", User, fields)


def delete_user(user: str) -> Call[None]:
    """Erase a user."""
    return Call("DELETE", f"/v1/users/{_quote(user)}", _read_nothing)


def upload_trial(
    user: str,
    clips: Iterable[Clip],
    *,
    label: str | None,
    finetune: bool,
    idempotency_key: str | None,
) -> Call[StoredTrial]:
    """Upload a trial as frames."""
    body = _drop_absent({"label": label}) | {"finetune": finetune}
    body["clips"] = [_write_clip(clip) for clip in clips]
    return Call(
        "POST",
        _find_trials(user),
        _reader(StoredTrial),
        content=msgspec.msgpack.encode(body),
        headers={
            "Content-Type": MSGPACK_TYPE,
            "Accept": JSON_TYPE,
            "Idempotency-Key": idempotency_key or str(uuid4()),
        },
    )


def upload_files(
    user: str, paths: Iterable[Path], *, label: str | None, finetune: bool
) -> Call[StoredTrial]:
    """Upload a trial as files."""
    files = tuple(("file", (path.name, path.read_bytes())) for path in paths)
    fields = {"finetune": "true" if finetune else "false"}
    if label is not None:
        fields["label"] = label
    return Call(
        "POST",
        _find_trials(user),
        _reader(StoredTrial),
        files=files,
        fields=fields,
        headers={"Accept": JSON_TYPE},
    )


def list_trials(user: str, limit: int, cursor: str | None) -> Call[Page[Trial]]:
    """List trials."""
    return _list(_find_trials(user), Page[Trial], limit, cursor)


def get_trial(user: str, trial: str) -> Call[Trial]:
    """Get a trial."""
    return _get(f"{_find_trials(user)}/{_quote(trial)}", Trial)


def delete_trial(user: str, trial: str) -> Call[None]:
    """Erase a trial."""
    return Call("DELETE", f"{_find_trials(user)}/{_quote(trial)}", _read_nothing)


def list_versions(user: str, limit: int, cursor: str | None) -> Call[Page[PersonalVersion]]:
    """List versions."""
    return _list(f"/v1/users/{_quote(user)}/versions", Page[PersonalVersion], limit, cursor)


def get_version(user: str, number: int) -> Call[PersonalVersion]:
    """Get a version."""
    return _get(f"/v1/users/{_quote(user)}/versions/{int(number)}", PersonalVersion)


def promote(user: str, number: int, active_sha256: str | None) -> Call[Version]:
    """Activate a version."""
    path = f"/v1/admin/users/{_quote(user)}/versions/{int(number)}/promote"
    return _send("POST", path, Version, _drop_absent({"active_sha256": active_sha256}))


def rollback(user: str, active_sha256: str | None) -> Call[Version]:
    """Go back to what was active before."""
    path = f"/v1/admin/users/{_quote(user)}/rollback"
    return _send("POST", path, Version, _drop_absent({"active_sha256": active_sha256}))


def start_job(user: str, trials: Iterable[str] | None) -> Call[Job]:
    """Ask for fine-tuning."""
    body = {"trials": None if trials is None else list(trials)}
    return _send("POST", f"/v1/admin/users/{_quote(user)}/finetune", Job, body)


def get_job(job: str) -> Call[Job]:
    """Get a job."""
    return _get(f"/v1/admin/jobs/{_quote(job)}", Job)


def list_jobs(
    user: str | None, state: str | None, limit: int, cursor: str | None
) -> Call[Page[Job]]:
    """List jobs."""
    query = {"user": user, "state": state, "limit": limit, "cursor": cursor}
    return Call("GET", "/v1/admin/jobs", _reader(Page[Job]), query=query)


def cancel_job(job: str) -> Call[Job]:
    """Call a job off."""
    return Call("POST", f"/v1/admin/jobs/{_quote(job)}/cancel", _reader(Job))


def _get(path: str, kind: type[Answer]) -> Call[Answer]:
    return Call("GET", path, _reader(kind))


def _list(path: str, kind: type[Answer], limit: int, cursor: str | None) -> Call[Answer]:
    return Call("GET", path, _reader(kind), query={"limit": limit, "cursor": cursor})


def _send(method: str, path: str, kind: type[Answer], body: Mapping[str, object]) -> Call[Answer]:
    content = msgspec.json.encode(body)
    return Call(method, path, _reader(kind), content=content, headers={"Content-Type": JSON_TYPE})


def _reader(kind: type[Answer]) -> Callable[[bytes], Answer]:
    return msgspec.json.Decoder(kind).decode


def _read_nothing(content: bytes) -> None:
    del content


def _find_trials(user: str) -> str:
    return f"/v1/users/{_quote(user)}/trials"


def _quote(part: str) -> str:
    quoted = quote(part, safe="")
    return quoted if quoted.strip(".") else "%2E" * len(part)


def _drop_absent(fields: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in fields.items() if value is not None}


def _write_clip(clip: Clip) -> dict[str, object]:
    frames = _read_floats(clip.frames, "frames", np.float32, 3)
    if frames.shape[2] != 3:
        raise FrameError(f"frames must have the shape [T, J, 3], got {list(frames.shape)}.")
    written: dict[str, object] = {"frames": _write_array(frames)}
    if clip.t is not None:
        written["t"] = _write_array(_read_floats(clip.t, "t", np.float64, 1))
    if clip.confidence is not None:
        confidence = _read_floats(clip.confidence, "confidence", np.float32, 2)
        written["confidence"] = _write_array(confidence)
    if clip.action is not None:
        written["action"] = clip.action
    return written


def _read_floats(value: Array, name: str, dtype: Any, ndim: int) -> npt.NDArray[Any]:  # noqa: ANN401 - numpy's
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise FrameError(f"{name} must be numbers: {error}.") from None
    if array.ndim != ndim or array.size == 0:
        raise FrameError(f"{name} must have {ndim} axes, got the shape {list(array.shape)}.")
    return array


def _write_array(array: npt.NDArray[Any]) -> dict[str, object]:
    dtype = array.dtype.newbyteorder("<")
    data = array.astype(dtype).tobytes()
    return {"shape": list(array.shape), "dtype": dtype.str, "data": data}
