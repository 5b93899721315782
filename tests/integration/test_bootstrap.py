import stat

import pytest

from app.domain.access import Scope
from app.domain.errors import StartError, UnauthorizedError
from app.storage import keys
from app.storage.bootstrap import ensure_admin, load_audit_key, write_secret
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
