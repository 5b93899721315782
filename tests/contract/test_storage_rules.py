import re

import pytest

from tests.conftest import ROOT


@pytest.mark.parametrize("pattern", [r"\.commit\(", r"\.rollback\(", r"isolation_level\s*="])
def test_only_the_database_module_ends_transactions(pattern):
    allowed = ROOT / "app" / "storage" / "database.py"
    found = [
        str(path.relative_to(ROOT))
        for folder in ("app", "migrations")
        for path in (ROOT / folder).rglob("*.py")
        if path != allowed and re.search(pattern, path.read_text())
    ]
    assert found == []


def test_only_the_settings_read_the_environment():
    allowed = ROOT / "app" / "settings.py"
    found = [
        str(path.relative_to(ROOT))
        for path in (ROOT / "app").rglob("*.py")
        if path != allowed and re.search(r"os\.environ|os\.getenv|getenv\(", path.read_text())
    ]
    assert found == []
