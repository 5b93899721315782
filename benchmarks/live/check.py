"""What a take has to stand: every frame answered once, by the version that is named, and stored."""

import bisect
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from app.commands.client.messages import Error, Forecast, Trial, VersionChanged, Waiting
from benchmarks.live.take import RATE_HZ, Place, Take, list_shown
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.skeleton import HIP_CENTER
from models.spec import MotionSpec

OBSERVE = MotionSpec().observe
TOLERANCE_M = 1e-5
WAITING_AGAIN_S = 1.5
"""A `waiting` stands for the frames of the next second, and a little more on a busy machine."""
_BATCH = 256

Net = Predictor | PersonalDecoder


@dataclass(frozen=True, eq=False)
class Offline:
    """What every version makes of every window that was answered, computed in this process.

    Attributes:
        forecasts: those that came, in their order.
        received: when each came.
        places: of their newest frames.
        frames: by sha256, metres in the person's frame of reference.
        shares: by sha256, the person's part; 0 for the base.
    """

    forecasts: list[Forecast]
    received: list[float]
    places: list[Place]
    frames: dict[str, Float32[np.ndarray, "forecast 15 20 3"]]
    shares: dict[str, Float64[np.ndarray, " forecast"]]


def count_frames(take: Take) -> dict[str, Any]:
    """Account for every frame that was sent."""
    refused = {
        message.seq: message.code
        for _, message in take.heard
        if isinstance(message, Error) and message.seq is not None
    }
    asked = sorted(
        seq for seq, place in list_shown(take) if place.frame >= OBSERVE - 1 and seq not in refused
    )
    answered, told = _settle(take, asked)
    waiting = set(range(len(take.places))) - set(asked) - set(refused)
    uncovered = waiting - _find_covered(take, waiting, between=waiting | set(refused))
    errors = sorted({m.code for _, m in take.heard if isinstance(m, Error)})
    return {
        "sent": len(take.places),
        "answered": len(answered),
        "skipped": told["skipped"],
        "waiting": len(waiting) - len(uncovered) + told["overloaded"],
        "refused": len(refused),
        "missing": told["missing"] + len(uncovered),
        "twice": told["twice"],
        "errors": errors,
    }


def _settle(take: Take, asked: Sequence[int]) -> tuple[set[int], dict[str, int]]:
    """Go through the forecasts and compare their counts with what they passed over."""
    open_, answered = set(asked), set[int]()
    told = dict.fromkeys(("skipped", "overloaded", "missing", "twice"), 0)
    for _, message in take.heard:
        if isinstance(message, Waiting) and message.reason == "overloaded":
            covered = {seq for seq in open_ if seq <= message.seq}
            open_ -= covered
            told["overloaded"] += len(covered)
        if not isinstance(message, Forecast):
            continue
        told["twice"] += message.seq not in open_
        answered.add(message.seq)
        open_.discard(message.seq)
        passed = {seq for seq in open_ if seq < message.seq}
        open_ -= passed
        counted = message.skipped + message.not_due
        told["skipped"] += min(counted, len(passed))
        told["missing"] += abs(len(passed) - counted)
    told["missing"] += len(open_)
    return answered, told


def _find_covered(take: Take, waiting: set[int], *, between: set[int]) -> set[int]:
    """Find the frames that a `waiting` stands for: up to the next forecast, for a second or so.

    Args:
        take: what was sent and heard.
        waiting: frames for which there cannot be a forecast.
        between: what may lie between the message and the frame.
    """
    told = sorted(m.seq for _, m in take.heard if isinstance(m, Waiting))
    covered = set()
    for seq in waiting:
        nearest = bisect.bisect_right(told, seq) - 1
        if nearest < 0:
            continue
        said = told[nearest]
        is_recent = take.due[seq] - take.due[said] <= WAITING_AGAIN_S
        if is_recent and all(other in between for other in range(said, seq)):
            covered.add(seq)
    return covered


def count_strays(take: Take, base_sha256: str) -> int:
    """Count the forecasts that are not by the version that was announced last."""
    announced: str | None = base_sha256
    strays = 0
    for _, message in take.heard:
        if isinstance(message, VersionChanged):
            announced = message.version.sha256
        elif isinstance(message, Forecast) and message.version.fallback is None:
            strays += message.version.sha256 != announced
    return strays


def compute_offline(take: Take, nets: Mapping[str, Net]) -> Offline:
    """Forecast every answered window by every version.

    Args:
        take: what was sent and answered.
        nets: the versions by the sha256 of their weights.
    """
    pairs = [(at, m) for at, m in take.heard if isinstance(m, Forecast)]
    places = [place for _, m in pairs if (place := take.places[m.seq]) is not None]
    if len(places) < len(pairs):
        raise ValueError("a frame without the person was answered by a forecast")
    windows = np.stack(
        [take.clips[p.clip].poses[p.frame - OBSERVE + 1 : p.frame + 1] for p in places]
    )
    computed = {sha256: forecast_windows(net, windows) for sha256, net in nets.items()}
    return Offline(
        forecasts=[m for _, m in pairs],
        received=[at for at, _ in pairs],
        places=places,
        frames={sha256: frames for sha256, (frames, _) in computed.items()},
        shares={sha256: shares for sha256, (_, shares) in computed.items()},
    )


def forecast_windows(
    net: Net, windows: Float32[np.ndarray, "window 15 20 3"]
) -> tuple[Float32[np.ndarray, "window 15 20 3"], Float64[np.ndarray, " window"]]:
    """Forecast windows as the service does: centred in float64, then moved back."""
    exact = windows.astype(np.float64)
    origin = exact[:, -1:, HIP_CENTER : HIP_CENTER + 1]
    centred = torch.from_numpy((exact - origin).astype(np.float32))
    frames, shares = [], []
    with torch.inference_mode():
        for part in centred.split(_BATCH):
            if isinstance(net, PersonalDecoder):
                made, share = net.forecast(net.base.encode(part), part)
            else:
                made, share = net(part), torch.zeros(len(part))
            moved = (made - part[:, -1:]).numpy().astype(np.float64)
            frames.append(moved)
            shares.append(share.double().numpy())
    return (exact[:, -1:] + np.concatenate(frames)).astype(np.float32), np.concatenate(shares)


def compare(offline: Offline) -> dict[str, Any]:
    """Compare every forecast with what the version that it names gives, and with all others."""
    own: dict[str, list[float]] = {}
    other: list[float] = []
    share_off = [0.0]
    alike = without_weights = 0
    for i, forecast in enumerate(offline.forecasts):
        named = forecast.version.sha256
        if named is None:
            without_weights += 1
            continue
        off = {sha256: _differ(frames[i], forecast) for sha256, frames in offline.frames.items()}
        own.setdefault(str(forecast.version.number), []).append(off.pop(named))
        share_off.append(abs(forecast.version.share - float(offline.shares[named][i])))
        for sha256, distance in off.items():
            if max(offline.shares[sha256][i], offline.shares[named][i]) == 0:
                alike += 1  # neither has a share, so both are the base
            else:
                other.append(distance)
    return {
        "forecasts_by_version": {number: len(values) for number, values in own.items()},
        "largest_difference_m": {number: max(values) for number, values in own.items()},
        "largest_difference_of_share": max(share_off),
        "compared_with_others": len(other),
        "smallest_difference_from_others_m": min(other, default=None),
        "as_near_to_others": sum(distance <= TOLERANCE_M for distance in other),
        "unfamiliar_windows": alike,
        "without_weights": without_weights,
    }


def _differ(frames: Float32[np.ndarray, "15 20 3"], forecast: Forecast) -> float:
    return float(np.abs(frames.astype(np.float64) - forecast.frames).max())


def compare_stored(take: Take, archive: bytes) -> dict[str, Any]:
    """Compare the trial in a user's export with what was sent.

    Args:
        take: what was sent.
        archive: the zip.
    """
    trial = next(m.trial for _, m in take.heard if isinstance(m, Trial))
    sent = [[(seq, p) for seq, p in list_shown(take) if p.clip == n] for n in range(take.recorded)]
    with zipfile.ZipFile(io.BytesIO(archive)) as zipped:
        names = sorted(name for name in zipped.namelist() if name.startswith(f"trials/{trial}/"))
        stored = [np.load(io.BytesIO(zipped.read(name))) for name in names]
        told = next(one for one in json.loads(zipped.read("trials.json")) if one["id"] == trial)
    pairs = list(zip(stored, sent, strict=False))
    is_equal = len(stored) == len(sent) and all(_is_same(take, a, b) for a, b in pairs)
    actions = [clip["action"] for clip in told["clips"]]
    return {
        "trial": trial,
        "clips": len(stored),
        "frames": sum(len(clip["t"]) for clip in stored),
        "frames_sent": sum(len(frames) for frames in sent),
        "equal": is_equal and actions == [clip.action for clip in take.clips[: take.recorded]],
    }


def _is_same(
    take: Take, stored: Mapping[str, Float[np.ndarray, "..."]], sent: list[tuple[int, Place]]
) -> bool:
    times = np.array([seq / RATE_HZ for seq, _ in sent])
    poses = np.stack([take.find(place) for _, place in sent])
    return np.array_equal(stored["t"], times) and np.array_equal(stored["joints"], poses)
