"""The scenario's key in errors, and remedies for users of scenarios."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from drake_dae.dae.structure.assumptions import Violation, ViolationKind
from drake_dae.errors import AssumptionError, DrakeDaeError, ScenarioError

T = TypeVar("T")
S = TypeVar("S")


@contextmanager
def at(key: str) -> Iterator[None]:
    """Converts errors in the block to a ScenarioError with the key of the scenario."""
    try:
        yield
    except ScenarioError:
        raise  # It has a key already.
    except DrakeDaeError as error:
        raise ScenarioError((key, str(error))) from error


def each(key: str, items: Iterable[S], make: Callable[[S], T]) -> list[T]:
    """Applies a function to each item; errors get the key with the index of the item."""
    results = []
    for index, item in enumerate(items):
        with at(f"{key}.{index}"):
            results.append(make(item))
    return results


_REMEDIES = {
    ViolationKind.CONSTRAINT_DEGREE: (
        "Start elsewhere, by start.positions, or write the constraint so that its gradient does "
        "not vanish"
    ),
    ViolationKind.OUTPUT_DEGREE: "Choose another output, or start elsewhere, by start.positions",
    ViolationKind.EARLY_CONTROL: (
        "The constraint then binds the control instead of the state. Take that one out of "
        "robot.actuators, or add a stage under actuation"
    ),
    ViolationKind.REDUNDANT: (
        "The constraints are redundant at every state: the distribution of the forces among them "
        "is not determined. Take a redundant one out, or write compliances: {}, which has the "
        "forces shared by least squares"
    ),
    ViolationKind.NUMBERS: (
        "The structure must be the same for all parameter values of the robot. Give such a "
        "number another value where it is written, away from the one at which it changes, or "
        "give its range under bounds; or choose another output or constraint"
    ),
    ViolationKind.CONTROL_RANK: (
        "An output may repeat a constraint or another output; choose others. Or the robot is in "
        "a singular configuration, such as a stretched arm: give start.positions of another "
        "configuration"
    ),
}
"""The remedies for violations, where a scenario's differ from those in Python."""


def violated(error: AssumptionError) -> ScenarioError:
    """The exception to raise for a scenario whose robot violates an assumption of the theory."""
    key, text = "constraints" if error.assumption <= 3 else "outputs", str(error)
    if isinstance(error.violation, Violation):
        cause = error.violation.cause
        text = text.replace(cause.value, _REMEDIES.get(cause, cause.value))
    return ScenarioError((key, text))
