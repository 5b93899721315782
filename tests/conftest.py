import os
from pathlib import Path

import pytest
import structlog

ROOT = Path(__file__).resolve().parents[1]
# As in production: pretty tracebacks with every variable take seconds.
structlog.configure(
    processors=[
        *structlog.get_config()["processors"][:-1],
        structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback),
    ]
)


@pytest.fixture(scope="session")
def utd_mhad() -> Path:
    """The folder of the published recordings; tests that take it are marked `recordings`."""
    path = Path(os.environ.get("UTD_MHAD", ROOT.parent / "shared" / "data" / "utd-mhad"))
    if not path.exists():
        pytest.skip(f"no UTD-MHAD recordings at {path} (set UTD_MHAD to where they are)")
    return path
