import numpy as np

from app.personalize.bodies import tell_apart

DRAW = np.random.default_rng(0)
ANN, BOB, EVE = np.zeros(8), np.full(8, 0.15), np.full(8, -0.2)


def trial(person: np.ndarray, clips: int = 10) -> list[np.ndarray]:
    return [person + 0.02 * DRAW.standard_normal(8) for _ in range(clips)]


def test_trials_of_one_person_are_all_theirs() -> None:
    found = tell_apart({"a": trial(ANN), "b": trial(ANN), "c": trial(ANN, 1)}, None)
    assert found.person == {"a", "b", "c"}
    assert not found.strangers
    assert not found.is_open


def test_the_majority_of_the_trials_decides_whoever_came_first() -> None:
    found = tell_apart({"a": trial(BOB), "b": trial(ANN), "c": trial(ANN)}, None)
    assert found.person == {"b", "c"}
    assert found.strangers == {"a"}


def test_one_against_one_stays_open() -> None:
    found = tell_apart({"a": trial(BOB), "b": trial(ANN)}, None)
    assert found.is_open
    assert found.strangers == {"a", "b"}
    assert not found.person


def test_who_was_seen_live_decides_between_equals() -> None:
    trials = {"a": trial(BOB), "b": trial(ANN)}
    assert tell_apart(trials, ANN + 0.01).person == {"b"}
    assert tell_apart(trials, BOB - 0.01).person == {"a"}
    assert tell_apart(trials, EVE).is_open


def test_who_was_seen_live_is_one_voice_only() -> None:
    trials = {"a": trial(ANN), "b": trial(ANN), "c": trial(BOB)}
    assert tell_apart(trials, BOB).is_open
    assert tell_apart(trials | {"d": trial(ANN)}, BOB).person == {"a", "b", "d"}


def test_who_was_seen_live_speaks_for_the_body_that_is_most_like_theirs() -> None:
    noisy = {
        "a": [BOB + 0.1 * DRAW.standard_normal(8) for _ in range(20)],
        "b": [ANN + 0.1 * DRAW.standard_normal(8) for _ in range(20)],
    }
    assert tell_apart(noisy, None).is_open
    assert tell_apart(noisy, ANN + 0.02).person == {"b"}
    assert tell_apart(noisy, BOB - 0.02).person == {"a"}


def test_trials_without_any_good_clip_have_no_voice() -> None:
    found = tell_apart({"a": [], "b": trial(ANN)}, None)
    assert found.person == {"b"}
    assert not tell_apart({"a": []}, None).is_open
