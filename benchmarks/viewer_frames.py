"""Pictures per second of the viewer with three people, drawn in software, through the real stream.

Run with `make viewer-frames` on an idle machine: browser, service and forecasts share its cores.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from app.commands.own_server import run_own_server
from benchmarks.browser import SIZE, ask, open_browser, sign_in

SETTLE_S = 6.0
_COUNT = """await (async () => {
  const begin = performance.now(), drawn = main.view.drawn; let ticks = 0, on = true, last = begin;
  const gaps = [];
  const tick = (now) => { ticks++; gaps.push(now - last); last = now; if (on) requestAnimationFrame(tick) };
  requestAnimationFrame(tick);
  await new Promise((done) => setTimeout(done, SECONDS * 1000)); on = false;
  const seconds = (performance.now() - begin) / 1000;
  const waits = [...main.app.performers.values()].flatMap((one) =>
    one.history.toArray().map((moment) => moment.latencyMs)).filter(Number.isFinite).sort((a, b) => a - b);
  gaps.sort((a, b) => a - b);
  const gl = main.stage.renderer.getContext(), about = gl.getExtension('WEBGL_debug_renderer_info');
  return {
    people: main.view.figures.size, pictures_per_s: (main.view.drawn - drawn) / seconds,
    callbacks_per_s: ticks / seconds, longest_gap_ms: gaps.at(-1), pixel_ratio: main.stage.ratio,
    forecasts: waits.length, latency_p50_ms: waits[Math.floor(waits.length / 2)],
    latency_p99_ms: waits[Math.floor(0.99 * waits.length)],
    renderer: gl.getParameter(about ? about.UNMASKED_RENDERER_WEBGL : gl.RENDERER),
  };
})()"""  # noqa: E501


def measure(seconds: float, people: int) -> dict[str, Any]:
    """Start a service, let some synthetic people in and count."""
    with (
        tempfile.TemporaryDirectory() as folder,
        run_own_server(Path(folder)) as server,
        open_browser() as browser,
    ):
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        sign_in(page, server.url, server.key)
        page.click(f"[data-key=demo-{people}]")
        page.wait_for_timeout(1000 * SETTLE_S)
        told: dict[str, Any] = ask(page, _COUNT.replace("SECONDS", str(seconds)))
        return {name: round(x, 1) if isinstance(x, float) else x for name, x in told.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--people", type=int, choices=(1, 3), default=3)
    options = parser.parse_args()
    print(json.dumps(measure(options.seconds, options.people), indent=2))


if __name__ == "__main__":
    main()
