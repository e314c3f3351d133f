"""Programs of examples as modules, which bear names of their own while they are loaded."""

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).parents[2] / "examples"


@contextmanager
def loaded(name: str) -> Iterator[ModuleType]:
    """The program of the folder `examples/name`."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / name / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
        yield module
    finally:
        del sys.modules[name]
