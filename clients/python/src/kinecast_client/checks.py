"""Is what a caller asks for possible at all? Told at once, rather than by the service later."""

import math
import re
from uuid import UUID

from kinecast_client.messages import SUBPROTOCOLS, Settings

LABEL_MOST = 200
AGE_MOST_S = 60.0
FORECAST_EVERY_MOST = 600
_KEY = re.compile(r"[\x21-\x7e]+")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def check_key(key: str) -> str:
    """Give an API key back if it may be one.

    Raises:
        ValueError: it is empty, or has blanks or other characters that no key has.
    """
    if not isinstance(key, str) or not _KEY.fullmatch(key):
        raise ValueError("the key must be text without blanks, as `kinecast keys create` shows it")
    return key


def check_settings(settings: Settings) -> Settings:
    """Give settings back if a service may accept them.

    Raises:
        ValueError: naming what is wrong.
    """
    every, version = settings.forecast_every, settings.version
    if not _is_count(every, least=1) or every > FORECAST_EVERY_MOST:
        raise ValueError(f"forecast_every must be 1 to {FORECAST_EVERY_MOST}, got {every!r}")
    if not 0 < settings.coverage < 1:
        raise ValueError(f"coverage must be above 0 and below 1, got {settings.coverage!r}")
    if version not in ("active", "base") and not _is_count(version, least=0):
        raise ValueError(f"version must be 'active', 'base' or a number, got {version!r}")
    if not 0 < settings.max_age_ms <= AGE_MOST_S * 1e3:
        raise ValueError(f"max_age_s must be above 0 and at most {AGE_MOST_S:g}")
    return settings


def check_stream(user: str, *, hold_s: float, form: str, session: str | None) -> None:
    """Make sure that a stream can be opened like this.

    Raises:
        ValueError: naming what is wrong.
    """
    if not user or not _is_sendable(user):
        raise ValueError(f"{user!r} cannot be the id of a user")
    if not 0 < hold_s < math.inf:
        raise ValueError(f"hold_s must be above 0, got {hold_s!r}")
    if form not in SUBPROTOCOLS:
        raise ValueError(f"form must be one of {', '.join(SUBPROTOCOLS)}, got {form!r}")
    if session is not None and not re.fullmatch(r"[A-Za-z0-9._-]{1,64}", session):
        raise ValueError(f"session must be 1 to 64 of A-Z a-z 0-9 . _ -, got {session!r}")


def check_label(label: str | None) -> str | None:
    """Give a label or the name of an action back if it may be one.

    Raises:
        ValueError: it is empty, too long, or has control characters.
    """
    if label is None:
        return None
    is_short = 1 <= len(label) <= LABEL_MOST
    if not is_short or _CONTROL.search(label) or not _is_sendable(label):
        raise ValueError(
            f"a label has 1 to {LABEL_MOST} characters, none a control character or half of one"
        )
    return label


def check_trial(trial: str) -> str:
    """Give the id of a trial back as the service writes it.

    Raises:
        ValueError: it is no UUID.
    """
    return str(UUID(trial))


def _is_sendable(text: str) -> bool:
    """Whether UTF-8 has it: odd names of files may hold what is no character."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _is_count(value: object, *, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value < 2**31
