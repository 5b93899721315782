"""Trainers for tests: the port to the nets, without nets."""

import hashlib
import os
import signal
import time

from app.domain.versions import Verdict
from app.personalize.run import Learned


def quick(lesson, report):
    """Learns the digest of what it saw."""
    report({"step": 1, "steps": 1})
    digest = hashlib.sha256(b"".join(clip.poses.tobytes() for clip in lesson.clips)).digest()
    metrics = {"clips": len(lesson.clips), "trials": sorted({clip.trial for clip in lesson.clips})}
    return Learned(Verdict.PROMOTE, "better", digest, metrics)


def slow(lesson, report):
    for step in range(600):
        report({"step": step, "steps": 600})
        time.sleep(0.05)
    return quick(lesson, report)


def brief(lesson, report):
    """Takes long enough for something to happen meanwhile."""
    report({"step": 1, "steps": 2})
    time.sleep(0.8)
    return quick(lesson, report)


def bulky(lesson, report):
    """Makes weights of a size that needs new pages in a database."""
    learned = brief(lesson, report)
    return Learned(learned.verdict, learned.message, os.urandom(400_000), learned.metrics)


def picky(lesson, report):
    return Learned(Verdict.REJECT, "not better", b"loser", {"before": [1.0], "after": [2.0]})


def infinite(lesson, report):
    """Has figures that are no numbers."""
    time.sleep(0.3)  # progress is not passed on more often
    report({"step": 1, "loss": float("nan")})
    time.sleep(0.6)  # the worker looks now and then
    learned = quick(lesson, report)
    figures = {"before": [1.0, float("inf")], "deep": {"after": (float("-inf"), 0.5)}}
    return Learned(learned.verdict, learned.message, learned.blob, learned.metrics | figures)


def unspeakable(lesson, report):
    """Says what PostgreSQL keeps in no text."""
    learned = quick(lesson, report)
    return Learned(learned.verdict, "\x00", learned.blob, learned.metrics)


def broken(lesson, report):
    raise ValueError("the loss is not finite")


def deadly(lesson, report):
    os.kill(os.getpid(), signal.SIGKILL)


def chatty(lesson, report):
    print("a library that prints")
    return quick(lesson, report)
