"""`/healthz`, `/readyz`, `/metrics`: for those who run the service."""

import asyncio

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST

from app.api.dependencies import DatabaseNeeded
from app.api.openapi import needs, problems
from app.api.schemas import HealthOut, ReadyOut
from app.domain import errors
from app.domain.errors import DrainingError, NotReadyError

router = APIRouter(tags=["health"])
OPEN = needs(None)
PING_TIMEOUT_S = 2.0


@router.head("/healthz", include_in_schema=False)
@router.get("/healthz", summary="Is the process alive?", openapi_extra=OPEN)
async def check_alive() -> HealthOut:
    """Answer as soon as the process can; touches nothing else, so an outage stays one outage."""
    return HealthOut(status="alive")


@router.head("/readyz", include_in_schema=False)
@router.get(
    "/readyz",
    summary="Can it forecast now?",
    openapi_extra=OPEN,
    responses=problems(errors.NotReadyError, errors.DrainingError),
)
async def check_ready(request: Request, database: DatabaseNeeded) -> ReadyOut:
    """Tell whether the model is warm, the database reachable, and the replica here to stay."""
    if request.app.state.draining:
        raise DrainingError
    if not request.app.state.engine.is_ready:
        raise NotReadyError("The model is not warm.")
    try:
        async with asyncio.timeout(PING_TIMEOUT_S):
            await database.ping()
    except TimeoutError:
        raise NotReadyError("The database does not answer.") from None
    return ReadyOut(status="ready", hints=database.announcements.state)


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    openapi_extra=OPEN,
    response_class=PlainTextResponse,
)
async def show_metrics(request: Request) -> Response:
    """Give every metric in the text format of Prometheus; none names a user."""
    return Response(request.app.state.telemetry.render(), media_type=CONTENT_TYPE_LATEST)
