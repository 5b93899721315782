"""What may be trained on: checks of a clip by itself, and of a trial against those before it.

The thresholds were measured on the recordings of UTD-MHAD and of two further collections: no clip
of theirs is refused but the few whose torso is shorter than a quarter of a metre.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from app.domain.body import GuardRules, judge_body, measure_body, measure_bones
from app.domain.recordings import RawFrames
from app.domain.trials import ClipFlaw
from app.personalize.convert import ConvertRules, convert_clip
from models.skeleton import KINECT_V1, Skeleton
from models.spec import MotionSpec

_BODY_FLAWS = {
    "implausible_units": ClipFlaw.IMPLAUSIBLE_UNITS,
    "upside_down": ClipFlaw.UPSIDE_DOWN,
    "implausible_pose": ClipFlaw.IMPLAUSIBLE_POSE,
    "mirrored": ClipFlaw.MIRRORED,
}

_STARTS, _ENDS = np.array(KINECT_V1.bones).T


@dataclass(frozen=True, slots=True)
class QualityRules:
    """When a clip is kept and not trained on.

    Attributes:
        frozen_share: more of a clip than this in runs of identical poses is a frozen sensor.
        jitter_max_m: mean second difference of a joint between frames; people reach 0.05.
        stretch_max: mean relative spread of bone lengths over a clip; sensors reach 0.25.
        stranger_margin: how much the bones of one person may differ between trials, as the mean
            difference of logarithms, where they were measured ever so often.
        stranger_spread: and how many standard errors of the measurement on top of that.
        guard: what a body is like.
        convert: what counts as a hole.
    """

    frozen_share: float = 0.2
    jitter_max_m: float = 0.1
    stretch_max: float = 0.4
    stranger_margin: float = 0.03
    stranger_spread: float = 3.0
    guard: GuardRules = field(default_factory=GuardRules)
    convert: ConvertRules = field(default_factory=ConvertRules)


@dataclass(frozen=True, eq=False)
class Checked:
    """A clip that was looked at.

    Attributes:
        flaw: why it is not to be trained on, None if it may be.
        pieces: what there is to train on, in the net's skeleton; empty with a flaw.
        bones: lengths of the bones, None with a flaw.
    """

    flaw: ClipFlaw | None
    pieces: tuple[Float[np.ndarray, "_ 20 3"], ...] = ()
    bones: Float[np.ndarray, "8"] | None = None


def check_clip(
    frames: RawFrames,
    skeleton: Skeleton,
    *,
    up: str,
    rules: QualityRules | None = None,
    spec: MotionSpec | None = None,
) -> Checked:
    """Look at one clip by itself.

    Args:
        frames: as received.
        skeleton: the user's format.
        up: the user's up axis.
        rules: the thresholds.
        spec: rate and window of the net.
    """
    rules, spec = rules or QualityRules(), spec or MotionSpec()
    # as many frames as a window has, with the rounding of a client's clock
    if frames.seconds < (spec.frames - 1) / spec.rate_hz - 1e-3:
        return Checked(ClipFlaw.TOO_SHORT)
    if _measure_frozen(frames, rules.guard.frozen_poses) > rules.frozen_share:
        return Checked(ClipFlaw.FROZEN)
    pieces = convert_clip(frames, skeleton, up=up, rules=rules.convert, spec=spec)
    if not pieces:
        return Checked(ClipFlaw.PERSON_LOST)
    whole = np.concatenate(pieces)
    flaw = _find_jitter(pieces, rules) or _find_body_flaw(whole, rules.guard)
    if flaw is not None:
        return Checked(flaw)
    return Checked(None, tuple(pieces), measure_bones(whole))


def is_stranger(
    bones: Sequence[Float[np.ndarray, "8"]],
    known: Sequence[Float[np.ndarray, "8"]],
    *,
    rules: QualityRules | None = None,
) -> bool:
    """Tell whether the clips of a trial show somebody else than those before.

    Bones look longer or shorter from clip to clip, by as much as the known clips differ among
    themselves; over many clips that averages out, what is left is the person.

    Args:
        bones: of the good clips of the trial.
        known: of the good clips of the person's earlier trials.
        rules: the thresholds.
    """
    rules = rules or QualityRules()
    if not bones or not known:
        return False
    earlier = np.stack(known)
    person = np.median(earlier, axis=0)
    spread = float(np.median(np.abs(earlier - person).mean(axis=1)))
    count = min(len(bones), len(known))
    limit = rules.stranger_margin + rules.stranger_spread * spread / np.sqrt(count)
    return bool(np.abs(np.median(np.stack(bones), axis=0) - person).mean() > limit)


def _measure_frozen(frames: RawFrames, run: int) -> float:
    """Give the share of frames that lie in runs of at least `run` identical poses."""
    same = (frames.joints[1:] == frames.joints[:-1]).all(axis=(1, 2))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2] + 1
    return float(lengths[lengths >= run].sum() / max(len(frames), 1))


def _find_jitter(
    pieces: Sequence[Float[np.ndarray, "_ 20 3"]], rules: QualityRules
) -> ClipFlaw | None:
    bends = np.concatenate([np.diff(piece, 2, axis=0) for piece in pieces])
    if float(np.linalg.norm(bends, axis=-1).mean()) > rules.jitter_max_m:
        return ClipFlaw.NOISY
    whole = np.concatenate(pieces)
    bones = np.linalg.norm(whole[:, _ENDS] - whole[:, _STARTS], axis=-1)
    spread = bones.std(axis=0) / np.maximum(bones.mean(axis=0), 0.05)
    return ClipFlaw.NOISY if float(spread.mean()) > rules.stretch_max else None


def _find_body_flaw(poses: Float[np.ndarray, "time 20 3"], guard: GuardRules) -> ClipFlaw | None:
    """Judge the body over the whole clip, of which twenty poses tell enough."""
    chosen = poses[:: max(1, len(poses) // 20)]
    facts = np.array([measure_body(pose) for pose in chosen])
    flags = judge_body(facts, np.zeros(len(chosen)), rules=guard, whole=True)
    return next((flaw for flag, flaw in _BODY_FLAWS.items() if flag in flags), None)
