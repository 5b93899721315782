from datetime import UTC, datetime
from uuid import UUID

from app.domain.trials import MOVES, ClipFlaw, ClipInfo, Trial, TrialSource, TrialState


def test_every_state_explains_itself_and_has_a_row_in_the_table():
    assert set(MOVES) == set(TrialState)
    assert len({state.meaning for state in TrialState}) == len(TrialState)


def test_only_a_recording_goes_on():
    assert {state for state in TrialState if MOVES[state]} == {"recording"}
    assert TrialState.RECORDING.may_become(TrialState.STORED)
    assert not TrialState.STORED.may_become(TrialState.RECORDING)


def test_every_flaw_says_what_is_wrong():
    assert len({flaw.meaning for flaw in ClipFlaw}) == len(ClipFlaw)
    assert all(flaw.meaning.endswith((".", "?")) for flaw in ClipFlaw)


def test_trial_adds_its_clips_up():
    clips = (
        ClipInfo(ordinal=0, action="wave", frames=60, seconds=2.0, flaw=None),
        ClipInfo(ordinal=1, action=None, frames=9, seconds=0.3, flaw=ClipFlaw.TOO_SHORT),
    )
    trial = Trial(
        id=UUID(int=1),
        user="ada",
        label=None,
        state=TrialState.STORED,
        source=TrialSource.UPLOAD,
        finetune=True,
        clips=clips,
        created_at=datetime(2026, 1, 1, tzinfo=UTC),
        stored_at=None,
    )
    assert (trial.frames, round(trial.seconds, 3)) == (69, 2.3)
    assert [clip.used for clip in trial.clips] == [True, False]
