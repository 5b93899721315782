from uuid import uuid4

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.domain.access import Principal, Scope, find_key_id, hash_key, make_key, matches_key
from app.domain.errors import ForbiddenError


def principal(*scopes, user=None):
    return Principal(key_id=uuid4(), scopes=frozenset(scopes), bound_user=user)


def test_key_names_itself_and_matches_only_its_own_hash():
    key, other = make_key(), make_key()
    assert find_key_id(key.text) == key.id
    assert matches_key(key.text, hash_key(key.text))
    assert not matches_key(key.text, hash_key(other.text))


def test_secret_has_at_least_128_bits():
    secret = make_key().text.split("_")[2]
    assert len(secret) * 5.95 > 128  # 62 letters and digits


@given(st.text())
def test_any_other_text_names_no_key(text):
    assert find_key_id(text) is None


@pytest.mark.parametrize("scope", list(Scope))
def test_admin_may_do_everything(scope):
    principal(Scope.ADMIN).check_scope(scope)


def test_predict_may_not_record():
    with pytest.raises(ForbiddenError):
        principal(Scope.PREDICT).check_scope(Scope.RECORD)


def test_bound_key_touches_one_user_only():
    bound = principal(Scope.PREDICT, user="ada")
    bound.check_user("ada")
    for other in ("Ada", "bob", ""):
        with pytest.raises(ForbiddenError):
            bound.check_user(other)
    principal(Scope.PREDICT).check_user("anybody")
