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
from drake_dae.arrays import FloatArray, numbers, vector
from drake_dae.dae.system.called import called_functions
from drake_dae.dae.system.checks import checked_fields
from drake_dae.dae.system.contacts import Contacts, UnilateralInput
from drake_dae.dae.system.exogenous import Exogenous
from drake_dae.dae.system.parameters import parameter_slice, parameter_symbol
from drake_dae.dae.system.scale import spread_about
from drake_dae.dae.system.sharing import ForceSharing
from drake_dae.dae.system.signals import Parameter, Signal, bounded, moving, valued
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.factorization import Factors, PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import NEGLIGIBLE, SINGULAR


@dataclass(frozen=True, eq=False)
class DaeSystem:
    """A nonlinear differential-algebraic control system, equations (1)-(3):

        x' = f(x) + g(x) v + h(x) u,    0 = k(x),    z = l(x) + m(x) v.

    All functions may also depend on exogenous signals w(t), which are not controlled and whose
    derivatives are known: they are parameters with `exogenous=True`. In section 2, L_f then becomes
    the total derivative D = L_f + sum_j (d/dw^(j)) w^(j+1); degrees, A, B and (9)-(28) keep their
    form, and N* moves.

    With a mass matrix E the first is E(x) x' = f + g v + h u, and what the paper calls f, g, h is
    E^-1 f, E^-1 g, E^-1 h (see `explicit`). Giving E, as a robot has it in M(q), costs far fewer
    operations than giving its inverse.

    If there are more controls than outputs, B(x) of (16) does not determine the control. Among all
    u with B u = ubar - a the law (28) then takes the one nearest to `free_control` u_0 in the
    metric `control_metric` W,

        u = u_0 + W^-1 B^T (B W^-1 B^T)^-1 (ubar - a - B u_0).

    u_0 does not affect the outputs. W must make the terms of u^T W u comparable: for torques in N m
    and forces in N, take 1 / limit^2 as weights. The zero dynamics of such systems depend on W and
    u_0; pinned outputs and stability use the same choice.

    The fields are CasADi SX expressions of `state` and of the symbols of `parameters`; numbers
    and NumPy arrays are taken as constants. The data checks itself when it is made.

    Attributes:
        state: The symbols x, shape (n, 1).
        f: The drift, shape (n, 1).
        g: The input matrix of the constraint inputs v, shape (n, m).
        h: The input matrix of the control inputs u, shape (n, p); p = 0 without control.
        k: The constraint outputs y, shape (m, 1); m = 0 is an ordinary control system.
        l: The controlled outputs z at v = 0, as many as the controls for a law (28), shape (p, 1),
            or fewer with a `control_metric`; a system that is only simulated may have others, or
            none.
        m: The matrix of v in the controlled outputs, shape (p, m).
        parameters: Named numbers that the expressions depend on.
        state_signals, constraint_input_signals, control_signals, constraint_output_signals,
            output_signals: Names and units of x, v, u, y and z; a plain name is a Signal without
            unit. Made up ("x0", "x1", ...) where not given.
        nominal_state: The initial guess for consistent states, shape (n,); zero if None.
        state_scale: The typical size of each state, positive, shape (n,). Random states, searches
            and tolerances are relative to it. If None, max(|nominal state|, 1), so that give it
            where a state is measured in a unit that is far from its size.
        name: The name of the system in messages.
        mass_matrix: E, shape (n, n), symmetric positive definite; the identity if None.
        implicit: A function of x' and v that returns E x' - f - g v, shape (n, 1), and the
            derivatives of L_f^(r_i - 1) k_i along x', shape (m, 1), for when it takes fewer
            operations than the expressions above: for a robot it is inverse dynamics.
        factorize: A function that returns factors of given rows and columns of E, for when they
            take fewer operations than a triangular factor: for a robot with many links they are the
            articulated-body algorithm. It returns None if it has none for these rows.
        sharing: The distribution of forces among redundant constraints; k contains the others. None
            without redundant constraints. Made by `share_forces`.
        control_metric: W, shape (p, p), symmetric positive definite, for more controls than
            outputs; None otherwise.
        free_control: u_0, shape (p, 1); zero if None.
        compiled: Whether functions that are called often are compiled to machine code, if there is
            a C compiler: True, from the first call; False, never; "auto", if the cache has the
            code, or once a function was called so often that compilation pays. See
            `trace.compiled`.
        least_margin: A(x) and B(x) count as singular where their smallest singular value, rows and
            columns scaled to about length one, is below this.
        negligible: Entries below this, relative to the others in their row or column, count as zero
            when relative degrees are decided, such as 1e-17 in place of 0. If such an entry is
            intended, change units or this number.
        contacts: The unilateral constraint inputs, if friction acts on one of them. The motion is
            well defined only where a unique nonnegative force exists, see `dae.system.contacts`.
        dry: The names of parameters that are coefficients of Coulomb friction in f, which turns
            where a velocity does.

    Raises:
        ModelError: A shape does not fit, a symbol is neither state nor parameter, names or symbols
            are not unique, a constant is not finite, or a function is not smooth in the state, such
            as fabs.
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
    factorize: Callable[[Sequence[int]], Factors | None] | None = None
    sharing: ForceSharing | None = None
    control_metric: ca.SX = None
    free_control: ca.SX = None
    compiled: Compiled = "auto"
    contacts: tuple[UnilateralInput, ...] = ()
    least_margin: float = SINGULAR
    negligible: float = NEGLIGIBLE
    dry: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        arguments = {item.name: getattr(self, item.name) for item in fields(self)}
        for key, value in checked_fields(arguments).items():
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        counts = (self.num_states, self.num_constraints, self.num_controls)
        return f"DaeSystem('{self.name}', n={counts[0]}, m={counts[1]}, p={counts[2]})"

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
        expression, or a list (of lists for a matrix, row by row). Use functions of CasADi, such as
        casadi.sin. numpy.sin works but CasADi warns about it; math.sin does not work.

        Args:
            state: Names (or Signals) of the states, or their number n.
            f, g, h, k, l, m: The functions of (1)-(3). Without constraints leave out g, k and m;
                without controls h; without controlled outputs l and m.
            parameters: Name -> default; a name must be a Python identifier.
            exogenous: The names of the parameters that are exogenous signals w(t).
            bounds: Name of a parameter -> its range (low, high); see `with_bounds`.
            labels: The remaining fields of the class.

        Raises:
            ModelError: A function fails, or the functions do not form a system; see the class.
        """
        functions = {"f": f, "g": g, "h": h, "k": k, "l": l, "m": m}
        names = [item.name for item in fields(cls)]
        system = cls(**called_functions(state, functions, parameters or {}, labels, names))
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
            factorize=None,
            state_scale=self.scale,
        )

    @cached_property
    def fields(self) -> TracedFunction:
        """The function (state, parameters) -> f, g, h, l, m of the system with E = 1."""
        e = self.explicit
        outputs = {"f": e.f, "g": e.g, "h": e.h, "l": e.l, "m": e.m}
        return self.trace("fields", outputs, often=False)

    @cached_property
    def num_states(self) -> int:
        """n, the number of states."""
        return int(self.state.numel())

    @cached_property
    def num_constraints(self) -> int:
        """m, the number of constraints."""
        return int(self.k.numel())

    @cached_property
    def num_controls(self) -> int:
        """p, the number of controls."""
        return int(self.h.shape[1])

    @cached_property
    def num_outputs(self) -> int:
        """The number of controlled outputs. The law (28) needs as many outputs as controls."""
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

    def outputs(self, constraint_input: ca.SX) -> ca.SX:
        """Returns the controlled outputs z = l(x) + m(x) v (3), shape (p, 1)."""
        return self.l + ca.mtimes(self.m, constraint_input)  # (3)

    @cached_property
    def parameter_symbol(self) -> ca.SX:
        """The symbols of all parameters in one column, then w', w'', ... of exogenous ones."""
        return parameter_symbol(self.parameters)

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
        """Returns the same system with some parameters as exogenous signals.

        Raises:
            ModelError: No parameter has that name.
        """
        for name in names:
            self.parameter_slice(name)
        return replace(self, parameters=moving(self.parameters, names))

    @checked(ModelError)
    def with_bounds(self, bounds: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> "DaeSystem":
        """Returns the same system with bounds for some parameters.

        Relative degrees must be the same for all values of the parameters: an input acts on a
        derivative for all of them or for none. Bounds restrict the values to those for which this
        holds.

        Args:
            bounds: Name -> (low, high), each a number or one for each entry; the default lies
                between them. Equal bounds fix the parameter; as an exogenous signal it is constant.

        Raises:
            ModelError: No parameter has that name, or bounds are not valid.
        """
        return self._with_parameters(bounded, bounds)

    @checked(ModelError)
    def with_values(self, values: Mapping[str, ArrayLike]) -> "DaeSystem":
        """Returns the same system with other default values of some parameters.

        Args:
            values: Name -> its default, a number for all entries or one for each.

        Raises:
            ModelError: No parameter has that name, or a value does not fit.
        """
        return self._with_parameters(valued, values)

    def _with_parameters(
        self, changed: Callable[[Parameter, Any], Parameter], values: Mapping[str, Any]
    ) -> "DaeSystem":
        for name in values:
            self.parameter_slice(name)
        parameters = [
            changed(p, values[p.name]) if p.name in values else p for p in self.parameters
        ]
        return replace(self, parameters=tuple(parameters))

    @property
    def parameter_box(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and highest values of `parameter_symbol` for which degrees are checked.

        Derivatives of signals are bounded by the size of the signal, or 1, per second.
        """
        low, high = (
            [np.zeros(0), *[getattr(p, k) for p in self.parameters]] for k in ("low", "high")
        )
        for p in self.exogenous.moving:
            size = np.where(p.low < p.high, np.where(p.value == 0.0, 1.0, np.abs(p.value)), 0.0)
            low += [-size] * len(p.derivatives)
            high += [size] * len(p.derivatives)
        return np.concatenate(low), np.concatenate(high)

    @cached_property
    def scale(self) -> FloatArray:
        """The typical size of each state, shape (n,): `state_scale`, or max(|nominal state|, 1).

        Do not change the array.
        """
        if self.state_scale is not None:
            return self.state_scale
        return np.maximum(np.abs(self.nominal_state), 1.0)

    @property
    def nominal_spread(self) -> FloatArray:
        """The default standard deviation of random states around the nominal one, shape (n,)."""
        return self.usual_spread(self.nominal_state)

    def usual_spread(self, state: ArrayLike) -> FloatArray:
        """Returns the default standard deviation of random states around a state, shape (n,).

        Raises:
            ModelError: The state has a wrong shape, or a number is not finite.
        """
        return spread_about(self.state_vector(state), self.scale)

    def trace(
        self,
        name: str,
        outputs: Mapping[str, ca.SX],
        inputs: Mapping[str, ca.SX] | None = None,
        pivot: ca.SX | None = None,
        regular: str = "a matrix",
        often: bool = True,
        doubt: ca.SX | None = None,
        lean: bool = False,
    ) -> TracedFunction:
        """Compiles expressions to a function of the state, of other inputs and of the parameters.

        Args:
            name: The name of the outputs in messages.
            outputs, pivot, regular, often, doubt, lean: The arguments of `TracedFunction`.
            inputs: Further input symbols, placed between "state" and "parameters".
        """
        every = {"state": self.state, **(inputs or {}), "parameters": self.parameter_symbol}
        return TracedFunction(
            f"{self.name} {name}", every, outputs, pivot, regular, often, self.compiled, doubt, lean
        )

    def parameter_vector(self, parameters: ArrayLike | None) -> FloatArray:
        """Checks a parameter vector, ordered as `parameter_symbol`; the default if None.

        The array may be shared: do not change it.

        Raises:
            ModelError: The shape is wrong, or a number is not finite.
        """
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

        Args:
            other: A system of the same robot, as that of a plant with a payload.
            values: Its parameters, shape (k,) or (samples, k).

        Raises:
            ModelError: The shape is wrong.
        """
        values, size = numbers("values", values), other.parameter_symbol.numel()
        if values.ndim not in (1, 2) or values.shape[-1] != size:
            raise ModelError(
                f"{self.name}: values must have shape ({size},) or (samples, {size}), got "
                f"{values.shape}"
            )
        parameters = np.empty((*values.shape[:-1], self._defaults.size))
        parameters[...] = self._defaults
        sizes = {p.name: p.value.size for p in other.parameters}
        for p in self.parameters:
            if sizes.get(p.name) == p.value.size:
                place = self.parameter_slice(p.name)
                parameters[..., place] = values[..., other.parameter_slice(p.name)]
        own, rates = {p.name: p.value.size for p in self.parameters}, other.exogenous.rates()
        for name, to in self.exogenous.rates().items():
            if name in rates and sizes[name] == own[name]:
                count = min(to.stop - to.start, rates[name].stop - rates[name].start)
                first = rates[name].start
                parameters[..., to.start : to.start + count] = values[..., first : first + count]
        return parameters

    def state_vector(self, state: ArrayLike) -> FloatArray:
        """Checks a state and returns it as a new array of shape (n,).

        Raises:
            ModelError: The shape is wrong, or a number is not finite.
        """
        return vector(f"{self.name}: a state", state, self.num_states)

    @checked(ModelError)
    def parameter_slice(self, name: str) -> slice:
        """Returns the slice of a parameter in the parameter vector.

        Raises:
            ModelError: No parameter has that name.
        """
        return parameter_slice(self.name, self.parameters, name)
