"""`/v1/users`: who is known."""

from fastapi import APIRouter, Request, Response

from app.api.dependencies import (
    PAGE_SIZE,
    Admin,
    After,
    DatabaseNeeded,
    JsonBody,
    PageSize,
    UserId,
)
from app.api.export import show_plainly
from app.api.openapi import DENIED, needs, problems
from app.api.schemas import PageOut, UserIn, UserOut, UserPatch
from app.api.versions import show_active
from app.domain import errors
from app.domain.access import Scope
from app.domain.errors import InvalidError
from app.domain.users import User
from app.domain.versions import ActiveVersion
from app.storage import users, versions
from models.skeleton import SKELETONS

router = APIRouter(tags=["users"])
ADMIN_ONLY = needs(Scope.ADMIN)


@router.post(
    "/v1/users",
    status_code=201,
    summary="Add a user",
    dependencies=[JsonBody],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED, errors.UserExistsError, errors.UnsupportedMediaTypeError, InvalidError
    ),
)
async def add_user(
    body: UserIn, caller: Admin, database: DatabaseNeeded, request: Request, response: Response
) -> UserOut:
    """Add a person whose motion is to be forecast, with the format that their poses come in."""
    async with database.write() as tx:
        user = await users.create(
            tx,
            user_id=body.id,
            skeleton=body.skeleton,
            up=body.up,
            root_relative=body.root_relative or SKELETONS[body.skeleton].root_relative,
            display_name=body.display_name,
            actor=caller.key_id,
        )
    response.headers["Location"] = f"/v1/users/{user.id}"
    return _show(user, ActiveVersion(), request)


@router.get(
    "/v1/users",
    summary="List users",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, InvalidError),
)
async def list_users(
    caller: Admin,
    database: DatabaseNeeded,
    request: Request,
    after: After,
    limit: PageSize = PAGE_SIZE,
) -> PageOut[UserOut]:
    """List the users, newest first."""
    del caller
    async with database.read() as tx:
        page = await users.list_page(tx, after=after, limit=limit)
        active = await versions.read_active(tx, [user.uuid for user in page.items])
    base = ActiveVersion()
    shown = [_show(user, active.get(user.uuid, base), request) for user in page.items]
    return PageOut[UserOut](items=shown, next_cursor=page.next_cursor)


@router.get(
    "/v1/users/{user}",
    summary="Get a user",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, errors.UnknownUserError),
)
async def get_user(
    caller: Admin, user: UserId, database: DatabaseNeeded, request: Request
) -> UserOut:
    """Get one user, with the active version."""
    del caller
    async with database.read() as tx:
        found = await users.get(tx, user)
        active = await versions.read_active_of(tx, found.uuid)
    return _show(found, active, request)


@router.patch(
    "/v1/users/{user}",
    summary="Change a user",
    dependencies=[JsonBody],
    openapi_extra=ADMIN_ONLY,
    responses=problems(
        *DENIED, errors.UnknownUserError, errors.UnsupportedMediaTypeError, InvalidError
    ),
)
async def change_user(
    body: UserPatch, caller: Admin, user: UserId, database: DatabaseNeeded, request: Request
) -> UserOut:
    """Change what may change of a user; fields that are left out stay as they are."""
    async with database.write() as tx:
        changes = body.model_dump(exclude_unset=True)
        if changes:
            changed = await users.change(tx, user, changes, actor=caller.key_id)
        else:
            changed = await users.get(tx, user)
        active = await versions.read_active_of(tx, changed.uuid)
    return _show(changed, active, request)


@router.delete(
    "/v1/users/{user}",
    status_code=204,
    summary="Erase a user",
    openapi_extra=ADMIN_ONLY,
    responses=problems(*DENIED, errors.UnknownUserError),
)
async def erase_user(
    caller: Admin, user: UserId, database: DatabaseNeeded, request: Request
) -> None:
    """Erase a user and everything of theirs, in one transaction; open streams close in 2 s."""
    audit_key: bytes = request.app.state.audit_key
    async with database.write() as tx:
        await users.erase(tx, user, actor=caller.key_id, audit_key=audit_key)
    await database.forget_erased()


def _show(user: User, active: ActiveVersion, request: Request) -> UserOut:
    """Show a user with the active version: the base, as long as there is no personal one."""
    return UserOut(**show_plainly(user), version=show_active(active, request.app.state.base_sha256))
