from benchmarks.where import SAMPLES_HZ, count_samples, tabulate

LINES = [
    f"{thread} {at:.6f}: 7f00 ({library})"
    for at in (1.0, 5.0, 5.5, 6.0, 8.0)
    for thread, library in (
        (11, "/lib/_kernel.cpython-311.so"),
        (11, "[kernel.kallsyms]"),
        (10, "/usr/lib/libpython3.11.so.1.0"),
    )
]


def test_samples_are_counted_by_thread_and_library_in_the_time_that_was_asked_for() -> None:
    found = count_samples([*LINES, ""], last_s=2.0)
    assert found == {
        ("11", "kernel of the nets"): 3,
        ("11", "operating system"): 3,
        ("10", "Python"): 3,
    }


def test_the_table_has_the_busiest_thread_first_and_time_per_forecast() -> None:
    found = count_samples(LINES, last_s=2.0)
    lines = tabulate(found, forecasts=1e6 / SAMPLES_HZ).splitlines()
    assert lines[2] == "| 1 | **all** | **6** |"
    assert "| 1 | kernel of the nets | 3 |" in lines
    assert lines[-1] == "| 2 | Python | 3 |"
