"""What can go wrong between a client and the service.

ClientError
├── UnreachableError   nobody answers there
├── SilenceError       the link is up, but nothing came or could be sent in time
├── ApiError           a request was answered with a problem
└── ClosedError        the stream ended
"""

FINAL_CLOSES = frozenset({4400, 4401, 4403, 4404, 4406, 4409, 4410, 4413})
"""Close codes after which coming back with the same request is no use."""


class ClientError(Exception):
    """Base of everything that this client raises."""


class UnreachableError(ClientError):
    """Nobody answers at the address."""


class SilenceError(ClientError):
    """Nothing came, or nothing could be sent, in time: the link is as good as dead."""


class ApiError(ClientError):
    """A request was answered with a problem.

    Attributes:
        status: of the HTTP response.
        code: the stable name of the error.
        detail: what was wrong.
    """

    def __init__(self, status: int, code: str, detail: str) -> None:
        super().__init__(f"{code}: {detail}")
        self.status, self.code, self.detail = status, code, detail


class ClosedError(ClientError):
    """The stream ended.

    Attributes:
        close_code: of the WebSocket; 1006 where the connection broke.
        code: the stable name of the error that ended it, or of the goodbye.
        retry_after_s: when the server wants the client back.
    """

    def __init__(
        self, close_code: int, *, code: str, message: str, retry_after_s: float = 0.0
    ) -> None:
        super().__init__(f"{code}: {message} (closed with {close_code})")
        self.close_code, self.code, self.retry_after_s = close_code, code, retry_after_s

    @property
    def is_final(self) -> bool:
        """Whether coming back with the same request is no use."""
        return self.close_code in FINAL_CLOSES
