import numpy as np
import pytest

from app.domain.versions import Verdict
from app.personalize.judge import (
    REACHES,
    Evidence,
    Figures,
    Rival,
    compare,
    join,
    judge,
    no_figures,
)
from models.metrics import FRAMES


def make_figures(*ratios: float, clips: int = 12, spread: float = 0.02, seed: int = 0) -> Figures:
    """Clips on which the candidate at each reach has this part of the base's error."""
    draw = np.random.default_rng(seed)
    before = draw.uniform(10, 60, (clips, 1)) * np.linspace(0.2, 1, len(FRAMES))
    wanted = np.array(ratios if len(ratios) > 1 else ratios * len(REACHES))
    noise = 1 + spread * draw.standard_normal((len(REACHES), clips, 1))
    return Figures(before, before[None] * wanted[:, None, None] * noise)


def make_evidence(
    like: Figures,
    unlike: Figures,
    trials: dict[str, Figures] | None = None,
    rival: Rival | None = None,
) -> Evidence:
    return Evidence(like, unlike, trials or {}, rival)


def test_what_helps_and_does_no_harm_is_promoted_at_the_furthest_reach() -> None:
    ruling = judge(make_evidence(make_figures(0.9), make_figures(0.97)))
    assert (ruling.verdict, ruling.reach) == (Verdict.PROMOTE, REACHES[0])
    assert "-3." in ruling.message


def test_the_furthest_reach_that_does_no_harm_is_taken() -> None:
    unlike = make_figures(1.12, 1.06, 0.97, 0.98, spread=0.01)
    ruling = judge(make_evidence(make_figures(0.8), unlike))
    assert (ruling.verdict, ruling.reach) == (Verdict.PROMOTE, REACHES[2])


def test_what_harms_at_every_reach_is_rejected() -> None:
    ruling = judge(make_evidence(make_figures(0.9), make_figures(1.05, spread=0.01)))
    assert ruling.verdict is Verdict.REJECT
    assert "not good enough" in ruling.message


def test_what_never_helps_is_rejected() -> None:
    ruling = judge(make_evidence(make_figures(1.05), make_figures(1.0)))
    assert ruling.verdict is Verdict.REJECT
    assert "does not help" in ruling.message


def test_a_few_clips_of_other_motion_say_little_and_many_say_much() -> None:
    unsure = make_figures(1.03, clips=4, spread=0.15)
    assert unsure.compare(REACHES[0]).ratio > 1.02
    assert judge(make_evidence(make_figures(0.8), unsure)).verdict is Verdict.PROMOTE
    sure = make_figures(1.03, clips=100, spread=0.05)
    assert judge(make_evidence(make_figures(0.8), sure)).verdict is Verdict.REJECT


def test_a_gain_that_is_not_seen_for_want_of_clips_is_no_harm() -> None:
    unsure = make_figures(1.02, clips=4, spread=0.15, seed=1)
    assert 1 < unsure.compare(REACHES[0]).ratio < 1.1
    ruling = judge(make_evidence(unsure, make_figures(0.99, clips=4)))
    assert ruling.verdict is Verdict.PROMOTE


def test_later_parts_alone_reject_only_what_is_surely_worse() -> None:
    weak = make_figures(1.05, 1.04, 1.03, 0.99, clips=6, spread=0.2)
    assert judge(make_evidence(weak, make_figures(0.95))).reach == REACHES[0]
    strong = make_figures(1.3, 1.2, 1.05, 0.98, spread=0.01)
    assert judge(make_evidence(strong, make_figures(0.95))).reach == REACHES[2]


def test_whole_trials_left_out_must_show_the_gain() -> None:
    weak = make_figures(0.99, spread=0.2)
    trials = {"b": weak}
    assert judge(make_evidence(weak, make_figures(0.97), trials)).verdict is Verdict.REJECT
    sure = make_figures(0.7, spread=0.1)
    ruling = judge(make_evidence(sure, make_figures(0.97), {"b": sure}))
    assert ruling.verdict is Verdict.PROMOTE
    assert "Whole trials" in ruling.message


def test_a_trial_that_a_candidate_loses_on_rejects_it() -> None:
    good, bad = make_figures(0.6), make_figures(1.1, spread=0.01)
    trials = {"good": good, "bad": bad}
    ruling = judge(make_evidence(good, make_figures(0.97), trials))
    assert ruling.verdict is Verdict.REJECT
    assert "trial bad" in ruling.message


def make_rival(figures: Figures, active: float) -> Rival:
    base = figures.before[:, -1]
    return Rival(base=base, active=active * base, candidate=figures.after[:, :, -1])


def test_a_candidate_must_not_lose_against_what_is_active_on_the_new_trial() -> None:
    new = make_figures(0.8)
    for active, verdict in ((0.7, Verdict.REJECT), (0.8, Verdict.PROMOTE), (0.9, Verdict.PROMOTE)):
        evidence = make_evidence(new, make_figures(0.97), {"new": new}, make_rival(new, active))
        assert judge(evidence).verdict is verdict, active


def test_a_candidate_that_equals_the_active_version_on_the_new_trial_does_not_lose() -> None:
    new = make_figures(0.8, spread=0.0)
    same = Rival(new.before[:, -1], new.after[0, :, -1] * (1 - 1e-9), new.after[:, :, -1])
    evidence = make_evidence(new, make_figures(0.97), {"new": new}, same)
    assert judge(evidence).verdict is Verdict.PROMOTE


def test_an_active_version_that_harms_on_the_new_trial_gives_way_to_the_base() -> None:
    new = make_figures(1.02)
    harmful, harmless = make_rival(new, 1.2), make_rival(new, 0.95)
    evidence = make_evidence(new, make_figures(0.99), {"new": new}, harmful)
    ruling = judge(evidence)
    assert ruling.verdict is Verdict.RETURN_TO_BASE
    assert "active version does harm" in ruling.message
    evidence = make_evidence(new, make_figures(0.99), {"new": new}, harmless)
    assert judge(evidence).verdict is Verdict.REJECT


def test_the_clip_is_the_unit() -> None:
    before = np.array([10.0, 20.0, 30.0])
    found = compare(before, np.array([5.0, 20.0, 35.0]))
    assert found.ratio == pytest.approx(1.0)
    assert found.error > 0.1
    assert compare(before[:1], before[:1]).error == float("inf")


def test_figures_say_how_many_clips_were_won() -> None:
    figures = join([make_figures(0.9, clips=4, spread=0), make_figures(1.1, clips=3, spread=0)])
    told = figures.summarise(REACHES[0])
    assert (told["clips"], told["clips_won"], told["clips_lost"]) == (7, 4, 3)
    assert len(told["before_cm2"]) == len(told["after_cm2"]) == len(FRAMES)


def test_without_later_parts_the_motion_left_out_decides() -> None:
    assert judge(make_evidence(no_figures(), make_figures(0.9))).verdict is Verdict.PROMOTE
    assert judge(make_evidence(no_figures(), make_figures(1.1))).verdict is Verdict.REJECT
    assert no_figures().summarise(REACHES[0]) == {"clips": 0}


def test_without_enough_other_motion_nothing_is_promoted() -> None:
    for clips in (0, 1):
        unlike = make_figures(0.9, clips=clips) if clips else no_figures()
        ruling = judge(make_evidence(make_figures(0.7), unlike, {"b": make_figures(0.7)}))
        assert ruling.verdict is Verdict.REJECT
        assert "too little other motion" in ruling.message
    harmful = make_figures(5.0, clips=1)
    assert judge(make_evidence(make_figures(0.7), harmful)).verdict is Verdict.REJECT


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_errors_that_are_no_numbers_are_never_promoted(wrong: float) -> None:
    for like, unlike in ((wrong, 0.9), (0.9, wrong), (wrong, wrong)):
        ruling = judge(make_evidence(make_figures(like), make_figures(unlike)))
        assert ruling.verdict is Verdict.REJECT
        assert "not finite" in ruling.message


def test_figures_of_one_clip_have_no_standard_error() -> None:
    told = make_figures(0.9, clips=1).summarise(REACHES[0])
    assert told["standard_error"] is None


@pytest.mark.parametrize("after", [[1.1, 1.4], [1.1, 1.9], [0.9, 0.9, 0.9, 3.3], [1.3, 1.0, 1.03]])
def test_a_tenth_worse_is_never_admitted_however_unsure_a_few_clips_are(after: list[float]) -> None:
    before = np.full((len(after), len(FRAMES)), 20.0)
    harmful = Figures(before, np.tile(before * np.array(after)[:, None], (len(REACHES), 1, 1)))
    ruling = judge(make_evidence(make_figures(0.7), harmful))
    assert ruling.verdict is Verdict.REJECT


def test_a_clip_that_the_base_forecasts_without_error_hides_no_harm() -> None:
    before = np.array([[100.0], [0.0]]) * np.ones(len(FRAMES))
    harmful = Figures(before, np.tile(before * 1.3, (len(REACHES), 1, 1)))
    assert judge(make_evidence(make_figures(0.7), harmful)).verdict is Verdict.REJECT
