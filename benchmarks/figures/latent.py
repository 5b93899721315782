"""The latent, coloured by action, along the directions that tell actions apart."""

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.linalg import eigh

from benchmarks.figures.people import read_clips
from benchmarks.figures.style import INK
from models.checkpoint import SHIPPED, load_checkpoint
from models.data.windows import cut_windows
from models.predictor import Predictor

FITTED, TRAINED, NEW = ("1", "3", "5"), "7", "2"
"""Whose windows give the directions; who trained the base too; and who never did."""
_STRIDE, _TINTS, _RIDGE = 3, 27, 1e-3


def draw_latent() -> Figure:
    """Draw z of two people's windows along two directions that were found on others."""
    net = load_checkpoint(SHIPPED).predictor
    z, actions = _encode(net, *FITTED)
    directions = find_directions(z, actions)
    centres = {one: (z[actions == one] @ directions).mean(axis=0) for one in np.unique(actions)}
    figure, axes = plt.subplots(1, 2, figsize=(11, 5.2), sharex=True, sharey=True, layout="tight")
    for axis, subject in zip(axes, (TRAINED, NEW), strict=True):
        own, shown = _encode(net, subject)
        placed = own @ directions
        right = 100 * np.mean(find_nearest(placed, centres) == shown)
        _scatter(axis, placed[:, :2], shown)
        who = "who trained it" if subject == TRAINED else "who never did"
        axis.set_title(
            f"subject {subject}, {who}\n{right:.0f} % of windows nearest to their action's centre",
            fontsize=9,
        )
        axis.set_xlabel("direction of z that tells actions apart best")
    axes[0].set_ylabel("second")
    people = ", ".join(FITTED)
    figure.suptitle(
        f"Windows in the latent, by action; directions and centres of subjects {people}"
    )
    return figure


def find_directions(z: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Give Fisher's linear discriminants, best first.

    Args:
        z: [sample, coordinate].
        labels: [sample] of at least two kinds.

    Returns:
        [coordinate, label - 1] directions, along which samples of a label vary by about one.
    """
    kinds = np.unique(labels)
    means = np.array([z[labels == kind].mean(axis=0) for kind in kinds])
    spread = z - means[np.searchsorted(kinds, labels)]
    within = spread.T @ spread / len(z)
    within += _RIDGE * np.trace(within) / len(within) * np.eye(len(within))
    counts = np.array([np.sum(labels == kind) for kind in kinds])
    offsets = means - np.average(means, axis=0, weights=counts)
    between = (offsets.T * counts) @ offsets / len(z)
    _, directions = eigh(between, within)
    best: np.ndarray = directions[:, ::-1][:, : len(kinds) - 1]
    return best


def find_nearest(placed: np.ndarray, centres: dict[int, np.ndarray]) -> np.ndarray:
    """Name the centre that each sample is nearest to."""
    names, places = np.array(list(centres)), np.array(list(centres.values()))
    squared = (placed**2).sum(axis=1)[:, None] - 2 * placed @ places.T + (places**2).sum(axis=1)
    nearest: np.ndarray = names[squared.argmin(axis=1)]
    return nearest


def _encode(net: Predictor, *subjects: str) -> tuple[np.ndarray, np.ndarray]:
    """Give z of people's windows, and the action of each."""
    clips = [clip for subject in subjects for clip in read_clips(subject)]
    windows = cut_windows(clips, net.spec, stride=_STRIDE)
    with torch.inference_mode():
        z = net.encode(torch.from_numpy(windows.observed)).z.numpy()
    return z, np.array([int(clips[clip].action) for clip in windows.clip])


def _scatter(axis: Axes, placed: np.ndarray, actions: np.ndarray) -> None:
    tints = plt.get_cmap("turbo")
    for action in np.unique(actions):
        own = placed[actions == action]
        tint = tints((action - 1) / (_TINTS - 1))
        axis.scatter(
            own[:, 0], own[:, 1], s=5, color=tint, alpha=0.6, linewidths=0, rasterized=True
        )
        x, y = np.median(own, axis=0).tolist()
        axis.text(x, y, str(action), color=INK, fontsize=8, ha="center", weight="bold")
