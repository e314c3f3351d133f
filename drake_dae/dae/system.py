"""The system class of the paper: x' = f + g v + h u, 0 = k(x), z = l + m v.      (1)-(3)"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cached_property
from inspect import signature
from types import SimpleNamespace
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.signals import Parameter, Signal, is_symbol
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.smoothness import flaw


@dataclass(frozen=True, eq=False)
class DaeSystem:
    """A nonlinear differential-algebraic control system, equations (1)-(3):

        x' = f(x) + g(x) v + h(x) u,    0 = k(x),    z = l(x) + m(x) v.

    With a mass matrix E the first is E(x) x' = f + g v + h u, and what the paper calls f, g, h is
    E^-1 f, E^-1 g, E^-1 h (see `explicit`). Giving E, as a robot has it in M(q), costs far fewer
    operations than giving its inverse.

    The fields are CasADi SX expressions of `state` and of the symbols of `parameters`; numbers
    and NumPy arrays are taken as constants. The data checks itself when it is made.

    Attributes:
        state: The symbol x, shape (n, 1).
        f: Drift, shape (n, 1).
        g: How the constraint inputs v enter, shape (n, m).
        h: How the control inputs u enter, shape (n, p).
        k: Constraint outputs y, shape (m, 1); m = 0 is an ordinary control system.
        l: Controlled outputs at v = 0, shape (p, 1).
        m: How v enters the controlled outputs, shape (p, m).
        parameters: Named numbers that the expressions depend on.
        state_signals, constraint_input_signals, control_signals, constraint_output_signals,
            output_signals: Names and units of x, v, u, y and z; a plain name is a Signal without
            unit. Made up ("x0", "x1", ...) where not given.
        nominal_state: Where a search for consistent states starts, shape (n,); zero if not given.
        name: For messages.
        mass_matrix: E, shape (n, n), symmetric positive definite; the identity if None.
        motion: A function of x' and v that returns E x' - f - g v, shape (n, 1), and the
            derivatives of L_f^(r_i - 1) k_i along x', shape (m, 1), for when it takes fewer
            operations than the expressions above: for a robot it is inverse dynamics.

    Raises:
        ModelError: A shape that does not fit, a symbol that is neither state nor parameter, names
            or symbols that are not unique, a constant that is not finite, or a function that is not
            smooth in the state, such as fabs.
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
    name: str = "system"
    mass_matrix: ca.SX = None
    motion: Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ModelError(f"the name of a system must be text, got {self.name!r}")
        if not (is_symbol(self.state) and self.state.numel()):
            raise ModelError(
                f"{self.name}: 'state' must be a CasADi SX column of symbols, "
                f"for example casadi.SX.sym('x', 4); got {type(self.state).__name__}"
            )

        def put(key: str, value: object) -> None:
            object.__setattr__(self, key, value)

        put("state", ca.vec(self.state))
        put("parameters", tuple(self.parameters))
        n = self.state.numel()
        k = _expression("k", self.k, self.name)
        constraints = k.numel()
        controls = _expression("h", self.h, self.name).shape[1]
        shapes = {
            "f": (n, 1),
            "g": (n, constraints),
            "h": (n, controls),
            "k": (constraints, 1),
            "l": (controls, 1),
            "m": (controls, constraints),
            "mass_matrix": (n, n),
        }
        if self.mass_matrix is None:
            put("mass_matrix", ca.SX.eye(n))
        _unique([p.name for p in self.parameters], "parameter", self.name)
        known = ca.vertcat(self.state, self.parameter_symbol)
        if len(ca.symvar(known)) != known.numel():
            raise ModelError(f"{self.name}: a symbol stands twice among the states and parameters")
        for key, shape in shapes.items():
            value = _expression(key, getattr(self, key), self.name)
            if value.numel() == 0 and 0 in shape:
                value = ca.SX(*shape)
            if value.shape != shape and value.shape == shape[::-1] and 1 in shape:
                value = value.T
            if value.shape != shape:
                hint = (
                    " (as many controlled outputs as controls: the law (28) inverts B(x), "
                    "which is p x p)"
                    if key in "lm"
                    else ""
                )
                if value.numel() == 0 and constraints and key in "gm":
                    raise ModelError(
                        f"{self.name}: k is given, so g and m are needed; {key} is missing, with "
                        f"shape {shape}"
                    )
                raise ModelError(
                    f"{self.name}: {key} has shape {value.shape}, expected {shape} for "
                    f"n = {n} states, m = {constraints} constraints, p = {controls} controls{hint}"
                )
            unknown = [s.name() for s in ca.symvar(value) if not ca.depends_on(known, s)]
            if unknown:
                raise ModelError(
                    f"{self.name}: {key} depends on {', '.join(unknown)}, which is neither a "
                    "state nor a parameter; pass it in 'parameters' or put its number in"
                )
            put(key, ca.sparsify(value))  # Zeros of an array are structural, too.
        _check_operations(self, list(shapes))
        sizes = (
            ("state_signals", n, "x"),
            ("constraint_input_signals", constraints, "v"),
            ("constraint_output_signals", constraints, "y"),
            ("control_signals", controls, "u"),
            ("output_signals", controls, "z"),
        )
        for key, count, letter in sizes:
            made_up = [f"{letter}{i}" for i in range(count)]
            given = _signals(f"{self.name}: {key}", getattr(self, key) or made_up)
            if len(given) != count:
                raise ModelError(f"{self.name}: {key} has {len(given)} entries, expected {count}")
            _unique([s.name for s in given], key, self.name)
            put(key, given)
        nominal = np.zeros(n)
        if self.nominal_state is not None:
            nominal = numbers(f"{self.name}: nominal_state", self.nominal_state)
        if nominal.shape != (n,) or not np.all(np.isfinite(nominal)):
            raise ModelError(
                f"{self.name}: nominal_state must be finite with shape ({n},), "
                f"got {self.nominal_state!r}"
            )
        nominal.setflags(write=False)
        put("nominal_state", nominal)

    def __repr__(self) -> str:
        counts = (self.num_states, self.num_constraints, self.num_controls)
        return f"DaeSystem('{self.name}', n={counts[0]}, m={counts[1]}, p={counts[2]})"

    @classmethod
    def from_functions(
        cls,
        state: Sequence[Signal | str] | int,
        *,
        f: Callable[..., Any],
        h: Callable[..., Any],
        l: Callable[..., Any],  # noqa: E741
        g: Callable[..., Any] | None = None,
        k: Callable[..., Any] | None = None,
        m: Callable[..., Any] | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        **labels: Any,
    ) -> Self:
        """Builds a system from Python functions of the state.

        Each function is called once with a CasADi column x, and, if there are `parameters`, with
        a namespace p of their symbols: `f=lambda x, p: [x[1], -p.stiffness * x[0]]`. It returns
        an expression, or a list (of lists for a matrix, row by row). Functions of CasADi are meant,
        casadi.sin; numpy.sin works too, but CasADi warns of it, and math.sin does not.

        Args:
            state: Names (or Signals) of the states, or their number n.
            f, g, h, k, l, m: As in the class. Without constraints leave out g, k and m.
            parameters: Name -> default; a name must be a Python identifier.
            labels: The remaining fields of the class.

        Raises:
            ModelError: As the class, or a function that fails.
        """
        owner = labels.get("name", "system")
        own = {"state", "parameters", "state_signals", *"fghklm"}
        known = [item.name for item in fields(cls) if item.name not in own]
        for label in labels:
            if label not in known:
                near = get_close_matches(label, known, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                raise ModelError(f"{owner}: no field '{label}'; {hint}fields: {', '.join(known)}")
        bad = [name for name in parameters or {} if not name.isidentifier()]
        if bad:
            raise ModelError(
                f"parameter names must be Python identifiers, to be read as p.name: {bad}"
            )
        if isinstance(state, int):
            state = [f"x{i}" for i in range(state)]
        named = _signals(f"{owner}: the states", state)
        if not named:
            raise ModelError(f"{owner}: a system needs at least one state")
        x = ca.vertcat(ca.SX(0, 1), *[ca.SX.sym(s.name) for s in named])
        defined = tuple(
            Parameter(name, numbers(f"parameter '{name}'", value))
            for name, value in (parameters or {}).items()
        )
        arguments = [x]
        if defined:
            arguments.append(SimpleNamespace(**{p.name: p.symbol for p in defined}))

        def call(letter: str, function: Callable[..., Any] | None) -> ca.SX:
            if function is None:
                return ca.SX(0, 0)
            if not callable(function):
                raise ModelError(
                    f"{owner}: {letter} must be a function of the state, got "
                    f"{type(function).__name__}; `DaeSystem(...)` takes expressions"
                )
            try:
                value = function(*arguments)
            except Exception as error:
                raise ModelError(
                    f"{owner}: function {letter} failed on a CasADi column of {x.numel()} states: "
                    f"{_explained(error, function, arguments)}"
                ) from error
            if value is None:
                raise ModelError(f"{owner}: function {letter} returned nothing")
            return _expression(letter, value, owner)

        drift, control = call("f", f), call("h", h)
        if control.shape[0] == 1 and x.numel() != 1:
            control = control.T
        return cls(
            state=x,
            f=drift,
            g=call("g", g),
            h=control,
            k=call("k", k),
            l=call("l", l),
            m=call("m", m),
            parameters=defined,
            state_signals=named,
            **labels,
        )

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
            motion=None,
        )

    @property
    def num_states(self) -> int:
        """n."""
        return int(self.state.numel())

    @property
    def num_constraints(self) -> int:
        """m."""
        return int(self.k.numel())

    @property
    def num_controls(self) -> int:
        """p, which is also the number of controlled outputs."""
        return int(self.h.shape[1])

    @property
    def parameter_symbol(self) -> ca.SX:
        """All parameters below each other."""
        return ca.vertcat(ca.SX(0, 1), *[p.symbol for p in self.parameters])

    @property
    def parameter_values(self) -> FloatArray:
        """The defaults of all parameters, in the order of `parameter_symbol`."""
        return np.concatenate([np.zeros(0), *[p.value for p in self.parameters]])

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
        names = ", ".join(p.name for p in self.parameters) or "none"
        raise ModelError(f"{self.name} has no parameter '{name}'; it has {names}")


def check_is_system(value: Any, owner: str) -> None:
    """Refuses what is no DaeSystem.

    Raises:
        ModelError: With the attribute that was meant, if there is one.
    """
    if isinstance(value, DaeSystem):
        return
    meant = [name for name in ("dae", "system") if isinstance(getattr(value, name, 0), DaeSystem)]
    hint = f"; pass its .{meant[0]}" if meant else ""
    raise ModelError(f"{owner} needs a DaeSystem, got {type(value).__name__}{hint}")


def _signals(what: str, given: Any) -> tuple[Signal, ...]:
    """Signals, or names of signals without unit."""
    items = [given] if isinstance(given, str) or not isinstance(given, Sequence) else given
    bad = [item for item in items if not isinstance(item, (Signal, str))]
    if items is not given or bad:
        raise ModelError(f"{what} must be a list of names or Signals, got {(bad or items)[0]!r}")
    return tuple(Signal(item) if isinstance(item, str) else item for item in items)


def _explained(error: Exception, function: Callable[..., Any], arguments: Sequence[Any]) -> str:
    """What a function's own error means here."""
    text = str(error)
    try:
        signature(function).bind(*arguments)
    except TypeError:
        called = "the state x and the parameters p" if len(arguments) > 1 else "the state x alone"
        return f"{text}. It is called with {called}"
    except ValueError:
        pass  # Of built-in functions nothing is known.
    if "truth value" in text:
        return (
            "it asks whether a condition on the state is true, as in if, max or min. Conditions "
            "are not smooth, and the theory differentiates: write the side on which the state "
            "stays, or a smooth function"
        )
    if isinstance(error, AttributeError) and isinstance(error.obj, SimpleNamespace):
        return f"no parameter '{error.name}'; there are {', '.join(vars(error.obj))}"
    text = text.removeprefix("...").split(": ", 1)[-1] if text.startswith(".../casadi") else text
    if isinstance(error, NotImplementedError):
        text += ". Use CasADi's own functions (casadi.sin, casadi.vertcat) or plain operators"
    return text


def _expression(key: str, value: Any, owner: str) -> ca.SX:
    """An SX matrix from an SX, a number, an array, or a (nested) list of these."""
    if isinstance(value, ca.MX):
        raise ModelError(f"{owner}: {key} is a CasADi MX; use SX symbols and expressions")
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    try:
        if isinstance(value, (list, tuple)):
            rows = [ca.horzcat(*row) if isinstance(row, (list, tuple)) else row for row in value]
            value = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        result = ca.SX(np.asarray(value, dtype=float) if not isinstance(value, ca.SX) else value)
    except Exception as error:
        raise ModelError(
            f"{owner}: {key} must be a CasADi SX expression, an array, or a list of these (of "
            f"lists of one length for a matrix), got {type(value).__name__}"
        ) from error
    return result


def _check_operations(system: DaeSystem, keys: Sequence[str]) -> None:
    """Refuses what evaluates without complaint, but makes no sense in (1)-(3)."""
    expressions = [getattr(system, key) for key in keys]
    x, p = system.state, system.parameter_symbol
    if flaw(ca.veccat(*expressions), x, p, "the state") is None:
        return
    for key, expression in zip(keys, expressions, strict=True):
        for row, column in zip(*expression.sparsity().get_triplet(), strict=True):
            message = flaw(expression[row, column], x, p, "the state")
            if message:
                raise ModelError(
                    f"{system.name}: {key}, entry [{row}, {column}] of shape {expression.shape}, "
                    f"{message}"
                )


def _unique(names: Sequence[str], kind: str, owner: str) -> None:
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise ModelError(f"{owner}: {kind} names must be unique, twice: {', '.join(double)}")
