"""The system class of the paper: x' = f + g v + h u, 0 = k(x), z = l + m v.      (1)-(3)"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name, vector
from drake_dae.dae.contacts import Contacts, UnilateralInput
from drake_dae.dae.fields import checked_fields, fields_of_functions
from drake_dae.dae.signals import Exogenous, Parameter, Signal, parameter_symbol
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import SINGULAR


@dataclass(frozen=True, eq=False)
class ForceSharing:
    """The distribution of forces among redundant constraints, some of which are removed."""

    split: ca.SX  # T of v_all = T v.
    signals: tuple[Signal, ...]  # Of v_all.
    undetermined: tuple[str, ...]  # The constraint inputs that (1)-(3) do not determine.
    left_out: ca.SX  # The constraints that are removed.
    left_out_signals: tuple[Signal, ...]


@dataclass(frozen=True, eq=False)
class DaeSystem:
    """A nonlinear differential-algebraic control system, equations (1)-(3):

        x' = f(x) + g(x) v + h(x) u,    0 = k(x),    z = l(x) + m(x) v.

    The fields are CasADi SX expressions of `state` and of the symbols of `parameters`. Exogenous
    signals w(t) are parameters with `exogenous=True`: in section 2, L_f then becomes
    D = L_f + sum_j (d/dw^(j)) w^(j+1), and N* moves. With E the first equation is
    E x' = f + g v + h u; M(q) costs far fewer operations than its inverse.

    Attributes:
        state: The symbols x, shape (n, 1).
        f, g, h: The drift and the input matrices of v and u, shapes (n, 1), (n, m) and (n, p).
        k: The constraint outputs y, shape (m, 1); m = 0 is an ordinary control system.
        l, m: The controlled outputs z, shapes (q, 1) and (q, m). A law (28) needs q = p, or fewer
            with a `control_metric`.
        parameters: Named numbers that the expressions depend on.
        *_signals: Names and units of x, v, u, y, z; "x0", "x1", ... where not given.
        nominal_state: The initial guess for consistent states, shape (n,); zero if None.
        state_scale: The size of each state, to which tolerances are relative; max(|nominal|, 1) if
            None: give it where a unit is far from the size of a state.
        mass_matrix: E, shape (n, n), symmetric positive definite; the identity if None.
        implicit: (x', v) -> E x' - f - g v and the rates of L_f^(r_i - 1) k_i along x', if that
            takes fewer operations: for a robot it is inverse dynamics.
        sharing: The forces of redundant constraints, from `share_forces`.
        control_metric, free_control: W, shape (p, p), and u_0: with more controls than outputs (28)
            takes u = u_0 + W^-1 B^T (B W^-1 B^T)^-1 (ubar - a - B u_0), nearest to u_0.
        compiled: Machine code from the first call (True), never, or when it pays ("auto").
        least_margin: A(x) or B(x) is singular where its smallest singular value, scaled, is below.
        contacts: Constraint inputs that only push, if one has friction: see `contacts`.
        dry: The names of parameters that are coefficients of Coulomb friction in f.

    Raises:
        ModelError: A shape, a symbol, a name or a number does not fit, or a function is not smooth.
    """

    state: ca.SX
    f: ca.SX
    g: ca.SX
    h: ca.SX
    k: ca.SX
    l: ca.SX  # noqa: E741 - the paper's letter
    m: ca.SX
    parameters: tuple[Parameter, ...] = ()
    state_signals: tuple[Signal, ...] = ()
    constraint_input_signals: tuple[Signal, ...] = ()
    constraint_output_signals: tuple[Signal, ...] = ()
    control_signals: tuple[Signal, ...] = ()
    output_signals: tuple[Signal, ...] = ()
    nominal_state: FloatArray = field(default=None)  # type: ignore[arg-type]
    state_scale: FloatArray | None = None
    name: str = "system"
    mass_matrix: ca.SX = None
    implicit: Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]] | None = None
    sharing: ForceSharing | None = None
    control_metric: ca.SX = None
    free_control: ca.SX = None
    compiled: Compiled = "auto"
    contacts: tuple[UnilateralInput, ...] = ()
    least_margin: float = SINGULAR
    dry: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        arguments = {item.name: getattr(self, item.name) for item in fields(self)}
        for key, value in checked_fields(arguments).items():
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        counts = f"n={self.num_states}, m={self.num_constraints}, p={self.num_controls}"
        return f"DaeSystem('{self.name}', {counts})"

    @classmethod
    @checked(ModelError)
    def from_functions(
        cls,
        state: Sequence[Signal | str] | int,
        *,
        f: Callable[..., Any],
        h: Callable[..., Any] | None = None,
        l: Callable[..., Any] | None = None,  # noqa: E741
        g: Callable[..., Any] | None = None,
        k: Callable[..., Any] | None = None,
        m: Callable[..., Any] | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        exogenous: Sequence[str] = (),
        bounds: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
        **labels: Any,
    ) -> "DaeSystem":
        """Builds a system from Python functions of the state.

        Each function is called once with a CasADi column x, and, if there are `parameters`, with a
        namespace p of their symbols: `f=lambda x, p: [x[1], -p.stiffness * x[0]]`. It returns an
        expression, or a list (of lists for a matrix, row by row), made by functions of CasADi.

        Args:
            state: Names (or Signals) of the states, or their number n.
            f, g, h, k, l, m: The functions of (1)-(3). Without constraints leave out g, k and m;
                without controls h; without controlled outputs l and m.
            parameters: Name -> default; a name must be a Python identifier.
            exogenous: The names of the parameters that are exogenous signals w(t).
            bounds: Name of a parameter -> its range (low, high); see `with_bounds`.
            labels: The remaining fields of the class.
        """
        functions = {"f": f, "g": g, "h": h, "k": k, "l": l, "m": m}
        system = cls(**fields_of_functions(state, functions, parameters or {}, labels))
        system = system.with_exogenous(exogenous) if exogenous else system
        return system.with_bounds(bounds) if bounds else system

    @cached_property
    def explicit(self) -> "DaeSystem":
        """The equivalent system with E = 1, whose f, g and h are those of the paper."""
        if ca.is_equal(self.mass_matrix, ca.SX.eye(self.num_states)):
            return self
        fields = ca.horzcat(self.f, self.g, self.h)
        solved = PositiveDefiniteFactorization(self.mass_matrix).solve(fields)
        m = self.num_constraints
        return replace(
            self,
            f=solved[:, 0],
            g=solved[:, 1 : 1 + m],
            h=solved[:, 1 + m :],
            mass_matrix=None,
            implicit=None,
            state_scale=self.scale,
        )

    @cached_property
    def fields(self) -> TracedFunction:
        """The function (state, parameters) -> f, g, h, l, m of the system with E = 1."""
        outputs = {key: getattr(self.explicit, key) for key in "fghlm"}
        return self.trace("fields", outputs, often=False)

    @cached_property
    def num_states(self) -> int:
        """n"""
        return int(self.state.numel())

    @cached_property
    def num_constraints(self) -> int:
        """m"""
        return int(self.k.numel())

    @cached_property
    def num_controls(self) -> int:
        """p"""
        return int(self.h.shape[1])

    @cached_property
    def num_outputs(self) -> int:
        """q; the law (28) needs as many outputs as controls."""
        return int(self.l.numel())

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of all constraint inputs, including those of redundant constraints."""
        return self.constraint_input_signals if self.sharing is None else self.sharing.signals

    def forces(self, constraint_input: ca.SX) -> ca.SX:
        """Returns all constraint inputs, named by `force_signals`, from v of shape (m, 1)."""
        if self.sharing is None:
            return constraint_input
        return ca.mtimes(self.sharing.split, constraint_input)

    def implicit_with(
        self, term: Callable[[ca.SX], ca.SX]
    ) -> Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]] | None:
        """Returns `implicit` with a term, a function of x', added to its balance; None if None."""
        inner = self.implicit

        def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
            balance, constraint_rate = inner(rate, constraint_input)  # type: ignore[misc]
            return balance + term(rate), constraint_rate

        return implicit if inner else None

    def outputs(self, constraint_input: ca.SX) -> ca.SX:
        """Returns the controlled outputs z = l(x) + m(x) v (3), shape (p, 1)."""
        return self.l + ca.mtimes(self.m, constraint_input)  # (3)

    @cached_property
    def parameter_symbol(self) -> ca.SX:
        """The symbols of all parameters in one column, then w', w'', ... of exogenous ones."""
        return parameter_symbol(self.parameters)

    @property
    def parameter_signals(self) -> list[Signal]:
        """Names and units of the entries of `parameter_symbol`."""
        rates = [
            signal.derivative(order)
            for p in self.exogenous.moving
            for order in range(1, len(p.derivatives) + 1)
            for signal in p.signals
        ]
        return [*(signal for p in self.parameters for signal in p.signals), *rates]

    @property
    def parameter_values(self) -> FloatArray:
        """The default parameter vector, as `parameter_symbol`; derivatives are zero."""
        return self._defaults.copy()

    @cached_property
    def _defaults(self) -> FloatArray:
        values = np.concatenate([np.zeros(0), *[p.value for p in self.parameters]])
        return np.pad(values, (0, self.parameter_symbol.numel() - values.size))

    @cached_property
    def exogenous(self) -> Exogenous:
        """The exogenous parameters w, and the terms that they add to time derivatives."""
        return Exogenous(self.name, self.parameters)

    @cached_property
    def frictional_contacts(self) -> Contacts:
        """The unilateral contacts; it is true if at least one of them has friction."""
        return Contacts(self.name, self.constraint_input_signals, self.parameters, self.contacts)

    @checked(ModelError)
    def with_exogenous(self, names: Sequence[str]) -> "DaeSystem":
        """Returns the same system with some parameters as exogenous signals."""
        return self._with_parameters("exogenous", dict.fromkeys(names, True))

    @checked(ModelError)
    def with_bounds(self, bounds: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> "DaeSystem":
        """Returns the same system with bounds for some parameters: name -> (low, high).

        Relative degrees must be the same for all values within them; see `Parameter`.
        """
        return self._with_parameters("bounds", bounds)

    @checked(ModelError)
    def with_values(self, values: Mapping[str, ArrayLike]) -> "DaeSystem":
        """Returns the same system with other defaults of some parameters."""
        sized = {p.name: p.entries(values[p.name]) for p in self.parameters if p.name in values}
        return self._with_parameters("value", {**values, **sized})

    def _with_parameters(self, key: str, values: Mapping[str, Any]) -> "DaeSystem":
        for name in values:
            self.parameter_slice(name)
        parameters = [
            replace(p, **{key: values[p.name]}) if p.name in values else p for p in self.parameters
        ]
        return replace(self, parameters=tuple(parameters))

    @property
    def parameter_box(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and highest values of `parameter_symbol` for which degrees are checked.

        Derivatives of signals are bounded by the size of the signal, or 1, per second.
        """
        low = [np.zeros(0), *[p.low for p in self.parameters]]
        high = [np.zeros(0), *[p.high for p in self.parameters]]
        for p in self.exogenous.moving:
            size = np.where(p.low < p.high, np.where(p.value == 0.0, 1.0, np.abs(p.value)), 0.0)
            low += [-size] * len(p.derivatives)
            high += [size] * len(p.derivatives)
        return np.concatenate(low), np.concatenate(high)

    @cached_property
    def scale(self) -> FloatArray:
        """The typical size of each state: `state_scale`, or max(|nominal state|, 1)."""
        if self.state_scale is not None:
            return self.state_scale
        return np.maximum(np.abs(self.nominal_state), 1.0)

    def spread_around(self, state: ArrayLike) -> FloatArray:
        """Returns the default standard deviation of random states around a state, shape (n,).

        It is 0.1 of the scale, a hundredth of a value above 10 scales, and a tenth of one below
        1e-3 scales that is not round-off.
        """
        size = np.abs(self.state_vector(state)) / self.scale
        small = (size < 1e-3) & (size > 1e-12 * max(1.0, size.max()))
        return self.scale * np.where(size > 10.0, 0.01 * size, np.where(small, 0.1 * size, 0.1))

    def trace(
        self,
        name: str,
        outputs: Mapping[str, ca.SX],
        inputs: Mapping[str, ca.SX] | None = None,
        pivot: ca.SX | None = None,
        regular: str = "a matrix",
        often: bool = True,
    ) -> TracedFunction:
        """Compiles expressions to a function of the state, of other inputs and of the parameters.

        Further inputs stand between these; the other arguments are those of `TracedFunction`.
        """
        every = {"state": self.state, **(inputs or {}), "parameters": self.parameter_symbol}
        name = f"{self.name} {name}"
        return TracedFunction(name, every, outputs, pivot, regular, often, self.compiled)

    def matrix(
        self, name: str, expression: ca.SX
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Returns the function (state, parameters) -> a matrix as a new array of its shape."""
        function = self.trace(name, {"value": expression}, often=False)
        return lambda state, parameters: function(state, parameters)[0].reshape(expression.shape)

    def agree(self, first: ca.SX, second: ca.SX, *unknowns: ca.SX) -> bool:
        """Returns whether two expressions agree at random states and parameters near the nominal.

        States at which they are not finite, out of their domain, are left out.
        """
        symbols = [self.state, *unknowns, self.parameter_symbol]
        function = ca.Function("both", symbols, [ca.densify(first), ca.densify(second)])
        random, p = np.random.default_rng(0), self.parameter_values
        deviation, agree = self.spread_around(self.nominal_state), list[bool]()
        for spread in (0.0, 0.1, 0.1):
            x = self.nominal_state + deviation * random.standard_normal(self.num_states)
            numbers = [random.standard_normal(u.numel()) for u in unknowns]
            changed = p + spread * random.standard_normal(p.size) * np.where(p == 0.0, 1.0, p)
            a, b = (v.full() for v in function(x, *numbers, changed))
            # By columns: constraints may have very different units.
            size = np.abs(a).max(axis=0, initial=0.0) + np.abs(b).max(axis=0, initial=0.0)
            if np.all(np.isfinite(size)):
                agree.append(bool(np.all(np.abs(a - b) <= 1e-9 * np.abs(b) + 1e-11 * size)))
        return bool(agree) and all(agree)

    def parameter_vector(self, parameters: ArrayLike | None) -> FloatArray:
        """Checks a parameter vector, the default if None; do not change the array."""
        if parameters is None:
            return self._defaults
        if (  # Called in each step of a simulation, so without a copy.
            type(parameters) is np.ndarray
            and parameters.dtype == np.float64
            and parameters.shape == self._defaults.shape
            and isfinite(parameters.dot(parameters))
        ):
            return parameters
        return vector(f"{self.name}: parameters", parameters, self._defaults.size)

    @checked(ModelError)
    def parameters_of(self, other: "DaeSystem", values: ArrayLike) -> FloatArray:
        """Returns the parameter vector of this system with the values that another system has.

        Those are taken that have the same name and size in both, with their derivatives if they are
        exogenous.
        """
        given, found = other.parameter_vector(values), self.parameter_values
        sizes = {p.name: p.value.size for p in other.parameters}
        own, others = self.exogenous, other.exogenous
        for p in self.parameters:
            if sizes.get(p.name) == p.value.size:
                found[own.slices[p.name]] = given[others.slices[p.name]]
                if p.name in own.rates and p.name in others.rates:
                    found[own.rates[p.name]] = given[others.rates[p.name]]
        return found

    def state_vector(self, state: ArrayLike) -> FloatArray:
        """Checks a state and returns it as a new array of shape (n,)."""
        return vector(f"{self.name}: a state", state, self.num_states)

    def parameter_slice(self, name: str) -> slice:
        """Returns the place of a parameter in the parameter vector."""
        if (slices := self.exogenous.slices).get(name) is None:
            known = [p.name for p in self.parameters]
            raise ModelError(f"{self.name}: {unknown_name('parameter', name, known)}")
        return slices[name]
