"""The files of the viewer: served as they are, and nothing else; libraries are unmodified."""

import base64
import hashlib
import json
import re
import tomllib
from functools import partial

import pytest

from app.api.pages import VIEWER, list_assets
from app.domain.access import CODE_LASTS_S, OneTimeCode
from tests.conftest import ROOT
from tests.support import make_settings, run_service

ASSETS = sorted(list_assets())


@pytest.mark.asyncio
async def test_every_file_is_served_as_what_it_is(tmp_path):
    kinds = {"css": "text/css", "html": "text/html", "js": "text/javascript", "svg": "image/svg"}
    async with run_service(make_settings(tmp_path)) as service:
        for name in ASSETS:
            answer = await service.call("GET", f"/viewer/{name}", key=None)
            assert answer.status_code == 200
            assert answer.content == (VIEWER / name).read_bytes()
            kind = kinds.get(name.rpartition(".")[2], "")
            assert answer.headers["content-type"].startswith(kind)
            assert answer.headers["cache-control"] == "no-cache"
        assert len(ASSETS) > 20


@pytest.mark.asyncio
async def test_a_monitor_may_ask_for_the_head_alone(tmp_path):
    async with run_service(make_settings(tmp_path)) as service:
        for path in ("/", "/viewer/js/main.js", "/docs", "/healthz", "/readyz"):
            answer = await service.call("HEAD", path, key=None)
            assert answer.status_code == 200, path


@pytest.mark.asyncio
async def test_a_file_that_one_has_is_not_sent_again(tmp_path):
    async with run_service(make_settings(tmp_path)) as service:
        first = await service.call("GET", "/viewer/js/main.js", key=None)
        headers = {"If-None-Match": f'"other", {first.headers["etag"]}'}
        again = await service.call("GET", "/viewer/js/main.js", key=None, headers=headers)
        other = {"If-None-Match": '"other"'}
        fresh = await service.call("GET", "/viewer/js/main.js", key=None, headers=other)
    assert (again.status_code, again.content) == (304, b"")
    assert (fresh.status_code, fresh.content) == (200, first.content)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "path",
    [
        "../pyproject.toml",
        "..%2f..%2fpyproject.toml",
        "js/../../api/pages.py",
        "%2e%2e/api/pages.py",
        "/etc/passwd",
        "js",
        "",
        "js\\main.js",
        "index.html%00.js",
    ],
)
async def test_nothing_else_can_be_had(tmp_path, path):
    async with run_service(make_settings(tmp_path)) as service:
        answer = await service.call("GET", f"/viewer/{path}", key=None)
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")


@pytest.mark.asyncio
async def test_the_page_may_only_run_what_is_served_with_it(tmp_path):
    async with run_service(make_settings(tmp_path)) as service:
        home = await service.call("GET", "/", key=None)
    policy = dict(
        part.strip().partition(" ")[::2]
        for part in home.headers["content-security-policy"].split(";")
    )
    (inline,) = re.findall(r"<script[^>]*>([^<]+)</script>", home.text)
    digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == f"'self' 'sha256-{digest}'"
    assert policy["connect-src"] == policy["style-src"] == "'self'"
    assert "unsafe" not in home.headers["content-security-policy"]
    assert not re.search(r"\son\w+=|style=|https?://", home.text)


def test_what_the_page_and_its_modules_import_is_there():
    named = re.findall(r'(?:src|href)="(viewer/[^"]+)"', (VIEWER / "index.html").read_text())
    assert [name for name in named if name.removeprefix("viewer/") not in ASSETS] == []
    imported = [
        module.parent / target
        for module in VIEWER.glob("js/**/*.js")
        for target in re.findall(r"from '(\.[^']+)'", module.read_text())
    ]
    assert len(imported) > 20
    assert [str(path) for path in imported if not path.resolve().is_file()] == []


def test_libraries_of_others_are_unmodified():
    vendor = VIEWER / "vendor"
    libraries = json.loads((vendor / "VENDOR.json").read_text())
    for name, library in libraries.items():
        found = {
            file.name: hashlib.sha256(file.read_bytes()).hexdigest()
            for file in (vendor / name).iterdir()
        }
        assert found == library["files"]
        assert {"version", "licence", "source"} <= set(library)
        assert "LICENSE" in found
    assert {path.name for path in vendor.iterdir()} == {*libraries, "VENDOR.json"}


def test_modules_are_small():
    long = {
        file.name: lines
        for file in VIEWER.glob("js/**/*.js")
        if (lines := len(file.read_text().splitlines())) > 400
    }
    assert long == {}


def test_an_installed_service_has_the_viewer():
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert config["tool"]["setuptools"]["package-data"]["app"] == ["viewer/**/*"]


@pytest.mark.asyncio
async def test_the_code_of_the_terminal_gives_its_key_once_and_for_a_while(tmp_path):
    now = [0.0]
    async with run_service(make_settings(tmp_path)) as service:
        redeem = partial(service.call, "POST", "/v1/viewer/redeem", key=None)
        assert (await redeem(json={"code": "any"})).status_code == 401
        code = OneTimeCode("kc_key", clock=lambda: now[0])
        service.app.state.viewer_code = code
        assert (await redeem(json={"code": "wrong"})).status_code == 401
        right = {"code": code.code}
        answer = await redeem(json=right)
        assert (answer.status_code, answer.json()) == (200, {"key": "kc_key"})
        assert (await redeem(json=right)).status_code == 401
        late = OneTimeCode("kc_key", clock=lambda: now[0])
        service.app.state.viewer_code = late
        now[0] = CODE_LASTS_S + 1
        assert (await redeem(json={"code": late.code})).status_code == 401
