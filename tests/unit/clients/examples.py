"""The examples of the client, which are scripts and no package."""

import importlib
import sys
from types import ModuleType

from tests.conftest import ROOT

EXAMPLES = ROOT / "clients/python/examples"


def load_example(name: str) -> ModuleType:
    """Import an example as Python does when it is run: with its folder on the path."""
    if str(EXAMPLES) not in sys.path:
        sys.path.append(str(EXAMPLES))
    return importlib.import_module(name)
