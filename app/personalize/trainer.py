"""The trainer that workers use: fits one person's decoder and judges it on clips left out."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from app.domain.versions import Verdict
from app.personalize.judge import Figures, cut_blocks, judge, leave_out
from app.personalize.run import Learned, Lesson, Report
from models.baselines import Forecaster
from models.checkpoint import dump_personal, load_checkpoint
from models.data.clips import Clip, data_hash
from models.data.windows import cut_windows
from models.decoder import Decoder
from models.metrics import FRAMES, squared_errors_cm2
from models.predictor import Predictor
from models.training.finetune import FinetuneConfig, FinetuneProgress, finetune


def train(lesson: Lesson, report: Report) -> Learned:
    """Fit on some of the clips, judge on the others, and where it helps, fit on all of them."""
    base, config = load_checkpoint(lesson.base), FinetuneConfig()
    blocks = cut_blocks(lesson.clips)
    learn, held_out = leave_out(blocks)
    if not held_out:
        message = f"{len(blocks)} stretches of motion are too few to judge by; record more."
        return Learned(Verdict.TOO_LITTLE_DATA, message, None, {})
    tried = finetune(base.predictor, learn, config, report=_tell(report, "judging"))
    figures = Figures(
        before=_measure(base.predictor, held_out),
        after=_measure(_with_decoder(base.predictor, tried), held_out),
    )
    verdict, message = judge(figures)
    decoder = finetune(base.predictor, lesson.clips, config, report=_tell(report, "fitting"))
    metrics = figures.summarise() | {"clips": len(lesson.clips), "clips_held_out": len(held_out)}
    described = {"data": data_hash(list(lesson.clips))}
    blob = dump_personal(decoder, described, base_sha256=base.sha256)
    return Learned(verdict, message, blob, metrics)


def _tell(report: Report, phase: str) -> Any:  # noqa: ANN401 - the callback of finetune
    def tell(progress: FinetuneProgress) -> None:
        values: Mapping[str, Any] = {"phase": phase, **asdict(progress)}
        report(values)

    return tell


def _with_decoder(predictor: Predictor, decoder: Decoder) -> Predictor:
    """Give a predictor with the same frozen encoder and another decoder."""
    personal = Predictor(predictor.spec, predictor.config)
    personal.load_state_dict(predictor.state_dict())
    personal.decoder.load_state_dict(decoder.state_dict())
    return personal.eval()


def _measure(forecaster: Forecaster, clips: Sequence[Clip]) -> np.ndarray:
    """Give the error of every clip at every reported frame, cm²: [clip, frame]."""
    predictor: Any = forecaster
    rows = []
    for clip in clips:
        windows = cut_windows([clip], predictor.spec)
        observed = torch.from_numpy(windows.observed)
        with torch.inference_mode():
            forecast = torch.cat([forecaster(part) for part in observed.split(256)]).numpy()
        errors = squared_errors_cm2(forecast, windows.future).mean(axis=0)
        rows.append([errors[:frame].mean() for frame in FRAMES])
    return np.array(rows)
