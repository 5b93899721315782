"""A Chromium of the system that draws in software, for the viewer's tests, pictures and figures."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-unsafe-swiftshader",
)
SIZE = (1280, 720)


def find_browser() -> str | None:
    """The path of an installed Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def open_browser() -> Iterator[Browser]:
    path = find_browser()
    if path is None:
        raise SystemExit(f"No browser: none of {', '.join(NAMES)} is installed.")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=list(FLAGS))
        yield browser
        browser.close()


def sign_in(page: Page, url: str, key: str) -> None:
    page.goto(url)
    page.wait_for_selector("#sign-in[open]")
    page.fill("#key", key)
    page.keyboard.press("Enter")
    page.wait_for_selector("#link:has-text('Ready')")


def ask(page: Page, expression: str) -> Any:  # noqa: ANN401 - whatever the page answers
    """Evaluate with the parts of the page as `main`."""
    return page.evaluate(f"import('/viewer/js/main.js').then(async (main) => ({expression}))")
