import json
import os
import subprocess
import sys
from functools import partial

import pytest

from app.commands import serve
from app.settings import load_settings
from tests.conftest import ROOT
from tests.processes import run


@pytest.fixture
def kinecast(tmp_path):
    """Run a command on a database of its own."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("KINECAST_")}
    env = kept | {"KINECAST_DATA_DIR": str(tmp_path / "data"), "COLUMNS": "200"}

    return partial(run, env=env)


def test_key_is_printed_alone_listed_and_revoked(kinecast):
    made = kinecast("keys", "create", "--scope", "predict", "--scope", "record", "--name", "r7")
    assert made.returncode == 0, made.stderr
    key = made.stdout.strip()
    assert key.startswith("kc_")
    assert "keys revoke" in made.stderr
    (listed,) = json.loads(kinecast("keys", "list", "--json").stdout)
    assert (listed["name"], listed["scopes"], listed["state"]) == (
        "r7",
        ["predict", "record"],
        "works",
    )
    assert key.split("_")[2] not in json.dumps(listed)
    assert kinecast("keys", "revoke", listed["id"]).returncode == 0
    table = kinecast("keys", "list").stdout
    assert listed["id"] in table
    assert "revoked" in table


def test_key_as_json(kinecast):
    made = json.loads(kinecast("keys", "create", "--scope", "admin", "--json").stdout)
    assert made["key"].startswith("kc_" + made["id"].replace("-", ""))


@pytest.mark.parametrize(
    ("arguments", "status", "word"),
    [
        (("keys", "create"), 2, "--scope"),
        (("keys", "create", "--scope", "fly"), 2, "fly"),
        (("keys", "create", "--scope", "admin", "--user", "ada"), 2, "cannot be bound"),
        (("keys", "create", "--scope", "predict", "--user", "ada"), 1, "no user ada"),
        (("keys", "revoke", "7"), 2, "UUID"),
        (("keys", "revoke", "00000000-0000-0000-0000-000000000007"), 1, "no key"),
        (("fly",), 2, "fly"),
        (("evaluate",), 2, "--data"),
        (("serve", "--port", "99999"), 2, "KINECAST_PORT"),
    ],
)
def test_wrong_usage_is_told_in_words(kinecast, arguments, status, word):
    done = kinecast(*arguments)
    assert done.returncode == status, done.stderr
    assert word in done.stderr
    assert "Traceback" not in done.stderr


def test_database_is_upgraded_once_and_the_migrations_are_right(kinecast):
    assert "up to date now" in kinecast("db", "upgrade").stdout
    assert "Nothing to do" in kinecast("db", "upgrade").stdout
    checked = kinecast("db", "check")
    assert checked.returncode == 0, checked.stderr


def test_version_and_help(kinecast):
    assert kinecast("--version").stdout.startswith("kinecast ")
    shown = kinecast("--help").stdout
    for name in ("serve", "pretrain", "evaluate", "keys", "db"):
        assert name in shown


def test_help_of_a_lazy_command_is_that_of_the_real_one(kinecast):
    assert "--test-trials" in kinecast("evaluate", "--help").stdout


def test_help_imports_nothing_slow():
    code = (
        "import sys, app.cli\n"
        "slow = {'torch', 'sqlalchemy', 'fastapi', 'scipy', 'numpy'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(slow)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("host", "shown"),
    [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::1", "[::1]")],  # noqa: S104 - closed at once
)
def test_shown_address_can_be_opened_on_this_machine(host, shown):
    with serve._listen(load_settings(host=host, port=0)) as listener:
        port = listener.getsockname()[1]
        assert serve._name_address(listener) == f"http://{shown}:{port}"


def test_new_key_is_shown_on_a_terminal_only(tmp_path, monkeypatch):
    settings = load_settings(data_dir=tmp_path)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    shown = serve._show_key(settings, "kc_new")
    assert shown.where.startswith("kc_new")
    assert shown.prefix == "KINECAST_KEY=kc_new "
    assert not (tmp_path / "admin-key").exists()
    assert serve._show_key(settings, None).where == "shown at the first start"
    (tmp_path / "admin-key").touch()  # an empty file is no key
    assert serve._show_key(settings, None).where == "shown at the first start"


@pytest.mark.parametrize("command", [("serve", "--port", "0"), ("keys", "list"), ("db", "upgrade")])
@pytest.mark.parametrize("place", ["file", "file/data"])
def test_data_folder_that_cannot_be_is_one_line(kinecast, tmp_path, command, place):
    (tmp_path / "file").touch()
    done = kinecast(*command, "--data-dir", str(tmp_path / place))
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert str(tmp_path / "file") in done.stderr
