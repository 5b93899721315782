"""Personal versions of the studies: as they are served, and as they would be without safeguards."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from time import monotonic
from typing import Any

from app.domain.versions import Verdict
from app.personalize.offline import choose_forecaster, personalize
from app.personalize.run import Outcome
from app.personalize.trainer import train
from models.arithmetic import arithmetic
from models.baselines import Forecaster
from models.checkpoint import load_checkpoint
from models.data.clips import Clip
from models.personal import PersonalDecoder
from models.predictor import Predictor
from models.training.finetune import FinetuneConfig, finetune


@dataclass(frozen=True, eq=False)
class Served:
    """What a service would answer with after a trial, with judge and gate.

    Attributes:
        forecaster: the version, or the base where it was not promoted.
        outcome: what the judge said.
        seconds: from the clips to the verdict.
    """

    forecaster: Forecaster
    outcome: Outcome
    seconds: float

    def describe(self) -> dict[str, Any]:
        """Give what a row keeps."""
        outcome = self.outcome
        return {
            "verdict": str(outcome.verdict),
            "message": outcome.message,
            "reach": outcome.metrics.get("reach"),
            "clips_unused": len(outcome.flaws),
            "judged_s": round(self.seconds, 1),
        }


def make_served(base: bytes, clips: Sequence[Clip], *, seed: int = 0) -> Served:
    """Fit, judge and gate, exactly as the service does with default settings."""
    began = monotonic()
    trainer = partial(train, config=FinetuneConfig(seed=seed))
    outcome = personalize(base, clips, lambda _: None, trainer=trainer)
    return Served(choose_forecaster(base, outcome), outcome, monotonic() - began)


def make_plain(net: Predictor, clips: Sequence[Clip], *, seed: int = 0) -> PersonalDecoder:
    """Fit all of the way, and let it always answer: no judge, no gate."""
    with arithmetic(1):
        decoder = finetune(net, clips, FinetuneConfig(seed=seed))
    return PersonalDecoder(net, decoder, None, {})


def compare_versions(
    base: bytes, clips: Sequence[Clip], *, seed: int = 0
) -> tuple[dict[str, Forecaster], dict[str, Any]]:
    """Give the base, the version as it is served, and the plain fit, and what the judge said."""
    net = load_checkpoint(base).predictor
    served = make_served(base, clips, seed=seed)
    plain = make_plain(net, clips, seed=seed)
    return {"base": net, "served": served.forecaster, "plain": plain}, served.describe()


def is_promoted(row: dict[str, Any]) -> bool:
    """Tell whether a row's version answers."""
    return bool(row["verdict"] == Verdict.PROMOTE)
