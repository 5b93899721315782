"""How a worker gets its rules from the settings, and its base into the database."""

import hashlib

import structlog

from app.domain.errors import StartError
from app.settings import Settings
from app.storage import jobs, weights
from app.storage.database import Database
from app.worker.loop import WorkerRules
from models.checkpoint import SHIPPED

REFITS_AT_A_TIME = 100

log = structlog.get_logger(__name__)


def read_base(settings: Settings) -> bytes:
    """Read the base model, as its file.

    Raises:
        StartError: it cannot be read.
    """
    try:
        return (settings.model or SHIPPED).read_bytes()
    except OSError as error:
        raise StartError(f"The base model cannot be loaded: {error}.") from error


def make_rules(settings: Settings, *, owner: str) -> WorkerRules:
    """Read the base model and the rules.

    Raises:
        StartError: the base model cannot be read.
    """
    base = read_base(settings)
    return WorkerRules(
        owner=owner,
        base=base,
        base_sha256=hashlib.sha256(base).hexdigest(),
        poll_s=settings.worker_poll_s,
        lease_s=settings.lease_s,
        heartbeat_s=settings.heartbeat_s,
        timeout_s=settings.finetune_timeout_s,
        threads=settings.finetune_threads,
        steps=settings.finetune_steps,
        nice=settings.finetune_nice,
        versions_kept=settings.versions_kept,
    )


async def store_base(database: Database, base: bytes) -> None:
    """Keep a base beside the versions that run on it, for as long as there may be one."""
    sha256 = hashlib.sha256(base).hexdigest()
    async with database.read() as tx:
        if await weights.has(tx, sha256):
            return
    async with database.write() as tx:
        await weights.put(tx, base, kind="base")


async def ask_for_refits(database: Database, base_sha256: str) -> int:
    """Ask for jobs for everybody whose active version runs on another base than this one.

    Every replica may: a user is asked for once.

    Returns:
        How many users that were.
    """
    async with database.write() as tx:
        await jobs.want_base(tx, base_sha256)
    total, count = 0, REFITS_AT_A_TIME
    while count == REFITS_AT_A_TIME:
        async with database.write() as tx:
            count = await jobs.enqueue_refits(tx, base_sha256, limit=REFITS_AT_A_TIME)
        total += count
    if total:
        log.info("a new base: versions are fitted again", base_sha256=base_sha256, users=total)
    return total
