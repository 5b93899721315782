"""The viewer in a real browser, on a real service with a small base: nothing is simulated.

Needs a Chromium of the system; none is downloaded.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
import torch
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, Request

from app.commands.own_server import OwnServer, run_own_server
from benchmarks.browser import NAMES, find_browser, open_browser
from models.checkpoint import save_checkpoint
from models.predictor import Predictor
from tests.conftest import ROOT
from tests.nets import TINY
from tests.personal_support import record_frames

SCREENSHOTS = ROOT / "build" / "screenshots"
PATIENCE_MS = 45_000
_STATE = """[main.app.phase, document.activeElement.id, [...main.app.performers].map(([id, one]) =>
  [id, one.state, one.reason, one.waiting, one.seq, one.answers])]"""
LARGE = {"width": 1280, "height": 720}
TRAINED = "pia"
SERIOUS = {"serious", "critical"}
RECORDED = [(action, seed) for action in ("wave", "walk", "punch") for seed in (0, 1)]


@dataclass
class Window:
    """A page, and everything that went wrong on it."""

    page: Page
    server: OwnServer
    wrong: list[str] = field(default_factory=list)

    def watch(self) -> None:
        page = self.page
        page.on("console", lambda said: self._note("console", said.text, said.type == "error"))
        page.on("pageerror", lambda error: self._note("script", str(error), is_wrong=True))
        page.on("requestfailed", self._note_request)
        page.on(
            "response",
            lambda answer: self._note("answer", f"{answer.status} {answer.url}", not answer.ok),
        )

    def _note(self, kind: str, text: str, is_wrong: bool) -> None:
        if is_wrong and "304" not in text[:4]:
            self.wrong.append(f"{kind}: {text}")

    def _note_request(self, request: Request) -> None:
        # The page itself hangs up: on a job that it follows, and on all when it is left.
        is_own = request.url.endswith("/events") or "ERR_ABORTED" in (request.failure or "")
        if not is_own:
            self.wrong.append(f"request: {request.url} {request.failure}")

    def forgive(self, *parts: str) -> None:
        """Expect what a test has provoked."""
        self.wrong = [line for line in self.wrong if not any(part in line for part in parts)]

    def sign_in(self, key: str | None = None) -> None:
        self.page.fill("#key", key or self.server.key)
        self.page.keyboard.press("Enter")
        if key is None:
            self.page.wait_for_selector("#sign-in:not([open])", state="attached")
            self.page.wait_for_selector("#link:has-text('Ready')")

    def ask(self, expression: str):
        """Evaluate with the parts of the page as `main`."""
        return self.page.evaluate(f"import('/viewer/js/main.js').then((main) => ({expression}))")

    def await_that(self, expression: str) -> None:
        """Wait until it holds; the page's own policy forbids the driver's way of waiting."""
        deadline = time.monotonic() + PATIENCE_MS / 1e3
        while not self.ask(expression):
            assert time.monotonic() < deadline, (expression, self.ask(_STATE))
            self.page.wait_for_timeout(80)

    def await_forecasts(self, people: int) -> None:
        self.await_that(
            f"main.app.performers.size === {people}"
            " && [...main.app.performers.values()].every((one) => one.answers > 12)"
        )

    def shoot(self, name: str) -> None:
        self.page.evaluate("scrollTo(0, 0)")
        self.page.screenshot(path=SCREENSHOTS / f"{name}.png")


@pytest.fixture(scope="package")
def server(tmp_path_factory) -> Iterator[OwnServer]:
    folder = tmp_path_factory.mktemp("viewer")
    with torch.random.fork_rng():
        torch.manual_seed(1)
        save_checkpoint(folder / "small.safetensors", Predictor(config=TINY), {})
    own = {"model": folder / "small.safetensors", "worker_poll_s": 0.2, "finetune_steps": 20}
    with run_own_server(folder, **own) as running:
        yield running


@pytest.fixture(scope="package")
def trained(server: OwnServer) -> str:
    """Give a person for whom a version is being fitted; it is ready when it is looked at."""
    add_person(server, TRAINED, display_name="Pia")
    add_trial(server, TRAINED)
    call(server, "POST", f"/v1/admin/users/{TRAINED}/finetune", json={"trials": None})
    return TRAINED


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if find_browser() is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    with open_browser() as running:
        yield running


@pytest.fixture
def open_window(browser, server):
    """Open pages; after the test nothing may have gone wrong on any of them."""
    opened = []

    def open_one(url: str | None = None, *, viewport=LARGE, scheme: str = "light") -> Window:
        context = browser.new_context(
            viewport=viewport, color_scheme=scheme, reduced_motion="reduce", accept_downloads=False
        )
        context.set_default_timeout(PATIENCE_MS)
        window = Window(context.new_page(), server)
        window.watch()
        opened.append(window)
        window.page.goto(url or server.url)
        window.page.wait_for_selector("#sign-in[open]")
        return window

    yield open_one
    for window in opened:
        window.page.context.close()
    assert [line for window in opened for line in window.wrong] == []


@pytest.fixture
def window(open_window) -> Window:
    opened = open_window()
    opened.sign_in()
    return opened


def call(server: OwnServer, method: str, path: str, **body) -> httpx.Response:
    headers = {"Authorization": f"Bearer {server.key}"}
    return httpx.request(method, server.url + path, headers=headers, timeout=30, **body)


def add_person(server: OwnServer, user: str, **fields) -> None:
    answer = call(server, "POST", "/v1/users", json={"id": user, **fields})
    assert answer.status_code == httpx.codes.CREATED, answer.text


def add_trial(server: OwnServer, user: str) -> None:
    """Enough to fit a version to, without a job."""
    clips = [
        {"frames": record_frames(2.0, seed=1 + seed, action=action).joints.tolist()}
        for action, seed in RECORDED
    ]
    body = {"clips": clips, "finetune": False}
    answer = call(server, "POST", f"/v1/users/{user}/trials", json=body)
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text


def list_trials(server: OwnServer, user: str) -> list[dict]:
    return call(server, "GET", f"/v1/users/{user}/trials").json()["items"]


def scan(window, state):
    """What an accessibility scan finds that somebody would stumble over."""
    found = Axe().run(window.page).response["violations"]
    return [
        (state, one["id"], [node["target"] for node in one["nodes"]])
        for one in found
        if one["impact"] in SERIOUS
    ]


def find_file(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path
