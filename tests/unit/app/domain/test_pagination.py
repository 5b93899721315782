from contextlib import suppress
from datetime import UTC, datetime
from uuid import UUID

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.domain.errors import InvalidError
from app.domain.pagination import Cursor, decode_cursor

INSTANTS = st.datetimes(min_value=datetime(1970, 1, 1), timezones=st.just(UTC))  # noqa: DTZ001


@given(INSTANTS, st.uuids())
@settings(deadline=None, max_examples=50)
def test_cursor_comes_back_as_it_was(instant, key):
    cursor = Cursor(instant, key)
    assert decode_cursor(cursor.encode()) == cursor


@given(st.text(max_size=60))
@settings(deadline=None, max_examples=50)
def test_any_text_is_a_cursor_or_refused(text):
    with suppress(InvalidError):
        assert isinstance(decode_cursor(text).id, UUID)


@pytest.mark.parametrize("text", ["", "x", "ä", "A" * 31, "____________________________________"])
def test_foreign_text_is_refused(text):
    with pytest.raises(InvalidError):
        decode_cursor(text)
