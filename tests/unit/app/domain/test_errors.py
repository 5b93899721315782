import re

from app.domain import errors
from app.domain.errors import KinecastError


def every_error(root=KinecastError):
    yield root
    for child in root.__subclasses__():
        yield from every_error(child)


def test_codes_are_unique():
    codes = [error.code for error in every_error()]
    assert len(codes) == len(set(codes))


def test_every_error_has_a_title_of_its_own():
    titles = [error.title for error in every_error()]
    assert len(titles) == len(set(titles))


def test_tree_in_the_docstring_is_the_tree():
    lines = re.findall(r"^([ │├└─]*)(\w+Error)\b(?: +(\w+))?", errors.__doc__, re.MULTILINE)
    drawn = {name: code for _, name, code in lines}
    for error in every_error():
        assert error.__name__ in drawn
        if error is not KinecastError and drawn[error.__name__]:
            assert drawn[error.__name__] == error.code, error


def test_message_is_the_title_where_none_is_given():
    assert errors.UnknownUserError().message == errors.UnknownUserError.title
    assert str(errors.UnknownUserError("no ada")) == "no ada"
