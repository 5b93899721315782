"""Draw docs/figures/demo.svg: what `kinecast demo` shows after a while, as a terminal shows it.

Run it with `make picture`. The forecasts and their errors are real; only the frame is drawn.
"""

import argparse
import asyncio
import io
import re
import tempfile
import time
from pathlib import Path

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console, RenderableType

from app.commands.client.messages import MSGPACK
from app.commands.client.rest import Api
from app.commands.demo.person import RATE_HZ, Performer
from app.commands.demo.view import draw
from app.commands.own_server import OwnServer, run_own_server

SHOWN_URL = "http://127.0.0.1:8000"
WIDTH = 118


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/figures/demo.svg"))
    parser.add_argument("--users", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, run_own_server(Path(folder)) as server:
        shown = asyncio.run(_watch(server, users=arguments.users, seconds=arguments.seconds))
    console = Console(record=True, width=WIDTH, file=io.StringIO(), force_terminal=True)
    console.print("$ kinecast demo", style="bold")
    console.print(shown)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    svg = console.export_svg(
        title="kinecast demo", unique_id="demo", code_format=_without_fonts(CONSOLE_SVG_FORMAT)
    )
    arguments.out.write_text("\n".join(line.rstrip() for line in svg.splitlines()) + "\n")
    print(arguments.out)


def _without_fonts(template: str) -> str:
    """Drop the fonts that the template would load from another site."""
    return re.sub(r"@font-face \{\{.*?\}\}", "", template, flags=re.DOTALL)


async def _watch(server: OwnServer, *, users: int, seconds: float) -> RenderableType:
    performers = [Performer(f"demo-{n}", seed=n) for n in range(1, users + 1)]
    async with Api(server.url, key=server.key) as api:
        for performer in performers:
            await api.add_user(performer.report.user)
    started = time.monotonic()
    tasks = [
        asyncio.create_task(
            performer.perform(
                server.url,
                key=server.key,
                subprotocol=MSGPACK,
                start=started + n / users / RATE_HZ,
            )
        )
        for n, performer in enumerate(performers)
    ]
    await asyncio.wait(tasks, timeout=seconds)
    shown = draw([performer.report for performer in performers], url=SHOWN_URL, elapsed_s=seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return shown


if __name__ == "__main__":
    main()
