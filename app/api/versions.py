"""Versions of a user's decoder: what there is, its weights, and which one is active."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Request, Response

from app.api.dependencies import (
    PAGE_SIZE,
    Admin,
    After,
    DatabaseNeeded,
    JsonBodyIfAny,
    PageSize,
    PathUser,
    Predictor,
)
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import ActivationIn, PageOut, VersionDetailOut, VersionOut
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import InvalidError
from app.domain.motion import VersionStamp
from app.domain.versions import BASE_NUMBER, ActiveVersion, Version
from app.storage import versions, weights

router = APIRouter(tags=["versions"])
PREDICT, ADMIN_ONLY = needs(Scope.PREDICT), needs(Scope.ADMIN)
Number = Annotated[int, Path(ge=0, le=2**31 - 1, description="Of the version; 0 is the base.")]
Activation = Annotated[ActivationIn, Body(default_factory=ActivationIn)]
"""No body is one without fields."""
WEIGHTS_TYPE = "application/octet-stream"


@router.get(
    "/v1/users/{user}/versions",
    summary="List versions",
    openapi_extra=PREDICT,
    responses=problems(*DENIED, errors.UnknownUserError, InvalidError),
)
async def list_versions(
    caller: Predictor,
    user: PathUser,
    database: DatabaseNeeded,
    after: After,
    limit: PageSize = PAGE_SIZE,
) -> PageOut[VersionDetailOut]:
    """List the personal versions of a user, newest first, with the judge's figures."""
    del caller
    async with database.read() as tx:
        page = await versions.list_page(tx, user.uuid, after=after, limit=limit)
    items = [_show(version) for version in page.items]
    return PageOut[VersionDetailOut](items=items, next_cursor=page.next_cursor)


@router.get(
    "/v1/users/{user}/versions/{number}",
    summary="Get a version",
    openapi_extra=PREDICT,
    responses=problems(*DENIED, errors.UnknownVersionError, InvalidError),
)
async def get_version(
    caller: Predictor, user: PathUser, number: Number, database: DatabaseNeeded
) -> VersionDetailOut:
    """Get one personal version; the base, number 0, is nobody's own."""
    del caller
    async with database.read() as tx:
        return _show(await versions.get(tx, user.uuid, number))


@router.get(
    "/v1/users/{user}/versions/{number}/weights",
    summary="Download weights",
    openapi_extra=ADMIN_ONLY,
    response_class=Response,
    responses={
        200: {
            "content": {WEIGHTS_TYPE: {"schema": {"type": "string", "format": "binary"}}},
            "description": "A safetensors file; its sha256 is the ETag.",
        },
        304: {"description": "You have it already."},
        **problems(
            *DENIED,
            errors.UnknownVersionError,
            errors.WeightsPurgedError,
            errors.WeightsDamagedError,
            InvalidError,
        ),
    },
)
async def get_weights(
    caller: Admin, user: PathUser, number: Number, database: DatabaseNeeded, request: Request
) -> Response:
    """Download the weights of a version as safetensors."""
    del caller
    async with database.read() as tx:
        if number == BASE_NUMBER:
            sha256: str = request.app.state.base_sha256
        else:
            version = await versions.get(tx, user.uuid, number)
            sha256 = version.sha256
            if version.purged:
                raise errors.WeightsPurgedError(f"The weights of version {number} were removed.")
        headers = {"ETag": f'"{sha256}"'}
        if _has_already(request, sha256):
            return Response(status_code=304, headers=headers)
        blob = await weights.get(tx, sha256)
    return Response(blob, media_type=WEIGHTS_TYPE, headers=headers)


def _has_already(request: Request, sha256: str) -> bool:
    """Tell whether the caller names these weights in `If-None-Match`."""
    given = request.headers.get("if-none-match", "").split(",")
    return not {f'"{sha256}"', "*"}.isdisjoint(tag.strip().removeprefix("W/") for tag in given)


@router.post(
    "/v1/admin/users/{user}/versions/{number}/promote",
    summary="Promote a version",
    dependencies=[JsonBodyIfAny],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED,
        errors.UnknownVersionError,
        errors.ActiveChangedError,
        errors.WeightsPurgedError,
        errors.UnsupportedMediaTypeError,
        InvalidError,
    ),
)
async def promote(
    body: Activation,
    caller: Admin,
    user: PathUser,
    number: Number,
    database: DatabaseNeeded,
    request: Request,
) -> VersionOut:
    """Let a version answer from now on, 0 for the base; nothing is promoted by itself any more."""
    base: str = request.app.state.base_sha256
    async with database.write() as tx:
        await versions.promote(
            tx,
            user.uuid,
            number,
            expected=body.active_sha256,
            base_sha256=base,
            actor=caller.key_id,
        )
        active = await versions.read_active_of(tx, user.uuid)
    return show_active(active, base)


@router.post(
    "/v1/admin/users/{user}/rollback",
    summary="Go back to the version before",
    dependencies=[JsonBodyIfAny],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED,
        errors.UnknownUserError,
        errors.ActiveChangedError,
        errors.UnsupportedMediaTypeError,
        InvalidError,
    ),
)
async def roll_back(
    body: Activation, caller: Admin, user: PathUser, database: DatabaseNeeded, request: Request
) -> VersionOut:
    """Go back to what was active before and was not itself rolled back, else to the base."""
    base: str = request.app.state.base_sha256
    async with database.write() as tx:
        await versions.roll_back(
            tx, user.uuid, expected=body.active_sha256, base_sha256=base, actor=caller.key_id
        )
        active = await versions.read_active_of(tx, user.uuid)
    return show_active(active, base)


def show_active(active: ActiveVersion, base_sha256: str) -> VersionOut:
    """Show what is active as `hello` names it: about no forecast, so a personal one in full."""
    is_base = active.sha256 is None
    stamp = VersionStamp(
        number=active.number,
        kind="base" if is_base else "personal",
        sha256=active.sha256 or base_sha256,
        share=0.0 if is_base else 1.0,
    )
    return VersionOut.model_validate(stamp)


def _show(version: Version) -> VersionDetailOut:
    return VersionDetailOut(
        number=version.number,
        state=version.state,
        parent=version.parent,
        base_sha256=version.base_sha256,
        sha256=version.sha256,
        bytes=version.size,
        purged=version.purged,
        trained_on=list(version.trained_on),
        metrics=version.metrics,
        job=version.job_id,
        created_at=version.created_at,
        activated_at=version.activated_at,
    )
