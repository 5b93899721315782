import resource
import signal
import stat
from contextlib import contextmanager

import pytest

from app.domain.access import Scope
from app.domain.errors import StartError, UnauthorizedError
from app.storage import keys
from app.storage.bootstrap import ensure_admin, load_audit_key, read_secret, write_secret
from tests.support import ADMIN_KEY, make_settings


@pytest.mark.asyncio
async def test_first_start_makes_an_admin_key_and_the_second_does_not(database, settings):
    without = settings.model_copy(update={"admin_key": None})
    made = await ensure_admin(database, without)
    assert made is not None
    assert (await keys.authenticate(database, made)).scopes == {Scope.ADMIN}
    assert await ensure_admin(database, without) is None


@pytest.mark.asyncio
async def test_admin_key_of_the_settings_needs_no_other_and_goes_with_them(database, settings):
    assert await ensure_admin(database, settings) is None
    assert (await keys.authenticate(database, ADMIN_KEY)).principal.is_admin
    without = settings.model_copy(update={"admin_key": None})
    assert await ensure_admin(database, without) is not None
    with pytest.raises(UnauthorizedError):
        await keys.authenticate(database, ADMIN_KEY)


@pytest.mark.asyncio
async def test_short_admin_key_is_refused(database, tmp_path):
    with pytest.raises(StartError, match="at least 32 characters"):
        await ensure_admin(database, make_settings(tmp_path, admin_key="short"))


def test_audit_key_is_made_once_and_only_its_owner_can_read_it(tmp_path):
    settings = make_settings(tmp_path / "data")
    first = load_audit_key(settings)
    assert load_audit_key(settings) == first
    assert stat.S_IMODE((tmp_path / "data" / "audit-key").stat().st_mode) == 0o600
    assert load_audit_key(make_settings(tmp_path, audit_key="given")) == b"given"


def test_secret_replaces_a_file_that_others_can_read(tmp_path):
    path = tmp_path / "key"
    path.write_text("old")
    path.chmod(0o644)
    write_secret(path, "new")
    assert path.read_text() == "new\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [file.name for file in tmp_path.iterdir()] == ["key"]


@pytest.mark.asyncio
async def test_no_key_becomes_valid_that_could_not_be_written(database, settings, tmp_path):
    without = settings.model_copy(update={"admin_key": None})
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    with pytest.raises(OSError, match="blocked"):
        await ensure_admin(database, without, keep_in=blocked)
    async with database.read() as tx:
        assert await keys.count_admins(tx) == 0
    made = await ensure_admin(database, without, keep_in=tmp_path / "key")
    assert made is not None
    assert read_secret(tmp_path / "key") == made


@contextmanager
def full_disk():
    """No file may grow: what a full disk does to a writer, as far as one process can have it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def test_full_disk_leaves_the_old_secret_and_no_draft(tmp_path):
    path = tmp_path / "key"
    write_secret(path, "old")
    with full_disk(), pytest.raises(OSError, match="too large"):
        write_secret(path, "new")
    assert [file.name for file in tmp_path.iterdir()] == ["key"]
    assert read_secret(path) == "old"


def test_empty_audit_key_is_made_anew(tmp_path):
    (tmp_path / "audit-key").touch()
    settings = make_settings(tmp_path)
    made = load_audit_key(settings)
    assert len(made) == 64
    assert load_audit_key(settings) == made
