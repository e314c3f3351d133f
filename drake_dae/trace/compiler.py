"""The available C compiler, its options, and its calls."""

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
from typing import Any, NamedTuple

from drake_dae.errors import MachineCodeError

# -O1 comes with them. -O2 takes 1.3 to 1.6 times as long, for laws that are faster by 1 to 6 per
# cent with rigid joints, 12 with flexible ones, and 20 to 25 for two arms or a hand.
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
# Uses all instructions of this processor, if the compiler accepts the option. Without it a call on
# x86-64 takes 10 % longer, sometimes twice as long. The results are the same to the bit.
NATIVE = "-march=native"
# Options that make Python a C compiler, if ziglang is installed: code for any processor, since
# machines may share a home, and without Zig's checks for undefined behavior.
ZIG = ("-m", "ziglang", "cc", "-mcpu=baseline", "-fno-sanitize=undefined")
# Options that make Python a compiler of WebAssembly.
WEB = (
    *("-m", "ziglang", "cc", "-target", "wasm32-wasi", "-mexec-model=reactor", "-std=c99", "-O2"),
    *("-ffp-contract=off", "-fno-math-errno", "-fno-sanitize=undefined", "-Wl,--strip-all"),
    "-Wl,-z,stack-size=1048576",
)
WEB_PATIENCE = 600.0  # That compiler hangs if it takes longer than this, in s.
# A compiler that takes longer than this to report its version counts as hanging, in s.
ANSWERS = 60.0
# Compilers that hung in this process, by identity, with the message: each is waited for once.
_HANGING: dict[str, str] = {}


class CompilerHangs(MachineCodeError):
    """The exception for a compiler that does not finish."""


class Compiler(NamedTuple):
    """A C compiler: its command, its identity and its options."""

    command: tuple[str, ...]
    identity: str
    target: tuple[str, ...] = ()

    def compile(
        self, source: str, file: Path, level: str, seconds: float, more: tuple[str, ...] = ()
    ) -> None:
        """Writes C source to file.c and compiles it to file.so, by default for this processor."""
        code, library = file.with_suffix(".c"), file.with_suffix(".so")
        code.write_text(source)
        options = [*FLAGS, *self.target, *more, level, str(code), "-o", str(library), "-lm"]
        try:
            _compile([*self.command, *options], library, seconds)
        except CompilerHangs as error:
            _HANGING[self.identity] = str(error)
            raise


def find_compiler() -> Compiler:
    """Returns the C compiler named by CC, or else `cc`, or else that of the package ziglang."""
    compiler = _find_compiler(os.environ.get("CC", ""), os.environ.get("PATH", ""))
    if isinstance(compiler, str):
        raise MachineCodeError(compiler)
    if compiler.identity in _HANGING:
        raise MachineCodeError(_HANGING[compiler.identity])
    return compiler


def gcc_options(*options: str) -> tuple[str, ...]:
    """Returns options that only GCC knows; none of them if another compiler, or none, is found."""
    with suppress(MachineCodeError):
        if "Free Software Foundation" in find_compiler().identity:
            return options
    return ()


@cache
def _find_compiler(named: str, path: str) -> Compiler | str:
    """The compiler, or the reason why there is none; a hanging one is waited for once."""
    try:
        command = shlex.split(named)
    except ValueError as error:
        return f"CC is no command, {named!r}: {error}"
    if not command:
        has_own = shutil.which("cc") or find_spec("ziglang") is None
        command = ["cc"] if has_own else [sys.executable, *ZIG]
    if (found := shutil.which(command[0])) is None:
        where = f"CC names '{command[0]}', which is" if named.strip() else "'cc' is"
        return (
            f"no C compiler: {where} not found; install gcc or clang, name "
            "one in CC, or pip install ziglang"
        )
    # The option for this processor, and the target that the compiler derives from it. The target is
    # part of the identity, so that machines with a shared cache each have their own code.
    target, processor = tuple[str, ...](), ""
    try:
        version = _run([*command, "--version"], ANSWERS)
        if not any(word.startswith(("-march", "-mcpu")) for word in command):
            answer = _run([*command, NATIVE, "-dM", "-E", "-x", "c", os.devnull], ANSWERS)
            if answer.returncode == 0:
                target, processor = (NATIVE,), answer.stdout
    except MachineCodeError as error:
        return str(error)
    library = "CS_GNU_LIBC_VERSION" in os.confstr_names and os.confstr("CS_GNU_LIBC_VERSION")
    said = (version.stdout, version.stderr, library, platform.system(), platform.machine())
    return Compiler(tuple(command), repr((found, *said, processor)), target)


def compile_webassembly(source: Path, file: Path) -> None:
    """Compiles C to a WebAssembly module that imports nothing, by the zig of ziglang.

    The first call on a machine compiles zig's C library as well, which takes half a minute.
    """
    _compile([sys.executable, *WEB, str(source), "-o", str(file)], file, WEB_PATIENCE)


def _compile(command: list[str], file: Path, seconds: float) -> None:
    """Runs a command that makes a file; where it fails, raises with its first error."""
    done = _run(command, seconds)
    if done.returncode or not file.exists():
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        wrong = [line for line in lines if "error" in line.lower()] or lines or ["no message"]
        raise MachineCodeError(
            f"the C compiler '{command[0]}' fails (exit {done.returncode}): {wrong[0].strip()}"
        )


def _run(command: list[str], seconds: float) -> "subprocess.CompletedProcess[str]":
    """Runs a command to its end. After a timeout it also ends the child processes."""
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    options |= {"stdin": subprocess.DEVNULL, "errors": "replace", "process_group": 0}
    try:
        with subprocess.Popen(command, **options) as process:
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
