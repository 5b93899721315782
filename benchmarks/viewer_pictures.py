"""The pictures of the viewer in the README and in docs/viewer.md: `make screenshots`.

A synthetic person is recorded through the viewer until there is a version of their own; then the
page is photographed. The moving picture is one pause of it, gone through frame by frame, so that it
is smooth whatever the machine.
"""

import argparse
import io
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page

from app.commands.own_server import run_own_server
from benchmarks.browser import SIZE, ask, open_browser, sign_in

FIGURES = Path("docs/figures")
STEPS = 60
STEP_FRAMES = 2
FPS = 30
WIDTH = 800
PATIENCE_MS = 600_000


def record(page: Page, seconds: float) -> None:
    """Record the selected person and wait for the version that comes of it."""
    page.click("#record")
    page.wait_for_selector(".chip:has-text('recording')")
    page.wait_for_timeout(1000 * seconds)
    page.click("#record")
    page.wait_for_selector(".job")
    page.click("#stop")  # drawing in software leaves little for the fit
    page.wait_for_selector("[data-version='1']", timeout=PATIENCE_MS)
    page.click("#play")
    if page.locator("[data-version='1'] button").count():  # it did not win: shown all the same
        page.click("[data-version='1'] button")
    page.wait_for_selector("[data-version='1']:has-text('active')")


def take_still(page: Page, name: str) -> None:
    """Photograph the page, with everything that it said meanwhile gone."""
    page.evaluate("document.querySelector('#toasts').replaceChildren()")
    page.screenshot(path=FIGURES / f"viewer-{name}.png")


def take_film(page: Page) -> None:
    """Go through the newest seconds of a pause and keep the room as a moving picture."""
    ask(page, "main.view.flip('beside')")
    box = page.locator("#stage-box").bounding_box()
    assert box is not None
    frames = []
    for step in range(STEPS, 0, -1):
        ask(page, f"main.view.seek({step * STEP_FRAMES})")
        ask(page, "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        shot = page.screenshot(
            clip={"x": box["x"], "y": box["y"], "width": box["width"], "height": box["height"]}
        )
        image = Image.open(io.BytesIO(shot)).convert("RGB")
        frames.append(image.resize((WIDTH, round(image.height * WIDTH / image.width))))
    frames[0].save(
        FIGURES / "viewer.webp",
        save_all=True,
        append_images=frames[1:],
        duration=1000 * STEP_FRAMES // FPS,
        loop=0,
        quality=70,
        method=4,
    )


def take_dark(browser: Browser, url: str, key: str) -> None:
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, color_scheme="dark")
    sign_in(page, url, key)
    page.click("[data-key=demo-3]")
    page.wait_for_timeout(12_000)
    ask(page, "main.view.pause()")
    take_still(page, "dark")
    page.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=45.0, help="length of the recording")
    parser.add_argument("--steps", type=int, help="optimisation steps of a fit")
    options = parser.parse_args()
    own: dict[str, Any] = {"finetune_nice": 0}
    if options.steps is not None:
        own["finetune_steps"] = options.steps
    FIGURES.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        run_own_server(Path(folder), **own) as server,
        open_browser() as browser,
    ):
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(60_000)
        sign_in(page, server.url, server.key)
        page.click("[data-key=demo-1]")
        page.wait_for_selector(".chip:has-text('live')")
        record(page, options.seconds)
        page.wait_for_timeout(33_000)  # so that the strips are full
        ask(page, "main.view.pause()")
        take_still(page, "versions")
        take_film(page)
        page.close()
        take_dark(browser, server.url, server.key)


if __name__ == "__main__":
    main()
