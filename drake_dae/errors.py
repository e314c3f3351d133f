"""The exceptions: each says what was wrong, which value, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def _array(values: ArrayLike) -> Any:
    import numpy as np  # Only where there is an error: a command that lists files is quick.

    return np.array(values, dtype=float)


class DrakeDaeError(Exception):
    """Base of every exception that drake_dae raises on purpose; it survives `pickle`, with data."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.args), dict(vars(self))


def _restored(kind: type[DrakeDaeError], args: tuple[Any, ...]) -> DrakeDaeError:
    """An exception without a call of its constructor; `pickle` then adds its data."""
    return kind.__new__(kind, *args)


class ModelError(DrakeDaeError, ValueError):
    """A system, robot, surface, signal or argument that is not valid."""


class GainError(DrakeDaeError, ValueError):
    """Gains of a wrong shape, or whose error dynamics (30) are not Hurwitz."""


class ReferenceSignalError(DrakeDaeError, ValueError):
    """A reference that is too short, too rough, or lacks derivatives that the law needs."""


class ScenarioError(DrakeDaeError, ValueError):
    """An invalid scenario; the message has a line "key: text" for each problem.

    Attributes:
        problems: The dotted key and the text of each; the key is "" if a problem has none.
    """

    def __init__(self, *problems: tuple[str, str]) -> None:
        self.problems = tuple((key, " ".join(text.split())) for key, text in problems)
        super().__init__(
            "\n".join(f"{key}: {text}" if key else text for key, text in self.problems)
        )


class AssumptionError(DrakeDaeError):
    """An assumption of the theory that the system violates.

    Attributes:
        assumption: The number of the assumption in the paper, 1 to 5.
        state: A consistent state, shape (n,), where it fails, or None if it fails everywhere.
        violation: Details, as a `dae.structure.assumptions.Violation`; None if `dynamic_extension`
            found no integrators.
    """

    def __init__(
        self, message: str, assumption: int, state: ArrayLike | None = None, violation: Any = None
    ) -> None:
        super().__init__(message)
        self.assumption = assumption
        self.state = None if state is None else _array(state)
        self.violation = violation


class InconsistentStateError(DrakeDaeError):
    """A state that is not on the manifold N* of (4), or does not satisfy further conditions.

    Attributes:
        residual: The nonzero residual: the constraint outputs and their derivatives, shape (sum
            r_i,), then the output errors if outputs were prescribed; x' if no equilibrium was
            found; from `NormalForm.state` the error of the coordinates, shape (n,).
    """

    def __init__(self, message: str, residual: ArrayLike) -> None:
        super().__init__(message)
        self.residual = _array(residual)


class WiringError(DrakeDaeError, ValueError):
    """Blocks that cannot be connected in this way: an algebraic loop, or a loop that diverges."""


class MachineCodeError(DrakeDaeError):
    """Functions that cannot be compiled: no compiler, or no trusted cache."""


class SimulationError(DrakeDaeError):
    """A run that cannot continue.

    Attributes:
        time: When it failed, in s.
        state: The state there, shape (n,).
    """

    def __init__(self, message: str, time: float, state: ArrayLike) -> None:
        super().__init__(message)
        self.time = time
        self.state = _array(state)

    def retold(self, message: str, time: float, state: ArrayLike) -> SimulationError:
        """The same error, its other data kept, with another text, time and state."""
        error = type(self)(message, time, state)
        vars(error).update({**vars(self), **vars(error)})
        return error


class SingularityError(SimulationError):
    """A(x) of Assumption (2) or B(x) of Assumption (5) lost its rank during a run.

    Attributes:
        constraints: The names of the constraints whose gradients become dependent; empty if they
            are not the cause, or not known.
    """

    constraints: tuple[str, ...] = ()


class PainleveError(SingularityError):
    """The Painleve paradox in a frictional contact: A(x) is not a P-matrix."""


class NonFiniteError(SimulationError):
    """A derivative or an output that is NaN or infinite."""


class NonMinimumPhaseWarning(UserWarning):
    """A law for a system with unstable zero dynamics: outputs are tracked, but states diverge."""


class AdviceWarning(UserWarning):
    """Recommended gains outside of the range of validity of the recommendation."""


class MachineCodeWarning(UserWarning):
    """Functions run interpreted although machine code was requested, or would be faster."""


class GeometryWarning(UserWarning):
    """Geometry of a robot that is left out, since it cannot be read or drawn."""


class RobotFileWarning(UserWarning):
    """A part of a robot's file that the equations treat differently than written."""


def describe_os_error(error: OSError) -> str:
    """The text for a file that could not be read or written."""
    return f"{error.filename or 'output'}: {error.strerror or error}"
