"""What the service does with one frame besides the nets, in microseconds of processor time.

Many streams in one process and one thread, without sockets and without waiting: bytes go in where
the event loop would hand them over, and come out where it would send them. The nets are computed,
so that they push everything else out of the cache as they do in a service, but do not count.

    python -m benchmarks.frames
    python -m benchmarks.frames --against ../other-checkout

With `--against` both are measured in turns, each time in a process of its own: the machine's speed
varies by more than what is to be seen. `--bare` leaves the nets out, so that nothing else is in the
cache.
"""

import argparse
import asyncio
import json
import logging
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import numpy as np
import uvicorn
import uvloop
from starlette.websockets import WebSocket
from uvicorn.server import ServerState
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from app.api.sockets import ClientSocket, StreamProtocol
from app.commands.bench.residents import vary
from app.commands.client.messages import Wire
from app.domain.body import measure_bones
from app.domain.limits import Limits
from app.domain.motion import VersionStamp
from app.domain.streams import OpenStream
from app.live.actions import Identity
from app.live.codec import Codec
from app.live.connection import Connection
from app.live.decoders import Decoders
from app.live.engine import Engine
from app.live.protocol import JSON, MSGPACK, StreamSettings
from app.live.session import Session
from app.live.steps import Outcome, Step
from app.live.work import Choice
from models.checkpoint import SHIPPED, Checkpoint, load_checkpoint
from models.data.synthetic import SyntheticPerson
from models.personal import PersonalDecoder
from models.runtime.fused import KERNEL
from models.runtime.served import serve
from models.skeleton import KINECT_V1

PARTS = ("frame", "engine", "answer")
WARM_UP = 45
_LIMITS = Limits(262_144, 1e6, 1e6, 64, 8, 600, 2**26, 500, 9000)
_SETTINGS = StreamSettings(forecast_every=1, coverage=0.9, version="active", max_age_ms=60_000)


class Outgoing(asyncio.Transport):
    """A connection whose client takes everything at once."""

    def __init__(self) -> None:
        super().__init__()
        self.last = b""

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.last = bytes(data)

    def is_closing(self) -> bool:
        return False

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass

    def close(self) -> None:
        pass


class Meter:
    """The kernel's function, with a clock on it."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.ns = 0
        self._function = function

    def __call__(self, *arguments: object) -> None:
        begin = time.thread_time_ns()
        self._function(*arguments)
        self.ns += time.thread_time_ns() - begin


def _stand_still(*arguments: Any) -> None:  # noqa: ANN401 - the kernel's
    """Forecast in no time that nobody moves."""
    for made, value in zip(arguments[-3:], (0.0, 1.0, 0.0), strict=True):
        made.fill(value)


class Person:
    """One stream: the frames of a synthetic person, and the service's end of their connection."""

    def __init__(
        self, number: int, engine: Engine, choice: Choice, *, form: str, count: int
    ) -> None:
        loop = asyncio.get_running_loop()
        self._engine, self._choice, self._form = engine, choice, form
        self.outgoing = Outgoing()
        self._task: asyncio.Task[None] | None = None
        config = uvicorn.Config(
            self._serve,
            interface="asgi3",
            log_config=None,
            proxy_headers=False,
            ws_per_message_deflate=False,
            ws_ping_interval=None,
        )
        config.load()
        self._protocol = StreamProtocol(config, ServerState(), {}, loop)
        self._protocol.connection_made(self.outgoing)
        self._frames = _write_frames(number, form=form, count=count)

    def open(self) -> None:
        """Shake hands; the stream has begun after some turns of the loop."""
        uri = parse_uri("ws://127.0.0.1/stream")
        client = ClientProtocol(uri, subprotocols=[Subprotocol(self._form)])
        client.send_request(client.connect())
        self._protocol.data_received(b"".join(client.data_to_send()))

    def send(self, frame: int) -> None:
        self._protocol.data_received(self._frames[frame])

    async def _serve(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401 - ASGI's own
        websocket = WebSocket(scope, receive, send)
        await websocket.accept(subprotocol=self._form)
        socket = ClientSocket(websocket, max_message_bytes=_LIMITS.max_message_bytes)
        codec = Codec(self._form, joints=len(KINECT_V1.joints))
        socket.use(codec)
        session = Session(
            Identity("ada", KINECT_V1, "y", False, "s", 1, False),  # noqa: FBT003
            settings=_SETTINGS,
            limits=_LIMITS,
            resolve=self._engine.decoders.resolve,
            engine_ms=lambda: 0.0,
            telemetry=self._engine.telemetry,
            now=time.monotonic(),
            active=self._choice,
        )
        stream = OpenStream(uuid4(), uuid4(), "s", 1)
        await Connection(socket, codec, session, self._engine, stream, archive=_store_nothing).run()


async def _store_nothing(step: Step) -> Outcome:
    raise NotImplementedError(step)


def _write_frames(number: int, *, form: str, count: int) -> list[bytes]:
    """Write what a client sends: masked WebSocket frames."""
    wire = Wire(form)
    poses = SyntheticPerson(number % 64).record("walk", count / 30)
    kind = Opcode.BINARY if wire.is_binary else Opcode.TEXT
    begin = 1000.0 + number / 7
    said = (wire.encode_frame(i, begin + i / 30, pose) for i, pose in enumerate(poses))
    whole = (one.encode() if isinstance(one, str) else one for one in said)
    return [Frame(kind, one).serialize(mask=True) for one in whole]


def _choose(base: Checkpoint, streams: int) -> list[Choice]:
    """Give everybody a decoder of their own, and the bones that it was made for."""
    choices = []
    for number, decoder in zip(range(streams), vary(base.predictor.decoder), strict=False):
        forecaster = serve(PersonalDecoder(base.predictor, decoder, None, {"radius_scale": 1.0}))
        bones = measure_bones(SyntheticPerson(number % 64).record("walk", 1.0).astype(np.float64))
        stamp = VersionStamp(number + 1, "personal", f"{number:064x}", share=1.0)
        choices.append(Choice(stamp, forecaster, bones=tuple(bones.tolist())))
    return choices


async def measure(
    *, streams: int, batch: int, ticks: int, form: str, bare: bool
) -> dict[str, float]:
    """Give the median of each part, microseconds per frame."""
    base = load_checkpoint(SHIPPED)
    decoders = Decoders(base.predictor, base_sha256=base.sha256, radius=base.radius)
    engine = Engine(decoders, batch=batch)
    choices = _choose(base, streams)
    count = WARM_UP + ticks
    people = [
        Person(number, engine, choice, form=form, count=count)
        for number, choice in enumerate(choices)
    ]
    for person in people:
        person.open()
    await asyncio.sleep(0.2)
    assert KERNEL is not None, "there is no kernel"
    meter = Meter(_stand_still if bare else KERNEL.forecast)
    cast("Any", KERNEL).forecast = meter
    rows = [await _tick(people, engine, meter, frame=frame, batch=batch) for frame in range(count)]
    assert all(b"frames" in person.outgoing.last for person in people), "not everybody was answered"
    parts = zip(*rows[WARM_UP:], strict=True)
    each = {
        part: statistics.median(ns) / streams / 1e3 for part, ns in zip(PARTS, parts, strict=True)
    }
    return each | {"all": sum(each.values())}


async def _tick(
    people: Sequence[Person], engine: Engine, meter: Meter, *, frame: int, batch: int
) -> list[int]:
    """Let everybody send a frame, some at a time; gives the nanoseconds of each part."""
    spent = [0, 0, 0]
    for first in range(0, len(people), batch):
        marks = [time.thread_time_ns()]
        for person in people[first : first + batch]:
            person.send(frame)
        marks.append(time.thread_time_ns())
        kernel = meter.ns
        jobs = engine._take() if engine._waiting else []  # noqa: SLF001 - its thread's own steps
        if jobs:
            engine._serve(jobs)  # noqa: SLF001
        marks.append(time.thread_time_ns())
        await asyncio.sleep(0)
        marks.append(time.thread_time_ns())
        for part in range(len(PARTS)):
            spent[part] += marks[part + 1] - marks[part]
        spent[1] -= meter.ns - kernel
    return spent


def compare(folders: Sequence[Path], arguments: argparse.Namespace) -> list[dict[str, float]]:
    """Measure checkouts in turns; gives the medians of each."""
    found: list[list[dict[str, float]]] = [[] for _ in folders]
    for _ in range(arguments.repeats):
        for rows, folder in zip(found, folders, strict=True):
            rows.append(_measure_apart(folder, arguments))
    return [
        {part: statistics.median(row[part] for row in rows) for part in (*PARTS, "all")}
        for rows in found
    ]


def _measure_apart(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    options = {name: getattr(arguments, name) for name in ("streams", "batch", "ticks", "form")}
    command = [sys.executable, "-P", __file__, "--once", *(["--bare"] if arguments.bare else [])]
    command += [word for name, value in options.items() for word in (f"--{name}", str(value))]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    row: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streams", type=int, default=64)
    parser.add_argument("--batch", type=int, default=4, help="frames that come together")
    parser.add_argument("--ticks", type=int, default=60, help="frames of each stream")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--form", choices=(MSGPACK, JSON), default=MSGPACK)
    parser.add_argument("--bare", action="store_true", help="without the nets")
    parser.add_argument("--against", type=Path, help="another checkout, with its kernel built")
    parser.add_argument("--once", action="store_true", help="one measurement, as JSON")
    arguments = parser.parse_args()
    if arguments.once:
        logging.disable()
        names = ("streams", "batch", "ticks", "form", "bare")
        options = {name: getattr(arguments, name) for name in names}
        print(json.dumps(uvloop.run(measure(**options))))
        return
    folders = [Path(__file__).parent.parent.resolve()]
    if arguments.against is not None:
        folders.insert(0, arguments.against.resolve())
    print(f"µs per frame, {arguments.streams} streams, load {os.getloadavg()[0]:.1f}")
    print(f"| checkout | {' | '.join((*PARTS, 'all'))} |\n|---|" + "---|" * (len(PARTS) + 1))
    for folder, row in zip(folders, compare(folders, arguments), strict=True):
        cells = " | ".join(f"{value:.1f}" for value in row.values())
        print(f"| {folder.name} | {cells} |")


if __name__ == "__main__":
    main()
