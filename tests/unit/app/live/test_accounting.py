from app.live.accounting import ErrorBudget, Ledger, RateLimit
from app.live.clock import ClientClock


def test_a_forecast_settles_itself_and_counts_what_it_overtook() -> None:
    ledger = Ledger()
    for seq in range(5):
        ledger.ask(seq, seq / 30, 0.0)
    ledger.pass_over()
    assert ledger.settle(3) == (3, 1)
    assert ledger.settle(3) is None
    assert ledger.settle(2) is None
    assert ledger.settle(4) == (0, 0)
    assert len(ledger) == 0


def test_what_was_told_otherwise_is_not_counted() -> None:
    ledger = Ledger()
    for seq in range(4):
        ledger.ask(seq, seq / 30, float(seq))
    assert ledger.drop(1)
    assert not ledger.drop(1)
    assert ledger.cover(asked_before=1.0).seq == 0
    assert ledger.cover(asked_before=1.0) is None
    assert ledger.settle(3) == (1, 0)


def test_what_is_forgotten_counts_as_skipped() -> None:
    ledger = Ledger()
    ledger.ask(1, 0.0, 0.0)
    ledger.forget()
    ledger.ask(2, 0.1, 0.1)
    assert ledger.settle(1) is None
    assert ledger.settle(2) == (1, 0)


def test_a_bucket_takes_a_burst_and_then_its_rate() -> None:
    bucket = RateLimit(rate_hz=10.0, burst=5.0)
    assert [bucket.take(0.0) for _ in range(6)] == [True] * 5 + [False]
    assert bucket.take(0.11)
    assert not bucket.take(0.11)
    assert all(bucket.take(1.0 + i / 10) for i in range(50))


def test_a_budget_forgives_with_time() -> None:
    budget = ErrorBudget(most=3, within_s=10.0)
    assert [budget.spend(t) for t in (0.0, 1.0, 2.0, 9.0)] == [True, True, True, False]
    assert budget.spend(12.5)


def test_the_quickest_frame_is_not_delayed() -> None:
    clock = ClientClock()
    assert clock.observe(5.0, 100.5) == 0.0
    assert clock.observe(6.0, 101.3) == 0.0
    assert round(clock.observe(7.0, 102.4)) == 90


def test_a_clock_that_runs_slow_does_not_age_its_frames() -> None:
    clock = ClientClock()
    ages = [clock.observe(i / 30, 100 + i / 30 * 1.05) for i in range(3000)]
    assert max(ages) < 10


def test_a_backlog_is_as_old_as_the_stall() -> None:
    clock = ClientClock()
    for i in range(30):
        clock.observe(i / 30, 100 + i / 30)
    ages = [clock.observe(i / 30, 103.0) for i in range(30, 90)]
    assert ages[0] > 1900
    assert ages[-1] < 50


def test_a_pong_of_a_program_that_stood_still_does_not_age_what_follows() -> None:
    clock = ClientClock()
    clock.observe(0.0, 100.0)
    clock.pong(server_t=100.0, t=3.5, now=103.5)  # the ping waited 3.5 s to be read
    assert clock.observe(3.6, 103.6) < 100


def test_a_quick_pong_tells_more_than_frames_that_were_all_delayed() -> None:
    clock = ClientClock()
    clock.observe(0.0, 100.2)
    clock.pong(server_t=100.3, t=0.31, now=100.32)
    assert 180 < clock.observe(0.4, 100.6) < 220
