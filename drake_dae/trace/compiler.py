"""The C compiler at hand: which one it is, what options it takes, and how it is run."""

import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from drake_dae.errors import MachineCodeError

FLAGS = (
    "-std=c99",
    "-fPIC",
    "-shared",
    "-fno-fast-math",  # CC may hold options too.
    "-ffp-contract=off",
    "-fno-math-errno",  # Nobody reads errno, and a square root is one instruction.
    # Small functions of CasADi's are put in line only where no other library can replace them.
    "-fvisibility=hidden",
    "-DGCC_HASCLASSVISIBILITY",
)
"""-O1 comes with them. -O2 takes 1.3 to 1.6 times as long, for laws that are faster by 1 to 6 per
cent with rigid joints, 12 with flexible ones, and 20 to 25 for two arms or a hand."""

NATIVE = "-march=native"
"""All that the processor at hand can do, where the compiler takes this option for it: not each one
does for each processor. On x86-64, where older instructions meet the newer ones of libm and memcpy,
a call takes a tenth longer without, at times twice as long. The bits are the same."""

ZIG = ("-m", "ziglang", "cc", "-mcpu=baseline", "-fno-sanitize=undefined")
"""Options of Python that make it a C compiler, where ziglang is installed. Code for any processor:
a home may be shared by machines; and without Zig's own checks of what C leaves undefined."""

ANSWERS = 10.0
"""A compiler that takes longer to say what it is hangs, in s."""


class CompilerHangs(MachineCodeError):
    """A compiler that does not come to an end."""


_HANGING: dict[str, str] = {}
"""Compilers that hung in this process, by their identity, with what is said of each: to wait for
one once is enough."""


class Compiler(NamedTuple):
    """A C compiler.

    Attributes:
        command: How it is called.
        identity: What tells it from others: its own words on its version, and for what machine it
            works.
        target: Its options that choose the processor.
    """

    command: tuple[str, ...]
    identity: str
    target: tuple[str, ...] = ()

    def compile(self, source: str, file: Path, level: str, seconds: float) -> None:
        """Writes a source to file.c and its machine code to file.so.

        Raises:
            MachineCodeError: The compiler fails, or takes longer than some seconds.
            OSError: A file cannot be written.
        """
        code, library = file.with_suffix(".c"), file.with_suffix(".so")
        code.write_text(source)
        options = [*FLAGS, *self.target, level, str(code), "-o", str(library), "-lm"]
        done = _run([*self.command, *options], seconds)
        if done.returncode == 0 and library.exists():
            return
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        wrong = [line for line in lines if "error" in line.lower()] or lines or ["no message"]
        said = wrong[0].replace(f"{code.parent}/", "").strip()
        raise MachineCodeError(
            f"the C compiler '{shlex.join(self.command)}' fails (exit {done.returncode}): {said}"
        )


def find_compiler() -> Compiler:
    """The C compiler that CC names, with options if it has any; else `cc`; else what pip brought.

    The last is `python -m ziglang cc`, the optional group "compiler".

    Raises:
        MachineCodeError: There is none.
    """
    found = _find_compiler(os.environ.get("CC", ""), os.environ.get("PATH", ""))
    if isinstance(found, str):
        raise MachineCodeError(found)
    if found.identity in _HANGING:
        raise MachineCodeError(_HANGING[found.identity])
    return found


def give_up(compiler: Compiler, error: MachineCodeError) -> None:
    """Waits no more in this process for a compiler that hung."""
    _HANGING[compiler.identity] = str(error)


@cache
def _find_compiler(named: str, path: str) -> Compiler | str:
    """The compiler, or why there is none: one that hangs is waited for once."""
    try:
        return _looked_up(named)
    except MachineCodeError as error:
        return str(error)


def _looked_up(named: str) -> Compiler:
    try:
        command = shlex.split(named)
    except ValueError as error:
        raise MachineCodeError(f"CC is no command, {named!r}: {error}") from None
    if not command:
        has_own = shutil.which("cc") or find_spec("ziglang") is None
        command = ["cc"] if has_own else [sys.executable, *ZIG]
    if shutil.which(command[0]) is None:
        where = f"CC names '{command[0]}', which is" if named.strip() else "'cc' is"
        raise MachineCodeError(
            f"no C compiler: {where} not found; install gcc or clang, or drake_dae[compiler], or "
            "name one in CC"
        )
    version = _run([*command, "--version"], ANSWERS)
    library = "CS_GNU_LIBC_VERSION" in os.confstr_names and os.confstr("CS_GNU_LIBC_VERSION")
    target, processor = _native(command)
    machine = (library, platform.system(), platform.machine(), processor)
    words = (shutil.which(command[0]), version.stdout, version.stderr, *machine)
    return Compiler(tuple(command), repr(words), target)


def _native(command: list[str]) -> tuple[tuple[str, ...], str]:
    """The option for the processor at hand, and what a compiler takes it for.

    None where the command chooses a processor, or where the compiler does not know this one. A
    cache that several machines share has code for each of them, by what the compiler says.
    """
    if any(word.startswith(("-march", "-mcpu")) for word in command):
        return (), ""
    told = _run([*command, NATIVE, "-dM", "-E", "-x", "c", os.devnull], ANSWERS)
    return ((NATIVE,), told.stdout) if told.returncode == 0 else ((), "")


def _run(command: list[str], seconds: float) -> "subprocess.CompletedProcess[str]":
    """Runs a command to its end; where that is not awaited, what it started ends with it."""
    try:
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            process_group=0,
        ) as process:
            try:
                said = process.communicate(timeout=seconds)
            except BaseException:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                raise
        return subprocess.CompletedProcess(command, process.returncode, *said)
    except subprocess.TimeoutExpired:
        raise CompilerHangs(
            f"the C compiler '{command[0]}' takes longer than {seconds:g} s"
        ) from None
    except (OSError, ValueError) as error:
        raise MachineCodeError(f"the C compiler '{command[0]}' does not run: {error}") from None
