import pytest

from app.domain.motion import FLAGS, QUALITY, Severity, worst_severity


def test_flags_are_unique_and_explained():
    assert len(QUALITY) == len(FLAGS) == 17
    assert all(flag.meaning.endswith(".") for flag in FLAGS)


@pytest.mark.parametrize(
    ("flags", "severity"),
    [
        ([], Severity.INFO),
        (["filled_joints"], Severity.INFO),
        (["filled_joints", "gap"], Severity.DEGRADED),
        (["gap", "mirrored", "blended"], Severity.UNSAFE),
        (["a_flag_of_the_future"], Severity.DEGRADED),
    ],
)
def test_severity_is_that_of_the_worst_flag(flags, severity):
    assert worst_severity(flags) is severity
