"""Where the service is: addresses of HTTP and of streams."""

import ipaddress
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import quote, urlencode, urlsplit

_STREAMING = {"http": "ws", "https": "wss"}
_PLAIN = {"ws": "http", "wss": "https"}


def read_url(url: str) -> str:
    """Give the address of a service as http or https, without a slash at the end.

    Raises:
        ValueError: it is no address of a service.
    """
    base = url.strip().rstrip("/")
    scheme, colon, rest = base.partition("://")
    base = f"{_PLAIN.get(scheme.lower(), scheme.lower())}{colon}{rest}"
    if not base.startswith(("http://", "https://")) or not _has_host(base):
        raise ValueError(f"{url!r} is no address such as http://127.0.0.1:8000")
    return base


def _has_host(base: str) -> bool:
    try:
        parts = urlsplit(base)
        return bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:  # the port is none
        return False


def find_stream_url(base: str, user: str, query: Mapping[str, str | int | float]) -> str:
    """Give the WebSocket address of a user's stream; `base` as from `read_url`."""
    scheme, _, rest = base.partition("://")
    return f"{_STREAMING[scheme]}://{rest}/v1/users/{quote(user, safe='')}/stream?" + urlencode(
        query
    )


def is_loopback(base: str) -> bool:
    """Whether an address is on this machine, where no proxy can know it."""
    host = urlsplit(base).hostname or ""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"
