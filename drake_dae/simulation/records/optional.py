"""Packages that only some users need."""

from importlib import import_module
from typing import Any

from drake_dae.errors import ModelError


def optional_module(module: str, asked: str, extra: str) -> Any:
    """A module of a package that an extra of this one installs.

    Args:
        module: The module's name.
        asked: What needs it, the beginning of a sentence.
        extra: The extra.

    Raises:
        ModelError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ModelError(f"{asked} needs {package}: pip install 'drake_dae[{extra}]'") from None
