"""The exceptions: each says what was wrong, which value, and what to do."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike


class DrakeDaeError(Exception):
    """Base of every exception that drake_dae raises on purpose."""


class ModelError(DrakeDaeError, ValueError):
    """A system, robot, surface or signal that is not well formed."""


class GainError(DrakeDaeError, ValueError):
    """Gains of a wrong shape, or whose error dynamics (30) are not Hurwitz."""


class ReferenceSignalError(DrakeDaeError, ValueError):
    """A reference that is too short, too rough, or lacks derivatives that the law needs."""


class ScenarioError(DrakeDaeError, ValueError):
    """A scenario that cannot be used; the message has a line "key: text" for each problem.

    Attributes:
        problems: The dotted key and the text of each; the key is "" where a problem has none.
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
        violation: What was found, as a `dae.structure.assumptions.Violation`; None where
            integrators were sought and none help.
    """

    def __init__(
        self,
        message: str,
        assumption: int,
        state: ArrayLike | None = None,
        violation: Any = None,
    ) -> None:
        super().__init__(message)
        self.assumption = assumption
        self.state = None if state is None else np.array(state, dtype=float)
        self.violation = violation


class InconsistentStateError(DrakeDaeError):
    """A state that is not on the manifold N* of (4), or not where it was asked to be.

    Attributes:
        residual: What is not zero: the constraint outputs and their derivatives, shape
            (sum r_i,), then the output errors if outputs were pinned; x' where no equilibrium is
            found; from `NormalForm.state` what is left in the coordinates, shape (n,).
    """

    def __init__(self, message: str, residual: ArrayLike) -> None:
        super().__init__(message)
        self.residual = np.array(residual, dtype=float)


class WiringError(DrakeDaeError, ValueError):
    """Blocks that must not be connected like this: an algebraic loop, or a loop that diverges."""


class MachineCodeError(DrakeDaeError):
    """Functions that cannot become machine code: no compiler, or no cache that can be trusted."""


class SimulationError(DrakeDaeError):
    """A run that cannot go on.

    Attributes:
        time: When it failed, in s.
        state: The state there, shape (n,).
    """

    def __init__(self, message: str, time: float, state: ArrayLike) -> None:
        super().__init__(message)
        self.time = time
        self.state = np.array(state, dtype=float)

    def retold(self, message: str, time: float, state: ArrayLike) -> "SimulationError":
        """The same error with another text, time and state."""
        return type(self)(message, time, state)


class SingularityError(SimulationError):
    """A(x) of Assumption (2) or B(x) of Assumption (5) lost its rank on the way."""


class PainleveError(SingularityError):
    """The Painleve paradox in a frictional contact: A(x) is not a P-matrix.

    Attributes:
        outcome: A `dae.system.contacts.PainleveOutcome`; None if it is not known.
    """

    def __init__(self, message: str, time: float, state: ArrayLike, outcome: Any = None) -> None:
        super().__init__(message, time, state)
        self.outcome = outcome

    def retold(self, message: str, time: float, state: ArrayLike) -> "PainleveError":
        return type(self)(message, time, state, self.outcome)


class NonFiniteError(SimulationError):
    """A derivative or an output that is NaN or infinite."""


class NonMinimumPhaseWarning(UserWarning):
    """A law for a system with unstable zero dynamics: outputs follow, but states run off."""


class AdviceWarning(UserWarning):
    """Gains that are advised outside of the range in which they are right."""


class NegligibleWarning(UserWarning):
    """What is larger than round-off counts as zero where relative degrees are decided."""


class MachineCodeWarning(UserWarning):
    """Functions that run interpreted where machine code was asked for, or would have paid."""


class GeometryWarning(UserWarning):
    """Geometry of a robot that is left out, since it cannot be read or drawn."""


class RobotFileWarning(UserWarning):
    """What of a robot's file the equations take otherwise than it is written."""


def describe_os_error(error: OSError) -> str:
    """What a message says of a file that could not be read or written."""
    return f"{error.filename or 'output'}: {error.strerror or error}"
