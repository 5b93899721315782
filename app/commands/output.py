"""How the commands talk: results to standard output, everything else to standard error."""

from typing import NoReturn

from rich.console import Console

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def fail(message: str, *, status: int) -> NoReturn:
    """Say in one line what is wrong, and exit.

    Args:
        message: one sentence.
        status: 2 for wrong usage, 1 for everything else.
    """
    err.print("Error:", style="bold red", end=" ")
    err.print(message, markup=False)
    raise SystemExit(status)
