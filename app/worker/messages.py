"""What a worker and its training process say to each other: msgpack, each with its length before.

Only the two of them share the pipe, and nothing on it is ever unpickled.
"""

import asyncio
import struct
from typing import Any, BinaryIO

import msgspec

from app.personalize.run import Outcome, Task

_LENGTH = struct.Struct(">Q")


class Start(msgspec.Struct, tag="start"):
    """From the worker, once: what to do, and who does it (`module:function`)."""

    task: Task
    trainer: str


class Progress(msgspec.Struct, tag="progress"):
    """From the trainer, often: how far it is."""

    values: dict[str, Any]


class Done(msgspec.Struct, tag="done"):
    """From the trainer, at the end."""

    outcome: Outcome


class Failed(msgspec.Struct, tag="failed"):
    """From the trainer, instead of an end: what went wrong."""

    message: str


FromTrainer = Progress | Done | Failed
_decoder = msgspec.msgpack.Decoder(FromTrainer)


def pack(message: msgspec.Struct) -> bytes:
    """Write a message with its length."""
    content = msgspec.msgpack.encode(message)
    return _LENGTH.pack(len(content)) + content


def read_start(stream: BinaryIO) -> Start:
    """Wait for the task, in the training process.

    Raises:
        EOFError: the worker is gone.
    """
    (length,) = _LENGTH.unpack(_read_exactly(stream, _LENGTH.size))
    return msgspec.msgpack.decode(_read_exactly(stream, length), type=Start)


async def read_reply(stream: asyncio.StreamReader) -> FromTrainer | None:
    """Wait for the next message of the training process; None when it is gone."""
    try:
        (length,) = _LENGTH.unpack(await stream.readexactly(_LENGTH.size))
        reply: FromTrainer = _decoder.decode(await stream.readexactly(length))
    except asyncio.IncompleteReadError:
        return None
    return reply


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    content = stream.read(size)
    if len(content) != size:
        raise EOFError("the worker is gone")
    return content
