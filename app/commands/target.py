"""Which service a command talks to, and with which key."""

from pathlib import Path
from typing import NamedTuple

from app.commands.client.stream import is_loopback
from app.commands.output import fail
from app.settings import CLIENT_KEY_VARIABLE, Settings, load_settings, read_client_key
from app.storage.bootstrap import ADMIN_KEY_FILE


class Target(NamedTuple):
    """A service and the key for it."""

    url: str
    key: str


def find_target(*, url: str | None, key: str | None, data_dir: Path | None = None) -> Target:
    """Find the service and the key; says in one line what is missing, and exits.

    Args:
        url: of the service; by default the one that `kinecast serve` starts on this machine.
        key: the API key; by default that of the environment, else the admin key that a service
            started in the same folder has left there.
        data_dir: folder of that service.
    """
    settings = load_settings(data_dir=data_dir)
    address = url or f"http://{settings.host}:{settings.port}"
    if not address.startswith(("http://", "https://", "ws://", "wss://")):
        fail(f"{address} is no address: write http://HOST:PORT.", status=2)
    found = key or read_client_key()
    if found is None and is_loopback(address):  # a key of this machine goes nowhere else
        found = _read_admin_key(settings)
    if found is None:
        fail(
            f"There is no key: give --key or {CLIENT_KEY_VARIABLE}. `kinecast serve` shows the "
            "admin key at its first start; on the same machine this makes another: "
            'kinecast demo --key "$(kinecast keys create --scope admin)"',
            status=2,
        )
    return Target(address.rstrip("/"), found)


def _read_admin_key(settings: Settings) -> str | None:
    """Read the admin key of the settings, else the one that a first start has written to a file."""
    if settings.admin_key is not None:
        return settings.admin_key.get_secret_value()
    try:
        return (settings.data_dir / ADMIN_KEY_FILE).read_text(encoding="utf-8").strip()
    except OSError:
        return None
