"""A process of its own for work that must not happen where forecasts are made.

The child is a fresh interpreter, never a fork: threads of torch do not survive one. It gets its
task on standard input and answers on standard output, in one piece, and is ended when it takes too
long or too much.
"""

import asyncio
import os
import resource
import sys
from asyncio.subprocess import PIPE
from collections.abc import Callable

TIMED_OUT, CRASHED = "timed_out", "crashed"


class ChildError(Exception):
    """A child that gave no answer.

    Attributes:
        why: `timed_out` or `crashed`.
    """

    def __init__(self, why: str) -> None:
        super().__init__(f"the child process {why.replace('_', ' ')}")
        self.why = why


async def run_child(module: str, task: bytes, *, timeout_s: float, memory_bytes: int) -> bytes:
    """Run a module as a child, hand it a task, and give its answer.

    Args:
        module: whose `main` calls `serve_task`.
        task: for its standard input.
        timeout_s: longest time for all of it.
        memory_bytes: most address space.

    Raises:
        ChildError: no answer, for whichever reason.
    """
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-m", module, str(memory_bytes), stdin=PIPE, stdout=PIPE
    )
    try:
        answer, _ = await asyncio.wait_for(child.communicate(task), timeout_s)
    except TimeoutError:
        raise ChildError(TIMED_OUT) from None
    finally:
        if child.returncode is None:
            child.kill()
            await child.wait()
    if child.returncode != 0:
        raise ChildError(CRASHED)
    return answer


def serve_task(work: Callable[[bytes], bytes]) -> None:
    """Be the child: limit yourself, read the task, work, answer."""
    memory = int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.nice(5)
    answer = work(sys.stdin.buffer.read())
    sys.stdout.buffer.write(answer)
    sys.stdout.buffer.flush()
