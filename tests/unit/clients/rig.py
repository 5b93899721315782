"""A core of the Python client in the hands of a test, which is its network and its clock."""

from typing import Any

import msgspec
import numpy as np
from kinecast_client.clock import Moment
from kinecast_client.core import Core
from kinecast_client.events import Event
from kinecast_client.rules import Rules

JOINTS = ("head", "left_hand")
HORIZON = 15
VERSION = {"number": 0, "kind": "base", "sha256": "0" * 64, "requested": "active", "share": 0.0}
SETTINGS = {"forecast_every": 1, "coverage": 0.9, "version": "active", "max_age_ms": 200.0}
POSE = np.array([[0.0, 1.7, 2.0], [0.4, 1.0, 2.0]])


class Rig:
    """A core, and what the service would say to it."""

    def __init__(self, form: str = "json", *, rules: Rules | None = None, **options: Any) -> None:
        self.now, self.skew, self.epoch = 1000.0, 0.0, 0
        self.form = form
        self.core = Core(
            "ada",
            session="s",
            form=form,
            rules=rules,
            read_now=self.moment,
            draw=lambda: 1.0,
            **options,
        )

    def moment(self) -> Moment:
        return Moment(self.now, self.now + self.skew)

    def dial(self) -> None:
        self.core.dial(self.moment())
        self.core.connected(self.core.connection)

    def connect(self, **changes: Any) -> list[Event]:
        """Open a connection, as far as the hello lets it."""
        self.dial()
        self.epoch += 1
        return self.greet(**changes)

    def greet(self, **changes: Any) -> list[Event]:
        hello = {
            "protocol": 1,
            "features": [],
            "session": "s",
            "epoch": self.epoch,
            "user": "ada",
            "skeleton": "kinect_v1",
            "joints": list(JOINTS),
            "rate_hz": 30.0,
            "observe": 15,
            "horizon": HORIZON,
            "version": VERSION,
            "settings": SETTINGS,
            "limits": {"max_rate_hz": 120.0},
        }
        return self.hear("hello", **(hello | changes))

    def hear(self, kind: str, *, connection: int | None = None, **fields: Any) -> list[Event]:
        """Let the service say something."""
        return self.receive(self.write(kind, **fields), connection=connection)

    def receive(self, data: str | bytes, *, connection: int | None = None) -> list[Event]:
        number = self.core.connection if connection is None else connection
        return self.core.received(number, data, self.moment())

    def write(self, kind: str, **fields: Any) -> str | bytes:
        library = msgspec.msgpack if self.form == "msgpack" else msgspec.json
        data = library.encode({"type": kind, **fields})
        return data if self.form == "msgpack" else data.decode()

    def lose(self, code: int = 1006, reason: str = "cut") -> list[Event]:
        return self.core.lost(self.core.connection, code, reason, self.moment())

    def wait(self, seconds: float) -> None:
        """Let time pass, with the ticks that belong to it."""
        steps = max(1, round(seconds / 0.05))
        for _ in range(steps):
            self.now += seconds / steps
            self.core.tick(self.moment())

    def offer(self, t: float | None = None, joints: Any = POSE) -> int | None:
        return self.core.offer(joints, t, None, self.moment())

    def drain(self) -> list[dict[str, Any]]:
        """Everything that may be sent now."""
        library = msgspec.msgpack if self.form == "msgpack" else msgspec.json
        sent = []
        while (data := self.core.take(self.moment())) is not None:
            sent.append(library.decode(data))
        return sent

    def frames(self) -> list[dict[str, Any]]:
        """The frames among that."""
        return [message for message in self.drain() if message["type"] == "frame"]

    def stream(self, count: int = 1) -> list[int]:
        """Offer and send frames at 30 Hz; gives their numbers."""
        numbers = []
        for _ in range(count):
            self.now += 1 / 30
            numbers.append(self.offer())
            self.drain()
        return numbers

    def answer(self, seq: int | None, t: float | None = None, **changes: Any) -> list[Event]:
        """Let the service answer a frame; that of now if no time is given."""
        t = self.now + self.skew if t is None else t
        return self.hear("forecast", **(self.forecast(seq, t) | changes))

    def forecast(self, seq: int | None, t: float) -> dict[str, Any]:
        frames = np.tile(POSE, (HORIZON, 1, 1)).astype("<f4")
        times = t + np.arange(1, HORIZON + 1) / 30
        radius = np.full((HORIZON, len(JOINTS)), 0.05, "<f4")
        arrays = {"frames": frames, "t_out": times, "radius": radius}
        if self.form == "msgpack":
            arrays = {name: array.tobytes() for name, array in arrays.items()}
        else:
            arrays = {name: array.tolist() for name, array in arrays.items()}
        return {
            "seq": seq,
            "t": t,
            "age_ms": 2.0,
            **arrays,
            "coverage": 0.9,
            "version": VERSION,
            "quality": [],
            "severity": "info",
            "filled": [],
            "skipped": 0,
            "not_due": 0,
            "timing": {"queue_ms": 0.1, "compute_ms": 0.5, "total_ms": 0.6},
        }

    @property
    def latest(self) -> Any:
        return self.core.latest(self.moment())

    @property
    def statistics(self) -> Any:
        return self.core.sum_up()
