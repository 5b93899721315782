"""How a worker gets its rules from the settings."""

import hashlib

from app.domain.errors import StartError
from app.settings import Settings
from app.storage import weights
from app.storage.database import Database
from app.worker.loop import WorkerRules
from models.checkpoint import SHIPPED


def make_rules(settings: Settings, *, owner: str) -> WorkerRules:
    """Read the base model and the rules.

    Raises:
        StartError: the base model cannot be read.
    """
    try:
        base = (settings.model or SHIPPED).read_bytes()
    except OSError as error:
        raise StartError(f"The base model cannot be loaded: {error}.") from error
    return WorkerRules(
        owner=owner,
        base=base,
        base_sha256=hashlib.sha256(base).hexdigest(),
        poll_s=settings.worker_poll_s,
        lease_s=settings.lease_s,
        heartbeat_s=settings.heartbeat_s,
        timeout_s=settings.finetune_timeout_s,
        threads=settings.finetune_threads,
        nice=settings.finetune_nice,
        versions_kept=settings.versions_kept,
    )


async def store_base(database: Database, rules: WorkerRules) -> None:
    """Keep the base beside the versions that run on it."""
    async with database.write() as tx:
        if not await weights.has(tx, rules.base_sha256):
            await weights.put(tx, rules.base, kind="base")
