"""Dynamic extension: integrators before controls, where B(x) has no inverse without them.

If B(x) of (16) is singular, one combination of the controls acts on some outputs before the others
do, as the drive of a wheeled robot before its steering. If that combination becomes a state and its
derivative the control, all controls act at the same order. The law (28) of the extended system is
then a dynamic state feedback of the original one.

Descusse and Moog, International Journal of Control 42(6), 1985; Isidori, Nonlinear Control Systems,
1995, section 5.4.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show
from drake_dae.dae.relative_degrees import InputActions
from drake_dae.dae.samples import Samples, spread_of
from drake_dae.dae.signals import Signal, places_of
from drake_dae.dae.structure import Structure, examine_structure, find_structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import positive


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Extension:
    """A system with integrators before its controls, whose B(x) is regular.

    The original system's control is u = offset(x_e) + matrix(x_e) w, with x_e and w the state and
    the control of the extended one, whose first n states are those of the original. `integrators`
    is the number before each of the original controls. If others are mixed in first, the new state
    has a star: "u1*" is u1 + sum_j b_j(x) u_j.
    """

    original: DaeSystem
    system: DaeSystem
    structure: Structure
    integrators: Mapping[str, int]
    control_offset: ca.SX  # In terms of `system.state`, shape (p, 1).
    control_matrix: ca.SX  # Likewise, shape (p, p).

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
def dynamic_extension(
    system: DaeSystem,
    *,
    nominal_control: Mapping[str, float] | None = None,
    spread: ArrayLike | None = None,
) -> Extension:
    """Finds integrators that make B(x) regular, by the dynamic extension algorithm.

    In each round the controls that act in the dependent rows of B(x) get an integrator. If more
    than q controls act in rows of rank q, a regular static feedback u = beta(x) w is applied first,
    after which only q controls act in them; see `Extension.integrators`. Each round reduces the
    dimension of the zero dynamics by the rank deficiency of B(x), so that it ends after few rounds.

    The system stays as it is if its B(x) is regular.

    Args:
        system: The system (1)-(3).
        nominal_control: Values of the controls at the nominal state, for the integrators that hold
            them; zero where not given.
        spread: The standard deviation of the random states, as in `find_structure`; of a control
            0.1 of its nominal value, or 0.1.

    Raises:
        AssumptionError: No integrators help: the outputs are not independent, B(x) is singular at
            isolated states only, or more than n are needed; or Assumption (3) is violated.
        ModelError, InconsistentStateError: As of `find_structure`, or for a `control_metric`.
    """
    if system.control_metric is not None:
        raise ModelError(
            f"{system.name}: control_metric compares controls, not their derivatives; leave it "
            "out, and give the extended system one"
        )
    values, names = nominal_control or {}, [signal.name for signal in system.control_signals]
    held = np.zeros(len(names))
    places = places_of("control", values, system.control_signals, f"{system.name}: ")
    held[places] = list(values.values())
    spreads = spread_of(system, spread)
    bases = [(signal, 0) for signal in system.control_signals]  # And how often integrated.
    extended, integrators = system, dict[str, int]()
    offset, matrix = ca.SX(system.num_controls, 1), ca.SX.eye(system.num_controls)
    while True:
        # Beside the nominal state, where rows of B(x) may vanish accidentally, as sin(heading) does
        # at heading 0.
        step = 0.1 * spreads * np.random.default_rng(0).standard_normal(extended.num_states)
        near = replace(
            extended, nominal_state=extended.nominal_state + step, state_scale=extended.scale
        )
        choice = _controls_to_integrate(examine_structure(near, spread=spreads))
        if choice is None:
            break
        columns, mixing = choice
        others, nominal = [j for j in range(len(names)) if j not in columns], held[columns]
        if mixing is not None:
            mixed = extended.matrix("mixing", mixing)
            here = mixed(extended.nominal_state, extended.parameter_values)
            nominal = nominal + here @ held[others]
            for i in columns:
                control = extended.control_signals[i]
                bases[i] = (Signal(f"{control.name}*", control.unit), 0)
        added, controls = list[Signal](), list(extended.control_signals)
        for i in columns:
            base, order = bases[i]
            added.append(base.derivative(order))
            controls[i], bases[i] = base.derivative(order + 1), (base, order + 1)
            integrators[names[i]] = integrators.get(names[i], 0) + 1
        count = extended.num_states
        extended = _integrated(extended, columns, added, controls, nominal, mixing)
        # u_i = x_i - sum_j b_ij u_j, with the new state x_i.
        offset += ca.mtimes(matrix[:, columns], extended.state[count:])
        if mixing is not None:
            matrix[:, others] -= ca.mtimes(matrix[:, columns], mixing)
        matrix[:, columns] = 0.0
        held[columns] = 0.0
        # B(x) is often singular at zero, so a nonzero value is kept away from zero.
        spreads = np.concatenate([spreads, 0.1 * positive(np.abs(nominal))])
        if sum(integrators.values()) > system.num_states:
            raise AssumptionError(
                f"more than {system.num_states} integrators are needed for a regular B(x) of "
                f"(16), so far {_listed(integrators)}. Choose other outputs",
                5,
            )
    try:
        structure = find_structure(extended, spread=spreads)
    except AssumptionError as error:
        if error.state is None:
            raise
        raise AssumptionError(
            f"B(x) of (16) is regular around x = {show(error.state)}, but not there, which "
            "more integrators do not change. Keep away from this state, or give the controls that "
            f"are integrated another nominal_control; integrators: {_listed(integrators)}",
            error.assumption,
            error.state,
        ) from error
    return Extension(system, extended, structure, integrators, offset, matrix)


def _listed(integrators: Mapping[str, int]) -> str:
    return ", ".join(f"{count} before {name}" for name, count in integrators.items()) or "none"


def _controls_to_integrate(structure: Structure) -> tuple[list[int], ca.SX | None] | None:
    """The controls that act in the dependent rows of B(x), and how to mix them."""
    system = structure.system
    samples = Samples(structure.manifold, structure.states)
    actions = InputActions(samples, structure.elimination)
    matrices = actions.numbers(actions.feedthrough)  # B(x) without its round-off.
    dynamic = [i for i, degree in enumerate(structure.output_degrees) if degree]
    if dynamic:
        last = ca.vertcat(*[structure.output_chains[i][-1] for i in dynamic])
        matrices[:, dynamic] = actions.numbers(actions.along(last, "h*"))
    size = np.abs(matrices).max(axis=0)
    row_size = positive(size.max(axis=1))
    column_size = positive((size / row_size[:, None]).max(axis=0))
    scaled = matrices / row_size[:, None] / column_size
    left, values, _ = np.linalg.svd(scaled)
    ranks = (values > system.least_margin).sum(axis=1)
    rank, p = int(ranks.max()), system.num_controls
    if rank == p:
        return None
    rows = np.flatnonzero(np.abs(left[:, :, rank:]).max(axis=(0, 2)) > system.least_margin).tolist()
    if ranks.min() < rank:
        state = samples.states[int(ranks.argmin())]
        raise AssumptionError(
            f"the rank of B(x) of (16) falls from {rank} to {ranks.min()} at x = {show(state)}, so "
            "that the integrators to add differ from state to state. Keep away from this state",
            5,
            state,
        )
    if samples.dependent(ca.vertcat(structure.manifold.residual_expression, structure.chain)):
        names = ", ".join(system.output_signals[i].name for i in rows)
        raise AssumptionError(
            f"no integrators make B(x) of (16) regular: the outputs {names} and their derivatives "
            "depend on each other or on the constraints, so that the system is not right-"
            "invertible. Choose other outputs",
            5,
        )
    q = len(rows) - (p - rank)
    acting = [j for j in range(p) if matrices[:, rows, j].any()]
    if len(acting) == q:
        return acting, None

    def distance(columns: Iterable[int]) -> float:
        values = np.linalg.svd(scaled[:, rows][:, :, list(columns)], compute_uv=False)
        return round(float(values[:, -1].min()), 9)

    columns = list(max(combinations(acting, q), key=distance))
    others = [j for j in range(p) if j not in columns]
    # Least squares over all dependent rows, since q of them may be dependent at other states. It is
    # exact: every column lies in the span of the chosen ones.
    part = structure.control_matrix[rows, :] / row_size[rows]
    chosen = part[:, columns]
    mixing = Factorization(ca.mtimes(chosen.T, chosen)).solve(ca.mtimes(chosen.T, part[:, others]))
    return columns, ca.sparsify(mixing)


def _integrated(
    system: DaeSystem,
    columns: list[int],
    added: Sequence[Signal],
    controls: Sequence[Signal],
    nominal: FloatArray,
    mixing: ca.SX | None = None,
) -> DaeSystem:
    """One integrator before each of some controls, where u_i = x_i - sum_j b_ij(x) u_j."""
    q, n, p = len(columns), system.num_states, system.num_controls
    others = [j for j in range(p) if j not in columns]
    new = ca.vertcat(*[ca.SX.sym(signal.name) for signal in added])
    h, scale = ca.SX(n + q, p), system.state_scale
    h[:n, others], h[n:, columns] = system.h[:, others], ca.SX.eye(q)
    if mixing is not None:
        h[:n, others] -= ca.mtimes(system.h[:, columns], mixing)
    if scale is not None:
        scale = np.concatenate([scale, positive(np.abs(nominal))])
    return replace(
        system,
        state=ca.vertcat(system.state, new),
        f=ca.vertcat(system.f + ca.mtimes(system.h[:, columns], new), ca.SX(q, 1)),
        g=ca.vertcat(system.g, ca.SX(q, system.num_constraints)),
        h=h,
        state_signals=(*system.state_signals, *added),
        control_signals=tuple(controls),
        nominal_state=np.concatenate([system.nominal_state, nominal]),
        state_scale=scale,
        mass_matrix=ca.diagcat(system.mass_matrix, ca.SX.eye(q)),
        implicit=None,  # The derivatives of the constraints may differ.
    )
