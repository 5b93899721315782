"""`kinecast db`: the tables."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from app.commands.output import out
from app.settings import load_settings

app = typer.Typer(help="Bring the database up to date, or check the migrations.")

DataDir = Annotated[
    Path | None, typer.Option(help="Folder of the SQLite database.", show_default="var")
]


@app.command()
def upgrade(data_dir: DataDir = None) -> None:
    """Bring the database's tables to this version; `serve` does it by itself."""
    from app.storage.database import Database  # noqa: PLC0415 - slow to import
    from app.storage.migrate import upgrade as bring_up_to_date  # noqa: PLC0415

    async def run() -> bool:
        database = Database.from_settings(load_settings(data_dir=data_dir))
        try:
            return await bring_up_to_date(database)
        finally:
            await database.close()

    out.print("The database is up to date now." if asyncio.run(run()) else "Nothing to do.")


@app.command()
def check() -> None:
    """Check that the migrations give exactly the tables of the code; touches no data."""
    from app.storage.migrate import check_migrations  # noqa: PLC0415 - slow to import

    asyncio.run(check_migrations())
    out.print("The migrations give exactly the tables of the code.")
