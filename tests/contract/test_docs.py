"""The documentation says what the code does."""

import re

from app.api.errors import find_answer
from app.domain.errors import KinecastError, StartError
from app.live.telemetry import Telemetry
from app.settings import list_settings
from tests.conftest import ROOT


def read_table(name, heading):
    """The rows of the table under a heading line, as lists of cells."""
    text = (ROOT / "docs" / name).read_text()
    rows = text.split(heading, 1)[1].lstrip("\n").splitlines()[1:]
    table = []
    for row in rows:
        if not row.startswith("|"):
            break
        table.append([cell.strip().strip("`") for cell in row.strip("|").split("|")])
    return table


def test_every_setting_is_documented_with_its_default():
    documented = read_table("operations.md", "| variable | default | meaning |")
    expected = [
        [setting.variable, setting.default or "none", setting.sentence]
        for setting in list_settings()
    ]
    assert [[name, default, text.strip()] for name, default, text in documented] == [
        [name, default, text.strip("`")] for name, default, text in expected
    ]


def every_error(root=KinecastError):
    yield root
    for child in root.__subclasses__():
        yield from every_error(child)


def test_every_error_code_is_documented():
    documented = read_table(
        "errors.md", "| code | HTTP status | close code | worth a retry | meaning |"
    )
    expected = []
    for kind in every_error():
        if kind is KinecastError or issubclass(kind, StartError):
            continue
        answer = find_answer(kind)
        close_code = str(answer.close_code or "none")
        expected.append(
            [kind.code, str(answer.status), close_code, "yes" if kind.retryable else "no"]
        )
    assert [row[:4] for row in documented] == expected
    assert all(row[4].endswith(".") for row in documented)


def test_routes_named_in_operations_exist(tmp_path):
    from app.main import create_app
    from tests.support import make_decoders, make_settings

    app = create_app(make_settings(tmp_path), decoders=make_decoders())
    known = set(app.openapi()["paths"]) | {"/docs", "/openapi.json", "/"}
    text = (ROOT / "docs" / "operations.md").read_text()
    named = set(re.findall(r"`(?:[A-Z]+ )?(/[a-z0-9/._-]*)`", text)) - {"/run/secrets"}
    assert named
    assert {path for path in named if path not in known} == set()


def test_every_metric_is_documented_with_its_type_and_labels():
    collectors = [one for one in vars(Telemetry()).values() if hasattr(one, "_labelnames")]
    expected = []
    for collector in collectors:
        (family,) = collector.describe()
        name = family.name + ("_total" if family.type == "counter" else "")
        expected.append([name, family.type, ", ".join(collector._labelnames)])
    documented = read_table("operations.md", "| metric | type | labels | meaning |")
    assert [row[:3] for row in documented] == expected
    assert len(expected) == len(list(Telemetry().registry.collect()))
