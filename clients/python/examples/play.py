"""Play a recorded stream back through a service, at its own pace, and compare what comes.

  KEY=kc_... python play.py stream.mcap --user ada

Prints how far the new forecasts are from those that were recorded: 0.0 mm where the same weights
answer. Needs `pip install 'kinecast-client[mcap]'`.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import make_parser, read_key, run

from kinecast_client import Client
from kinecast_client.forecasts import Forecast
from kinecast_client.interop.tape_file import Frame, TapeError, TapeReader


@dataclass(frozen=True)
class Comparison:
    """What a playback came to.

    Attributes:
        sent: frames.
        came: forecasts.
        compared: how many of them were recorded as well.
        apart_mm: the largest distance of a joint between the two; None where none was compared.
    """

    sent: int
    came: int
    compared: int
    apart_mm: float | None


def at_their_pace(frames: Iterable[Frame]) -> Iterator[tuple[float, Frame]]:
    """Give frames when they are due, each with its time by `time.monotonic`."""
    start, first = time.monotonic(), None
    for frame in frames:
        first = frame.t if first is None else first
        due = start + frame.t - first
        time.sleep(max(0.0, due - time.monotonic()))
        yield due, frame


def play(client: Client, tape: TapeReader, user: str) -> Comparison:
    """Send what a tape holds, and hold the forecasts against those on it."""
    recorded = {forecast.t_observed: forecast for forecast in tape.forecasts()}
    times: dict[int, float] = {}
    came: list[Forecast] = []
    with client.stream(user) as stream:
        for t, frame in at_their_pace(tape.frames()):
            seq = stream.send(frame.joints, t, frame.confidence)
            if seq is not None:
                times[seq] = frame.t
            forecast = stream.wait(0.02)
            if forecast is not None:
                came.append(forecast)
    pairs = [(new, recorded.get(times.get(new.seq or 0, np.nan))) for new in came]
    gaps = [_find_gap(new, old) for new, old in pairs if old is not None]
    return Comparison(len(times), len(came), len(gaps), max(gaps) if gaps else None)


def _find_gap(one: Forecast, other: Forecast) -> float:
    return float(np.linalg.norm(one.frames - other.frames, axis=-1).max()) * 1e3


def main(arguments: Sequence[str] | None = None) -> None:
    """Play a file."""
    parser = make_parser(__doc__)
    parser.set_defaults(user=None)
    parser.add_argument("file", type=Path, help="as record.py wrote it")
    options = parser.parse_args(arguments)
    try:
        tape = TapeReader(options.file)
    except (TapeError, OSError) as error:
        raise SystemExit(str(error)) from None
    with Client(options.url, read_key()) as client:
        found = play(client, tape, options.user or tape.about.user)
    apart = "-" if found.apart_mm is None else f"{found.apart_mm:.1f} mm"
    print(f"{found.sent} frames, {found.came} forecasts, {found.compared} compared: {apart} apart")


if __name__ == "__main__":
    run(main)
