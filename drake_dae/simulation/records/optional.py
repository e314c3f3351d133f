"""Packages that only some users need."""

from importlib import import_module
from typing import Any

from drake_dae.errors import ModelError


def optional_module(module: str, user: str, extra: str) -> Any:
    """Imports a module of an optional package.

    Args:
        module: The module's name.
        user: The feature that needs it, as the beginning of a sentence.
        extra: The extra of drake_dae that installs it.

    Raises:
        ModelError: It is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise ModelError(f"{user} needs {package}: pip install 'drake_dae[{extra}]'") from None
