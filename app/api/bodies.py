"""Bodies with poses, in JSON or msgpack: decoded, checked, and explained where they are wrong."""

import json
from typing import Annotated, NoReturn

import msgspec
import numpy as np
from fastapi import Request
from jaxtyping import Float
from pydantic import BeforeValidator, InstanceOf, ValidationError, WithJsonSchema

from app.api.arrays import parse_confidence, parse_poses, parse_times
from app.api.errors import MAX_FIELD_ERRORS, explain_validation
from app.domain.errors import (
    BadFrameError,
    BadMessageError,
    FieldError,
    InvalidError,
    NanInJsonError,
)

JSON_TYPE = "application/json"
MSGPACK_TYPE = "application/msgpack"

_JOINT = {
    "anyOf": [
        {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
        {"type": "null"},
    ]
}
_POSES = {
    "type": "array",
    "items": {"anyOf": [{"type": "array", "items": _JOINT}, {"type": "null"}]},
}
_NUMBERS = {"type": "array", "items": {"type": "number"}}
_TABLE = {"type": "array", "items": _NUMBERS}
BINARY = {
    "type": "string",
    "format": "binary",
    "description": 'The same fields; an array is {"shape", "dtype": "<f4" or "<f8", "data"}.',
}
Array = InstanceOf[np.ndarray]
Poses = Annotated[Array, BeforeValidator(parse_poses), WithJsonSchema(_POSES)]
Times = Annotated[Array, BeforeValidator(parse_times), WithJsonSchema(_NUMBERS)]
Confidence = Annotated[Array, BeforeValidator(parse_confidence), WithJsonSchema(_TABLE)]


def decode_body(body: bytes, *, as_msgpack: bool) -> object:
    """Turn bytes into lists and numbers.

    Raises:
        NanInJsonError: NaN or Infinity in JSON.
        BadMessageError: no JSON or msgpack.
    """
    try:
        return msgspec.msgpack.decode(body) if as_msgpack else msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if not as_msgpack:
            _look_for_nan(body)
        name = "msgpack" if as_msgpack else "JSON"
        raise BadMessageError(f"The body is no {name}: {error}.") from None


def _look_for_nan(body: bytes) -> None:
    def refuse(name: str) -> NoReturn:
        raise NanInJsonError(f"{name} is no JSON: send null in place of a missing joint.")

    try:
        json.loads(body, parse_constant=refuse)
    except (ValueError, RecursionError):
        return


def explain_body(error: ValidationError, *, depth: int = 1) -> InvalidError:
    """Name the wrong places, down to the index within an array.

    Args:
        error: what Pydantic found.
        depth: how far below the body the fields with arrays are.
    """
    found = []
    for item in error.errors(include_url=False, include_input=False)[:MAX_FIELD_ERRORS]:
        context = item.get("ctx", {})
        place = context.get("at", ())
        # Pydantic names the branch of a union as well; clients know only fields
        loc = ("body", *item["loc"][:depth], *place)
        found.append({"type": item["type"], "loc": loc, "msg": context.get("msg", item["msg"])})
    return explain_validation(found)


def wants_msgpack(request: Request, media_type: str) -> bool:
    """Answer in the format that is asked for, else in that of the request."""
    accepted = request.headers.get("accept", "*/*").lower()
    if MSGPACK_TYPE in accepted:
        return True
    return media_type == MSGPACK_TYPE and JSON_TYPE not in accepted


def check_shapes(
    frames: Float[np.ndarray, "..."],
    t: Float[np.ndarray, "..."] | None,
    confidence: Float[np.ndarray, "..."] | None,
) -> None:
    """Refuse times or confidences of another length than the frames.

    Raises:
        BadFrameError: naming the field.
    """
    shape = frames.shape[:2]
    for name, array, needed in (
        ("t", t, shape[:1]),
        ("confidence", confidence, shape),
    ):
        if array is not None and array.shape != needed:
            given = " by ".join(str(n) for n in array.shape)
            message = f"{name} has {given} numbers, frames ask for {' by '.join(map(str, needed))}"
            raise BadFrameError(message, errors=(FieldError(("body", name), message),))
