"""Ray Serve as a peer: a process of its own, started by `benchmarks.peers.rows`.

The user's id comes in the header that Ray Serve routes by; poses are plain bytes both ways.
"""

import argparse
import os
import signal
import tempfile
import threading
from pathlib import Path

import ray
import torch
from ray import serve
from starlette.requests import Request
from starlette.responses import Response

from benchmarks.peers.people import forecast, from_bytes, load_decoder, to_bytes
from models.checkpoint import SHIPPED, load_checkpoint
from models.personal import PersonalDecoder

MOST_DECODERS = 1024
"""More than anybody measures: no decoder is loaded twice."""
MEMORY_BYTES = 256 * 2**20


class OwnDecoders:
    """Decoders by user id."""

    def __init__(self, folder: Path) -> None:
        torch.set_num_threads(1)
        self._folder, self._checkpoint = folder, load_checkpoint(SHIPPED)

    @serve.multiplexed(max_num_models_per_replica=MOST_DECODERS)  # type: ignore[untyped-decorator]
    async def find(self, user: str) -> PersonalDecoder:
        """Load a decoder the first time that it is asked for."""
        return load_decoder(self._checkpoint, self._folder / user)

    async def __call__(self, request: Request) -> Response:
        """Forecast by the person's own decoder."""
        decoder = await self.find(serve.get_multiplexed_model_id())
        frames = forecast(decoder, [from_bytes(await request.body())])[0]
        return Response(to_bytes(frames), media_type="application/octet-stream")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--users", type=int, required=True)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    ended = threading.Event()
    with tempfile.TemporaryDirectory(prefix="ray-") as folder:
        ray.init(
            address="local",
            num_cpus=max(given.workers, os.cpu_count() or 1),
            include_dashboard=False,
            object_store_memory=MEMORY_BYTES,
            log_to_driver=False,
            _node_ip_address="127.0.0.1",
            _temp_dir=folder,
        )
        for name in (signal.SIGTERM, signal.SIGINT):
            signal.signal(name, lambda *_: ended.set())
        try:
            serve.start(http_options={"host": "127.0.0.1", "port": given.port})
            deployment = serve.deployment(
                OwnDecoders, num_replicas=given.workers, max_ongoing_requests=given.users
            )
            serve.run(deployment.bind(given.folder))
            ended.wait()
        finally:
            serve.shutdown()
            ray.shutdown()


if __name__ == "__main__":
    main()
