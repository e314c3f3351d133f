"""Linear models of a system at a state and an input, as data."""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.round_off import equilibration

ComplexArray = np.typing.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model E x' = A x + B u, z = C x + D u, for small deviations.

    Attributes:
        E: Shape (k, k); singular in a descriptor form, the identity in a minimal one.
        A: Shape (k, k).
        B: Shape (k, q).
        C: Shape (p, k), for p outputs.
        D: Shape (p, q).
        state_signals, input_signals, output_signals: Names and units of x, u and z.
    """

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    state_signals: tuple[Signal, ...]
    input_signals: tuple[Signal, ...]
    output_signals: tuple[Signal, ...]

    def response(self, s: complex) -> ComplexArray:
        """Returns the transfer matrix C (s E - A)^-1 B + D at a frequency s in 1/s, shape (p, q).

        Raises:
            ModelError: s is a pole.
        """
        pencil = s * self.E - self.A
        rows, columns = equilibration(np.abs(pencil))
        try:
            moved = np.linalg.solve(pencil / rows[:, None] / columns, self.B / rows[:, None])
        except np.linalg.LinAlgError:
            raise ModelError(f"s = {s:g} is a pole; evaluate the response at another s") from None
        return np.asarray(self.C @ (moved / columns[:, None]) + self.D, dtype=complex)


@dataclass(frozen=True, eq=False)
class Linearization:
    """The linear models of one system at one state and input.

    Attributes:
        descriptor: (E, A, B, C, D) of (1)-(3) with the unknowns (x, v), n + m in all,

                E x' = f + g v + h u,    0 = k,    z = l + m v.

        minimal: (A, B, C, D) of the motion on N* with n - sum r_i states of x as coordinates. Where
            the state is at rest both have the same transfer matrix. Elsewhere each is the
            linearization of its own equations at that instant, and the hidden constraints of the
            descriptor form change with time.
        index: The index of the DAE, max r_i + 1; 0 without constraints. With constraints the pencil
            (E, A) has infinite poles; use the minimal form for tools that take (A, B, C, D).
        coordinates: The states of the minimal form, shape (n - sum r_i,).
        basis: The derivatives of all states by these on N*, shape (n, n - sum r_i).
        state, rate, control, constraint_input: x, x', u and v at the operating point.
    """

    descriptor: LinearModel
    minimal: LinearModel
    index: int
    coordinates: Indices
    basis: FloatArray
    state: FloatArray
    rate: FloatArray
    control: FloatArray
    constraint_input: FloatArray
