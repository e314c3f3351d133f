"""References as a LeafSystem, and Drake's trajectories as references.                (28)"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, DependencyTicket, System
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.references import Reference, ReferenceRows, stack_references
from drake_dae.dae.references.pieces import MOST_IN_EXPRESSION
from drake_dae.dae.references.reference import with_degrees
from drake_dae.dae.system.layout import Layout
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.systems.blocks.along import signal_along
from drake_dae.systems.blocks.block import DifferentiableSystem
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import TIME, Block, Computation
from drake_dae.trace.functions import TracedFunction


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class TrajectoryReference(Reference):
    """A reference that is a Drake Trajectory, with the derivatives that it provides itself.

    Attributes:
        trajectory: Any column-valued Trajectory, shape (k, 1).

    Raises:
        ReferenceSignalError: The Trajectory is not a column; when `derivatives` is called, it has
            no derivatives, or is a PiecewisePolynomial of which a derivative below the highest one
            jumps at a break; or, during a run, the time is outside its range, which Drake would
            silently clip.
    """

    trajectory: Trajectory

    def __post_init__(self) -> None:
        if self.trajectory.cols() != 1:
            raise ReferenceSignalError(
                "a reference Trajectory must be a column, this one is "
                f"{self.trajectory.rows()} x {self.trajectory.cols()}"
            )

    @property
    def size(self) -> int:
        return int(self.trajectory.rows())

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        highest = max(degrees)
        path = self.trajectory
        if highest and not path.has_derivative():
            raise ReferenceSignalError(
                f"{type(path).__name__} has no derivatives, the law needs {highest}"
            )
        if isinstance(path, PiecewisePolynomial):
            self._check_breaks(path, degrees)
        first, last = path.start_time(), path.end_time()
        slack = 1e-9 * max(1.0, abs(last))

        def evaluate(time: float) -> FloatArray:
            if not first - slack <= time <= last + slack:
                raise ReferenceSignalError(
                    f"the reference Trajectory covers {first:g} to {last:g} s and was asked for "
                    f"t = {time:g} s; extend it over the whole simulation"
                )
            table = [path.value(time)] + [
                path.EvalDerivative(time, k) for k in range(1, highest + 1)
            ]
            return np.array(
                [table[k][i, 0] for i, degree in enumerate(degrees) for k in range(degree + 1)]
            )

        return evaluate

    @staticmethod
    def _check_breaks(path: PiecewisePolynomial, degrees: Sequence[int]) -> None:
        breaks = path.get_segment_times()[1:-1]
        for order in range(max(degrees)):
            derivative = path.derivative(order) if order else path
            for index, time in enumerate(breaks):
                left = derivative.getPolynomialMatrix(index)
                right = derivative.getPolynomialMatrix(index + 1)
                width = time - path.get_segment_times()[index]
                for i, degree in enumerate(degrees):
                    before, after = (
                        left[i, 0].EvaluateUnivariate(width),
                        right[i, 0].EvaluateUnivariate(0.0),
                    )
                    if order < degree and abs(before - after) > 1e-6 * (1.0 + abs(before)):
                        raise ReferenceSignalError(
                            f"derivative {order} of row {i} of the reference Trajectory jumps by "
                            f"{after - before:.3g} at t = {time:g} s, but the law needs a "
                            f"reference with {degree} derivatives; use a smoother trajectory"
                        )


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class SystemReference(Reference):
    """A reference that a Drake System computes from the time alone, with its derivatives.

    The system has one output port: r_1, r_1', ..., r_1^(nu_1), r_2, ..., output-major. A LeafSystem
    may compute any function; it must ensure that each value is the derivative of the one before it.

    Attributes:
        system: The system; it has no inputs and no state.
        degrees: The number of derivatives nu_1, ..., nu_k of each output.

    Raises:
        ReferenceSignalError: The system has inputs, a state or another output; or, when
            `derivatives` is called, too few derivatives.
    """

    system: System
    degrees: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "degrees", tuple(self.degrees))
        system, size = self.system, Layout(self.degrees).reference_size
        if not self.degrees or min(self.degrees) < 0:
            raise ReferenceSignalError(
                f"degrees must be one whole number from 0 for each output, got {self.degrees}"
            )
        name = system.get_name() or type(system).__name__
        context = system.CreateDefaultContext()
        if system.num_input_ports() or not context.is_stateless():
            raise ReferenceSignalError(
                f"'{name}' has inputs or a state, so that its output does not follow from the time "
                "alone. Wire it yourself: make a RobotPlant and a TrackingController(law), and "
                f"builder.Connect its output, of size {size}, to "
                'controller.GetInputPort("reference")'
            )
        ports = [system.get_output_port(index) for index in range(system.num_output_ports())]
        if [port.size() for port in ports] != [size]:
            found = ", ".join(f"{port.get_name()} ({port.size()})" for port in ports) or "none"
            raise ReferenceSignalError(
                f"'{name}' must have one output port, of size {size}: each output with its "
                f"{', '.join(map(str, self.degrees))} derivatives, as r_1, r_1', ..., r_2, ...; it "
                f"has {found}"
            )

    @property
    def size(self) -> int:
        return len(self.degrees)

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        for row, (needed, given) in enumerate(zip(degrees, self.degrees, strict=True)):
            if needed > given:
                raise ReferenceSignalError(
                    f"the law needs {needed} derivatives of row {row}, its system gives {given}"
                )
        context, port = self.system.CreateDefaultContext(), self.system.get_output_port()
        table = Layout(self.degrees)
        places = [
            first + k
            for first, degree in zip(table.lowest, degrees, strict=True)
            for k in range(degree + 1)
        ]

        def evaluate(time: float) -> FloatArray:
            context.SetTime(time)
            return np.asarray(port.Eval(context))[places]

        return evaluate


@checked(ReferenceSignalError)
class ReferenceGenerator(DifferentiableSystem):
    """References of all outputs, stacked, with their derivatives.

    Output port:
        reference: R(t) of (28): r_1, r_1', ..., r_1^(mu_1), r_2, ..., output-major, shape
            (sum (mu_i + 1),).

    Args:
        references: The references, in the order of the outputs; together they cover all of them.
        degrees: The degrees mu_1, ..., mu_p, `TrackingLaw.degrees`.

    Attributes:
        references, degrees: The arguments.
        function: R(t) as a function of the time in s, whose array the next call overwrites.

    The block converts to AutoDiffXd. If the time has derivatives, each reference needs one more.

    Raises:
        ReferenceSignalError: The references cover too few or too many outputs, or are not smooth
            enough.
        NonFiniteError: A reference is not finite on the way; the exception has the time.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, references: Sequence[Reference], degrees: Sequence[int]) -> None:
        super().__init__()
        self.set_name("reference")
        covered = sum(reference.size for reference in references)
        if covered != len(degrees):
            raise ReferenceSignalError(
                f"the references cover {covered} outputs, the law has {len(degrees)}"
            )
        self.references, self.degrees = tuple(references), tuple(degrees)
        self.function = stack_references(references, degrees)
        self.DeclareVectorOutputPort(
            "reference",
            sum(degree + 1 for degree in degrees),
            weakly(self._calc_reference),
            self._sources(),
        )

    def _sources(self) -> set[DependencyTicket]:
        """What R depends on."""
        return {self.time_ticket()}

    @property
    def further_signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output port beside `reference` -> names and units, for a record."""
        return {}

    @property
    def follows_time(self) -> bool:
        """Whether R follows from the time alone."""
        return not (self.num_input_ports() or self.num_continuous_states())

    def reference(self, time: float) -> FloatArray:
        """R(t) at a time in s, shape (sum (mu_i + 1),)."""
        return self.function(time).copy()

    def along(self, times: ArrayLike) -> FloatArray:
        """R(t) at many times in s, one row for each; nan for times without a value."""
        moments = vector("times", times, None, ReferenceSignalError)
        return signal_along(self.function, self.get_output_port().size(), moments)

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.function(context.get_time()))

    def traced(self) -> Block:
        time = ca.SX.sym("t")
        rows = traced_references(self.references, self.degrees, time)
        function = TracedFunction("reference", {"time": time}, {"R": rows})
        return Block(self, (Computation.of(function, (TIME,), ("reference",)),))

    def _formulas(self) -> dict[str, Formula]:
        return {"reference": _ReferenceFormula(self.references, self.degrees)}


def traced_references(
    references: Sequence[Reference], degrees: Sequence[int], time: ca.SX
) -> ca.SX:
    """R(t) of references at a symbolic time, shape (sum (mu_i + 1), 1).

    Raises:
        ModelError: One is no expression of time.
    """
    rows = [ca.SX(0, 1)]
    for reference, own in with_degrees(references, degrees):
        row = reference.expression(own, time)
        if row is None:
            whole = reference.reference if isinstance(reference, ReferenceRows) else reference
            raise ModelError(
                f"a {type(whole).__name__} is no expression of time, or one of more than "
                f"{MOST_IN_EXPRESSION} polynomials, and a rollout needs one: take an "
                "ExpressionReference, PointToPointReference or SinusoidReference, fewer "
                "polynomials (by a larger tolerance, corner or smoothing), or run the loop by "
                "simulate"
            )
        rows.append(row)
    return ca.vertcat(*rows)


class _ReferenceFormula:
    """R(t); its derivative by the time needs one more derivative of each reference."""

    sources = ("time",)

    def __init__(self, references: Sequence[Reference], degrees: Sequence[int]) -> None:
        self._evaluate = stack_references(references, degrees)
        self._references, self._degrees = references, degrees

    def value(self, time: float, *arguments: FloatArray) -> FloatArray:
        return self._evaluate(time).copy()

    @cached_property
    def _higher(self) -> Callable[[float], FloatArray]:
        return stack_references(self._references, [degree + 1 for degree in self._degrees])

    def slope(self, moving: tuple[int, ...], time: float, *arguments: FloatArray) -> FloatArray:
        higher = Layout(tuple(degree + 1 for degree in self._degrees))
        return np.delete(self._higher(time), higher.lowest)[:, None]
