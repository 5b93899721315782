import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from models.training.ledger import record_reading


def read(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_reading_is_a_line_that_says_when_where_and_what(tmp_path: Path) -> None:
    ledger = tmp_path / "readings.jsonl"
    record_reading(ledger, what="evaluate", config={"model": "abc"}, figures=[{"cm²": 1.5}])
    record_reading(ledger, what="again", config={}, figures={})
    first, second = read(ledger)
    assert set(first) == {"date", "commit", "what", "config", "figures"}
    assert first["config"] == {"model": "abc"}
    assert first["figures"] == [{"cm²": 1.5}]
    assert str(first["date"]).endswith("+00:00")
    assert second["what"] == "again"


def test_lines_of_several_writers_do_not_mix(tmp_path: Path) -> None:
    ledger = tmp_path / "readings.jsonl"
    with ThreadPoolExecutor(4) as pool:
        for index in range(12):
            pool.submit(record_reading, ledger, what=str(index), config={}, figures=["x" * 50_000])
    assert sorted(int(str(line["what"])) for line in read(ledger)) == list(range(12))


def test_half_a_line_of_somebody_else_spoils_only_itself(tmp_path: Path) -> None:
    ledger = tmp_path / "readings.jsonl"
    ledger.write_text('{"what": "half')
    record_reading(ledger, what="whole", config={}, figures=[])
    assert json.loads(ledger.read_text().splitlines()[1])["what"] == "whole"


def test_a_line_that_does_not_fit_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = tmp_path / "readings.jsonl"
    record_reading(ledger, what="first", config={}, figures=[])
    before = ledger.read_bytes()
    write = os.write

    def write_some(handle: int, data: bytes) -> int:
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return write(handle, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", write_some)
    with pytest.raises(OSError, match="No space left"):
        record_reading(ledger, what="second", config={}, figures=[])
    assert ledger.read_bytes() == before


def test_what_is_no_figure_is_refused(tmp_path: Path) -> None:
    ledger = tmp_path / "readings.jsonl"
    with pytest.raises(ValueError, match="JSON compliant"):
        record_reading(ledger, what="nan", config={}, figures=[float("nan")])
    assert not ledger.exists()
