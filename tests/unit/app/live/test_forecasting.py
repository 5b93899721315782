import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.domain.motion import Timing, VersionStamp
from app.live.forecasting import add_displacement, make_answer
from app.live.window import assemble
from app.live.work import EngineResult
from models.data.synthetic import SyntheticPerson
from models.skeleton import SKELETONS, from_y_up, to_y_up

PERSON = SyntheticPerson(6).record("walk", 1.0).astype(np.float64)
DISPLACEMENT = np.random.default_rng(0).normal(size=(15, 20, 3)).astype(np.float32)


def answer_for(name: str, up: str = "y", displacement: np.ndarray = DISPLACEMENT, **fields):
    skeleton = SKELETONS[name]
    frames = from_y_up(PERSON[:, skeleton.carry], up)
    ready = assemble(frames, 5 + np.arange(len(frames)) / 30, None, skeleton=skeleton, up=up)
    result = EngineResult(
        displacement=displacement,
        radius=np.arange(300, dtype=np.float32).reshape(15, 20),
        coverage=0.8,
        version=VersionStamp(0, "base", "ab"),
        timing=Timing(1.0, 2.0, 3.0),
        flags=("uncalibrated",),
    )
    return frames, make_answer(ready, result, skeleton=skeleton, up=up, **fields)


@pytest.mark.parametrize("name", sorted(SKELETONS))
@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_every_joint_moves_as_its_joint_of_the_net(name: str, up: str) -> None:
    skeleton = SKELETONS[name]
    frames, answer = answer_for(name, up)
    moved = to_y_up(answer.frames.astype(np.float64) - frames[-1], up)
    np.testing.assert_allclose(moved, DISPLACEMENT[:, skeleton.carry], atol=1e-5)
    assert answer.radius.shape == (15, len(skeleton.joints))
    np.testing.assert_array_equal(answer.radius[2], 40 + skeleton.carry)


def test_nothing_jumps_at_the_seam() -> None:
    frames, answer = answer_for("azure_kinect", displacement=np.zeros_like(DISPLACEMENT))
    np.testing.assert_allclose(answer.frames, np.repeat(frames[-1:], 15, axis=0), atol=1e-6)


def test_times_go_on_from_the_newest_frame() -> None:
    _, answer = answer_for("kinect_v1")
    newest = 5 + (len(PERSON) - 1) / 30
    np.testing.assert_allclose(answer.t_out, newest + np.arange(1, 16) / 30, atol=1e-12)
    assert answer.t_out.dtype == np.float64


def test_flags_of_input_engine_and_transport_are_joined() -> None:
    _, answer = answer_for("mediapipe", flags=("late_input", "uncalibrated"))
    assert {"root_relative", "uncalibrated", "late_input"} <= set(answer.quality)
    assert len(answer.quality) == len(set(answer.quality))
    assert answer.severity == "degraded"
    assert (answer.coverage, answer.version.sha256) == (0.8, "ab")


@given(
    place=st.floats(-100, 100),
    size=st.floats(0, 50),
    name=st.sampled_from(sorted(SKELETONS)),
    up=st.sampled_from(["y", "-y", "z"]),
)
@settings(max_examples=50, deadline=None)
def test_every_coordinate_is_finite(place: float, size: float, name: str, up: str) -> None:
    joints = np.full((len(SKELETONS[name].joints), 3), place)
    frames = add_displacement(joints, DISPLACEMENT * size, skeleton=SKELETONS[name], up=up)
    assert np.isfinite(frames).all()
