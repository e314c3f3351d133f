"""What a block computes, as traced functions: the seam between a Drake diagram and its compiler."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import casadi as ca
from pydrake.systems.framework import Context, EventStatus, State, System

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, SimulationError
from drake_dae.trace.functions import TracedFunction

TIME, STATE, HELD, PARAMETERS, NOISE = "$time", "$state", "$held", "$parameters", "$noise"
"""What a computation reads besides input ports: the time in s, the block's own continuous state,
all groups of its discrete state below each other, those of its numeric parameters, and new random
numbers of deviation 1."""

DERIVATIVE = "$derivative"
"""The time derivative of a block's continuous state, among its outputs; its next discrete state is
HELD there."""

MARGINS, GAPS, RATES = "$margins", "$gaps", "$rates"
"""What a guard computes; see `Guard`."""


@dataclass(frozen=True, eq=False)
class Computation:
    """Some columns that a block computes together.

    Attributes:
        function: A CasADi function of columns; its first results are `outputs`.
        sources: Where each argument comes from: TIME, STATE, HELD, PARAMETERS, NOISE, the name of
            an input port, or that of an output of another computation of the block.
        outputs: What the first results are: names of output ports, DERIVATIVE, HELD, or names that
            other computations of the block have among their sources. "" is of no interest.
        traced: The same function, whose last result is finite where its values are of use, and
            which can say why they are not; None if it has values wherever its arguments have.
        choice: (flag, one, other), three of the sources: only one has to be of use where the flag
            is above 1 / 2, else only the other. None where all have to.
    """

    function: ca.Function
    sources: tuple[str, ...]
    outputs: tuple[str, ...]
    traced: TracedFunction | None = None
    choice: tuple[str, str, str] | None = None

    @classmethod
    def of(
        cls, traced: TracedFunction, sources: tuple[str, ...], outputs: tuple[str, ...]
    ) -> "Computation":
        """What a traced function computes."""
        return cls(traced.function, sources, outputs, traced)


def zero(name: str) -> Computation:
    """A value of 0, shape (1,), for an input port without a wire."""
    return Computation(ca.Function("zero", [], [ca.SX.zeros(1)]), (), (name,))


@dataclass(frozen=True, eq=False)
class Update:
    """What a block does with its discrete state at t_k = offset + k period.

    Attributes:
        computation: It has HELD among its outputs.
        period, offset: In s.
        is_unrestricted: Whether it is an unrestricted update. Drake makes those of an instant
            first, and all at once; then the discrete ones, all at once.
    """

    computation: Computation
    period: float
    offset: float = 0.0
    is_unrestricted: bool = False


@dataclass(frozen=True, eq=False)
class Projection:
    """How a block's state is brought onto a manifold at the start of each step.

    Attributes:
        newton: (state, start, parameters, held) -> a Newton step in units of `scale`; gradients
            are those at the start.
        scale: The sizes of the states, shape (n,).
        project: (state, parameters, held) -> the state on the manifold, where Newton's steps do
            not reach it; raises InconsistentStateError.
    """

    newton: ca.Function
    scale: FloatArray
    project: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Guard:
    """When a block changes its states at a moment that a run has to find, and how.

    Attributes:
        computation: Its outputs are MARGINS, numbers of which each is positive until the block
            changes; GAPS, distances that must not fall through zero within a step either, also
            where they come out again, any number of them; and RATES, their derivatives.
        react: (context, state) -> the status: what Drake does then. It reads the block's context,
            and changes a state of the block, which is a copy of the context's. It keeps in the
            context what a record has of it.
        in_samples: Whether it is looked at when the block is updated, and only then, in place of
            that update.
    """

    computation: Computation
    react: Callable[[Context, State], EventStatus]
    in_samples: bool = False


@dataclass(frozen=True, eq=False)
class DrakeStepped:
    """What Drake steps in a block at t_k = k period, as its own contact, since it is not traced.

    The first entries of the block's HELD are the values of some output ports of that system, below
    each other. They change at t_k alone, as by an unrestricted update; its step depends on them, on
    what one of its input ports reads at t_k, and on t_k. Other entries have updates as usual.

    Attributes:
        system: What Drake steps: the block, or a diagram in it.
        period: In s.
        ports: The names of these output ports.
        into: The name of that input port.
        reads: What it reads: the name of an input port of the block, or of an output that one of
            its computations has.
        held: The context of the block -> HELD, shape (size,).
        put: (context of the system, HELD) -> None; puts in what it steps from.
        size: The number of entries of HELD.
    """

    system: System
    period: float
    ports: tuple[str, ...]
    into: str
    reads: str
    held: Callable[[Context], FloatArray]
    put: Callable[[Context, FloatArray], None]
    size: int


@dataclass(frozen=True, eq=False)
class Block:
    """What one system of a diagram computes.

    Attributes:
        system: The system.
        computations: All of its outputs that can be traced, and the derivative of its state.
        updates: Its updates of the discrete state.
        initial: What it holds when a run begins, where that is not a number; it has HELD among its
            outputs, and does not read it. None where it is a number.
        check_start: (state, parameters) -> None; raises where no run may start. For a block with
            state; None where any state will do.
        projection: How its state stays on a manifold, if it does.
        scale: The sizes of its continuous states, shape (n,); ones if None.
        unwired: Name of an input port -> what stands there without a wire and without a value.
        moving: The entries of its parameters that come through an input port "exogenous".
        guard: When and how it changes at moments that a run has to find; None if at none.
        stepped: What Drake steps in it; None if all of it is traced.
        draws: Whether its update takes new random numbers.
        model: What its first parameters are those of, such as a DaeSystem; None for nothing that
            another block has.
        under: For a controller: a computation of this block's sources that gives what the
            computation with DERIVATIVE of its plant gives, in fewer operations, where plant and
            law have the same model and numbers and nothing stands between; None if there is none.
        signals: Name of an argument -> names and units of its entries, for messages.
        ports: Name of an output port -> names and units of its entries, as far as they are known.
        failure: (time, arguments) -> why its update ends a run, where its values are not valid;
            None for what any function says.
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
    guard: Guard | None = None
    stepped: DrakeStepped | None = None
    draws: bool = False
    model: object = None
    under: Callable[[], Computation | None] | None = None
    signals: Mapping[str, Sequence[Signal]] = field(default_factory=dict)
    ports: Mapping[str, tuple[Signal, ...]] = field(default_factory=dict)
    failure: Callable[[float, Sequence[FloatArray]], SimulationError] | None = None


def not_traced(what: str) -> ModelError:
    """The error of a block of ours that Drake's Simulator alone runs.

    Args:
        what: What it is, in the user's words.
    """
    return ModelError(
        f"{what} cannot be traced: a rollout does not know it; run the loop by simulate"
    )


@runtime_checkable
class Traced(Protocol):
    """A LeafSystem that tells what it computes.

    Rules, which one suite holds every such block against:

    1. `traced()` returns the same `Block` at each call, without a context: all that differs from
       run to run is state, discrete state, numeric parameters and inputs.
    2. The value of each output port that a computation names is what the port shows in any
       context, by the time, states, parameters and inputs of that context.
    3. DERIVATIVE is what `CalcTimeDerivatives` gives, and is there if there is continuous state.
    4. Each HELD is what the event of that period does to the discrete state, and there is one for
       each periodic event that changes it.
    5. An output depends on an input port in the same instant exactly if its sources lead there:
       Drake's `HasDirectFeedthrough` says the same.
    6. An output that cannot be traced is left out; what nobody can trace raises a ModelError that
       says why, in one sentence.
    7. What changes its states at other moments than these has a guard, whose margins fall through
       zero at the moments that Drake's Simulator finds.
    """

    def traced(self) -> Block:
        """What the block computes."""
