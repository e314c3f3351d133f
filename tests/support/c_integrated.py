"""An exported plant or loop as a library, called through ctypes."""

import ctypes

import numpy as np
from c_controller import compile_c

from drake_dae.running.export.steps.parts import WrittenPart


class CIntegrated:
    """A plant or a loop of a library.

    Args:
        written: What `write_integrated` wrote; it is compiled here.
        flags: Options of the compiler.
    """

    def __init__(self, written: WrittenPart, *flags: str) -> None:
        source = written.files[1]
        part, kind = written.part, written.kind
        self.outputs = {}
        first = 0
        for name, signals in part.outputs.items():
            self.outputs[name] = slice(first, first + len(signals))
            first += len(signals)
        self.num_inputs = sum(map(len, part.inputs.values()))
        count = len(written.parameters)

        def numbers(size: int) -> type:
            return ctypes.c_double * size

        class Own(ctypes.Structure):
            _fields_ = (
                ("parameters", numbers(count)),
                ("inputs", numbers(self.num_inputs + 1)),
                ("state", numbers(written.start.size + 1)),
                ("longest", ctypes.c_double),
                ("time", ctypes.c_double),
                ("row", numbers(first + 1)),
                ("rest", numbers(10000)),
            )

        target = f"{source.stem}.so"
        compile_c(source.parent, [source.name], target, *(flags or ("-O0",)), "-shared", "-fPIC")
        library = ctypes.CDLL(str(source.parent / target))
        name = source.stem.removesuffix(f"_{kind}")
        self._init, self._show = (
            getattr(library, f"{name}_{kind}_{each}") for each in ("init", "show")
        )
        self._advance = getattr(library, f"{name}_{kind}_advance")
        self._advance.argtypes = [ctypes.c_void_p, ctypes.c_double]
        self.own = Own()
        self.reset()

    def reset(self) -> None:
        self._init(ctypes.byref(self.own))

    def advance(self, time: float) -> int:
        return self._advance(ctypes.byref(self.own), time)

    def show(self) -> int:
        return self._show(ctypes.byref(self.own))

    def output(self, name: str) -> np.ndarray:
        return np.array(self.own.row)[self.outputs[name]]
