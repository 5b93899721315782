import os

import pytest

from benchmarks.studies.pool import work


def double(number):
    if number < 0:
        raise ValueError("no negative numbers")
    return 2 * number, os.getpid()


@pytest.mark.parametrize("at_once", [1, 2])
def test_every_job_has_its_result_or_its_error(at_once, capfd):
    found = dict(work(double, [1, -1, 3], at_once=at_once))
    assert found[1][0] == 2
    assert found[3][0] == 6
    assert isinstance(found[-1], ValueError)
    assert "no negative numbers" in capfd.readouterr().err
    assert (found[1][1] == os.getpid()) == (at_once == 1)


def test_nothing_to_do_is_nothing_done():
    assert list(work(double, [], at_once=1)) == []
