"""`/v1/admin/keys`: who may do what; `/v1/viewer/redeem`: the first key of all, for the viewer."""

from uuid import UUID

from fastapi import APIRouter, Request

from app.api.dependencies import PAGE_SIZE, Admin, After, DatabaseNeeded, JsonBody, PageSize
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import CodeIn, CodeOut, KeyIn, KeyOut, NewKeyOut, PageOut
from app.domain import errors
from app.domain.access import OneTimeCode, Scope
from app.domain.errors import InvalidError, UnauthorizedError
from app.storage import keys, users

router = APIRouter(tags=["keys"])
ADMIN_ONLY = needs(Scope.ADMIN)


@router.post(
    "/v1/admin/keys",
    status_code=201,
    summary="Make a key",
    dependencies=[JsonBody],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED, errors.UnknownUserError, errors.UnsupportedMediaTypeError, InvalidError
    ),
)
async def make_key(body: KeyIn, caller: Admin, database: DatabaseNeeded) -> NewKeyOut:
    """Make a key. The answer is the only place where it is ever shown."""
    async with database.write() as tx:
        user = None if body.user is None else await users.get(tx, body.user)
        made = await keys.create(
            tx,
            scopes=body.scopes,
            name=body.name,
            user_uuid=None if user is None else user.uuid,
            actor=caller.key_id,
        )
        stored = await keys.get(tx, made.id)
    return NewKeyOut(**KeyOut.model_validate(stored).model_dump(), key=made.text)


@router.get(
    "/v1/admin/keys",
    summary="List keys",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, InvalidError),
)
async def list_keys(
    caller: Admin, database: DatabaseNeeded, after: After, limit: PageSize = PAGE_SIZE
) -> PageOut[KeyOut]:
    """List the keys, newest first, the revoked ones too, without their secrets."""
    del caller
    async with database.read() as tx:
        page = await keys.list_page(tx, after=after, limit=limit)
    return PageOut[KeyOut].model_validate(page)


@router.delete(
    "/v1/admin/keys/{key}",
    status_code=204,
    summary="Revoke a key",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, errors.UnknownKeyError, InvalidError),
)
async def revoke_key(key: UUID, caller: Admin, database: DatabaseNeeded) -> None:
    """Revoke a key for good; its open streams close within 2 s."""
    async with database.write() as tx:
        await keys.revoke(tx, key, actor=caller.key_id)


@router.post(
    "/v1/viewer/redeem",
    summary="Exchange a one-time code",
    openapi_extra=needs(None),
    responses=problems(errors.UnauthorizedError, InvalidError),
)
async def redeem_code(body: CodeIn, request: Request) -> CodeOut:
    """Give the viewer its key for the code in the address that the terminal shows, once."""
    known: OneTimeCode | None = request.app.state.viewer_code
    key = None if known is None else known.redeem(body.code)
    if key is None:
        raise UnauthorizedError("This address was used before or is too old. Sign in with a key.")
    return CodeOut(key=key)
