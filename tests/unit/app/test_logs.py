import io
import json
import logging

import pytest
import structlog

from app.logs import configure_logs
from app.settings import load_settings


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def _restore():
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = handlers, level
    structlog.reset_defaults()


def fail_with(pose):
    raise ValueError("broken")


def write(stream, **settings):
    configure_logs(load_settings(**settings), stream=stream)
    log = structlog.get_logger("app")
    log.debug("hidden")
    try:
        fail_with(pose=[1 / 7])
    except ValueError:
        log.exception("failed")
    logging.getLogger("uvicorn.error").info("chatter")
    logging.getLogger("uvicorn.error").warning("worth %s", "knowing")
    return stream.getvalue()


def test_lines_are_json_where_nobody_watches():
    lines = [json.loads(line) for line in write(io.StringIO()).splitlines()]
    assert [line["event"] for line in lines] == ["failed", "worth knowing"]
    assert lines[0]["level"] == "error"
    assert "ValueError: broken" in lines[0]["exception"]
    assert lines[0]["timestamp"].endswith("Z")


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
@pytest.mark.parametrize("log_format", ["json", "console"])
def test_tracebacks_never_show_values(kind, log_format):
    text = write(kind(), log_format=log_format)
    assert "broken" in text
    assert "0.142857" not in text


def test_lines_are_text_on_a_terminal():
    text = write(Terminal())
    assert "failed" in text
    assert not text.startswith("{")


def test_level_is_that_of_the_settings():
    assert "hidden" in write(io.StringIO(), log_level="debug")
