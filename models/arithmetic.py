"""How this process computes: the same for everything that fits or is measured."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def arithmetic(threads: int) -> Iterator[None]:
    """Compute with so many threads, and without denormal numbers, until the block ends.

    Weights that decay towards zero pass through denormal numbers, which slow some processors
    tenfold. Equal results need equal settings.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(before)
