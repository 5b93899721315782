import pytest
import torch

from models.familiarity import DIRECTIONS, MOST_POINTS, Familiarity, FamiliarityRule


@pytest.fixture
def windows() -> torch.Tensor:
    """Forty windows of each of three motions, far from each other."""
    torch.manual_seed(0)
    middles = torch.randn(3, 1, 32) * 4
    return (middles + 0.2 * torch.randn(3, 40, 32)).flatten(0, 1)


def test_what_was_trained_on_is_familiar_and_what_is_far_away_is_not(windows: torch.Tensor) -> None:
    known = Familiarity.fit(windows[:80])
    assert (known.share(windows[:80]) > 0.95).all()
    assert known.share(windows[80:] + 10).max() == 0
    assert (known.distance(windows[80:]) > known.distance(windows[:80]).max()).all()


def test_the_share_falls_with_distance_and_is_half_where_the_rule_says(
    windows: torch.Tensor,
) -> None:
    known = Familiarity.fit(windows, FamiliarityRule(half=0.5, width=0.1))
    line = windows[:1] + torch.linspace(0, 60, 200)[:, None] * torch.randn(1, 32)
    distance, share = known.distance(line), known.share(line)
    order = distance.argsort()
    assert (share[order].diff() <= 1e-6).all()
    near_half = (distance - 0.5).abs().argmin()
    assert share[near_half].item() == pytest.approx(0.5, abs=0.35)


def test_it_comes_back_from_its_parts(windows: torch.Tensor) -> None:
    known = Familiarity.fit(windows, FamiliarityRule(half=0.9, width=0.2))
    again = Familiarity.restore(known.tensors(), known.describe())
    assert torch.equal(known.share(windows), again.share(windows))
    assert again.rule == known.rule


def test_long_recordings_are_thinned_out() -> None:
    torch.manual_seed(1)
    many = torch.randn(MOST_POINTS + 500, 8)
    known = Familiarity.fit(many)
    assert len(known.points) == MOST_POINTS
    assert known.distance(many[:1]).item() == pytest.approx(0, abs=1e-3)


def test_fewer_windows_than_directions_are_enough() -> None:
    torch.manual_seed(2)
    few = torch.randn(3, 32)
    assert (Familiarity.fit(few).share(few) > 0.9).all()


def test_nothing_is_refused(windows: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="at least one"):
        Familiarity.fit(windows[:0])


def test_parts_that_do_not_belong_together_are_refused(windows: torch.Tensor) -> None:
    known = Familiarity.fit(windows)
    for name, other, words in (
        ("mean", torch.zeros(5), "sizes"),
        ("axes", torch.zeros(32, 2), "sizes"),
        ("points", torch.zeros(4, 3), "sizes"),
        ("points", known.points[:0], "it knows 0 windows"),
        ("points", torch.zeros(MOST_POINTS + 1, DIRECTIONS), f"it knows {MOST_POINTS + 1} windows"),
        ("points", known.points.double(), "single precision"),
        ("mean", known.mean.half(), "single precision"),
    ):
        with pytest.raises(ValueError, match=words):
            Familiarity.restore(known.tensors() | {name: other}, known.describe())


def test_more_directions_than_a_gate_has_are_refused(windows: torch.Tensor) -> None:
    known = Familiarity.fit(windows)
    for directions in (0, DIRECTIONS + 1):
        wide = {"axes": torch.zeros(32, directions), "points": torch.zeros(4, directions)}
        with pytest.raises(ValueError, match=f"in {directions} directions"):
            Familiarity.restore(known.tensors() | wide, known.describe())


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0.0}, {"width": float("nan")}, {"half": -1.0}, {"half": 10**400}, {"width": 1e200}],
)
def test_a_rule_that_cannot_be_is_refused(windows: torch.Tensor, wrong: dict[str, float]) -> None:
    known = Familiarity.fit(windows)
    with pytest.raises(ValueError, match="impossible"):
        Familiarity.restore(known.tensors(), known.describe() | wrong)
