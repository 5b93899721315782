"""docs/protocol.md says what the interface is, all of it and nothing else."""

import json
import re
from dataclasses import fields
from typing import get_args

import msgspec
import numpy as np
import pytest

from app.api.errors import ANSWERS
from app.api.forecast import ForecastIn, ForecastOut
from app.api.sockets import FATAL
from app.api.stream import _Query
from app.domain.errors import KinecastError, StartError
from app.domain.limits import Limits, read_limits
from app.domain.motion import FLAGS, Fallback, Timing, VersionKind, VersionStamp
from app.live import protocol
from app.live.codec import Codec
from app.live.protocol import JSON, MSGPACK, SUBPROTOCOLS, Observation, Rejected, StreamSettings
from app.live.window import WaitReason
from app.main import create_app
from app.settings import Settings
from models.skeleton import HIP_CENTER, SKELETONS
from tests.conftest import ROOT
from tests.contract.pages import quoted, read_blocks, read_page, read_rows, read_section
from tests.contract.test_docs import every_error
from tests.support import make_decoders, make_settings

PAGE = "docs/protocol.md"
NESTED = {
    "version": {field.name for field in fields(VersionStamp)},
    "timing": {field.name for field in fields(Timing)},
    "limits": {field.name for field in fields(Limits)},
    "settings": set(StreamSettings.__struct_fields__),
}


def first_cells(heading, first):
    """The first column of a table under a heading, without backticks."""
    return [row[0].replace("`", "") for row in read_rows(read_section(PAGE, heading), first)]


def tag(struct):
    return struct.__struct_config__.tag


def test_every_route_is_listed_with_its_scope(tmp_path):
    app = create_app(make_settings(tmp_path), decoders=make_decoders())
    expected = [
        (f"{method.upper()} {path}", operation["x-scope"])
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
    ]
    rows = read_rows(read_section(PAGE, "## Routes"), "route")
    assert sorted((row[0].strip("`"), row[1]) for row in rows) == sorted(expected)
    assert "`WS /v1/users/{user}/stream`" in read_section(PAGE, "## The stream")


def test_every_field_of_a_forecast_is_explained():
    section = read_section(PAGE, "### `POST /v1/users/{user}/forecast`")
    rows = read_rows(section, "field of the request")
    assert {row[0].strip("`") for row in rows} == set(ForecastIn.model_fields)
    assert quoted(section) >= set(ForecastOut.model_fields)
    columns = {
        name
        for row in read_rows(read_section(PAGE, "### forecast"), "field")
        for name in quoted(row[0])
    }
    assert columns == set(protocol.Forecast.__struct_fields__)


def sort_examples():
    """The structs of which the page has an example; fails on one that is none."""
    servers = {
        (tag(kind), frozenset(kind.__struct_fields__)): kind
        for kind in get_args(protocol.ServerMessage)
    }
    found = set()
    for block in read_blocks(read_page(PAGE), "json"):
        content = json.loads(block)
        kind = servers.get((content["type"], frozenset(content) - {"type"}))
        if kind is None:
            joints = len(content.get("joints") or ())
            message = Codec(JSON, joints=joints).decode(block)
            assert not isinstance(message, Rejected), (block, message)
            kind = protocol.Frame if isinstance(message, Observation) else type(message)
        else:
            for name in content.keys() & NESTED:
                assert set(content[name]) == NESTED[name], (name, block)
        found.add(kind)
    return found


def test_every_message_has_an_example_that_is_one():
    every = set(get_args(protocol.ServerMessage)) | set(get_args(protocol.Incoming))
    assert sort_examples() == every


def test_subprotocols_and_parameters_of_the_url_are_listed():
    assert set(first_cells("## The stream", "subprotocol")) == set(SUBPROTOCOLS)
    names = ", ".join(first_cells("## The stream", "parameter")).split(", ")
    assert sorted(names) == sorted(_Query.__struct_fields__)


def test_reasons_of_waiting_are_listed():
    assert first_cells("### waiting", "reason") == list(get_args(WaitReason))


def test_kinds_of_weights_and_fallbacks_are_named():
    named = quoted(read_section(PAGE, "### forecast"))
    assert named >= set(get_args(VersionKind)) | set(get_args(Fallback))


def test_close_codes_are_those_of_the_table_of_errors():
    codes = {answer.close_code for answer in ANSWERS.values()} - {None} | {FATAL}
    assert first_cells("## Close codes", "code") == [str(code) for code in sorted(codes)]


def test_every_error_code_is_named_and_none_that_is_not():
    known = {kind.code for kind in every_error() if not issubclass(kind, StartError)}
    section = read_section(PAGE, "## Error codes")
    named = quoted(section)
    assert known - {KinecastError.code} - named == set()
    columns = [row[0] for row in read_rows(section, "code")]
    columns += [row[0] for row in read_rows(section.partition("HTTP requests can")[2], "code")]
    assert {code for cell in columns for code in quoted(cell)} <= known
    assert columns


def test_close_codes_of_fatal_errors_are_right():
    told = read_section(PAGE, "## Error codes").partition("These end a stream")[2].split("\n\n")[0]
    kinds = {kind.code: kind for kind in every_error()}
    pending = []
    for code, close_code in re.findall(r"`([a-z_]+)`|\((\d{4})\)", told):
        if code:
            pending.append(kinds[code])
            continue
        for kind in pending:
            answer = next(ANSWERS[parent] for parent in kind.__mro__ if parent in ANSWERS)
            assert str(answer.close_code or FATAL) == close_code, kind.code
        pending = []
    assert pending == []


def test_every_quality_flag_is_listed_with_its_severity():
    rows = read_rows(read_section(PAGE, "## Quality flags"), "flag")
    listed = {row[0].strip("`"): row[1] for row in rows}
    assert listed == {flag.name: flag.severity.value for flag in FLAGS}


def test_flags_that_are_not_raised_yet_are_said_to_be():
    paths = [*(ROOT / "app" / "live").glob("*.py"), ROOT / "app" / "domain" / "body.py"]
    code = "".join(path.read_text() for path in paths)
    silent = {flag.name for flag in FLAGS if f'"{flag.name}"' not in code}
    section = read_section(PAGE, "## Quality flags")
    assert set(re.findall(r"`(\w+)` is not raised yet", section)) == silent


def test_limits_are_listed_with_their_defaults():
    rows = read_rows(read_section(PAGE, "## Limits"), "limit")
    listed = {
        row[0].strip("`"): float(re.match(r"[\d,]+", row[1])[0].replace(",", "")) for row in rows
    }
    limits = read_limits(Settings())
    assert listed == {field.name: getattr(limits, field.name) for field in fields(Limits)}


def test_skeletons_are_listed_with_their_hip_centre():
    rows = read_rows(read_section(PAGE, "## Skeletons"), "name")
    assert [row[0].strip("`") for row in rows] == list(SKELETONS)
    for (_, joints, hip), skeleton in zip(rows, SKELETONS.values(), strict=True):
        assert int(re.match(r"\d+", joints)[0]) == len(skeleton.joints)
        assert ("root_relative" in joints) == skeleton.root_relative
        sources = np.flatnonzero(skeleton.to_net[HIP_CENTER])
        if len(sources) == 1:
            assert hip == f"`{skeleton.joints[sources[0]]}`"
        else:
            assert hip == "both hips and both shoulders"
            names = [skeleton.joints[j].lower() for j in sources]
            assert [sum(part in name for name in names) for part in ("hip", "shoulder")] == [2, 2]


def test_bytes_of_the_msgpack_example_are_a_frame():
    (block,) = read_blocks(read_page(PAGE), "hex")
    digits = "".join(
        pair
        for line in block.splitlines()
        for pair in re.findall(r"\b[0-9a-f]{2}\b", re.split(r" {4,}", line)[0])
    )
    shown = bytes.fromhex(digits)
    joints = 240 - 12
    message = Codec(MSGPACK, joints=20).decode(shown + bytes(joints))
    assert isinstance(message, Observation), message
    assert (message.seq, message.t) == (0, 12.0)
    (example,) = [
        json.loads(block) for block in read_blocks(read_page(PAGE), "json") if '"frame"' in block
    ]
    assert message.joints[0] == pytest.approx(example["joints"][0], abs=1e-4)


def test_python_of_the_msgpack_section_reads_and_writes_messages():
    (source,) = read_blocks(read_page(PAGE), "python")
    snippet = {}
    exec(source, snippet)  # noqa: S102 - the page under test
    pose = np.arange(60, dtype=np.float64).reshape(20, 3) / 100
    message = Codec(MSGPACK, joints=20).decode(snippet["pack_frame"](3, 1.5, pose))
    assert (message.seq, message.t) == (3, 1.5)
    assert message.joints == pytest.approx(pose, abs=1e-6)
    frames, t_out = np.ones((15, 20, 3), "<f4"), np.arange(15) / 30
    radius = np.full((15, 20), 0.1, "<f4")
    sent = {"frames": frames, "t_out": t_out, "radius": radius}
    raw = msgspec.msgpack.encode(
        {"type": "forecast"} | {name: array.tobytes() for name, array in sent.items()}
    )
    read = snippet["unpack"](raw)
    for name, array in sent.items():
        assert np.array_equal(read[name], array)
    nothing = msgspec.msgpack.encode({"type": "waiting"})
    assert snippet["unpack"](nothing) == {"type": "waiting"}
