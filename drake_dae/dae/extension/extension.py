"""Integrators before controls: a system whose controls are derivatives of those of another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.signals import Signal
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import positive


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Extension:
    """A system with integrators before its controls, whose B(x) is regular.

    The original system's control is u = offset(x_e) + matrix(x_e) w, with x_e and w the state and
    the control of the extended one; with the integrators it is a dynamic state feedback.

    Attributes:
        original: The system without integrators.
        system: The extended one. The first n states are those of the original.
        structure: The structure of the extended system.
        integrators: The number of integrators before each of the original controls. If others are
            mixed in first, the new state has a star: "u1*" is u1 + sum_j b_j(x) u_j.
        control_offset: offset(x_e) as an expression of `system.state`, shape (p, 1).
        control_matrix: matrix(x_e) likewise, shape (p, p).
    """

    original: DaeSystem
    system: DaeSystem
    structure: Structure
    integrators: Mapping[str, int]
    control_offset: ca.SX
    control_matrix: ca.SX

    def __repr__(self) -> str:
        return f"Extension({self.system!r}, integrators={dict(self.integrators)})"

    def original_control(
        self, state: ArrayLike, control: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """Returns the control u of the original system for x_e and w of the extended one."""
        return self._control(state, control, self.original.parameter_vector(parameters))[0]

    @cached_property
    def _control(self) -> TracedFunction:
        w = ca.SX.sym("w", self.system.num_controls)
        outputs = {"control": self.control_offset + ca.mtimes(self.control_matrix, w)}
        return self.system.trace("original control", outputs, {"control": w}, often=False)


@checked(ModelError)
def extend(
    system: DaeSystem,
    integrators: Mapping[str, int] | Sequence[str],
    nominal_control: Mapping[str, float] | None = None,
) -> DaeSystem:
    """Puts integrators before controls: u_i, u_i', ... become states, the next one the control.

    Constraints, outputs, parameters and mass matrix do not change, and the degrees r_i neither if
    Assumption (3) holds. If it is violated, since u_i acts on a derivative of a constraint before
    any constraint input does, integrators repair it: the constraint then restricts the state u_i.

    Args:
        system: The system (1)-(3).
        integrators: Name of a control -> number of integrators; or names, for one each.
        nominal_control: Values of controls at the nominal state, for the integrators that hold
            them; zero where not given. B(x) is often singular at zero.

    Raises:
        ModelError: A control is unknown, a number of integrators is below 1, or the system has a
            `control_metric`.
    """
    refuse_metric(system)
    if not isinstance(integrators, Mapping):
        integrators = dict.fromkeys(integrators, 1)
    if any(type(count) is not int or count < 1 for count in integrators.values()):
        raise ModelError(
            f"{system.name}: integrators must be whole numbers from 1, got {dict(integrators)}"
        )
    nominal = by_control(system, "nominal_control", nominal_control or {})
    by_control(system, "integrators", integrators)
    base = system.control_signals
    for order in range(max(integrators.values(), default=0)):
        columns = [i for i, signal in enumerate(base) if integrators.get(signal.name, 0) > order]
        system = integrated(
            system,
            columns,
            added=[base[i].derivative(order) for i in columns],
            following=[base[i].derivative(order + 1) for i in columns],
            nominal=nominal[columns] if order == 0 else np.zeros(len(columns)),
        )
    return system


def refuse_metric(system: DaeSystem) -> None:
    """Checks that the system has no `control_metric`."""
    if system.control_metric is not None:
        raise ModelError(
            f"{system.name}: control_metric compares controls, not their derivatives; leave it "
            "out, and give the extended system one"
        )


def integrated(
    system: DaeSystem,
    columns: list[int],
    added: Sequence[Signal],
    following: Sequence[Signal],
    nominal: FloatArray,
    mixing: ca.SX | None = None,
) -> DaeSystem:
    """Puts one integrator before each of some controls, where u_i = x_i - sum_j b_ij(x) u_j."""
    q, n, p = len(columns), system.num_states, system.num_controls
    others = [j for j in range(p) if j not in columns]
    new = ca.vertcat(*[ca.SX.sym(signal.name) for signal in added])
    h = ca.SX(n + q, p)
    h[:n, others] = system.h[:, others]
    if mixing is not None:
        h[:n, others] -= ca.mtimes(system.h[:, columns], mixing)
    controls = list(system.control_signals)
    for row, i in enumerate(columns):
        h[n + row, i] = 1.0
        controls[i] = following[row]
    return replace(
        system,
        state=ca.vertcat(system.state, new),
        f=ca.vertcat(system.f + ca.mtimes(system.h[:, columns], new), ca.SX(q, 1)),
        g=ca.vertcat(system.g, ca.SX(q, system.num_constraints)),
        h=h,
        state_signals=(*system.state_signals, *added),
        control_signals=tuple(controls),
        nominal_state=np.concatenate([system.nominal_state, nominal]),
        state_scale=(
            None
            if system.state_scale is None
            else np.concatenate([system.state_scale, positive(np.abs(nominal))])
        ),
        mass_matrix=ca.diagcat(system.mass_matrix, ca.SX.eye(q)),
        factorize=None,
        implicit=None,  # The derivatives of the constraints may differ.
    )


def by_control(system: DaeSystem, what: str, values: Mapping[str, float]) -> FloatArray:
    """Returns numbers by the names of controls as an array, shape (p,); 0 for others."""
    names = [signal.name for signal in system.control_signals]
    unknown = [name for name in values if name not in names]
    if unknown:
        raise ModelError(
            f"{system.name}: {what} names {', '.join(unknown)}, but the controls are "
            f"{', '.join(names) or 'none'}"
        )
    return vector(f"{system.name}: {what}", [values.get(n, 0.0) for n in names], len(names))
