import numpy as np
import pytest

from app.domain.recordings import RawFrames
from app.domain.trials import ClipFlaw
from app.personalize.quality import check_clip, is_stranger
from models.skeleton import KINECT_V1
from tests.personal_support import record_frames


def check(joints, rate_hz=30.0):
    joints = np.asarray(joints, dtype=np.float32)
    frames = RawFrames(t=np.arange(len(joints)) / rate_hz, joints=joints)
    return check_clip(frames, KINECT_V1, up="y")


GOOD = record_frames(3.0).joints
RNG = np.random.default_rng(0)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("action", ["wave", "walk"])
def test_believable_people_are_trained_on(seed, action):
    checked = check(record_frames(3.0, seed=seed, action=action).joints)
    assert checked.flaw is None
    assert len(checked.pieces) == 1
    assert checked.bones.shape == (8,)


@pytest.mark.parametrize(
    ("joints", "flaw"),
    [
        (GOOD[:29], ClipFlaw.TOO_SHORT),
        (np.repeat(GOOD[:1], 60, axis=0), ClipFlaw.FROZEN),
        (np.concatenate([GOOD[:40], np.repeat(GOOD[40:41], 40, axis=0)]), ClipFlaw.FROZEN),
        (RNG.normal(size=(90, 20, 3)), ClipFlaw.NOISY),
        (GOOD + RNG.normal(scale=0.1, size=GOOD.shape), ClipFlaw.NOISY),
        (GOOD[:, list(KINECT_V1.mirror)], ClipFlaw.MIRRORED),
        (GOOD * 1000.0, ClipFlaw.NOISY),
        (GOOD * 3.0, ClipFlaw.IMPLAUSIBLE_UNITS),
        (GOOD * [1, -1, -1], ClipFlaw.UPSIDE_DOWN),
        (np.full((60, 20, 3), np.nan), ClipFlaw.PERSON_LOST),
    ],
)
def test_junk_is_named(joints, flaw):
    checked = check(joints)
    assert checked.flaw is flaw
    assert checked.pieces == ()


def test_thirty_frames_are_enough_and_the_rate_does_not_matter():
    assert check(GOOD[:30]).flaw is None
    assert (
        check(np.repeat(GOOD, 2, axis=0)[:60] + np.linspace(0, 0.01, 60)[:, None, None], 60.0).flaw
        is None
    )
    assert check(GOOD[:40], 60.0).flaw is ClipFlaw.TOO_SHORT


def bones_of(seed, *, clips=6, noise=0.02, scale=1.0):
    rng = np.random.default_rng(seed)
    own = check(record_frames(2.0, seed=1).joints).bones + np.log(scale)
    return [own + rng.normal(scale=noise, size=8) for _ in range(clips)]


def test_same_person_is_no_stranger_however_bad_the_sensor():
    for noise in (0.0, 0.02, 0.1):
        assert not is_stranger(bones_of(1, noise=noise), bones_of(2, noise=noise))


def test_somebody_else_is():
    assert is_stranger(bones_of(1, scale=1.15), bones_of(2))
    assert is_stranger(bones_of(1, scale=0.85), bones_of(2))


def test_first_trial_is_always_that_of_the_person():
    assert not is_stranger(bones_of(1, scale=2.0), [])
    assert not is_stranger([], bones_of(1))


@pytest.mark.recordings
def test_recordings_of_real_people_are_trained_on(utd_mhad):
    from models.data.clips import load_clips

    clips = load_clips(utd_mhad, subjects={"1", "3"})
    checked = {}
    for clip in clips:
        found = check(clip.poses)
        assert found.flaw is None, (clip.subject, clip.action, clip.trial)
        assert np.array_equal(found.pieces[0].astype(np.float32), clip.poses)
        checked.setdefault((clip.subject, clip.trial), []).append(found.bones)
    for subject in ("1", "3"):
        for trial in ("2", "3", "4"):
            assert not is_stranger(checked[subject, trial], checked[subject, "1"])
