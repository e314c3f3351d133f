"""The computations of a block as traced functions: the interface between diagram and compiler."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import casadi as ca
from pydrake.systems.framework import Context, System

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

TIME, STATE, HELD, PARAMETERS, NOISE = "$time", "$state", "$held", "$parameters", "$noise"
"""The sources of a computation besides input ports: the time in s, the block's continuous state,
all groups of its discrete state stacked, all groups of its numeric parameters stacked, and new
random numbers of deviation 1."""

DERIVATIVE = "$derivative"
"""The time derivative of a block's continuous state, among the outputs of its computations; the
next discrete state is HELD there."""


@dataclass(frozen=True, eq=False)
class Computation:
    """A function that computes some values of a block.

    Attributes:
        function: A CasADi function of columns; its first results are `outputs`.
        sources: The source of each argument: TIME, STATE, HELD, PARAMETERS, NOISE, the name of an
            input port, or of an output of another computation of the block.
        outputs: The names of the first results: output ports, DERIVATIVE, HELD, or sources of other
            computations of the block. Results named "" are not used.
        traced: The same function, whose last result is finite if its values are valid, and which
            has the reason if they are not; None if valid arguments always give valid values.
    """

    function: ca.Function
    sources: tuple[str, ...]
    outputs: tuple[str, ...]
    traced: TracedFunction | None = None

    @classmethod
    def of(
        cls, traced: TracedFunction, sources: tuple[str, ...], outputs: tuple[str, ...]
    ) -> "Computation":
        """The computation by a traced function."""
        return cls(traced.function, sources, outputs, traced)


@dataclass(frozen=True, eq=False)
class Update:
    """The update of a block's discrete state at t_k = offset + k period.

    Attributes:
        computation: The computation, with HELD among its outputs.
        period, offset: Period and offset, in s.
        is_unrestricted: Whether it is an unrestricted update. At one instant Drake makes first all
            unrestricted updates together, then all discrete ones together.
    """

    computation: Computation
    period: float
    offset: float = 0.0
    is_unrestricted: bool = False


@dataclass(frozen=True, eq=False)
class Projection:
    """The projection of a block's state onto a manifold at the start of each step.

    Attributes:
        newton: (state, start, parameters) -> a Newton step in units of `scale`, with the
            gradients at the start.
        scale: The sizes of the states, shape (n,).
        project: (state, parameters) -> the state on the manifold, if Newton's steps do not
            converge; raises InconsistentStateError.
    """

    newton: ca.Function
    scale: FloatArray
    project: Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class DrakeStepped:
    """The part of a block that is not traced: Drake steps it at t_k = k period.

    The block's HELD are the values of some of its output ports, stacked. They change only at t_k,
    like by an unrestricted update; its step depends on them, on one of its input ports at t_k, and
    on t_k.

    Attributes:
        system: The system that Drake steps.
        period: The period, in s.
        ports: The names of these output ports.
        into: The name of that input port.
        held: The context of the block -> HELD, shape (size,).
        put: (context of the system, HELD) -> None; sets the state before a step.
        read: (context of the system, array) -> None; writes the values of these output ports,
            stacked, to the array.
        size: The number of entries of HELD.
    """

    system: System
    period: float
    ports: tuple[str, ...]
    into: str
    held: Callable[[Context], FloatArray]
    put: Callable[[Context, FloatArray], None]
    read: Callable[[Context, FloatArray], None]
    size: int


@dataclass(frozen=True, eq=False)
class Computations:
    """The computations of one system of a diagram.

    Attributes:
        system: The system.
        computations: All of its outputs that can be traced, and the derivative of its state.
        updates: The updates of its discrete state.
        initial: The computation of HELD at the start of a run if the default is not finite; it
            does not read HELD. None if the default is finite.
        check_start: (state, parameters) -> None; raises if no run may start there. None if any
            state is allowed, or without a state.
        projection: The projection of its state onto a manifold, if it has one.
        scale: The sizes of its continuous states, shape (n,); ones if None.
        unwired: Name of an input port -> its value if it has neither a wire nor a fixed value.
        moving: The indices of its parameters that come through an input port "exogenous".
        stepped: The part that Drake steps; None if all of it is traced.
        model: The owner of its first parameters, such as a DaeSystem; None if no other block shares
            it.
        under: For a controller: a computation of this block's sources with the same values as the
            computation of DERIVATIVE of its plant, in fewer operations, if plant and law have the
            same model and numbers and are wired directly; None if there is none.
        signals: Name of an argument -> names and units of its entries, for messages.
        ports: Name of an output port -> names and units of its entries, as far as they are known.
    """

    system: System
    computations: tuple[Computation, ...]
    updates: tuple[Update, ...] = ()
    initial: Computation | None = None
    check_start: Callable[[FloatArray, FloatArray], None] | None = None
    projection: Projection | None = None
    scale: FloatArray | None = None
    unwired: Mapping[str, Computation] = field(default_factory=dict)
    moving: tuple[int, ...] = ()
    stepped: DrakeStepped | None = None
    model: object = None
    under: Callable[[], Computation | None] | None = None
    signals: Mapping[str, Sequence[Signal]] = field(default_factory=dict)
    ports: Mapping[str, tuple[Signal, ...]] = field(default_factory=dict)


def not_traced(what: str) -> ModelError:
    """The error of a block that only Drake's Simulator can run.

    Args:
        what: The block, in the user's words.
    """
    return ModelError(
        f"{what} cannot be traced: a rollout does not know it; run the loop by simulate"
    )


@runtime_checkable
class Traced(Protocol):
    """A LeafSystem with traced computations.

    Rules, which one test suite checks for each such block:

    1. `traced()` returns the same `Computations` at each call, without a context: only state,
       discrete state, numeric parameters and inputs differ from run to run.
    2. The output of a computation that is named like an output port has the value of that port in
       any context, at the time, states, parameters and inputs of that context.
    3. DERIVATIVE is the result of `CalcTimeDerivatives`; it is an output if there is a continuous
       state.
    4. HELD of an update is the result of the periodic event of that period, and there is one update
       for each periodic event that changes the discrete state.
    5. An output depends on an input port in the same instant if and only if its sources lead there,
       in agreement with Drake's `HasDirectFeedthrough`.
    6. Outputs that cannot be traced are omitted; a block that cannot be traced at all raises a
       ModelError with the reason, in one sentence.
    """

    def traced(self) -> Computations:
        """The computations of the block."""
