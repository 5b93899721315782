"""LitServe as a peer: a process of its own, started by `benchmarks.peers.rows`.

Requests and answers are JSON with the poses' bytes in base64, which LitServe reads by itself and
which costs less than lists of numbers.
"""

import argparse
import base64
from collections.abc import Sequence
from pathlib import Path

import litserve
import torch

from benchmarks.peers.people import Poses, forecast, from_bytes, load_decoder, to_bytes
from models.checkpoint import SHIPPED, load_checkpoint

BATCH_WAIT_S = 0.005

Asked = tuple[str, Poses]


class OwnDecoders(litserve.LitAPI):  # type: ignore[misc]
    """A dictionary of decoders; one request after the other."""

    folder: Path

    def setup(self, device: str) -> None:
        """Load everybody's decoder."""
        del device
        torch.set_num_threads(1)
        self._checkpoint = load_checkpoint(SHIPPED)
        files = sorted(self.folder.iterdir())
        self._decoders = {file.name: load_decoder(self._checkpoint, file) for file in files}

    def decode_request(self, request: dict[str, str]) -> Asked:
        """Read who it is, and the window."""
        return request["user"], from_bytes(base64.b64decode(request["window"]))

    def predict(self, asked: Asked) -> Poses:
        """Forecast by the person's own decoder."""
        user, window = asked
        return forecast(self._decoders[user], [window])[0]

    def encode_response(self, output: Poses) -> dict[str, str]:
        """Write the forecast."""
        return {"frames": base64.b64encode(to_bytes(output)).decode()}


class OneDecoder(OwnDecoders):
    """The base for everybody, whose windows go through it together."""

    def predict(self, asked: Sequence[Asked]) -> Sequence[Poses]:  # type: ignore[override]
        """Forecast a batch."""
        return forecast(self._checkpoint.predictor, [window for _, window in asked])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--users", type=int, required=True)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--one", action="store_true", help="the base for everybody, in batches")
    given = parser.parse_args()
    if given.one:
        api = OneDecoder(max_batch_size=given.users, batch_timeout=BATCH_WAIT_S)
    else:
        api = OwnDecoders()
    api.folder = given.folder
    server = litserve.LitServer(
        api, accelerator="cpu", devices=1, workers_per_device=given.workers, timeout=False
    )
    server.run(host="127.0.0.1", port=given.port, log_level="warning", generate_client_file=False)


if __name__ == "__main__":
    main()
