"""Work on some units at once, each in a process with one thread of arithmetic."""

import os
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import TypeVar

import torch

Job = TypeVar("Job")
Result = TypeVar("Result")


def work(
    function: Callable[[Job], Result], jobs: Sequence[Job], *, at_once: int
) -> Iterator[tuple[Job, Result | Exception]]:
    """Give each job's result, or its error, as soon as it is there.

    With one at once all is done in this process. A `KeyboardInterrupt` ends it; jobs in work are
    lost then.
    """
    if at_once == 1:
        prepare_process()
        yield from ((job, _try(function, job)) for job in jobs)
        return
    pool = ProcessPoolExecutor(
        at_once,
        mp_context=get_context("spawn"),
        initializer=_prepare_child,
        initargs=(os.getpid(),),
    )
    futures = {pool.submit(_try, function, job): job for job in jobs}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BaseException:
        _end(pool)
        raise
    pool.shutdown()


def _try(function: Callable[[Job], Result], job: Job) -> Result | Exception:
    try:
        return function(job)
    except Exception as error:  # noqa: BLE001 - one bad row must not cost the others
        traceback.print_exc()
        return error


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
