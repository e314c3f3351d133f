"""Drake's trajectories and systems as references."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import System
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import Reference


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
        system, size = self.system, DerivativeLayout(self.degrees).reference_size
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
            outputs = ", ".join(f"{port.get_name()} ({port.size()})" for port in ports) or "none"
            raise ReferenceSignalError(
                f"'{name}' must have one output port, of size {size}: each output with its "
                f"{', '.join(map(str, self.degrees))} derivatives, as r_1, r_1', ..., r_2, ...; it "
                f"has {outputs}"
            )

    @property
    def size(self) -> int:
        return len(self.degrees)

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        for row, (needed, available) in enumerate(zip(degrees, self.degrees, strict=True)):
            if needed > available:
                raise ReferenceSignalError(
                    f"the law needs {needed} derivatives of row {row}, its system gives {available}"
                )
        context, port = self.system.CreateDefaultContext(), self.system.get_output_port()
        table = DerivativeLayout(self.degrees)
        places = [
            first + k
            for first, degree in zip(table.lowest, degrees, strict=True)
            for k in range(degree + 1)
        ]

        def evaluate(time: float) -> FloatArray:
            context.SetTime(time)
            return np.asarray(port.Eval(context))[places]

        return evaluate
