"""Break the service in every way that is promised to be harmless: `make faults`.

Each fault is repeated at random moments of a job, while a stream and single requests go on asking
for forecasts. Afterwards the database has to hold exactly what was promised.
"""

import argparse
import asyncio
import json
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from random import Random

from benchmarks.faults import harm
from benchmarks.faults.base import make_base
from benchmarks.faults.campaign import Campaign, Outcome, as_json
from benchmarks.faults.cluster import Cluster, NoClusterError
from benchmarks.faults.damage import DamageCampaign
from benchmarks.faults.harm import Harm, NoDiskError, SmallDisk
from benchmarks.faults.report import is_clean, say, tabulate
from benchmarks.faults.rig import Rig

FAULTS = ("none", "worker", "api", "both", "database", "disk", "weights")
KILLS: dict[str, Callable[[Rig], Harm]] = {
    "none": lambda _: harm.do_nothing(),
    "worker": harm.kill_worker,
    "api": harm.kill_service,
    "both": harm.kill_both,
}


def main() -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # tidy up all the same
    arguments = _read_arguments()
    outcomes: list[Outcome] = []
    skipped: dict[str, str] = {}
    for fault in arguments.only.split(","):
        try:
            outcomes += _repeat(fault, arguments)
        except (NoClusterError, NoDiskError) as error:
            skipped[fault] = str(error)
        if arguments.json is not None:
            report = {"outcomes": [as_json(one) for one in outcomes], "skipped": skipped}
            arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    print(tabulate(outcomes))
    for fault, why in skipped.items():
        print(f"{fault} was not examined: {why}")
    return 0 if is_clean(outcomes) else 1


def _read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--only", default=",".join(FAULTS), help="of " + ", ".join(FAULTS))
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write every outcome here")
    arguments = parser.parse_args()
    unknown = set(arguments.only.split(",")) - set(FAULTS)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    return arguments


def _repeat(fault: str, arguments: argparse.Namespace) -> list[Outcome]:
    random = Random(f"{arguments.seed} {fault}")  # noqa: S311 - the same again for the same seed
    with _prepare(fault, random, postgresql=arguments.database == "postgresql") as (rig, chosen):
        base = make_base(rig.model)
        try:
            if chosen is None:
                campaign: Campaign | DamageCampaign = DamageCampaign(rig, base, random)
            else:
                campaign = Campaign(rig, chosen, base, random)
            return asyncio.run(campaign.run(arguments.repeats, say))
        except BaseException:
            print(rig.read_logs()[-4000:], file=sys.stderr)
            raise


@contextmanager
def _prepare(fault: str, random: Random, *, postgresql: bool) -> Iterator[tuple[Rig, Harm | None]]:
    """Make a service that can be broken in this way."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kinecast-faults-")))
        data_dir, url, chosen = folder / "data", None, None
        if fault == "database" or (postgresql and fault != "disk"):
            cluster = Cluster()
            stack.callback(cluster.remove)
            cluster.start()
            url = cluster.url
        if fault == "disk":
            disk = SmallDisk(data_dir)
            stack.callback(disk.remove)
            chosen = harm.fill_disk(disk)
        elif fault == "database":
            chosen = harm.stop_database(cluster, random)
        rig = Rig(folder, data_dir=data_dir, database_url=url)
        if fault in KILLS:
            chosen = KILLS[fault](rig)
        stack.callback(rig.stop)
        yield rig, chosen


if __name__ == "__main__":
    sys.exit(main())
