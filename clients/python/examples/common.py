"""What the examples share: which service, which person, and frames where there is no sensor."""

import argparse
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import httpx
import numpy as np
from numpy.typing import NDArray

from kinecast_client import KinecastError
from kinecast_client.interop.body import Skeleton
from kinecast_client.samples import waving_person

Poses = NDArray[np.floating]


def run(main: Callable[[], None]) -> None:
    """Run an example: what can go wrong is told in a line, and Ctrl+C ends it.

    Raises:
        SystemExit: something went wrong.
    """
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except (KinecastError, httpx.HTTPError, LookupError) as error:
        raise SystemExit(str(error)) from None


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Make a parser with the options that every example has; the key is read from `KEY`."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--url", default="http://127.0.0.1:8000", help="of the service")
    parser.add_argument("--user", default="ada", help="whose motion")
    return parser


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the option that says where frames come from."""
    parser.add_argument(
        "--frames",
        type=Path,
        metavar="FILE",
        help="poses at 30 Hz, [frame, joint, xyz] in metres, as .npy; a waving person if absent",
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="of the waving person")


def read_key() -> str:
    """Give the API key.

    Raises:
        SystemExit: there is none.
    """
    key = os.environ.get("KEY") or os.environ.get("KINECAST_KEY")
    if not key:
        raise SystemExit("Put a key with the scope predict into KEY: see docs/quickstart.md.")
    return key


def read_poses(options: argparse.Namespace) -> Poses:
    """Give the poses that were asked for: [frame, joint, 3] in metres."""
    if options.frames is None:
        return waving_person(options.seconds)
    poses: Poses = np.load(options.frames, allow_pickle=False)
    if poses.ndim != 3 or poses.shape[2] != 3:
        raise SystemExit(f"{options.frames}: expected [frame, joint, 3], found {poses.shape}")
    return poses


def pace(poses: Poses, rate_hz: float = 30.0) -> Iterator[tuple[float, Poses]]:
    """Give poses at their rate, each with its time by `time.monotonic`: a sensor's place."""
    start = time.monotonic()
    for number, pose in enumerate(poses):
        due = start + number / rate_hz
        time.sleep(max(0.0, due - time.monotonic()))
        yield due, pose


def find_skeleton(url: str, joints: Sequence[str]) -> Skeleton:
    """Ask the service for the bones of a stream's joints.

    Raises:
        LookupError: it knows no format with these joints.
    """
    answer = httpx.get(f"{url.rstrip('/')}/v1/skeletons", timeout=10.0)
    for found in answer.raise_for_status().json()["items"]:
        names = tuple(joint["name"] for joint in found["joints"])
        if names == tuple(joints):
            return Skeleton(names, tuple((a, b) for a, b in found["bones"]))
    raise LookupError(f"no skeleton has the joints {', '.join(joints)}")
