"""The page at `/` and the reference at `/docs`, made here: they load nothing from elsewhere."""

from html import escape
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

router = APIRouter(include_in_schema=False)

_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "code{background:#8882;padding:.1em .3em;border-radius:3px}"
    "table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.4rem .6rem;"
    "border-bottom:1px solid #8884;vertical-align:top}:root{color-scheme:light dark}"
)


@router.get("/", response_class=HTMLResponse)
async def show_home(request: Request) -> HTMLResponse:
    """Say that the service runs, and where to go next."""
    app = request.app
    return _page(
        app.title,
        f"<h1>{escape(app.title)} {escape(app.version)} is running</h1>"
        f"<p>{escape(app.description)}</p><ul>"
        '<li><a href="/docs">Reference of the API</a>, also as '
        '<a href="/openapi.json">OpenAPI</a></li>'
        '<li><a href="/readyz">Readiness</a> and <a href="/metrics">metrics</a></li>'
        '<li><a href="/v1/skeletons">Skeleton formats</a>, <a href="/v1/limits">limits</a> and '
        '<a href="/v1/quality">quality flags</a></li></ul>',
    )


@router.get("/docs", response_class=HTMLResponse)
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


def _row(method: str, path: str, operation: dict[str, Any]) -> str:
    route = f"<code>{method.upper()} {escape(path)}</code>"
    what = f"<b>{escape(operation['summary'])}.</b> {escape(operation.get('description', ''))}"
    return f"<tr><td>{route}<td>{escape(operation['x-scope'])}<td>{what}</tr>"


def _page(title: str, body: str) -> HTMLResponse:
    return HTMLResponse(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style>{body}</html>'
    )
