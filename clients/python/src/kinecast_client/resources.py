"""What the service stores, for programs without an event loop: users, trials, versions, jobs."""

import time
from collections.abc import Callable, Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Protocol, TypeVar

from kinecast_client import calls
from kinecast_client.answers import follow
from kinecast_client.calls import Call
from kinecast_client.errors import DeadlineError
from kinecast_client.forecasts import Version
from kinecast_client.values import Clip, Job, Page, PersonalVersion, StoredTrial, Trial, User

Answer = TypeVar("Answer")
Item = TypeVar("Item")
UPLOAD_S = 60.0
PAGE = 100
_LOOK_EVERY_S = 0.5


class Sender(Protocol):
    """Sends a request and reads its answer."""

    def __call__(self, call: Call[Answer], timeout_s: float | None = None) -> Answer:
        """Send it; raises as `Client` says."""
        ...


class _Noun:
    def __init__(self, send: Sender) -> None:
        self._send = send


class Users(_Noun):
    """The people whose motion is forecast: `client.users`. Needs the scope `admin`."""

    def add(
        self,
        user: str,
        *,
        skeleton: str = "kinect_v1",
        up: str = "y",
        root_relative: bool = False,
        display_name: str | None = None,
    ) -> User:
        """Add a user; `skeleton` and `up` describe the sensor's poses and are fixed.

        Raises:
            ConflictError: the id is taken.
        """
        return self._send(
            calls.add_user(
                user,
                skeleton=skeleton,
                up=up,
                root_relative=root_relative,
                display_name=display_name,
            )
        )

    def get(self, user: str) -> User:
        """Get one user, with the version that answers at the moment."""
        return self._send(calls.get_user(user))

    def list(self) -> Iterator[User]:
        """Give every user, newest first."""
        return _turn(self._send, lambda cursor: calls.list_users(PAGE, cursor))

    def rename(self, user: str, display_name: str | None) -> User:
        """Change the name for people; None takes it away."""
        return self._send(calls.update_user(user, display_name=display_name))

    def set_auto_promote(self, user: str, *, on: bool) -> User:
        """Tell whether versions that win become active by themselves."""
        return self._send(calls.update_user(user, auto_promote=on))

    def delete(self, user: str) -> None:
        """Erase a user with every trial and version; their streams end."""
        self._send(calls.delete_user(user))


class Trials(_Noun):
    """What people were recorded doing: `client.trials`. Needs the scope `record`."""

    def upload(
        self,
        user: str,
        clips: Iterable[Clip],
        *,
        label: str | None = None,
        finetune: bool = True,
        idempotency_key: str | None = None,
    ) -> StoredTrial:
        """Upload a trial as frames; `job` of the answer is the fine-tuning that was asked for.

        Args:
            user: who was recorded.
            clips: what they did; each without a break, a second or longer.
            label: a name for people.
            finetune: whether to train on it.
            idempotency_key: the same key and clips within a day store nothing twice, so that an
                upload whose answer was lost can be repeated; drawn if absent.

        Raises:
            FrameError: a clip has another shape than one.
        """
        call = calls.upload_trial(
            user, clips, label=label, finetune=finetune, idempotency_key=idempotency_key
        )
        return self._send(call, UPLOAD_S)

    def upload_files(
        self,
        user: str,
        paths: Iterable[str | PathLike[str]],
        *,
        label: str | None = None,
        finetune: bool = True,
    ) -> StoredTrial:
        """Upload a trial as files: `.mat` of UTD-MHAD, `.npz` or `.csv`.

        Raises:
            OSError: a file cannot be read.
        """
        given = [Path(path) for path in paths]
        call = calls.upload_files(user, given, label=label, finetune=finetune)
        return self._send(call, UPLOAD_S)

    def get(self, user: str, trial: str) -> Trial:
        """Get one trial, with what is known of each clip."""
        return self._send(calls.get_trial(user, trial))

    def list(self, user: str) -> Iterator[Trial]:
        """Give every trial of a user, newest first."""
        return _turn(self._send, lambda cursor: calls.list_trials(user, PAGE, cursor))

    def delete(self, user: str, trial: str) -> None:
        """Erase a trial with every frame of it; versions that learned from it stay."""
        self._send(calls.delete_trial(user, trial))


class Versions(_Noun):
    """Versions of a user's decoder: `client.versions`."""

    def get(self, user: str, number: int) -> PersonalVersion:
        """Get one personal version, with what the judge measured."""
        return self._send(calls.get_version(user, number))

    def list(self, user: str) -> Iterator[PersonalVersion]:
        """Give every personal version of a user, newest first."""
        return _turn(self._send, lambda cursor: calls.list_versions(user, PAGE, cursor))

    def promote(self, user: str, number: int, *, active_sha256: str | None = None) -> Version:
        """Let a version answer from now on, 0 for the base; needs the scope `admin`.

        Args:
            user: whose.
            number: of the version.
            active_sha256: what you take to be active; where it is not, nothing changes.

        Raises:
            ConflictError: something else is active.
        """
        return self._send(calls.promote(user, number, active_sha256))

    def rollback(self, user: str, *, active_sha256: str | None = None) -> Version:
        """Go back to what was active before; as `promote`."""
        return self._send(calls.rollback(user, active_sha256))


class Jobs(_Noun):
    """Fine-tuning jobs: `client.jobs`. Needs the scope `admin`."""

    def start(self, user: str, trials: Iterable[str] | None = None) -> Job:
        """Ask for fine-tuning on these trials; None is all that is stored when it starts."""
        return self._send(calls.start_job(user, trials))

    def get(self, job: str) -> Job:
        """Look how far a job is."""
        return self._send(calls.get_job(job))

    def list(self, *, user: str | None = None, state: str | None = None) -> Iterator[Job]:
        """Give every job, newest first, of one user or in one state if given."""
        return _turn(self._send, lambda cursor: calls.list_jobs(user, state, PAGE, cursor))

    def cancel(self, job: str) -> Job:
        """Call a job off."""
        return self._send(calls.cancel_job(job))

    def wait(self, job: str, timeout_s: float) -> Job:
        """Wait until a job is over.

        Raises:
            DeadlineError: it was not over in time; it goes on.
        """
        deadline = time.monotonic() + timeout_s
        while not (seen := self.get(job)).is_over:
            left = deadline - time.monotonic()
            if left <= 0:
                raise DeadlineError(f"Job {job} was still {seen.state} after {timeout_s:g} s.")
            time.sleep(min(_LOOK_EVERY_S, left))
        return seen


def _turn(send: Sender, ask: Callable[[str | None], Call[Page[Item]]]) -> Iterator[Item]:
    """Give the items of every page."""
    cursor: str | None = None
    while True:
        page = send(ask(cursor))
        yield from page.items
        cursor = follow(cursor, page.next_cursor)
        if cursor is None:
            return
