"""Weights that 16 bits hold without loss, so that they can be kept, sent and read in 16 bits."""

import torch
from torch import nn


@torch.no_grad()
def round_matrices(net: nn.Module) -> None:
    """Round the matrices of a net, or of a part of one, to bfloat16; its vectors stay as they are.

    Matrices are nearly all of the bytes that a forecast reads, and vectors next to nothing. What
    it costs in accuracy is in models/training/LOG.md.
    """
    for name, weight in net.named_parameters():
        if weight.ndim > 1 and not name.endswith("bias"):
            weight.copy_(weight.bfloat16().float())
