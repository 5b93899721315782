"""Weights that are damaged by hand: never served, and what is next best answers, flagged."""

import asyncio
import time
from collections.abc import Callable
from random import Random

import httpx
from sqlalchemy import select, update

from app.commands.client.errors import ApiError
from app.commands.client.rest import Api
from app.storage import users, versions
from app.storage.database import Database
from app.storage.tables import WeightsRow
from benchmarks.faults.audit import Findings, inspect
from benchmarks.faults.campaign import (
    PATIENCE_S,
    Outcome,
    name_version,
    until,
    wait_for_end,
)
from benchmarks.faults.people import Accepted, make_upload, make_window, send_until_accepted
from benchmarks.faults.rig import Rig
from benchmarks.faults.watch import Log, watch
from models.checkpoint import Checkpoint

USER, SEED = "person-0", 0
TRIALS = 2
FALLBACKS = {1: "previous_version", 0: "weights_missing"}
"""What answers instead of version 2, by its number, and why it says that it does."""


class DamageCampaign:
    """Damages the active version of a user, or all of them, again and again.

    Args:
        rig: the service.
        base: the model that it serves.
        random: decides what is damaged, and how.
    """

    def __init__(self, rig: Rig, base: Checkpoint, random: Random) -> None:
        self._rig, self._base, self._random = rig, base, random
        self._accepted: list[Accepted] = []

    async def run(self, repeats: int, tell: Callable[[Outcome], None]) -> list[Outcome]:
        """Make two versions, then damage them."""
        await asyncio.to_thread(self._rig.start)
        await self._make_versions()
        outcomes = []
        for number in range(repeats):
            outcome = await self._repeat(heir=(number + 1) % 2)
            tell(outcome)
            outcomes.append(outcome)
        return outcomes

    async def _make_versions(self) -> None:
        """Record two trials, and make their versions active in turn, whatever the judge says."""
        async with Api(self._rig.url, key=self._rig.key, wait_s=30) as api:
            await api.add_user(USER)
            for take in range(TRIALS):
                upload = make_upload(USER, seed=SEED, take=take)
                sent = await send_until_accepted(
                    api, upload, patience_s=PATIENCE_S, note=lambda _: None
                )
                self._accepted.append(sent)
                await wait_for_end(api, sent.job)
        for number in range(1, TRIALS + 1):
            path = f"/v1/admin/users/{USER}/versions/{number}/promote"
            (await self._ask("POST", path, json={})).raise_for_status()

    async def _repeat(self, *, heir: int) -> Outcome:
        """Damage everything above one version, and see that this one answers until it is mended."""
        rig, findings = self._rig, Findings()
        await asyncio.to_thread(rig.stop)  # what is loaded already is right, and stays
        warned = rig.count_warnings()
        kind, kept = await self._damage(above=heir)
        await asyncio.to_thread(rig.start)
        struck = time.monotonic()
        async with watch(rig, USER, seed=SEED) as log:
            await until(lambda: log.answered_since(struck) is not None)
            await asyncio.sleep(1.0)
            await self._check_refusals(findings)
            mended = time.monotonic()
            _check_heir(log, heir, findings)
            await self._write(kept)
            await until(lambda: _is_back(log, mended))
        if not _is_back(log, mended):
            findings.unanswered.append("the mended version does not come back")
        found = await self._inspect(log)
        for name, lines in findings.as_json().items():
            getattr(found, name).extend(lines)
        seen = (*log.asked, *log.streamed)
        return Outcome(
            fault="weights",
            hit=kind,
            job="mended",
            attempts=1,
            recovered_s=round((log.answered_since(struck) or time.monotonic()) - struck, 2),
            tries=1,
            asked=len(log.asked),
            streamed=len(log.streamed),
            refused=sum(log.refused.values()),
            versions=sorted({name_version(one.version) for one in seen}),
            closes=dict(log.closes),
            opened=log.opened,
            warned=dict(rig.count_warnings() - warned),
            findings=found.as_json(),
        )

    async def _damage(self, *, above: int) -> tuple[str, dict[str, bytes]]:
        """Change bytes in the database; gives how, and what was there."""
        kept = await self._read(above=above)
        kind = self._random.choice(sorted(_WAYS))
        await self._write({name: _WAYS[kind](blob, self._random) for name, blob in kept.items()})
        return kind, kept

    async def _read(self, *, above: int) -> dict[str, bytes]:
        database = Database.from_settings(self._rig.settings)
        try:
            async with database.read() as tx:
                made = await versions.list_all(tx, (await users.get(tx, USER)).uuid)
                wanted = [version.sha256 for version in made if version.number > above]
                query = select(WeightsRow.sha256, WeightsRow.blob)
                rows = await tx.execute(query.where(WeightsRow.sha256.in_(wanted)))
                return dict(rows.tuples().all())
        finally:
            await database.close()

    async def _write(self, blobs: dict[str, bytes]) -> None:
        database = Database.from_settings(self._rig.settings)
        try:
            async with database.write() as tx:
                for sha256, blob in blobs.items():
                    change = update(WeightsRow).where(WeightsRow.sha256 == sha256)
                    await tx.execute(change.values(blob=blob))
        finally:
            await database.close()

    async def _check_refusals(self, findings: Findings) -> None:
        """Whoever asks for the damaged version by name learns that it is."""
        answer = await self._ask("GET", f"/v1/users/{USER}/versions/{TRIALS}/weights")
        if answer.is_success or answer.json()["code"] != "weights_damaged":
            findings.wrong.append(f"its weights were given: {answer.status_code}")
        async with Api(self._rig.url, key=self._rig.key) as api:
            try:
                pinned = await api.forecast(USER, make_window(SEED), version=TRIALS)
            except ApiError as error:
                if error.code != "version_unavailable":
                    findings.wrong.append(f"pinned: {error}")
            else:
                findings.wrong.append(f"the pinned version answered: {pinned.version}")

    async def _inspect(self, log: Log) -> Findings:
        database = Database.from_settings(self._rig.settings)
        try:
            return await inspect(database, USER, self._accepted, log, self._base, seed=SEED)
        finally:
            await database.close()

    async def _ask(self, method: str, path: str, json: object = None) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self._rig.key}"}
        async with httpx.AsyncClient(base_url=self._rig.url, trust_env=False) as client:
            return await client.request(method, path, headers=headers, json=json)


def _flip(blob: bytes, random: Random) -> bytes:
    """Change one bit somewhere."""
    changed = bytearray(blob)
    changed[random.randrange(len(blob))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _cut(blob: bytes, random: Random) -> bytes:
    return blob[: random.randrange(len(blob))]


def _overwrite(blob: bytes, random: Random) -> bytes:
    """Put zeros where numbers were, as a half-written page has them."""
    start = random.randrange(len(blob) // 2)
    return blob[:start] + bytes(len(blob) // 4) + blob[start + len(blob) // 4 :]


def _spoil_header(blob: bytes, random: Random) -> bytes:
    return random.randbytes(64) + blob[64:]


def _lengthen(blob: bytes, random: Random) -> bytes:
    return blob + random.randbytes(16)


_WAYS: dict[str, Callable[[bytes, Random], bytes]] = {
    "a bit flipped": _flip,
    "cut off": _cut,
    "partly zero": _overwrite,
    "header spoilt": _spoil_header,
    "longer": _lengthen,
}


def _check_heir(log: Log, heir: int, findings: Findings) -> None:
    """While the active version is damaged, the next best one answers and says so."""
    for seen in (*log.asked, *log.streamed):
        version = seen.version
        if (version.number, version.fallback) != (heir, FALLBACKS[heir]):
            findings.wrong.append(f"while damaged: {version}")


def _is_back(log: Log, moment: float) -> bool:
    """Tell whether the active version itself answered both ways after a moment."""
    return all(
        any(one.at > moment and one.version.number == TRIALS and not one.flagged for one in seen)
        for seen in (log.asked, log.streamed)
    )
