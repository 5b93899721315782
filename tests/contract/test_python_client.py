"""The Python client speaks the service's protocol, all of it, and knows nothing of its code."""

import ast
import math
import sys
import tomllib
from typing import Any, get_args

import kinecast_client
import numpy as np
import pytest
from kinecast_client import errors, messages, samples, values
from kinecast_client.messages import Wire
from msgspec import Struct

from app.api import schemas
from app.api.errors import ANSWERS, find_answer
from app.api.sockets import FATAL
from app.domain.jobs import JobState
from app.domain.motion import Timing, VersionStamp
from app.live import protocol
from app.live.codec import Codec
from app.live.protocol import JSON, MSGPACK, Observation, Rejected
from models.skeleton import KINECT_V1
from tests.conftest import ROOT
from tests.contract.pages import read_rows, read_section
from tests.contract.test_docs import every_error

SOURCE = ROOT / "clients" / "python"
FORMS = {"json": JSON, "msgpack": MSGPACK}
POSE = np.array([[0.25, 1.5, 2.0], [math.nan] * 3, [-0.125, 0.5, 2.5]], np.float32)


def tag(kind: type[Struct]) -> str:
    return str(kind.__struct_config__.tag)


def test_subprotocols_and_the_version_of_the_protocol_are_the_same():
    assert messages.SUBPROTOCOLS == FORMS
    assert messages.PROTOCOL == protocol.PROTOCOL


def test_every_message_of_the_service_is_known_with_all_its_fields():
    said = {tag(kind): kind.__struct_fields__ for kind in get_args(protocol.ServerMessage)}
    read = {tag(kind): kind.__struct_fields__ for kind in get_args(messages.Message)}
    assert read.keys() == said.keys()
    for name, fields in said.items():
        assert set(read[name]) == set(fields), name


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (messages.Settings, protocol.StreamSettings.__struct_fields__),
        (messages.JobNote, protocol.JobNote.__struct_fields__),
        (kinecast_client.Version, VersionStamp.__dataclass_fields__),
        (kinecast_client.Timing, Timing.__dataclass_fields__),
    ],
)
def test_what_messages_carry_has_the_same_fields(ours, theirs):
    assert set(ours.__struct_fields__) == set(theirs)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (values.User, schemas.UserOut),
        (values.Trial, schemas.TrialOut),
        (values.ClipReport, schemas.ClipOut),
        (values.Job, schemas.JobOut),
        (values.PersonalVersion, schemas.VersionDetailOut),
        (values.StoredTrial, schemas.RecordedOut),
        (values.Page, schemas.PageOut),
    ],
)
def test_what_routes_answer_is_known(ours, theirs):
    unknown = set(ours.__struct_fields__) - set(theirs.model_fields)
    assert unknown == set()
    left_out = set(theirs.model_fields) - set(ours.__struct_fields__)
    assert left_out <= {"source", "finetune", "requested_by"}


@pytest.mark.parametrize("form", FORMS)
def test_frames_are_read_by_the_service_as_they_were_meant(form):
    confidence = np.array([1.0, 0.0, 0.5], np.float32)
    data = Wire(form).encode_frame(7, 1.7e9 + 1 / 3, POSE, confidence, replay=True)
    frame = Codec(FORMS[form], joints=3).decode(data)
    assert isinstance(frame, Observation), frame
    assert (frame.seq, frame.t, frame.replay) == (7, 1.7e9 + 1 / 3, True)
    assert np.array_equal(frame.joints, POSE.astype(np.float64), equal_nan=True)
    assert np.array_equal(frame.confidence, confidence)
    nobody = Codec(FORMS[form], joints=3).decode(
        Wire(form).encode_frame(8, 2.0, None, None, replay=False)
    )
    assert (nobody.joints, nobody.confidence, nobody.replay) == (None, None, False)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("configure", {"forecast_every": 2, "coverage": 0.5, "version": 3, "max_age_ms": 100.0}),
        ("configure", {"version": "base"}),
        ("reset", {}),
        ("ping", {"id": 1, "t": 2.0}),
        ("pong", {"id": 1, "server_t": 3.0, "t": 2.0}),
        ("trial.start", {"trial": "0b2f7a0e-6f0e-4b0e-9d57-0e6a3c1d9f10", "label": "kitchen"}),
        ("trial.resume", {"trial": "0b2f7a0e-6f0e-4b0e-9d57-0e6a3c1d9f10"}),
        ("clip.start", {"action": "wave"}),
        ("clip.start", {}),
        ("clip.stop", {}),
        ("trial.stop", {"finetune": False}),
        ("trial.cancel", {}),
    ],
)
def test_messages_are_read_by_the_service_as_they_were_meant(form, kind, fields):
    read = Codec(FORMS[form], joints=3).decode(Wire(form).encode(kind, **fields))
    assert not isinstance(read, Rejected), read
    assert tag(type(read)) == kind
    for name, value in fields.items():
        assert str(getattr(read, name)) == str(value)


def make_forecast(radius: np.ndarray | None) -> protocol.Forecast:
    return protocol.Forecast(
        seq=14,
        t=1.7e9,
        age_ms=3.5,
        frames=np.arange(15 * 3 * 3, dtype=np.float32).reshape(15, 3, 3) / 64,
        t_out=1.7e9 + np.arange(1, 16) / 30,
        radius=radius,
        coverage=0.9,
        version=VersionStamp(number=3, kind="personal", sha256="9b", share=0.5),
        quality=("blended",),
        severity="info",
        filled=("head",),
        skipped=1,
        not_due=2,
        timing=Timing(queue_ms=0.1, compute_ms=0.2, total_ms=0.3),
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("has_radius", [True, False])
def test_forecasts_are_read_as_the_service_meant_them(form, has_radius):
    radius = np.full((15, 3), 0.25, np.float32) if has_radius else None
    sent = make_forecast(radius)
    data: Any = Codec(FORMS[form], joints=3).encode(sent)
    wire = Wire(form)
    read = wire.decode(data if form == "msgpack" else data.decode())
    assert isinstance(read, messages.WireForecast)
    for name in sorted(
        {*read.__struct_fields__} - {"frames", "t_out", "radius", "version", "timing"}
    ):
        assert getattr(read, name) == getattr(sent, name), name
    assert (read.version.number, read.version.share, read.version.kind) == (3, 0.5, "personal")
    assert read.timing.compute_ms == 0.2
    assert wire.read_array(read.frames, "<f4") == pytest.approx(sent.frames.ravel(), abs=1e-6)
    assert np.array_equal(wire.read_array(read.t_out, "<f8"), sent.t_out)
    got = wire.read_array(read.radius, "<f4")
    assert (got is None) if radius is None else np.array_equal(got, radius.ravel())


def test_close_codes_after_which_a_client_may_come_back_are_those_of_the_page():
    rows = read_rows(read_section("docs/protocol.md", "## Close codes"), "code")
    final = {int(code) for code, _, back in rows if back.startswith("no")}
    assert final == errors.FINAL_CLOSES
    codes = {answer.close_code for answer in ANSWERS.values()} - {None} | {FATAL}
    assert codes >= errors.FINAL_CLOSES


def test_every_status_of_an_error_has_an_exception():
    statuses = {find_answer(kind).status for kind in every_error()}
    unnamed = {status for status in statuses if errors.find_api_error(status) is errors.ApiError}
    assert unnamed == {405, 500}  # a defect of the client, and one of the service


def test_a_job_is_over_in_the_states_in_which_it_is():
    for state in JobState:
        job = values.Job(id="j", user="ada", state=state.value)
        assert job.is_over == state.is_final


def test_somebody_who_waves_has_the_joints_of_the_nets_skeleton():
    assert tuple(KINECT_V1.joints) == samples.JOINTS
    assert samples.waving_person(1.0).shape == (30, 20, 3)


def list_imports(path) -> set[str]:
    """Every top-level module that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, path
            found.add((node.module or "").split(".")[0])
    return found


def test_the_client_imports_nothing_of_the_service_and_nothing_that_it_does_not_install():
    project = tomllib.loads((SOURCE / "pyproject.toml").read_text())["project"]
    installed = {requirement.partition(">")[0] for requirement in project["dependencies"]}
    package = SOURCE / "src" / "kinecast_client"
    core = sorted(package.glob("*.py"))
    assert len(core) > 20
    for path in package.rglob("*.py"):
        foreign = list_imports(path) - sys.stdlib_module_names - {"kinecast_client"}
        assert foreign.isdisjoint({"app", "models", "tests", "torch"}), path
        if path in core:  # what lies deeper may need an extra
            assert foreign <= installed, path
    assert "torch" not in installed
