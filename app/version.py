"""Which version of Kinecast this is."""

from importlib.metadata import PackageNotFoundError, version


def read_version() -> str:
    """Give the version of the installed package; a source tree that is not installed has none."""
    try:
        return version("kinecast")
    except PackageNotFoundError:
        return "0+unknown"
