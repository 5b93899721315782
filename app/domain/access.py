"""Who may do what: scopes, keys and the caller of a request.

A key reads ``kc_<id>_<secret>``: 32 hex digits name it, 43 characters (256 random bits) prove it.
Only the SHA-256 of the whole key is kept. A fast hash is enough for a secret that nobody can
guess, and a slow one would cost every request.
"""

import hashlib
import hmac
import re
import secrets
import string
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import NamedTuple
from uuid import UUID, uuid4

from app.domain.errors import ForbiddenError

BOOTSTRAP_KEY_ID = UUID(int=0)
"""Id of the admin key that comes from the settings; such a key may have any form."""
BOOTSTRAP_KEY_MIN_LENGTH = 32

_ALPHABET = string.ascii_letters + string.digits
_SECRET_LENGTH = 43
_CODE_BYTES = 24
CODE_LASTS_S = 900.0
"""How long the one-time code of the terminal can be used."""
_KEY_PATTERN = re.compile(rf"kc_([0-9a-f]{{32}})_[A-Za-z0-9]{{{_SECRET_LENGTH}}}")


class Scope(StrEnum):
    """What a key may do; ``admin`` includes the others."""

    PREDICT = "predict"
    RECORD = "record"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class Principal:
    """The caller of a request, as far as the service knows them: a key.

    Attributes:
        key_id: id of the key.
        scopes: what it may do.
        bound_user: id of the only user that it may touch, None for any.
    """

    key_id: UUID
    scopes: frozenset[Scope]
    bound_user: str | None = None

    @property
    def is_admin(self) -> bool:
        """Whether the key may do everything."""
        return Scope.ADMIN in self.scopes

    def has(self, scope: Scope) -> bool:
        """Tell whether the key may do what the scope names."""
        return self.is_admin or scope in self.scopes

    def check_scope(self, scope: Scope) -> None:
        """Refuse a caller without the scope.

        Raises:
            ForbiddenError: the key has other scopes.
        """
        if not self.has(scope):
            raise ForbiddenError(f"This needs a key with the scope {scope}.")

    def check_user(self, user_id: str) -> None:
        """Refuse a caller that is bound to another user, whether or not this one exists.

        Raises:
            ForbiddenError: the key is bound to somebody else.
        """
        if self.bound_user is not None and self.bound_user != user_id:
            raise ForbiddenError("This key is bound to another user.")


@dataclass(frozen=True, slots=True)
class ApiKey:
    """A stored key, without its secret.

    Attributes:
        id: what the key is called in lists and logs.
        name: free text of whoever made it.
        scopes: what it may do.
        user: id of the user that it is bound to, None for any.
        created_at: when it was made.
        revoked_at: when it stopped working, None while it works.
        last_used_at: when it was last seen, to the hour; None if never.
    """

    id: UUID
    name: str | None
    scopes: frozenset[Scope]
    user: str | None
    created_at: datetime
    revoked_at: datetime | None
    last_used_at: datetime | None

    @property
    def principal(self) -> Principal:
        """The caller that this key stands for."""
        return Principal(key_id=self.id, scopes=self.scopes, bound_user=self.user)


class NewKey(NamedTuple):
    """A key that was just made: the only moment at which its text is known."""

    id: UUID
    text: str


def make_key() -> NewKey:
    """Draw a new key."""
    key_id = uuid4()
    secret = "".join(secrets.choice(_ALPHABET) for _ in range(_SECRET_LENGTH))
    return NewKey(key_id, f"kc_{key_id.hex}_{secret}")


def find_key_id(text: str) -> UUID | None:
    """Read the id out of a key, None where it has another form."""
    match = _KEY_PATTERN.fullmatch(text)
    return UUID(match[1]) if match else None


def hash_key(text: str) -> bytes:
    """Give the SHA-256 under which a key is stored."""
    return hashlib.sha256(text.encode()).digest()


def matches_key(text: str, stored: bytes) -> bool:
    """Compare a key with a stored hash, in constant time."""
    return hmac.compare_digest(hash_key(text), stored)


class OneTimeCode:
    """Stands for a key in an address that a terminal shows, and can be exchanged for it once.

    So the key itself is in no address, no history and no log of a proxy.

    Args:
        key: what it is exchanged for.
        clock: seconds, ever growing.
    """

    def __init__(self, key: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.code = secrets.token_urlsafe(_CODE_BYTES)
        self._clock = clock
        self._until = clock() + CODE_LASTS_S
        self._key: str | None = key

    def redeem(self, code: str) -> str | None:
        """Give the key for the code; None where it is wrong, too old or was used."""
        if self._key is None or self._clock() > self._until:
            self._key = None
            return None
        if not hmac.compare_digest(code.encode(), self.code.encode()):
            return None
        key, self._key = self._key, None
        return key
