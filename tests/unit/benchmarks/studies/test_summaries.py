"""Summaries of rows of which the truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies import ablation, everybody, growth, main, seconds, training, unseen, wild
from benchmarks.studies.elsewhere import ELSEWHERE
from benchmarks.studies.measured import Measured
from benchmarks.studies.recordings import read_person
from benchmarks.studies.runner import STUDIES
from benchmarks.studies.tables import Table
from models.data.splits import TEST_SUBJECTS
from models.metrics import FRAMES
from models.training.bootstrap import ClipSums
from models.training.evaluate import PUBLISHED

WINDOWS = np.array([10, 20, 30, 10, 20, 30])
ACTIONS = ("1", "1", "1", "2", "2", "2")


def make_errors(**factors):
    """Six clips of two actions; a method's errors are the base's times its factors per action."""
    random = np.random.default_rng(0)
    base = random.uniform(5, 20, (6, len(FRAMES))) * WINDOWS[:, None]
    scale = {"base": 1.0, "zero_velocity": 2.0} | factors
    sums = {
        method: ClipSums(base * np.repeat(np.broadcast_to(factor, 2), 3)[:, None], WINDOWS)
        for method, factor in scale.items()
    }
    return Measured(ACTIONS, ("2", "3", "4") * 2, sums).as_json()


def make_row(unit, **kept):
    return {"unit": unit, "verdict": "promote", "reach": 1.6, "message": "", **kept}


def find(tables, start):
    (table,) = (table for table in tables if table.title.startswith(start))
    return table


def test_who_is_worse_off_is_counted():
    rows = [
        make_row("a", errors=make_errors(served=0.8, plain=(0.5, 1.2))),
        make_row("b", errors=make_errors(served=0.9, plain=1.3), verdict="reject"),
    ]
    tables = everybody.summarise(rows)
    lines = {line[0]: line[1:] for line in tables[0].rows}
    worse = lines["versions worse than the base at frame 15"]
    assert worse == ("0 of 2 (0.0%)", "1 of 2 (50.0%)")
    harmed = lines["version and action worse by more than 5%, interval above 1"]
    assert harmed == ("0 of 4 (0.0%)", "3 of 4 (75.0%)")
    assert lines["promoted"] == ("1 of 2 (50.0%)", "-")
    assert [line[:2] for line in tables[2].rows] == [("a", "2"), ("b", "1"), ("b", "2")]
    assert [line[1] for line in tables[1].rows] == ["promoted", "reject"]


def test_an_action_is_harmed_only_by_more_than_the_margin():
    found = Measured.from_json(make_errors(served=(1.04, 1.06)))
    harmed = {
        a: everybody.is_harmed(r) for a, r in everybody.compare_actions(found, "served").items()
    }
    assert harmed == {"1": False, "2": True}


def test_draws_are_halves_of_the_actions():
    draws = [unseen.draw_actions(draw) for draw in range(unseen.DRAWS)]
    assert {len(set(draw)) for draw in draws} == {13, 14}
    assert len({tuple(draw) for draw in draws}) == unseen.DRAWS
    assert draws == [unseen.draw_actions(draw) for draw in range(unseen.DRAWS)]
    assert set.union(*map(set, draws)) == {str(action) for action in range(1, 28)}


def test_seen_and_unseen_actions_are_told_apart():
    rows = [
        make_row(f"{draw}", person="utd-mhad/2", draw=draw, actions=["1"], errors=errors)
        for draw, errors in enumerate(
            (
                make_errors(served=(0.8, 1.0), plain=(0.6, 1.2)),
                make_errors(served=(0.72, 1.02), plain=(0.6, 1.4)),
            )
        )
    ]
    (table,) = unseen.summarise(rows)
    served, plain = table.rows
    assert served[3:5] == ("0.760 (0.800)", "1.010 (1.020)")
    assert plain[3:5] == ("0.600 (0.600)", "1.300 (1.400)")
    assert served[-1] == "60%"
    assert plain[-1] == "100%"


def make_main_rows(family="shipped", seeds=(0, 1), **factors):
    return [
        make_row(
            f"{family}-{seed}, subject {subject}",
            family=family,
            seed=seed,
            person=f"utd-mhad/{subject}",
            errors=make_errors(**{m: f * (1 + 0.1 * seed) for m, f in factors.items()}),
        )
        for seed in seeds
        for subject in TEST_SUBJECTS
    ]


def test_the_papers_rows_are_divided_by_as_the_protocol_says():
    row = make_main_rows(served=0.7, plain=0.6)[0]
    found = {subject: Measured.from_json(row["errors"]) for subject in TEST_SUBJECTS}
    ratios = main.compare_with_paper(found, "served")
    cells = np.array(
        [np.divide(found[s].cm2("served"), PUBLISHED["paper: personal", s]) for s in TEST_SUBJECTS]
    )
    assert ratios["late"] == pytest.approx(cells[:, 2:].mean())
    assert ratios["early"] == pytest.approx(cells[:, :2].mean())
    assert ratios["worst"] == pytest.approx(cells.max())


def test_the_protocol_is_summed_up_over_seeds_and_families():
    rows = make_main_rows(served=0.7, plain=0.6) + make_main_rows("paper", served=0.9, plain=0.8)
    rows += make_main_rows("ridge", seeds=(0,), plain=0.95)
    tables = main.summarise(rows)
    ratios = {line[0]: line[1:] for line in find(tables, "Ratios on the same clips").rows}
    own = ratios["shipped, personal, with judge and gate ÷ shipped, base"]
    assert own == (*["0.735"] * len(FRAMES), "0.735 to 0.735")
    assert "paper, personal, with judge and gate ÷ ridge, personal, without" in ratios
    seeds = {line[0]: line[2] for line in tables[0].rows}
    assert seeds["shipped, base"] == "2"
    assert seeds["ridge, base"] == "1"
    assert len(find(tables, "cm², mean over frames 1..k: shipped").rows) == 9


def test_peers_elsewhere_are_divided_by_cell_by_cell():
    rows = make_main_rows(served=0.7, plain=0.6)
    table = find(main.summarise(rows), "Error ÷ that of the peers in another")
    both_seeds = 1.05  # the second seed's factor is a tenth above the first one's
    assert [line[1] for line in table.rows] == ["siMLPe", "siMLPe, personal"]
    errors = np.array(Measured.from_json(rows[0]["errors"]).cm2("served")) * both_seeds
    ratios = np.array([errors / ELSEWHERE["siMLPe, personal"][who] for who in TEST_SUBJECTS])
    told = (ratios.mean(), ratios[:, 1:].mean(), ratios[:, 1:].max(), ratios.max())
    assert table.rows[1][3:] == tuple(f"{value:.3f}" for value in told)


def test_seeds_that_lack_a_subject_are_not_summed_up():
    rows = make_main_rows(served=0.7, plain=0.6)[:-1]
    assert set(main.by_seed(rows, "shipped")) == {0}
    assert main.summarise(rows[:1])[0].rows == []


def test_growth_is_shown_with_the_base_first():
    rows = [
        make_row(
            f"{count}",
            person="utd-mhad/2",
            trials=[str(i + 1) for i in range(count)],
            errors=make_errors(served=0.9 - 0.1 * count),
        )
        for count in (2, 1)
    ]
    errors, ratios = growth.summarise(rows)
    assert [line[1] for line in errors.rows] == ["none", "1", "1, 2"]
    assert [line[2] for line in ratios.rows] == ["0.800", "0.700"]


def test_people_in_the_wild_are_pooled_by_collection():
    rows = [
        make_row(person, part=wild.NEW_COLLECTION, person=person, errors=make_errors())
        for person in ("precog/1", "precog/2", "precog/7")
    ]
    summary, table = wild.summarise(rows)
    assert [line[0] for line in summary.rows] == [
        "new collection, precog",
        "new collection, mean of 1",
    ]
    assert {line[-1] for line in summary.rows} == {"0.500"}
    assert summary.rows[0][1].startswith("0.500 (0.500 to")
    assert [line[0] for line in table.rows[3:]] == [
        "precog, people who train",
        "precog, people who never train",
    ]
    assert {line[1] for line in table.rows} == {"0.500"}


def test_the_halves_of_a_sequence_lie_a_gap_apart(place):
    (clip, *_) = read_person(place, "precog/7")
    (earlier,), (later,) = wild.cut_earlier([clip]), wild.cut_later([clip])
    middle = len(clip.poses) // 2
    assert np.array_equal(earlier.poses, clip.poses[:middle])
    assert np.array_equal(later.poses, clip.poses[middle + wild.GAP_FRAMES :])
    assert wild.cut_later([replace(clip, poses=clip.poses[:100])]) == []


def test_ablations_are_divided_by_every_part():
    rows = [
        make_row(ablation.EVERY_PART, errors=make_errors(plain=0.6, gated=0.7)),
        make_row("ablation-no-c", errors=make_errors(plain=0.9, gated=0.7)),
    ]
    ratios, means, errors = ablation.summarise(rows)
    assert ratios.rows[1][2] == "1.500 (1.500 to 1.500)"
    assert means.rows[1][1:5] == ("1.000", "1.000", "1.500", "1.500")
    assert len(errors.rows) == 2
    assert len(ablation.summarise(rows[1:])) == 1


def test_a_budget_is_divided_into_copies_and_steps():
    config = seconds.spend(10.0, copy_s=0.5, step_s=0.1)
    assert (config.copies, config.steps) == (6, 70)
    small = seconds.spend(1.0, copy_s=0.5, step_s=0.1)
    assert (small.copies, small.steps) == (1, 5)
    assert seconds.spend(0.1, copy_s=0.5, step_s=0.1).steps == 1


def test_bases_are_listed():
    row = {
        "unit": "paper-1",
        "data": {"utd-mhad": {"subjects": ["1", "3"]}},
        "left_out": [],
        "steps": 10,
        "steps_of_this_run": 4,
        "training_s": 3.0,
        "sha256": "a" * 64,
    }
    (table,) = training.summarise([row])
    assert table.rows == [("paper-1", "utd-mhad: 2", "-", "10", "resumed", "a" * 12)]
    assert training.tell(row).startswith("10 steps")


def test_tables_as_markdown():
    table = Table("Title", ("a", "b"), [("1", "2")])
    assert table.as_markdown() == "Title\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_every_study_asks_something():
    assert all(study.question.endswith("?") for study in STUDIES.values())
