import json
import threading

from benchmarks.studies.cache import Cache, locked, make_key


def test_a_key_is_decided_by_everything_and_by_no_order():
    assert make_key({"a": 1, "b": [2]}) == make_key({"b": [2], "a": 1})
    assert make_key({"a": 1}) != make_key({"a": 2})


def test_rows_are_given_by_unit_and_the_later_one_counts(tmp_path):
    cache = Cache(tmp_path / "deep" / "study.jsonl")
    assert cache.read() == {}
    for unit, value in (("x", 1), ("y", 2), ("x", 3)):
        cache.add({"key": f"{unit}{value}", "unit": unit, "value": value})
    assert {unit: row["value"] for unit, row in cache.read().items()} == {"x": 3, "y": 2}


def test_a_line_that_was_cut_short_costs_that_row_alone(tmp_path):
    cache = Cache(tmp_path / "study.jsonl")
    cache.add({"key": "x", "unit": "x"})
    with cache.path.open("a") as file:
        file.write('{"key": "torn", "un')
    cache.add({"key": "y", "unit": "y"})
    assert set(cache.read()) == {"x", "y"}


def test_tidying_keeps_the_latest_row_of_each_unit(tmp_path):
    cache = Cache(tmp_path / "study.jsonl")
    for key, unit in (("old", "a"), ("other", "b"), ("new", "a")):
        cache.add({"key": key, "unit": unit})
    cache.tidy()
    lines = [json.loads(line) for line in cache.path.read_text().splitlines()]
    assert {line["unit"]: line["key"] for line in lines} == {"a": "new", "b": "other"}


def test_processes_take_turns(tmp_path):
    cache, began = Cache(tmp_path / "study.jsonl"), threading.Event()

    def add():
        began.set()
        cache.add({"key": "x", "unit": "x"})

    with locked(tmp_path):
        thread = threading.Thread(target=add)
        thread.start()
        began.wait(10)
        thread.join(0.2)
        assert cache.read() == {}
    thread.join(10)
    assert set(cache.read()) == {"x"}


def test_tidying_nothing_leaves_nothing(tmp_path):
    cache = Cache(tmp_path / "study.jsonl")
    cache.tidy()
    assert not cache.path.exists()
