"""The file of a study: a first line that identifies the study, then a line for each run.

Lines are only appended. A run counts as done when its line is synced to the disk. A killed process
leaves complete lines and at most one incomplete line, which is removed when the study continues.
"""

import errno
import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from drake_dae.arrays import brief
from drake_dae.errors import ModelError
from drake_dae.studies.results import RunResult
from drake_dae.studies.variations import Variation

FORMAT = 1


def study_head(
    version: str,
    scenario: Mapping[str, Any],
    variations: Sequence[Variation],
    rollout: bool = False,
) -> dict[str, Any]:
    """Returns the data of the first line of a study's file; equal studies have equal data."""
    return {
        "study": FORMAT,
        "drake_dae": version,
        **({"rollout": True} if rollout else {}),
        "scenario": dict(scenario),
        "variations": list(variations),
    }


class Journal:
    """An open file of a study.

    Attributes:
        path: The path of the file.
        results: Number of a run -> its first final result in the file, or the last result if no
            result is final.
    """

    def __init__(self, path: Path, file: int, results: dict[int, RunResult]) -> None:
        self.path = path
        self.results = results
        self._file = file

    def append(self, results: Iterable[RunResult]) -> None:
        """Appends results, and returns when they are on the disk.

        Raises:
            ModelError: They cannot be written, for example to a full disk.
        """
        results = list(results)
        try:
            _write(self._file, b"".join(_line(result.to_dict()) for result in results))
            os.fsync(self._file)
        except OSError as error:
            raise ModelError(
                f"cannot write to '{self.path}': {error.strerror or error}; the study continues "
                "from what it has when there is room again"
            ) from None
        self.results.update((result.run, result) for result in results)


@contextmanager
def open_journal(path: Path, head: Mapping[str, Any]) -> Iterator[Journal]:
    """Creates the file of a study, or opens it to continue the study, and locks it.

    Args:
        path: The path of the file; missing folders are created.
        head: The first line, from `study_head`.

    Raises:
        ModelError: The file belongs to another study (the message lists the differences), it is not
            the file of a study, another process writes to it, or it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _open(path, head)
    except ModelError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path.
        reason = getattr(error, "strerror", None) or error
        raise ModelError(f"cannot write to {brief(str(path))}: {reason}") from None
    try:
        yield Journal(path, file, _recorded(path, file, head))
    finally:
        os.close(file)


def _open(path: Path, head: Mapping[str, Any]) -> int:
    """Opens and locks the file; a new one gets its first line."""
    if not path.exists():
        # Renaming a complete file is atomic.
        part = path.with_name(f".{path.name}.{os.getpid()}")
        new = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            _write(new, _line(head))
            os.fsync(new)
            if not path.exists():
                part.rename(path)
        finally:
            os.close(new)
            part.unlink(missing_ok=True)
        _sync_folder(path.parent)  # Otherwise the new name may be lost.
    if not path.is_file():
        raise ModelError(f"'{path}' is no file")
    file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            os.close(file)
            raise ModelError(
                f"another process writes to '{path}'; wait for its end or choose another file"
            ) from None
    return file


def _sync_folder(folder: Path) -> None:
    entry = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(entry)
    finally:
        os.close(entry)


def _recorded(path: Path, file: int, head: Mapping[str, Any]) -> dict[int, RunResult]:
    """Reads the results in a file, and removes an incomplete last line."""
    first, *lines = path.read_bytes().split(b"\n")
    try:
        file_head = json.loads(first)
        file_format = file_head["study"]
    except (ValueError, TypeError, LookupError, RecursionError):
        raise ModelError(f"'{path}' is no file of a study; choose another name") from None
    if file_format != FORMAT:
        raise ModelError(f"'{path}' has format {brief(file_format)}, this version writes {FORMAT}")
    if differing := differences(file_head, json.loads(_line(head))):
        raise ModelError(
            f"'{path}' belongs to another study: {'; '.join(differing)}. Choose another folder, or "
            "remove it"
        )
    rest = lines.pop() if lines else b""
    results: dict[int, RunResult] = {}
    for number, line in enumerate(lines, start=2):
        try:
            result = RunResult.from_dict(json.loads(line))
            if result.run >= len(head["variations"]):
                raise LookupError(result.run)
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            is_json = not isinstance(error, (json.JSONDecodeError, UnicodeDecodeError))
            if number == len(lines) + 1 and not is_json:  # Zeros after a power failure.
                rest = line + b"\n" + rest
                break
            raise ModelError(
                f"'{path}' was changed: line {number} is no run of this study"
            ) from None
        if not (result.run in results and results[result.run].outcome.is_final):
            results[result.run] = result
    if rest:
        os.ftruncate(file, os.fstat(file).st_size - len(rest))
        os.fsync(file)
    return results


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """The differences between the first lines of two studies, in words; at most six."""
    differing = [
        *_different("drake_dae", there.get("drake_dae"), here.get("drake_dae")),
        *_different("rollout", there.get("rollout", False), here.get("rollout", False)),
        *_different("", there.get("scenario"), here.get("scenario")),
    ]
    old, new = there.get("variations", []), here["variations"]
    if len(old) != len(new):
        differing.append(f"{len(old)} runs there, {len(new)} here")
    for number, (a, b) in enumerate(zip(old, new, strict=False)):
        if a != b:
            differing.append(f"run {number} has {next(_different('', a, b))}")
            break
    return differing if len(differing) <= 6 else [*differing[:6], f"and {len(differing) - 6} more"]


def _different(key: str, there: Any, here: Any) -> Iterator[str]:
    if isinstance(there, dict) and isinstance(here, dict):
        for name in {**there, **here}:
            inner = f"{key}.{name}" if key else name
            missing = object()
            a, b = there.get(name, missing), here.get(name, missing)
            if a is missing or b is missing:
                yield f"{inner} only {'here' if a is missing else 'there'}"
            else:
                yield from _different(inner, a, b)
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        for index, (a, b) in enumerate(zip(there, here, strict=True)):
            yield from _different(f"{key}.{index}", a, b)
    elif there != here:
        yield f"{key} = {brief(there)} there, {brief(here)} here"


def _line(data: Mapping[str, Any]) -> bytes:
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _write(file: int, data: bytes) -> None:
    while data:
        data = data[os.write(file, data) :]
