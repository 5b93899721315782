"""Where a service's processor time goes while people stream: `make where`, Linux with `perf`.

Prints a table by thread and library, in microseconds per forecast.
"""

import argparse
import collections
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from app.commands.bench.stream import StreamPlan, measure_stream, own_subject

RATE_HZ = 30
SAMPLES_HZ = 997
_PLAIN = {"_kernel": "kernel of the nets", "libpython": "Python", "[kernel": "operating system"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--users", type=int, default=64, help="streams at the same time")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the profile")
    arguments = parser.parse_args()
    if shutil.which("perf") is None:
        sys.exit("This needs Linux's `perf`, which is not installed.")
    plan = StreamPlan(
        users=(arguments.users,), seconds=arguments.seconds + 3, repeats=1, form="msgpack"
    )
    with tempfile.TemporaryDirectory() as folder, own_subject(arguments.users) as subject:
        if subject.process is None:
            sys.exit("There is no service of our own.")
        data = Path(folder) / "perf.data"
        with _recording(subject.process, data):
            measure_stream(plan, subject)
        script = ["perf", "script", "-i", str(data), "-F", "tid,time,ip,dso"]
        text = subprocess.run(script, capture_output=True, text=True, check=True).stdout
    shares = count_samples(text.splitlines(), last_s=arguments.seconds)
    print(tabulate(shares, forecasts=arguments.users * RATE_HZ * arguments.seconds))


@contextmanager
def _recording(process: int, data: Path) -> Iterator[None]:
    command = ["perf", "record", "-q", "-F", str(SAMPLES_HZ), "-p", str(process), "-o", str(data)]
    recorder = subprocess.Popen(command)
    try:
        yield
    finally:
        recorder.terminate()
        recorder.wait(30)


def count_samples(lines: Iterable[str], *, last_s: float) -> collections.Counter[tuple[str, str]]:
    """Count samples by thread and library, in the last seconds that people streamed.

    Args:
        lines: of `perf script`: thread, time, address and library of each sample.
        last_s: how long before the last sample.
    """
    samples = [parts for line in lines if len(parts := line.replace(":", " ").split()) >= 4]
    until = max((float(parts[1]) for parts in samples), default=0.0) - 1.0
    found: collections.Counter[tuple[str, str]] = collections.Counter()
    for thread, at, *_, library in samples:
        if until - last_s <= float(at) <= until:
            found[thread, _name(library)] += 1
    return found


def tabulate(shares: collections.Counter[tuple[str, str]], *, forecasts: float) -> str:
    """Write samples as a table in Markdown, the busiest threads first."""
    threads = collections.Counter[str]()
    for (thread, _), count in shares.items():
        threads[thread] += count
    rows = ["| thread | where | µs per forecast |", "|---|---|---|"]
    for number, (thread, whole) in enumerate(threads.most_common(3), start=1):
        rows.append(f"| {number} | **all** | **{_to_us(whole, forecasts):.0f}** |")
        for (other, where), count in shares.most_common():
            if other == thread and _to_us(count, forecasts) >= 1:
                rows.append(f"| {number} | {where} | {_to_us(count, forecasts):.0f} |")
    return "\n".join(rows)


def _to_us(samples: int, forecasts: float) -> float:
    return samples / SAMPLES_HZ / forecasts * 1e6


def _name(library: str) -> str:
    name = library.strip("()").rsplit("/", 1)[-1]
    return next((plain for part, plain in _PLAIN.items() if part in name), name.split(".")[0])


if __name__ == "__main__":
    main()
