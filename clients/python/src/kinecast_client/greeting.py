"""Will this hello do? What the service says first decides whether anything else is believed."""

import math

from kinecast_client.errors import StoppedError, find_stop
from kinecast_client.messages import PROTOCOL, Hello

HORIZON_MOST = 10_000


def find_refusal(hello: Hello, joints: tuple[str, ...] | None) -> StoppedError | None:
    """Tell why no hello of this kind will ever do, None where it may."""
    if hello.protocol != PROTOCOL:
        detail = f"The service speaks protocol {hello.protocol}, this client {PROTOCOL}."
        return find_stop(4406)(4406, "unsupported_protocol", detail)
    if joints is not None and hello.joints != joints:
        return find_stop(4400)(4400, "layout_mismatch", "The user has another skeleton.")
    return None


def find_flaw(hello: Hello, *, user: str, session: str, last: Hello | None) -> str | None:
    """Tell why this hello will not do, though the next one may; None where it will.

    An epoch that is not above the last one is not of our newest connection. Every try raises it in
    the service, so a database that was restored from a backup catches up by itself.
    """
    if hello.user != user or hello.session != session:
        return "the hello is for another stream"
    if last is not None and hello.epoch <= last.epoch:
        return "the hello is of an old epoch"
    is_size = 1 <= hello.horizon <= HORIZON_MOST and hello.joints
    if not is_size or not 0 < hello.rate_hz < math.inf:
        return "the hello makes no sense"
    return None
