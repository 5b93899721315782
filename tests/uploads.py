"""Trials as clients upload them, and versions made of them."""

from tests.personal_support import claim, finish, record_frames

TRIALS = "/v1/users/ada/trials"


def to_json(frames, **fields):
    return {"frames": frames.joints.tolist(), "action": "wave", **fields}


def to_msgpack(frames):
    joints = frames.joints.astype("<f4")
    array = {"shape": list(joints.shape), "dtype": "<f4", "data": joints.tobytes()}
    times = {"shape": [len(joints)], "dtype": "<f8", "data": frames.t.tobytes()}
    return {"frames": array, "t": times}


async def upload(service, *clips, headers=None, **fields):
    body = {"clips": list(clips), **fields}
    return await service.call("POST", TRIALS, json=body, headers=headers or {})


async def make_version(service, **result):
    await upload(service, to_json(record_frames()))
    await finish(service.database, await claim(service.database), **result)
