"""What routes ask for: the service's parts, the caller, the user of the path."""

from collections.abc import Mapping
from typing import Annotated

from fastapi import Depends, Path, Query, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection

from app.api.bodies import JSON_TYPE
from app.domain.access import Principal, Scope
from app.domain.errors import UnauthorizedError, UnsupportedMediaTypeError
from app.domain.pagination import DEFAULT_PAGE, MAX_PAGE, Cursor, decode_cursor
from app.domain.users import User
from app.settings import Settings
from app.storage import keys, users
from app.storage.database import Database

bearer_scheme = HTTPBearer(
    auto_error=False, scheme_name="ApiKey", description="An API key, `kc_…`."
)


def get_settings(connection: HTTPConnection) -> Settings:
    """Give the settings of the application that serves this request or socket."""
    settings = connection.app.state.settings
    if not isinstance(settings, Settings):
        raise TypeError("app.state.settings is not set")
    return settings


def get_database(connection: HTTPConnection) -> Database:
    """Give the database of the application that serves this request or socket."""
    database = connection.app.state.database
    if not isinstance(database, Database):
        raise TypeError("app.state.database is not set")
    return database


def read_bearer(headers: Mapping[str, str]) -> str | None:
    """Take the key out of an `Authorization: Bearer` header, None where there is none."""
    scheme, _, text = headers.get("authorization", "").partition(" ")
    return text.strip() or None if scheme.lower() == "bearer" else None


async def authenticate(database: Database, key: str | None) -> Principal:
    """Tell whose key this is; for requests and streams alike.

    Raises:
        UnauthorizedError: there is no key, or it is unknown or revoked.
        NotReadyError: the database cannot be reached.
    """
    if not key:
        raise UnauthorizedError("Send the header: Authorization: Bearer <key>")
    return (await keys.authenticate(database, key)).principal


async def _authenticate_request(
    request: Request,
    _: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer_scheme)],
) -> Principal:
    return await authenticate(get_database(request), read_bearer(request.headers))


class Require:
    """Dependency that lets only callers of a scope in, and tells who they are."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope

    async def __call__(
        self, caller: Annotated[Principal, Depends(_authenticate_request)]
    ) -> Principal:
        """Refuse a caller without the scope."""
        caller.check_scope(self.scope)
        return caller


async def _check_user(
    user: Annotated[str, Path(description="Id of the user.", examples=["ada"])],
    caller: Annotated[Principal, Depends(_authenticate_request)],
) -> str:
    """Refuse a caller that is bound to somebody else, before looking whether this one exists."""
    caller.check_user(user)
    return user


async def _find_user(user_id: Annotated[str, Depends(_check_user)], request: Request) -> User:
    async with get_database(request).read() as tx:
        return await users.get(tx, user_id)


async def _read_cursor(
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
) -> Cursor | None:
    return None if cursor is None else decode_cursor(cursor)


SettingsNeeded = Annotated[Settings, Depends(get_settings)]
DatabaseNeeded = Annotated[Database, Depends(get_database)]
Admin = Annotated[Principal, Depends(Require(Scope.ADMIN))]


async def _require_json(request: Request, caller: Admin) -> None:
    """Refuse other formats, but only to those who may send anything here."""
    del caller
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != JSON_TYPE:
        raise UnsupportedMediaTypeError(f"Send the body as {JSON_TYPE}.")


async def _require_json_if_any(request: Request, caller: Admin) -> None:
    """Refuse other formats where there is a body at all."""
    if await request.body():
        await _require_json(request, caller)


Recorder = Annotated[Principal, Depends(Require(Scope.RECORD))]
Predictor = Annotated[Principal, Depends(Require(Scope.PREDICT))]
UserId = Annotated[str, Depends(_check_user)]
PathUser = Annotated[User, Depends(_find_user)]
JsonBody = Depends(_require_json)
JsonBodyIfAny = Depends(_require_json_if_any)
After = Annotated[Cursor | None, Depends(_read_cursor)]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE, description="Items of a page.")]
PAGE_SIZE = DEFAULT_PAGE
