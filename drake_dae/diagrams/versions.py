"""The versions of the software that made a record."""

import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version


def versions() -> dict[str, str]:
    """The versions of the library, its dependencies and Python, and the machine."""
    versions_of = {"python": platform.python_version(), "machine": platform.platform()}
    for name in ("drake_dae", "drake", "casadi", "numpy"):
        with suppress(PackageNotFoundError):  # Drake may be built from its source.
            versions_of[name] = version(name)
    return versions_of
