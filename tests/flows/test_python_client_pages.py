"""The pages of the Python client: every block runs as it stands, and every call is in one."""

import asyncio
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import kinecast_client
import pytest
from kinecast_client import async_resources, resources

from tests.conftest import ROOT
from tests.contract.pages import read_blocks, read_page
from tests.live_support import RealServer, serve
from tests.support import ADMIN_KEY, make_settings, open_database
from tests.versions import add_version, make_net, make_net_decoders, make_personal

README, REFERENCE = PAGES = ("clients/python/README.md", "clients/python/REFERENCE.md")
DEFAULT = "127.0.0.1:8000"
NOUNS = ("Users", "Trials", "Versions", "Jobs")


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[RealServer]:
    """A service with a user `ada` who has a personal version, and no worker."""
    settings = make_settings(tmp_path_factory.mktemp("service"))
    net = make_net()

    async def personalise() -> None:
        async with open_database(settings) as database:
            await add_version(database, "ada", make_personal(net, 1))

    with serve(settings, make_net_decoders(net)) as running:
        running.add_user("ada")
        asyncio.run(personalise())
        yield running


def run(source: str, server: RealServer, folder: Path) -> str:
    """Run a program as a robot would, in a process of its own where every warning is an error."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", source.replace(DEFAULT, f"127.0.0.1:{server.port}")],
        cwd=folder,
        env=dict(os.environ) | {"KEY": ADMIN_KEY, "PYTHONPATH": str(ROOT / "clients/python/src")},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout


def test_every_block_of_the_first_page_runs_and_the_ten_lines_print_forecasts(server, tmp_path):
    blocks = read_blocks(read_page(README), "python")
    assert len(blocks) >= 8
    lines = [line for line in blocks[0].splitlines() if line and "import" not in line]
    assert len(lines) <= 10
    shown = run("\n".join(blocks), server, tmp_path)
    printed = re.findall(r"^in half a second: .* m, \d+ ms old$", shown, re.MULTILINE)
    assert len(printed) > 10  # of 137; a busy machine skips some


def test_every_call_of_the_reference_does_what_it_says(server, tmp_path):
    run("\n".join(read_blocks(read_page(REFERENCE), "python")), server, tmp_path)


def test_every_example_names_its_service_and_key_alike():
    for name in PAGES:
        text = "\n".join(read_blocks(read_page(name), "python"))
        assert set(re.findall(r"http://[\w.:]+", text)) == {f"http://{DEFAULT}"}
        assert "kc_" not in text


def list_members(kind: type) -> set[str]:
    return {
        name
        for name, value in inspect.getmembers(kind)
        if not name.startswith("_")
        and (callable(value) or isinstance(value, property) or inspect.isdatadescriptor(value))
    }


def every_class() -> list[type]:
    exported = [getattr(kinecast_client, name) for name in kinecast_client.__all__]
    nouns = [getattr(resources, name) for name in NOUNS]
    return [kind for kind in (*exported, *nouns) if inspect.isclass(kind)]


DESCRIBED = {
    kind
    for kind in every_class()
    if not issubclass(kind, Exception)
    and kind.__module__.rpartition(".")[2]
    in {"client", "stream", "resources", "forecasts", "statistics", "values", "recordings"}
}


def test_every_call_and_field_is_in_an_example():
    text = "\n".join(block for name in PAGES for block in read_blocks(read_page(name), "python"))
    missing = {
        f"{kind.__name__}.{member}"
        for kind in DESCRIBED
        for member in list_members(kind)
        if not re.search(rf"\.{member}\b|\b{member}=", text)
    }
    assert missing == set()
    assert len(DESCRIBED) > 12


def test_everything_public_has_a_docstring():
    silent = {
        f"{kind.__name__}.{name}"
        for kind in every_class()
        for name in list_members(kind)
        if callable(getattr(kind, name)) and not inspect.getdoc(getattr(kind, name))
    }
    assert silent == set()
    for kind in every_class():
        assert kind.__doc__, kind
        assert not kind.__doc__.startswith(f"{kind.__name__}("), kind  # what a dataclass makes up


@pytest.mark.parametrize("name", ["Client", "Stream", "Recording"])
def test_both_kinds_of_client_have_the_same_calls(name):
    plain, awaited = getattr(kinecast_client, name), getattr(kinecast_client, f"Async{name}")
    assert list_members(plain) == list_members(awaited)
    for member in list_members(plain):
        if not callable(getattr(plain, member)):
            continue
        both = [inspect.signature(getattr(kind, member)) for kind in (plain, awaited)]
        assert list(both[0].parameters) == list(both[1].parameters), member


@pytest.mark.parametrize("name", NOUNS)
def test_both_kinds_of_nouns_have_the_same_calls(name):
    plain, awaited = getattr(resources, name), getattr(async_resources, f"Async{name}")
    assert list_members(plain) == list_members(awaited)
    for member in list_members(plain):
        both = [inspect.signature(getattr(kind, member)) for kind in (plain, awaited)]
        assert list(both[0].parameters) == list(both[1].parameters), member


def test_the_tree_of_errors_is_the_one_that_is_drawn():
    drawn = {}
    path: list[str] = []
    for line in kinecast_client.errors.__doc__.splitlines():
        if match := re.match(r"([│├└─ ]*)(\w+Error)\b", line):
            depth = len(match[1]) // 4
            path[depth:] = [match[2]]
            drawn[match[2]] = path[depth - 1] if depth else "Exception"
    actual = {
        kind.__name__: kind.__bases__[0].__name__
        for kind in vars(kinecast_client.errors).values()
        if inspect.isclass(kind) and issubclass(kind, Exception)
    }
    assert drawn == actual
    assert set(drawn) <= set(kinecast_client.__all__)
