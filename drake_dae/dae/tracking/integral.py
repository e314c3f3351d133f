"""Integral action: errors that the law (28) integrates."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.arrays import unknown_name
from drake_dae.dae.signals import DerivativeLayout, Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking.measured_force import ForceMeasurement
from drake_dae.errors import GainError


@dataclass(frozen=True, eq=False)
class IntegralAction:
    """The integrals sigma_i' = z_i - r_i of some outputs, which extend (30) to

        e_i^(mu_i) = -K_i0 sigma_i - K_i1 e_i - ... - K_i mu_i e_i^(mu_i - 1),

    so that an output has mu_i + 1 poles in place of mu_i. If mu_i = 0 it is the integral of a
    measured force: ubar_i = r_i - K_i0 int (z_i - r_i) dt. With a constant model error, e_i tends
    to zero.
    """

    outputs: tuple[int, ...]
    degrees: tuple[int, ...]
    signals: tuple[Signal, ...]
    symbol: ca.SX

    @classmethod
    def of(
        cls,
        system: DaeSystem,
        degrees: Sequence[int],
        names: Sequence[str],
        measured: ForceMeasurement | None,
    ) -> "IntegralAction":
        """Returns the integral action on outputs by their names."""
        names_of_outputs = [signal.name for signal in system.output_signals]
        integrated = []
        for name in names:
            if name not in names_of_outputs:
                raise GainError(f"integral: {unknown_name('output', name, names_of_outputs)}")
            i = names_of_outputs.index(name)
            if i in integrated:
                raise GainError(f"integral: '{name}' occurs twice")
            if degrees[i] == 0 and (measured is None or i not in measured.rows):
                raise GainError(
                    f"integral: by the model the law attains '{name}' without delay, so there is "
                    "no error to integrate; make the law with measured_force=True, and integrate "
                    "a constraint input or a combination of some"
                )
            integrated.append(i)
        chosen = tuple(sorted(integrated))
        signals = tuple(
            Signal(
                f"integral of {names_of_outputs[i]}", f"{system.output_signals[i].unit or '1'} s"
            )
            for i in chosen
        )
        return cls(chosen, tuple(degrees), signals, ca.SX.sym("integral", len(chosen)))

    @property
    def all_degrees(self) -> tuple[int, ...]:
        """The number of poles of each output."""
        return tuple(degree + (i in self.outputs) for i, degree in enumerate(self.degrees))

    def coordinates(self, errors: ca.SX, integral: ca.SX | None = None) -> ca.SX:
        """Returns the error coordinates, with the integrals among them."""
        values = self.symbol if integral is None else integral
        starts, rows = DerivativeLayout(self.degrees).starts.tolist(), []
        for i, degree in enumerate(self.degrees):
            if i in self.outputs:
                rows.append(values[self.outputs.index(i)])
            rows.append(errors[starts[i] : starts[i] + degree, :])
        return ca.vertcat(ca.SX(0, 1), *rows)

    def rate(self, chain: ca.SX, values: ca.SX, measured: ForceMeasurement | None) -> ca.SX:
        """Returns sigma' = z - r of these outputs, shape (k, 1)."""
        starts, rows = DerivativeLayout(self.degrees).starts.tolist(), [ca.SX(0, 1)]
        for i in self.outputs:
            if self.degrees[i]:
                rows.append(chain[starts[i]] - values[i])
            elif measured is not None:
                rows.append(measured.value(i) - values[i])
        return ca.vertcat(*rows)
