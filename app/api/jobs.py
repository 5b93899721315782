"""Fine-tuning jobs: asked for, listed, watched, called off."""

from collections.abc import AsyncIterator
from time import monotonic
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import StreamingResponse

from app.api.dependencies import (
    PAGE_SIZE,
    Admin,
    After,
    DatabaseNeeded,
    JsonBody,
    PageSize,
    PathUser,
)
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import FinetuneIn, JobOut, PageOut
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import InvalidError, KinecastError
from app.domain.events import Action
from app.domain.jobs import JobState
from app.personalize.record import request_finetuning
from app.storage import audit, jobs
from app.storage.announcements import Topic
from app.storage.clock import read_clock
from app.storage.database import Database

router = APIRouter(tags=["jobs"])
ADMIN_ONLY = needs(Scope.ADMIN)
LOOK_EVERY_S = 0.5
KEEP_ALIVE_S = 15.0
EVENTS_TYPE = "text/event-stream"


@router.post(
    "/v1/admin/users/{user}/finetune",
    status_code=202,
    summary="Ask for fine-tuning",
    dependencies=[JsonBody],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED,
        errors.UnknownUserError,
        errors.UnknownTrialError,
        errors.JobQueuedError,
        errors.NothingToTrainOnError,
        errors.UnsupportedMediaTypeError,
        InvalidError,
    ),
)
async def finetune(
    body: FinetuneIn, caller: Admin, user: PathUser, database: DatabaseNeeded, response: Response
) -> JobOut:
    """Train on all stored trials, or on exactly the given ones; such a list is never merged."""
    async with database.write() as tx:
        job = await request_finetuning(tx, user, body.trials, requested_by=caller.key_id)
        audit.record(tx, Action.JOB_REQUESTED, actor=caller.key_id, user_uuid=user.uuid)
    response.headers["Location"] = f"/v1/admin/jobs/{job.id}"
    return JobOut.model_validate(job)


@router.get(
    "/v1/admin/jobs",
    summary="List jobs",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, InvalidError),
)
async def list_jobs(
    caller: Admin,
    database: DatabaseNeeded,
    after: After,
    user: Annotated[str | None, Query(description="Only of this user.")] = None,
    state: Annotated[JobState | None, Query(description="Only in this state.")] = None,
    limit: PageSize = PAGE_SIZE,
) -> PageOut[JobOut]:
    """List jobs, newest first."""
    del caller
    async with database.read() as tx:
        page = await jobs.list_page(tx, user=user, state=state, after=after, limit=limit)
    items = [JobOut.model_validate(job) for job in page.items]
    return PageOut[JobOut](items=items, next_cursor=page.next_cursor)


@router.get(
    "/v1/admin/jobs/{job}",
    summary="Get a job",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, errors.UnknownJobError, InvalidError),
)
async def get_job(caller: Admin, job: UUID, database: DatabaseNeeded) -> JobOut:
    """Get one job, with its progress."""
    del caller
    return await _get(database, job)


@router.post(
    "/v1/admin/jobs/{job}/cancel",
    summary="Cancel a job",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, errors.UnknownJobError, InvalidError),
)
async def cancel_job(caller: Admin, job: UUID, database: DatabaseNeeded) -> JobOut:
    """Call a job off; one that runs ends within a second, one that has ended stays as it is."""
    async with database.write() as tx:
        now = await read_clock(tx)
        return JobOut.model_validate(await jobs.cancel(tx, job, actor=caller.key_id, now=now))


@router.get(
    "/v1/admin/jobs/{job}/events",
    summary="Watch a job",
    openapi_extra=ADMIN_ONLY,
    response_class=StreamingResponse,
    responses={
        200: {
            "content": {EVENTS_TYPE: {"schema": {"type": "string"}}},
            "description": "Server-sent events `job` with the job as data, until it has ended.",
        },
        **problems(*DENIED, errors.UnknownJobError, InvalidError),
    },
)
async def watch_job(
    caller: Admin, job: UUID, database: DatabaseNeeded, request: Request
) -> StreamingResponse:
    """Tell every change of a job as a server-sent event, and close when it has ended."""
    del caller
    first = await _get(database, job)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(
        _tell(database, first, request), media_type=EVENTS_TYPE, headers=headers
    )


async def _get(database: Database, job: UUID) -> JobOut:
    async with database.read() as tx:
        return JobOut.model_validate(await jobs.get(tx, job))


async def _tell(database: Database, job: JobOut, request: Request) -> AsyncIterator[str]:
    """Write an event for each change, and a comment now and then so that nobody hangs up."""
    told: JobOut | None = None
    said_at, ear = monotonic(), database.announcements.listen(Topic.PROGRESS)
    while True:
        if job != told:
            yield f"event: job\ndata: {job.model_dump_json()}\n\n"
            told, said_at = job, monotonic()
        if job.state.is_final or request.app.state.draining:
            return
        await ear.wait(LOOK_EVERY_S)
        if monotonic() - said_at >= KEEP_ALIVE_S:
            yield ": still there\n\n"
            said_at = monotonic()
        try:
            job = await _get(database, job.id)
        except KinecastError:  # erased with its user, or no database: the client asks again
            return
