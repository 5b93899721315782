"""What the first start of a database needs: an admin, and a secret for the audit log."""

import secrets
from contextlib import suppress
from pathlib import Path

from app.domain.access import BOOTSTRAP_KEY_MIN_LENGTH, Scope
from app.domain.errors import StartError
from app.settings import Settings
from app.storage import keys
from app.storage.database import Database

ADMIN_KEY_FILE = "admin-key"
AUDIT_KEY_FILE = "audit-key"
_AUDIT_KEY_BYTES = 32


async def ensure_admin(database: Database, settings: Settings) -> str | None:
    """See to it that somebody can administrate.

    The admin key of the settings works exactly as long as it is set. Where it is not, and no other
    admin key works, one is made.

    Returns:
        The text of the key that was made, to be shown once; None where none was needed.

    Raises:
        StartError: the admin key of the settings is too short to be a secret.
    """
    given = settings.admin_key.get_secret_value() if settings.admin_key else None
    if given is not None and len(given) < BOOTSTRAP_KEY_MIN_LENGTH:
        raise StartError(
            f"KINECAST_ADMIN_KEY must have at least {BOOTSTRAP_KEY_MIN_LENGTH} characters."
        )
    async with database.lock("kinecast.bootstrap") as tx:
        await keys.set_bootstrap(tx, given)
        await tx.flush()
        if await keys.count_admins(tx):
            return None
        made = await keys.create(
            tx, scopes=frozenset({Scope.ADMIN}), name="first start", user_uuid=None, actor=None
        )
        return made.text


def write_secret(path: Path, text: str) -> None:
    """Write a secret to a new file that only its owner can read."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.unlink(missing_ok=True)
    path.touch(mode=0o600, exist_ok=False)
    path.write_text(text + "\n", encoding="utf-8")


def load_audit_key(settings: Settings) -> bytes:
    """Give the secret under which the audit log keeps the ids of erased users.

    It lies outside the database, so that a copy of the database alone cannot be searched for an id.
    """
    if settings.audit_key is not None:
        return settings.audit_key.get_secret_value().encode()
    path = settings.data_dir / AUDIT_KEY_FILE
    with suppress(FileNotFoundError):
        return path.read_text(encoding="utf-8").strip().encode()
    made = secrets.token_hex(_AUDIT_KEY_BYTES)
    write_secret(path, made)
    return made.encode()
