"""Poses, forecasts and a tracker's markers for the tests of the conversions."""

from types import SimpleNamespace

import numpy as np
from kinecast_client.forecasts import Forecast, Timing, Version
from kinecast_client.samples import waving_person

from models.skeleton import SKELETONS

AZURE = SKELETONS["azure_kinect"]
NOW = 1_780_000_000.123456789


def make_forecast(frames=None, *, radius=True, severity="info", t=NOW, seq=7, **changes):
    if frames is None:
        frames = waving_person(seconds=0.5).astype(np.float32)
    fields = {
        "frames": frames,
        "t": t + np.arange(1, 16) / 30,
        "radius": np.full(frames.shape[:2], 0.07, np.float32) if radius else None,
        "coverage": 0.9,
        "version": Version(3, "personal", "ab" * 32, share=0.75),
        "quality": ("blended",),
        "severity": severity,
        "filled": (),
        "timing": Timing(0.1, 0.4, 0.6),
        "t_observed": t,
        "seq": seq,
    }
    return Forecast(**fields | changes)


def make_pose(away=2.0, number=0):
    """A pose of an Azure Kinect in its optical frame."""
    kinect = waving_person(5.0)[number] * [-1, -1, 1] + [0, 0, away - 2.5]
    pose = np.linalg.pinv(AZURE.to_net) @ kinect
    return pose + (kinect[3] - (AZURE.to_net @ pose)[3])


def make_markers(pose, body=1, t=NOW, frame="depth_camera_link"):
    stamp = SimpleNamespace(sec=int(t), nanosec=round(t % 1 * 1e9))
    header = SimpleNamespace(stamp=stamp, frame_id=frame)
    return [
        SimpleNamespace(
            id=100 * body + joint,
            header=header,
            pose=SimpleNamespace(position=SimpleNamespace(x=p[0], y=p[1], z=p[2])),
        )
        for joint, p in enumerate(pose.tolist())
    ]
