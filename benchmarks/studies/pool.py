"""Work on some units at once, each in a process with one thread of arithmetic."""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import TypeVar

import torch

Job = TypeVar("Job")
Result = TypeVar("Result")


def work(
    function: Callable[[Job], Result], jobs: Sequence[Job], *, at_once: int
) -> Iterator[tuple[Job, Result]]:
    """Give each job's result as soon as it is there; with one at once, in this process.

    Ends at the first job that fails, and with a `KeyboardInterrupt`; those in work are lost then.
    """
    if at_once == 1:
        prepare_process()
        yield from ((job, function(job)) for job in jobs)
        return
    pool = ProcessPoolExecutor(
        at_once,
        mp_context=get_context("spawn"),
        initializer=_prepare_child,
        initargs=(os.getpid(),),
    )
    futures = {pool.submit(function, job): job for job in jobs}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BaseException:
        _end(pool)
        raise
    pool.shutdown()


def prepare_process() -> None:
    """Compute with one thread, so that equal settings give equal numbers."""
    torch.set_num_threads(1)


def _prepare_child(parent: int) -> None:
    prepare_process()
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()


def _follow(parent: int) -> None:
    """End with the parent, however that ended."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _end(pool: ProcessPoolExecutor) -> None:
    pool.shutdown(wait=False, cancel_futures=True)
    for process in list((pool._processes or {}).values()):  # noqa: SLF001 - no public way in 3.11
        process.terminate()
