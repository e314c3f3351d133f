"""The system class of the paper: x' = f + g v + h u, 0 = k(x), z = l + m v.      (1)-(3)"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from math import isfinite
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers, unknown_name, vector
from drake_dae.dae.contacts import Contact, Contacts
from drake_dae.dae.exogenous import Exogenous
from drake_dae.dae.expressions import as_functions, as_signals, call, check_unique
from drake_dae.dae.scale import natural_scale
from drake_dae.dae.sharing import Sharing
from drake_dae.dae.signals import Parameter, Signal, bounded, is_symbol, moving
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled, check_choice
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import NEGLIGIBLE, SINGULAR


@dataclass(frozen=True, eq=False)
class DaeSystem:
    """A nonlinear differential-algebraic control system, equations (1)-(3):

        x' = f(x) + g(x) v + h(x) u,    0 = k(x),    z = l(x) + m(x) v.

    All functions may also depend on exogenous signals w(t), which nobody here steers and whose
    derivatives are known: they are parameters with `exogenous=True`. In section 2, L_f then becomes
    the total derivative D = L_f + sum_j (d/dw^(j)) w^(j+1); degrees, A, B and (9)-(28) keep their
    form, and N* moves.

    With a mass matrix E the first is E(x) x' = f + g v + h u, and what the paper calls f, g, h is
    E^-1 f, E^-1 g, E^-1 h (see `explicit`). Giving E, as a robot has it in M(q), costs far fewer
    operations than giving its inverse.

    Where there are more controls than outputs, B(x) of (16) leaves some of the control open. A
    `control_metric` W says how controls compare: the law (28) takes the u next to `free_control`
    u_0, of all with B u = ubar - a,

        u = u_0 + W^-1 B^T (B W^-1 B^T)^-1 (ubar - a - B u_0).

    Whatever u_0 is, it moves no output. W u . u means something only if it adds what is alike: of
    torques in N m and forces in N, weights by the squares of what each may be. Such systems have
    zero dynamics that depend on the choice, which pinned outputs and stability therefore make, too.

    The fields are CasADi SX expressions of `state` and of the symbols of `parameters`; numbers
    and NumPy arrays are taken as constants. The data checks itself when it is made.

    Attributes:
        state: The symbols x, shape (n, 1).
        f: The drift, shape (n, 1).
        g: How the constraint inputs v enter, shape (n, m).
        h: How the control inputs u enter, shape (n, p); p = 0 is a system that nobody steers.
        k: The constraint outputs y, shape (m, 1); m = 0 is an ordinary control system.
        l: The controlled outputs z at v = 0, as many as the controls for a law (28), shape (p, 1),
            or fewer with a `control_metric`; a system that is only simulated may have others, or
            none.
        m: How v enters the controlled outputs, shape (p, m).
        parameters: Named numbers that the expressions depend on.
        state_signals, constraint_input_signals, control_signals, constraint_output_signals,
            output_signals: Names and units of x, v, u, y and z; a plain name is a Signal without
            unit. Made up ("x0", "x1", ...) where not given.
        nominal_state: Where a search for consistent states starts, shape (n,); zero if not given.
        state_scale: How large the states are in use, positive, shape (n,): random states, searches
            and tolerances are relative to it. If None, `scale` finds it from the equations.
        name: What messages call the system.
        mass_matrix: E, shape (n, n), symmetric positive definite; the identity if None.
        implicit: A function of x' and v that returns E x' - f - g v, shape (n, 1), and the
            derivatives of L_f^(r_i - 1) k_i along x', shape (m, 1), for when it takes fewer
            operations than the expressions above: for a robot it is inverse dynamics.
        sharing: How v is shared among redundant constraints, of which k holds those that stay;
            None where v is all there is. `share_forces` makes it.
        control_metric: W, shape (p, p), symmetric positive definite, for more controls than
            outputs; None if there is nothing to choose.
        free_control: u_0, shape (p, 1); zero if None.
        compiled: Whether functions of the system that are called often become machine code, where a
            C compiler is found: True, from the first call on; False; or "auto", what the cache has,
            and else what was called so often that compiling it pays. See `trace.compiled`.
        least_margin: A(x) and B(x) count as singular where their smallest singular value, rows and
            columns scaled to about length one, is below this.
        negligible: What is below this, relative to the other entries of its row or column, counts
            as zero where relative degrees are decided: 1e-17 in place of a typed 0. What is smaller
            and meant needs other units, or a smaller number here.
        contacts: Those constraint inputs that can only push, where friction acts on one of them:
            the motion makes sense only where they are sure to push, see `dae.contacts`.

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
    sharing: Sharing | None = None
    control_metric: ca.SX = None
    free_control: ca.SX = None
    compiled: Compiled = "auto"
    contacts: tuple[Contact, ...] = ()
    least_margin: float = SINGULAR
    negligible: float = NEGLIGIBLE

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ModelError(f"the name of a system must be text, got {self.name!r}")
        if not (is_symbol(self.state) and self.state.numel()):
            raise ModelError(
                f"{self.name}: 'state' must be a CasADi SX column of symbols, "
                f"for example casadi.SX.sym('x', 4); got {type(self.state).__name__}"
            )
        check_choice(self.name, self.compiled)
        for key in ("least_margin", "negligible"):
            if not 1e-15 <= getattr(self, key) < 1.0:
                raise ModelError(
                    f"{self.name}: {key} must be from 1e-15, which is round-off, to below 1, got "
                    f"{getattr(self, key):g}"
                )
        self._put("state", ca.vec(self.state))
        given = self.parameters if isinstance(self.parameters, (list, tuple)) else [None]
        if not all(isinstance(parameter, Parameter) for parameter in given):
            raise ModelError(
                f"{self.name}: parameters must be a list of Parameters, got "
                f"{brief(self.parameters)}"
            )
        self._put("parameters", tuple(given))
        check_unique(self.name, "parameter", [p.name for p in self.parameters])
        for contact in self.contacts:
            if contact.friction is not None:
                self.parameter_slice(contact.friction)
        if self.mass_matrix is None:
            self._put("mass_matrix", ca.SX.eye(self.state.numel()))
        functions = {key: getattr(self, key) for key in ("f", "g", "h", "k", "l", "m")}
        functions["mass_matrix"] = self.mass_matrix
        chosen = {key: getattr(self, key) for key in ("control_metric", "free_control")}
        functions |= {key: value for key, value in chosen.items() if value is not None}
        checked = as_functions(self.name, functions, self.state, self.parameter_symbol)
        for key, expression in checked.items():
            self._put(key, expression)
        for key, count, letter in (
            ("state_signals", self.num_states, "x"),
            ("constraint_input_signals", self.num_constraints, "v"),
            ("constraint_output_signals", self.num_constraints, "y"),
            ("control_signals", self.num_controls, "u"),
            ("output_signals", self.num_outputs, "z"),
        ):
            labels = getattr(self, key) or [f"{letter}{i}" for i in range(count)]
            signals = as_signals(f"{self.name}: {key}", labels)
            if len(signals) != count:
                raise ModelError(f"{self.name}: {key} has {len(signals)} entries, expected {count}")
            check_unique(self.name, key, [signal.name for signal in signals])
            self._put(key, signals)
        start = np.zeros(self.num_states) if self.nominal_state is None else self.nominal_state
        nominal = vector(f"{self.name}: nominal_state", start, self.num_states)
        nominal.setflags(write=False)
        self._put("nominal_state", nominal)
        if self.state_scale is not None:
            scale = vector(f"{self.name}: state_scale", self.state_scale, self.num_states)
            if not np.all(scale > 0.0):
                raise ModelError(f"{self.name}: state_scale must be positive, got {brief(scale)}")
            scale.setflags(write=False)
            self._put("state_scale", scale)
        self._check_choice()

    def _check_choice(self) -> None:
        """Refuses a choice of the control where there is none, or no metric to choose by."""
        if self.control_metric is not None and self.free_control is None:
            self._put("free_control", ca.SX(self.num_controls, 1))
        if self.control_metric is None and self.free_control is not None:
            raise ModelError(f"{self.name}: free_control needs a control_metric that it is near in")
        if self.control_metric is not None and self.num_controls <= self.num_outputs:
            raise ModelError(
                f"{self.name}: control_metric chooses among controls, but with "
                f"{self.num_controls} controls and {self.num_outputs} controlled outputs there is "
                "nothing to choose; leave it out"
            )

    def _put(self, key: str, value: object) -> None:
        """Sets a field while the frozen system is made."""
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

        Each function is called once with a CasADi column x, and, if there are `parameters`, with
        a namespace p of their symbols: `f=lambda x, p: [x[1], -p.stiffness * x[0]]`. It returns
        an expression, or a list (of lists for a matrix, row by row). Functions of CasADi are meant,
        casadi.sin; numpy.sin works too, but CasADi warns of it, and math.sin does not.

        Args:
            state: Names (or Signals) of the states, or their number n.
            f, g, h, k, l, m: The functions of (1)-(3). Without constraints leave out g, k and m;
                without controls h; without controlled outputs l and m.
            parameters: Name -> default; a name must be a Python identifier.
            exogenous: The names of those parameters that move, as signals w(t).
            bounds: Name of a parameter -> (low, high), between which it stays; see `with_bounds`.
            labels: The remaining fields of the class.

        Raises:
            ModelError: A function fails, or the functions make no system; see the class.
        """
        owner = labels.get("name", "system")
        own = {"state", "parameters", "state_signals", *"fghklm"}
        known = [item.name for item in fields(cls) if item.name not in own]
        for label in labels:
            if label not in known:
                raise ModelError(f"{owner}: {unknown_name('field', label, known)}")
        bad = [name for name in parameters or {} if not name.isidentifier()]
        if bad:
            raise ModelError(
                f"parameter names must be Python identifiers, to be read as p.name: {bad}"
            )
        names = [f"x{i}" for i in range(state)] if isinstance(state, int) else state
        named = as_signals(f"{owner}: the states", names)
        if not named:
            raise ModelError(f"{owner}: a system needs at least one state")
        x = ca.vertcat(*[ca.SX.sym(signal.name) for signal in named])
        defined = tuple(
            Parameter(name, numbers(f"parameter '{name}'", value))
            for name, value in (parameters or {}).items()
        )
        arguments: list[Any] = [x]
        if defined:
            arguments.append(SimpleNamespace(**{p.name: p.symbol for p in defined}))
        functions = {"f": f, "g": g, "h": h, "k": k, "l": l, "m": m}
        values = {key: call(owner, key, given, arguments) for key, given in functions.items()}
        if values["h"].shape[0] == 1 and x.numel() != 1:
            values["h"] = values["h"].T
        system = cls(state=x, **values, parameters=defined, state_signals=named, **labels)
        system = system.with_exogenous(exogenous) if exogenous else system
        return system.with_bounds(bounds) if bounds else system

    @cached_property
    def explicit(self) -> "DaeSystem":
        """The same system with E = 1: f, g and h are those of the paper."""
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
        """f, g, h, l and m of the system with E = 1, as a function of state and parameters."""
        e = self.explicit
        outputs = {"f": e.f, "g": e.g, "h": e.h, "l": e.l, "m": e.m}
        return self.trace("fields", outputs, often=False)

    @property
    def num_states(self) -> int:
        """n, the number of states."""
        return int(self.state.numel())

    @property
    def num_constraints(self) -> int:
        """m, the number of constraints."""
        return int(self.k.numel())

    @property
    def num_controls(self) -> int:
        """p, the number of controls."""
        return int(self.h.shape[1])

    @property
    def num_outputs(self) -> int:
        """The number of controlled outputs; that of the controls where there is a law (28)."""
        return int(self.l.numel())

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of all constraint inputs, those of redundant constraints included."""
        return self.constraint_input_signals if self.sharing is None else self.sharing.signals

    def forces(self, constraint_input: ca.SX) -> ca.SX:
        """All constraint inputs, one for each of `force_signals`, of v, shape (m, 1)."""
        if self.sharing is None:
            return constraint_input
        return ca.mtimes(self.sharing.split, constraint_input)

    @cached_property
    def parameter_symbol(self) -> ca.SX:
        """The symbols of all parameters, below each other; then w', w'', ... of those that move."""
        rates = [rate for p in self.exogenous.moving for rate in p.derivatives]
        return ca.vertcat(ca.SX(0, 1), *[p.symbol for p in self.parameters], *rates)

    @property
    def parameter_values(self) -> FloatArray:
        """The defaults of all parameters, in the order of `parameter_symbol`: nothing moves."""
        return self._defaults.copy()

    @cached_property
    def _defaults(self) -> FloatArray:
        values = np.concatenate([np.zeros(0), *[p.value for p in self.parameters]])
        return np.pad(values, (0, self.parameter_symbol.numel() - values.size))

    @cached_property
    def exogenous(self) -> Exogenous:
        """The parameters that move, w, and how they enter time derivatives."""
        return Exogenous(self.name, self.parameters)

    @cached_property
    def rubbing(self) -> Contacts:
        """The contacts that can only push, if friction acts on one of them; see `dae.contacts`."""
        return Contacts(self.name, self.constraint_input_signals, self.parameters, self.contacts)

    @checked(ModelError)
    def with_exogenous(self, names: Sequence[str]) -> "DaeSystem":
        """The same system, some of whose parameters move.

        Raises:
            ModelError: No parameter has that name.
        """
        known = [p.name for p in self.parameters]
        for name in names:
            if name not in known:
                raise ModelError(f"{self.name}: {unknown_name('parameter', name, known)}")
        return replace(self, parameters=moving(self.parameters, names))

    @checked(ModelError)
    def with_bounds(self, bounds: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> "DaeSystem":
        """The same system, some of whose parameters stay between bounds.

        Relative degrees belong to all numbers that a system may have: an input acts on a derivative
        everywhere or nowhere. Where this holds only for some of them, bounds say which are meant.

        Args:
            bounds: Name -> (low, high), each a number or one for each entry; the default lies
                between them. Where both are the same, the parameter stays there, and as an
                exogenous signal it stands still.

        Raises:
            ModelError: No parameter has that name, or bounds make no sense.
        """
        known = [p.name for p in self.parameters]
        for name in bounds:
            if name not in known:
                raise ModelError(f"{self.name}: {unknown_name('parameter', name, known)}")
        return replace(
            self,
            parameters=tuple(
                bounded(p, bounds[p.name]) if p.name in bounds else p for p in self.parameters
            ),
        )

    @property
    def parameter_box(self) -> tuple[FloatArray, FloatArray]:
        """The lowest and highest values of `parameter_symbol` at which degrees are looked at.

        Derivatives of signals are as large as the signals, or 1, in one second.
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
        """How large the states are in use, shape (n,): `state_scale`, or as the equations tell.

        In other units the same sizes come out, in those units; see `natural_scale`. Do not change
        the array.
        """
        if self.state_scale is not None:
            return self.state_scale
        keys = ("mass_matrix", "f", "g", "h", "k", "l", "m")
        functions = {key: getattr(self, key) for key in keys}
        parameters = (self.parameter_symbol, self._defaults)
        return natural_scale(functions, self.state, parameters, self.nominal_state)

    @property
    def nominal_spread(self) -> FloatArray:
        """How far states are drawn from the nominal one where nobody says, shape (n,)."""
        return self.usual_spread(self.nominal_state)

    def usual_spread(self, state: ArrayLike) -> FloatArray:
        """How far states are drawn from one where nobody says, shape (n,): 0.1 of their scale.

        It is a hundredth of a value that is above 10 of them, and a tenth of one that is below
        1e-3 and not round-off.

        Raises:
            ModelError: The state has a wrong shape, or a number is not finite.
        """
        size = np.abs(self.state_vector(state)) / self.scale
        small = (size < 1e-3) & (size > 1e-12 * size.max())
        return self.scale * np.where(size > 10.0, 0.01 * size, np.where(small, 0.1 * size, 0.1))

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
        """Expressions as a fast function of the state, of other inputs and of the parameters.

        Args:
            name: What the outputs are, for messages.
            outputs, pivot, regular, often, doubt, lean: The arguments of `TracedFunction`.
            inputs: Other symbols, which stand between "state" and "parameters".
        """
        every = {"state": self.state, **(inputs or {}), "parameters": self.parameter_symbol}
        return TracedFunction(
            f"{self.name} {name}", every, outputs, pivot, regular, often, self.compiled, doubt, lean
        )

    def parameter_vector(self, parameters: ArrayLike | None) -> FloatArray:
        """Values of all parameters in the order of `parameter_symbol`; the defaults if None.

        The array may be shared: do not change it.

        Raises:
            ModelError: The shape is wrong, or a number is not finite.
        """
        if parameters is None:
            return self._defaults
        if (  # In each step of a simulation, so without a copy.
            type(parameters) is np.ndarray
            and parameters.dtype == np.float64
            and parameters.shape == self._defaults.shape
            and isfinite(parameters.dot(parameters))
        ):
            return parameters
        return vector(f"{self.name}: parameters", parameters, self._defaults.size)

    def state_vector(self, state: ArrayLike) -> FloatArray:
        """A state as a new array of shape (n,).

        Raises:
            ModelError: The shape is wrong, or a number is not finite.
        """
        return vector(f"{self.name}: a state", state, self.num_states)

    @checked(ModelError)
    def parameter_slice(self, name: str) -> slice:
        """Where a parameter stands in `parameter_values`.

        Raises:
            ModelError: No parameter has that name.
        """
        start = 0
        for parameter in self.parameters:
            if parameter.name == name:
                return slice(start, start + parameter.value.size)
            start += parameter.value.size
        known = [parameter.name for parameter in self.parameters]
        raise ModelError(f"{self.name}: {unknown_name('parameter', name, known)}")
