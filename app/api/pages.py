"""The viewer at `/` and the reference at `/docs`: they load nothing from elsewhere."""

import base64
import hashlib
import re
from functools import cache, lru_cache
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse

from app.domain.errors import MissingError

router = APIRouter(include_in_schema=False)

VIEWER = Path(__file__).resolve().parents[1] / "viewer"
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}
"""What the viewer consists of; files of other kinds, such as licences, are text."""
_KEPT_ASSETS = 256

_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "code{background:#8882;padding:.1em .3em;border-radius:3px}"
    "table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.4rem .6rem;"
    "border-bottom:1px solid #8884;vertical-align:top}:root{color-scheme:light dark}"
)


class Asset(NamedTuple):
    """One file of the viewer, and what is said with it."""

    body: bytes
    headers: dict[str, str]


@router.api_route("/", methods=["GET", "HEAD"])
async def show_viewer(request: Request) -> Response:
    """Show the viewer; it asks for a key by itself."""
    return _answer(request, "index.html")


@router.api_route("/viewer/{path:path}", methods=["GET", "HEAD"])
async def show_asset(path: str, request: Request) -> Response:
    """Give a file of the viewer."""
    return _answer(request, path)


@router.api_route("/docs", methods=["GET", "HEAD"], response_class=HTMLResponse)
async def show_reference(request: Request) -> HTMLResponse:
    """List every route with the scope that it needs."""
    document: dict[str, Any] = request.app.openapi()
    rows = "".join(
        _row(method, path, operation)
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
    )
    return _page(
        f"{request.app.title}: reference",
        f"<h1>{escape(request.app.title)}: reference</h1>"
        "<p>Send <code>Authorization: Bearer &lt;key&gt;</code>. Schemas and examples are in "
        '<a href="/openapi.json">openapi.json</a>.</p>'
        f"<table><tr><th>Route<th>Scope<th>What it does</tr>{rows}</table>",
    )


@cache
def list_assets() -> dict[str, Path]:
    """Name every file of the viewer. A path of a request is only looked up here, never opened."""
    return {
        file.relative_to(VIEWER).as_posix(): file
        for file in sorted(VIEWER.rglob("*"))
        if file.is_file()
    }


def _answer(request: Request, path: str) -> Response:
    file = list_assets().get(path)
    if file is None:
        raise MissingError(f"The viewer has no file {path[:200]}.")
    asset = _read_asset(file, file.stat().st_mtime_ns)
    known = [tag.strip() for tag in request.headers.get("if-none-match", "").split(",")]
    if asset.headers["ETag"] in known:
        return Response(status_code=304, headers=asset.headers)
    return Response(asset.body, headers=asset.headers)


@lru_cache(maxsize=_KEPT_ASSETS)
def _read_asset(file: Path, _changed_ns: int) -> Asset:
    """Read a file once for each time that it changes."""
    body = file.read_bytes()
    headers = {
        "Content-Type": _TYPES.get(file.suffix, "text/plain; charset=utf-8"),
        "ETag": f'"{hashlib.sha256(body).hexdigest()}"',
        "Cache-Control": "no-cache",  # asked for again each time, sent again only when changed
    }
    if file.suffix == ".html":
        headers["Content-Security-Policy"] = _make_policy(body.decode())
    return Asset(body, headers)


def _make_policy(page: str) -> str:
    """Allow what is served from here, and of scripts within the page the very ones that it has."""
    inline = re.findall(r"<script[^>]*>([^<]+)</script>", page)
    hashes = "".join(
        f" 'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in inline
    )
    return (
        f"default-src 'none'; script-src 'self'{hashes}; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _row(method: str, path: str, operation: dict[str, Any]) -> str:
    route = f"<code>{method.upper()} {escape(path)}</code>"
    what = f"<b>{escape(operation['summary'])}.</b> {escape(operation.get('description', ''))}"
    return f"<tr><td>{route}<td>{escape(operation['x-scope'])}<td>{what}</tr>"


def _page(title: str, body: str) -> HTMLResponse:
    return HTMLResponse(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style>{body}</html>'
    )
