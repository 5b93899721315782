"""What the first start of a database needs: an admin, and a secret for the audit log."""

import os
import secrets
from pathlib import Path

from app.domain.access import BOOTSTRAP_KEY_MIN_LENGTH, Scope
from app.domain.errors import StartError
from app.settings import Settings
from app.storage import keys
from app.storage.database import Database

ADMIN_KEY_FILE = "admin-key"
AUDIT_KEY_FILE = "audit-key"
_AUDIT_KEY_BYTES = 32


async def ensure_admin(
    database: Database, settings: Settings, *, keep_in: Path | None = None
) -> str | None:
    """See to it that somebody can administrate.

    The admin key of the settings works exactly as long as it is set. Where it is not, and no other
    admin key works, one is made.

    Args:
        database: with all its tables.
        settings: for their admin key.
        keep_in: file that gets a new key. It is written before the key becomes valid: a key that
            works and that nobody has would be the only one, for good.

    Returns:
        The text of the key that was made, to be shown once; None where none was needed.

    Raises:
        StartError: the admin key of the settings is too short to be a secret.
        OSError: the file cannot be written; then no key was made.
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
        if keep_in is not None:
            write_secret(keep_in, made.text)
        return made.text


def write_secret(path: Path, text: str) -> None:
    """Write a secret to a new file that only its owner can read, whole or not at all.

    Raises:
        OSError: it cannot be written; a file that was there before is untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        draft.touch(mode=0o600, exist_ok=False)
        with draft.open("w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    _sync_folder(path.parent)  # without it, a power cut may take the new name back


def read_secret(path: Path) -> str | None:
    """Read what `write_secret` wrote; None where there is no file, or an empty one.

    Raises:
        OSError: there is something else, or nothing that this process may read.
    """
    if not path.exists():
        return None
    return path.read_text(encoding="utf-8").strip() or None


def load_audit_key(settings: Settings) -> bytes:
    """Give the secret under which the audit log keeps the ids of erased users.

    It lies outside the database, so that a copy of the database alone cannot be searched for an id.

    Raises:
        OSError: the file that keeps it cannot be read or written.
    """
    if settings.audit_key is not None:
        return settings.audit_key.get_secret_value().encode()
    path = settings.data_dir / AUDIT_KEY_FILE
    kept = read_secret(path)
    if kept is not None:
        return kept.encode()
    made = secrets.token_hex(_AUDIT_KEY_BYTES)
    write_secret(path, made)
    return made.encode()


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
