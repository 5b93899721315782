"""`WS /v1/users/{user}/stream`: frames in, forecasts out.

The socket is accepted first and refused afterwards: browsers cannot see why a handshake failed.
"""

import asyncio
import time
from contextlib import suppress
from functools import partial
from typing import Annotated, Literal
from urllib.parse import parse_qsl
from uuid import uuid4

import msgspec
from fastapi import APIRouter
from msgspec import Meta, Struct
from starlette.datastructures import State
from starlette.websockets import WebSocket

from app.api.dependencies import authenticate, read_bearer
from app.api.recording import TrialArchive
from app.api.sockets import ClientSocket
from app.domain.access import Principal, Scope
from app.domain.errors import (
    BadConfigureError,
    InternalError,
    KinecastError,
    LayoutMismatchError,
    NotReadyError,
    UnauthorizedError,
    UnknownFieldError,
    UnsupportedSubprotocolError,
)
from app.domain.limits import read_limits
from app.domain.motion import RequestedVersion
from app.domain.streams import OpenStream
from app.domain.users import User
from app.live.actions import Identity
from app.live.codec import Codec
from app.live.connection import Connection, GoneError
from app.live.protocol import (
    JSON,
    SUBPROTOCOLS,
    Auth,
    Coverage,
    ForecastEvery,
    StreamSettings,
    VersionNumber,
)
from app.live.session import Session
from app.live.work import Choice
from app.storage import users
from app.storage.sessions import discard_session, open_session
from models.skeleton import SKELETONS, Skeleton

AUTH_TIMEOUT_S = 5.0
AUTH_MAX_BYTES = 1024

router = APIRouter()


class _Query(Struct, forbid_unknown_fields=True):
    """The parameters of the URL."""

    session: Annotated[str, Meta(pattern=r"^[A-Za-z0-9._-]{1,64}\Z")] | None = None
    layout: Annotated[str, Meta(pattern=r"^[0-9a-fA-F]{64}\Z")] | None = None
    version: VersionNumber | Literal["active", "base"] = "active"
    coverage: Coverage | None = None
    forecast_every: ForecastEvery = 1


@router.websocket("/v1/users/{user}/stream")
async def stream(websocket: WebSocket, user: str) -> None:
    """Serve one stream, from the handshake to its end."""
    state = websocket.app.state
    offered = websocket.scope["subprotocols"]
    chosen = next((name for name in SUBPROTOCOLS if name in offered), None)
    await websocket.accept(subprotocol=chosen)
    socket = ClientSocket(websocket, max_message_bytes=state.settings.max_message_bytes)
    codec = Codec(chosen or JSON, joints=0)
    socket.use(codec)
    try:
        if chosen is None:
            offer = ", ".join(SUBPROTOCOLS)
            raise UnsupportedSubprotocolError(f"Offer one of the subprotocols {offer}.")
        await _serve(websocket, socket, user, codec)
    except GoneError:
        pass
    except KinecastError as error:
        await socket.refuse(error, codec)
    finally:
        if socket.is_open:  # a defect; its details go to the log, where the server writes them
            await socket.refuse(InternalError(), codec)
        state.telemetry.count_close(socket.close_code)


async def _serve(websocket: WebSocket, socket: ClientSocket, user_id: str, codec: Codec) -> None:
    """Let a client in, and serve it.

    Raises:
        KinecastError: it is not let in, or something fails in the middle.
        GoneError: it left.
    """
    state = websocket.app.state
    state.registry.refuse_when_draining()
    caller = await _identify(websocket, socket, codec)
    caller.check_scope(Scope.PREDICT)
    caller.check_user(user_id)
    async with state.database.read() as tx:
        user = await users.get(tx, user_id)
    skeleton = SKELETONS[user.skeleton]
    query = _read_query(websocket, skeleton)
    active, pinned = await _choose(state, user, query.version)
    codec = Codec(codec.subprotocol, joints=len(skeleton.joints))
    with state.registry.take_seat(key_id=caller.key_id, user_uuid=user.uuid):
        opened = await _open(websocket, caller, user, query.session)
        try:
            may_record = caller.has(Scope.RECORD)
            session = _make_session(state, user, opened, query, active, may_record=may_record)
            if pinned is not None:
                session.weights.pin(pinned)
            fetch = partial(state.library.choose, user.uuid)
            archive = TrialArchive(state.database, user, opened)
            connection = Connection(
                socket, codec, session, state.engine, opened, archive=archive, fetch=fetch
            )
            with state.registry.keep(connection):
                await connection.run()
            await state.witness.note(connection)
        finally:
            if query.session is None:
                await _forget(websocket, opened)


async def _choose(
    state: State, user: User, requested: RequestedVersion
) -> tuple[Choice, Choice | None]:
    """Load what is active, and the pinned version if there is one.

    Raises:
        VersionUnavailableError: the pinned version cannot be used.
    """
    active = await state.library.choose(user.uuid, "active")
    if requested == "active":
        return active, None
    return active, await state.library.choose(user.uuid, requested)


def _make_session(
    state: State,
    user: User,
    opened: OpenStream,
    query: _Query,
    active: Choice,
    *,
    may_record: bool,
) -> Session:
    identity = Identity(
        user=user.id,
        skeleton=SKELETONS[user.skeleton],
        up=user.up,
        root_relative=user.root_relative,
        session=opened.session,
        epoch=opened.epoch,
        may_record=may_record,
    )
    settings = StreamSettings(
        forecast_every=query.forecast_every,
        coverage=state.settings.coverage if query.coverage is None else query.coverage,
        version=query.version,
        max_age_ms=state.settings.max_age_ms,
    )
    return Session(
        identity,
        settings=settings,
        limits=read_limits(state.settings),
        resolve=state.decoders.resolve,
        engine_ms=lambda: round(state.engine.latency_ms, 3),
        telemetry=state.telemetry,
        rules=state.window_rules,
        active=active,
        keep_s=state.settings.recording_keep_s,
        now=time.monotonic(),
    )


async def _identify(websocket: WebSocket, socket: ClientSocket, codec: Codec) -> Principal:
    """Find out whose key it is: in the header, else in the first message."""
    key = read_bearer(websocket.headers)
    if key is None:
        try:
            async with asyncio.timeout(AUTH_TIMEOUT_S):
                data = await socket.receive()
        except TimeoutError:
            raise UnauthorizedError(f"No key came within {AUTH_TIMEOUT_S:g} s.") from None
        message = codec.decode(data) if len(data) <= AUTH_MAX_BYTES else None
        if not isinstance(message, Auth):
            raise UnauthorizedError("Send the key in the header or in a first message `auth`.")
        key = message.key
    return await authenticate(websocket.app.state.database, key)


def _read_query(websocket: WebSocket, skeleton: Skeleton) -> _Query:
    """Read the parameters of the URL.

    Raises:
        UnknownFieldError: there is no such parameter.
        BadConfigureError: a value that makes no sense.
        LayoutMismatchError: the client means other joints.
    """
    given: dict[str, str | int] = dict(parse_qsl(websocket.url.query, keep_blank_values=True))
    version = str(given.get("version", ""))
    if version.isascii() and version.isdecimal():
        given["version"] = int(version)
    try:
        query = msgspec.convert(given, _Query, strict=False)
    except msgspec.ValidationError as error:
        kind = UnknownFieldError if "unknown field" in str(error) else BadConfigureError
        raise kind(f"URL: {error}.") from None
    if query.layout is not None and query.layout.lower() != skeleton.layout_sha256:
        raise LayoutMismatchError(f"The joints of {skeleton.name} have another layout.")
    return query


async def _open(
    websocket: WebSocket, caller: Principal, user: User, session: str | None
) -> OpenStream:
    """Take the session's name, or draw one; streams that had it before are fenced."""
    name = session or uuid4().hex
    epoch = await open_session(
        websocket.app.state.database,
        user_uuid=user.uuid,
        name=name,
        key_id=caller.key_id,
        is_admin=caller.is_admin,
    )
    return OpenStream(user_uuid=user.uuid, key_id=caller.key_id, session=name, epoch=epoch)


async def _forget(websocket: WebSocket, opened: OpenStream) -> None:
    """Drop a name that was drawn; nobody can come back to it."""
    with suppress(NotReadyError):
        await discard_session(
            websocket.app.state.database,
            user_uuid=opened.user_uuid,
            name=opened.session,
            epoch=opened.epoch,
        )
