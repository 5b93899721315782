"""What the OpenAPI document says of errors and scopes."""

from typing import Any

from fastapi import FastAPI
from fastapi.encoders import jsonable_encoder

from app.api.errors import PROBLEM_TYPE, describe, find_answer
from app.api.schemas import Problem
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import KinecastError

Responses = dict[int | str, dict[str, Any]]

DENIED: tuple[type[KinecastError], ...] = (errors.UnauthorizedError, errors.ForbiddenError)
"""What every route that needs a key may answer."""


def problems(*kinds: type[KinecastError]) -> Responses:
    """Document the errors of a route, each with an example."""
    responses: Responses = {}
    every: tuple[type[KinecastError], ...] = (*kinds, errors.InternalError)
    for kind in every:
        response = responses.setdefault(
            find_answer(kind).status,
            {
                "model": Problem,
                "description": kind.title,
                "content": {PROBLEM_TYPE: {"examples": {}}},
            },
        )
        examples = response["content"][PROBLEM_TYPE]["examples"]
        examples[kind.code] = {"value": jsonable_encoder(describe(_example(kind)))}
    return responses


def install(app: FastAPI) -> None:
    """Make the application describe itself as it is, errors included."""
    describe_plainly = app.openapi

    def describe_with_problems() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _correct(describe_plainly())
        return app.openapi_schema

    app.openapi = describe_with_problems  # type: ignore[method-assign] # the documented way


def needs(scope: Scope | None) -> dict[str, Any]:
    """Name the scope that a route needs, as an extension of its description."""
    return {"x-scope": scope.value if scope else "none"}


def _correct(document: dict[str, Any]) -> dict[str, Any]:
    """Give errors their media type, and drop the ones that the framework only supposes."""
    for operations in document["paths"].values():
        for operation in operations.values():
            responses = operation["responses"]
            for status in [status for status in responses if int(status) >= 400]:
                content = responses[status]["content"]
                if PROBLEM_TYPE in content:
                    content[PROBLEM_TYPE] |= content.pop("application/json", {})
                else:
                    del responses[status]
    for name in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(name, None)
    return document


def _example(kind: type[KinecastError]) -> KinecastError:
    if issubclass(kind, errors.LimitExceededError):
        return kind("At most 600 frames.", limit="forecast_frames")
    return kind()
