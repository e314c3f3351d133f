"""A loop in C as a library, called through ctypes."""

import ctypes
from pathlib import Path

import numpy as np
from c_controller import compile_c
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from drake_dae import ClosedLoop
from drake_dae.blocks.compose import compose
from drake_dae.running.c_code import BlockCode
from drake_dae.running.export import check_traced, write_loop


def code_of(loop: ClosedLoop, context: Context) -> BlockCode:
    """The signals of a loop as functions in C."""
    ports = {name: loop.diagram.GetOutputPort(name) for name in loop.signals}
    composed = compose(loop.diagram, ports, context=context, shares=False)
    check_traced(composed, "the loop")
    return BlockCode(composed, context, {}, {})


class CLoop:
    """A loop of a library.

    Args:
        code: The loop.
        folder: Where its files are written and compiled.
        config: The settings of its steps.
        flags: Options of the compiler.
    """

    def __init__(
        self,
        code: BlockCode,
        folder: Path,
        config: SimulatorConfig | None = None,
        *flags: str,
        name: str = "a",
    ) -> None:
        self.files = write_loop(code, 0.0, name, folder, config)
        self.outputs, first = {}, 0
        for port, signals in code.outputs.items():
            self.outputs[port] = slice(first, first + len(signals))
            first += len(signals)

        class Own(ctypes.Structure):
            _fields_ = (
                ("parameters", ctypes.c_double * (len(code.parameters) + 1)),
                ("state", ctypes.c_double * (code.steps.block.state.numel() + 1)),
                ("longest", ctypes.c_double),
                ("time", ctypes.c_double),
                ("row", ctypes.c_double * first),
                ("rest", ctypes.c_double * 10000),
            )

        options = (*(flags or ("-O0",)), "-shared", "-fPIC")
        library = ctypes.CDLL(compile_c(folder, [f"{name}_loop.c"], f"{name}.so", *options))
        self._init = getattr(library, f"{name}_loop_init")
        self._advance = getattr(library, f"{name}_loop_advance")
        self._advance.argtypes = [ctypes.c_void_p, ctypes.c_double]
        self.own = Own()
        self.reset()

    def reset(self) -> None:
        self._init(ctypes.byref(self.own))

    def advance(self, time: float) -> int:
        return self._advance(ctypes.byref(self.own), time)

    def output(self, name: str) -> np.ndarray:
        return np.array(self.own.row)[self.outputs[name]]
