"""Record a stream: frames go to the service, and with what comes back into an MCAP file.

  KEY=kc_... python record.py --user ada stream.mcap

Open the file in Foxglove: the 3D panel shows `/observed` and `/forecast`. Play it back with
play.py. Needs `pip install 'kinecast-client[mcap]'`.
"""

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from common import Poses, add_source, find_skeleton, make_parser, pace, read_key, read_poses, run

from kinecast_client import Client, Stream
from kinecast_client.interop.tape_file import About, Frame, TapeWriter


def record(client: Client, about: About, source: Iterable[tuple[float, Poses]], path: Path) -> int:
    """Send frames, and write them and their forecasts; gives how many forecasts came.

    A forecast is written once the next frame is sent, so that the sender never waits for one.
    """
    written = 0
    with client.stream(about.user) as stream, TapeWriter(path, about) as tape:
        for t, pose in source:
            seq = stream.send(pose, t)
            tape.write_frame(Frame(t, pose, None, seq))
            written += write_news(tape, stream, 0.0)
        written += write_news(tape, stream, 0.2)
    return written


def write_news(tape: TapeWriter, stream: Stream, timeout_s: float) -> int:
    """Write the newest forecast, if it is new; gives how many that were."""
    forecast = stream.wait(timeout_s)
    if forecast is not None:
        tape.write_forecast(forecast)
    return int(forecast is not None)


def find_about(client: Client, options: argparse.Namespace) -> About:
    """Ask the service what the user's joints are called."""
    with client.stream(options.user) as stream:
        joints = stream.joints
    return About(options.user, find_skeleton(options.url, joints), options.up)


def main(arguments: Sequence[str] | None = None) -> None:
    """Record for as long as there are frames, or until Ctrl+C."""
    parser = make_parser(__doc__)
    add_source(parser)
    parser.add_argument("--up", default="y", choices=["y", "-y", "z"], help="the user's")
    parser.add_argument("file", type=Path, help="to be written")
    options = parser.parse_args(arguments)
    with Client(options.url, read_key()) as client:
        about = find_about(client, options)
        count = record(client, about, pace(read_poses(options)), options.file)
    print(f"{options.file}: {count} forecasts")


if __name__ == "__main__":
    run(main)
