"""`kinecast keys`: made, listed and revoked straight in the database."""

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar
from uuid import UUID

import typer
from rich.table import Column, Table
from rich.text import Text

from app.commands.output import err, fail, out
from app.domain.access import ApiKey, NewKey, Scope
from app.settings import load_settings

if TYPE_CHECKING:
    from app.storage.database import Database

app = typer.Typer(help="Make, list and revoke API keys.", no_args_is_help=True)

Result = TypeVar("Result")
DataDir = Annotated[
    Path | None, typer.Option(help="Folder of the SQLite database.", show_default="var")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def create(
    scope: Annotated[list[Scope], typer.Option(help="What the key may do; repeat for more.")],
    user: Annotated[str | None, typer.Option(help="The only user that it may touch.")] = None,
    name: Annotated[str | None, typer.Option(help="What it is for.")] = None,
    data_dir: DataDir = None,
    *,
    as_json: AsJson = False,
) -> None:
    """Make a key and print it; it cannot be shown again."""
    if user is not None and Scope.ADMIN in scope:
        fail("an admin key cannot be bound to a user", status=2)

    async def run(database: "Database") -> NewKey:
        from app.storage import keys, users  # noqa: PLC0415 - slow to import

        async with database.write() as tx:
            bound = None if user is None else (await users.get(tx, user)).uuid
            return await keys.create(
                tx, scopes=frozenset(scope), name=name, user_uuid=bound, actor=None
            )

    key = _with_database(run, data_dir=data_dir)
    if as_json:
        typer.echo(json.dumps({"id": str(key.id), "key": key.text}))
        return
    typer.echo(key.text)
    err.print(f"Keep it: it is not stored. Revoke it with: kinecast keys revoke {key.id}")


@app.command("list")
def list_keys(data_dir: DataDir = None, *, as_json: AsJson = False) -> None:
    """List all keys, newest first."""

    async def run(database: "Database") -> list[ApiKey]:
        from app.storage import keys  # noqa: PLC0415 - slow to import

        async with database.read() as tx:
            return await keys.list_all(tx)

    found = [_describe(key) for key in _with_database(run, data_dir=data_dir)]
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    table = Table(
        Column("id", no_wrap=True), "name", "scopes", "user", "created", "last used", "state"
    )
    for key in found:
        cells = (", ".join(v) if isinstance(v, list) else v or "" for v in key.values())
        table.add_row(*(Text(cell) for cell in cells))  # names are anybody's: no markup in them
    out.print(table)


@app.command()
def revoke(
    key: Annotated[UUID, typer.Argument(help="Id of the key.")], data_dir: DataDir = None
) -> None:
    """Revoke a key for good; its open streams close within 2 s."""

    async def run(database: "Database") -> None:
        from app.storage import keys  # noqa: PLC0415 - slow to import

        async with database.write() as tx:
            await keys.revoke(tx, key, actor=None)

    _with_database(run, data_dir=data_dir)
    out.print(f"Revoked {key}.")


def _with_database(
    run: "Callable[[Database], Awaitable[Result]]", *, data_dir: Path | None
) -> Result:
    """Run something on an up-to-date database."""
    from app.storage.database import Database  # noqa: PLC0415 - slow to import
    from app.storage.migrate import upgrade  # noqa: PLC0415

    async def connect_and_run() -> Result:
        database = Database.from_settings(load_settings(data_dir=data_dir))
        try:
            await upgrade(database)
            return await run(database)
        finally:
            await database.close()

    return asyncio.run(connect_and_run())


def _describe(key: ApiKey) -> dict[str, Any]:
    return {
        "id": str(key.id),
        "name": key.name,
        "scopes": sorted(key.scopes),
        "user": key.user,
        "created_at": key.created_at.isoformat(timespec="seconds"),
        "last_used_at": key.last_used_at and key.last_used_at.isoformat(timespec="hours"),
        "state": "works" if key.revoked_at is None else "revoked",
    }
