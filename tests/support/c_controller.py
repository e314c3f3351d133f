"""An exported controller as a library, called through ctypes."""

import ctypes
import re
import subprocess

import numpy as np

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]


def compile_c(folder, sources, target, *flags: str, compiler: str = "cc") -> str:
    """Compiles as strictly as can be, and links; returns the path of what it made."""
    given = [str(folder / source) for source in sources]
    words = [compiler, *STRICT, "-ffp-contract=off", *(flags or ("-O1",)), *given]
    done = subprocess.run(
        [*words, "-o", str(folder / target), "-lm"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return str(folder / target)


class CController:
    """One controller of a library; settings are attributes of `own`."""

    def __init__(self, folder, name: str) -> None:
        header = (folder / f"{name}_controller.h").read_text()
        guard = name.upper()
        sizes = {
            key: int(value)
            for key, value in re.findall(rf"  {guard}_CONTROLLER_(\w+) = (\d+)", header)
        }
        inputs, outputs, controls = (sizes[key] for key in ("INPUTS", "OUTPUTS", "CONTROLS"))

        def numbers(size: int) -> type:
            return ctypes.c_double * size

        class Controller(ctypes.Structure):
            _fields_ = (
                ("parameters", numbers(sizes["PARAMETERS"] + inputs)),
                ("stop_control", numbers(controls)),
                ("stop_time", ctypes.c_double),
                ("max_age", ctypes.c_double),
                ("patience", ctypes.c_int),
                ("held", numbers(sizes["HELD"] + 1)),
                ("rest", numbers(outputs + 10)),
            )

        class Outputs(ctypes.Structure):
            _fields_ = (
                ("values", numbers(outputs)),
                ("status", ctypes.c_int),
                ("fault", ctypes.c_int),
                ("bad_steps", ctypes.c_int),
            )

        library = ctypes.CDLL(str(folder / "controller.so"))
        self._init = getattr(library, f"{name}_controller_init")
        self._step = getattr(library, f"{name}_controller_step")
        self.own, self.out, self._inputs = Controller(), Outputs(), numbers(2 + inputs)()
        self.controls, self.folder = controls, folder
        self.reset()

    def reset(self) -> None:
        self._init(ctypes.byref(self.own))

    def step(self, time: float, inputs, measured_at: float | None = None) -> int:
        self._inputs[:] = [time, time if measured_at is None else measured_at, *inputs]
        pointers = [ctypes.byref(each) for each in (self.own, self._inputs, self.out)]
        return self._step(*pointers)

    @property
    def control(self) -> np.ndarray:
        return np.array(self.out.values[: self.controls])
