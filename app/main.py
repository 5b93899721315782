"""The application: its parts, put together once, and started and stopped in order."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path

import structlog
from fastapi import FastAPI

from app.api import (
    errors,
    export,
    forecast,
    health,
    jobs,
    keys,
    openapi,
    pages,
    reference,
    stream,
    trials,
    users,
    versions,
)
from app.api.middleware import BodyLimit, RequestLog
from app.domain.errors import StartError
from app.domain.limits import read_limits
from app.live.decoders import Decoders
from app.live.engine import Engine
from app.live.frames import WindowRules
from app.live.housekeeper import Housekeeper
from app.live.job_watch import JobWatch, listen_to, read_from
from app.live.library import Library
from app.live.registry import Registry
from app.live.sweeper import Sweeper
from app.live.telemetry import Telemetry
from app.live.witness import Witness
from app.settings import Settings
from app.storage.announcements import Topic
from app.storage.bootstrap import load_audit_key
from app.storage.database import Database
from app.storage.migrate import check_current
from app.storage.sessions import watch
from app.version import read_version
from app.worker.embedded import EmbeddedWorker
from models.checkpoint import SHIPPED, CheckpointError, load_checkpoint

DESCRIPTION = "Forecasts how a person will move in the next half second, and learns each person."
WARM_UP_S = 60.0
SMALL_BODY_BYTES = 16_384
"""Users and keys need no more; poses have a limit of their own."""
ROUTES = (
    users,
    export,
    keys,
    trials,
    versions,
    jobs,
    forecast,
    stream,
    reference,
    health,
    pages,
)

log = structlog.get_logger(__name__)


def create_app(
    settings: Settings, *, decoders: Decoders | None = None, worker: EmbeddedWorker | None = None
) -> FastAPI:
    """Put the service together; nothing is opened or started before its lifespan begins.

    Args:
        settings: what to serve, and how.
        decoders: the weights; by default those of the settings, or the shipped ones.
        worker: a fine-tuning worker to start and stop with the service, None for none.

    Raises:
        StartError: the weights cannot be loaded.
    """
    app = FastAPI(
        title="Kinecast",
        version=read_version(),
        description=DESCRIPTION,
        docs_url=None,  # the framework's page loads scripts from elsewhere; app.api.pages has ours
        redoc_url=None,
        redirect_slashes=False,
        lifespan=_live,
    )
    state = app.state
    state.settings = settings
    state.database = Database.from_settings(settings)
    state.decoders = decoders or load_decoders(settings.model)
    state.base_sha256 = state.decoders.base_sha256
    state.window_rules = WindowRules.from_settings(settings)
    state.telemetry = Telemetry()
    state.engine = Engine(
        state.decoders,
        telemetry=state.telemetry,
        rules=state.window_rules.guard,
        batch=settings.engine_batch,
        queue=settings.forecast_queue,
        threads=settings.engine_threads,
    )
    state.library = Library(state.database, state.decoders)
    state.registry = _make_registry(state.library, settings, state.telemetry)
    state.job_watch = _make_job_watch(state.registry, state.database, settings)
    state.sweeper = Sweeper(state.database, abandoned_s=settings.recording_abandoned_s)
    state.witness = Witness(state.database, state.registry.list_connections)
    state.housekeeper = _make_housekeeper(state.registry, state.database, settings)
    state.worker = worker
    state.draining = False
    state.viewer_code = None  # a OneTimeCode where a terminal shows one
    for part in ROUTES:
        app.include_router(part.router)
    errors.install(app)
    openapi.install(app)
    _add_middleware(app, settings)
    return app


def _make_registry(library: Library, settings: Settings, telemetry: Telemetry) -> Registry:
    return Registry(
        partial(watch, library.database),
        follow=library.follow,
        listen=lambda: library.database.announcements.listen(Topic.STREAMS).wait,
        limits=read_limits(settings),
        telemetry=telemetry,
        watch_s=settings.watch_s,
        unconfirmed_s=settings.version_unconfirmed_s,
        close_s=settings.version_unconfirmed_close_s,
    )


def _make_job_watch(registry: Registry, database: Database, settings: Settings) -> JobWatch:
    return JobWatch(
        read_from(database),
        registry.list_connections,
        listen=listen_to(database.announcements),
        every_s=settings.watch_s,
    )


def _make_housekeeper(registry: Registry, database: Database, settings: Settings) -> Housekeeper:
    return Housekeeper(
        database,
        lambda: [connection.stream for connection in registry.list_connections()],
        kept=timedelta(days=settings.history_kept_days),
    )


def load_decoders(path: Path | None) -> Decoders:
    """Load the base model.

    Args:
        path: a checkpoint, None for the one that is shipped.

    Raises:
        StartError: there is no file, or it is no checkpoint.
    """
    try:
        checkpoint = load_checkpoint(path or SHIPPED)
    except (OSError, CheckpointError) as error:
        raise StartError(f"The base model cannot be loaded: {error}.") from error
    return Decoders(checkpoint.predictor, base_sha256=checkpoint.sha256, radius=checkpoint.radius)


async def drain(app: FastAPI) -> None:
    """Leave politely: take no new work, and let open streams end."""
    app.state.draining = True
    log.info("draining")
    await app.state.registry.drain(app.state.settings.drain_s)


def _add_middleware(app: FastAPI, settings: Settings) -> None:
    forecast_bytes = forecast.forecast_body_limit(settings)

    def limit(path: str) -> int:
        if path.endswith("/trials"):
            return settings.trial_bytes
        return forecast_bytes if path.endswith("/forecast") else SMALL_BODY_BYTES

    app.add_middleware(BodyLimit, limit=limit)
    app.add_middleware(RequestLog)  # the last one added sees a request first


@asynccontextmanager
async def _live(app: FastAPI) -> AsyncIterator[None]:
    """Start the parts in order, and stop them the other way round."""
    state = app.state
    watches = (state.registry, state.job_watch, state.sweeper, state.witness, state.housekeeper)
    try:
        await check_current(state.database)
        state.audit_key = load_audit_key(state.settings)
        state.engine.start()
        try:
            await _warm_up(state.engine)
            state.database.announcements.start()
            for one in watches:
                one.start()
            if state.worker is not None:
                state.worker.start()
            log.info("started", base_sha256=state.base_sha256)
            yield
        finally:
            if state.worker is not None:
                await state.worker.stop()
            for one in watches:
                await one.stop()
            await asyncio.to_thread(state.engine.stop)
    finally:
        await state.database.close()
        log.info("stopped")


async def _warm_up(engine: Engine) -> None:
    """Wait until forecasts are fast; a net that cannot forecast at all is served by fallbacks."""
    if not await asyncio.to_thread(engine.wait_ready, WARM_UP_S):
        log.error("the engine does not get ready")
