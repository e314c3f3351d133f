"""Exceptions as values: they pass between processes with their data."""

import inspect
import pickle

import numpy as np
import pytest
from problems import redundant

from drake_dae import errors, find_structure

STATE = np.array([0.1, -2.0])

MADE = {
    "ScenarioError": lambda kind: kind(("plant.friction", "must be positive"), ("", "no robot")),
    "AssumptionError": lambda kind: kind("A is singular", 2, STATE, violation=("wall", 3)),
    "InconsistentStateError": lambda kind: kind("not on N*", STATE),
}
"""Exceptions whose constructors take more than a text; others are made in `made`."""

KINDS = [
    kind
    for kind in vars(errors).values()
    if inspect.isclass(kind) and issubclass(kind, (errors.DrakeDaeError, Warning))
]


def made(kind):
    if kind.__name__ in MADE:
        return MADE[kind.__name__](kind)
    if issubclass(kind, errors.SimulationError):
        return kind("the state is not finite", 0.25, STATE)
    return kind("a text with 'quotes'")


@pytest.mark.parametrize("kind", KINDS)
def test_an_exception_survives_pickle_with_its_data(kind):
    error = made(kind)
    error.add_note("noted")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (str(again), repr(again)) == (str(error), repr(error))
    assert vars(again).keys() == vars(error).keys()
    for name, value in vars(error).items():
        assert np.array_equal(getattr(again, name), value), name


def test_a_violated_assumption_survives_with_its_values():
    with pytest.raises(errors.AssumptionError) as caught:
        find_structure(redundant(lambda x: [x[0], 2 * x[0]]))
    again = pickle.loads(pickle.dumps(caught.value)).violation
    assert str(again) == str(caught.value.violation)
    assert again.combinations[0].name == caught.value.violation.combinations[0].name
