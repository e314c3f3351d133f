"""A run ends at a singular configuration of its constraints, with time, state and their names."""

import pytest
from arms import error_controlled, fixed_step
from parallel_bars import bars, parallelogram
from problems import system_of

from drake_dae import DaePlant, simulate
from drake_dae.errors import SingularityError


@pytest.mark.parametrize("config", [error_controlled(1e-6), fixed_step(1e-3)])
@pytest.mark.parametrize("rate", [0.0, -1.0])
def test_a_parallelogram_ends_where_its_bars_lie_on_one_line(rate, config):
    """On a level line the gradient of the row that holds the coupler's height vanishes."""
    model, plant = bars(1, 9.81)
    context = plant.CreateDefaultContext()
    plant.set_state(context, parallelogram(model.links.plant, 0.0, rate))
    with pytest.raises(SingularityError, match="pin1") as refused:
        simulate(plant, context, 0.1, config)
    assert refused.value.time == 0.0
    (name,) = refused.value.constraints
    assert name.startswith("pin1")


def test_of_two_constraints_the_one_without_gradient_is_named():
    """The second one is z^2 = x^2, whose gradient vanishes where its lines cross."""
    system = system_of(
        6,
        f=lambda x: [x[3], x[4], x[5], 0, 0, 0],
        g=lambda x: [[0, 0], [0, 0], [0, 0], [1, 0], [0, -2 * x[1]], [0, 2 * x[2]]],
        k=lambda x: [x[0], x[2] ** 2 - x[1] ** 2],
        nominal_state=[0.0, -1.0, -1.0, 0.0, 1.0, 1.0],
        constraint_output_signals=("level", "cross"),
    )
    plant = DaePlant(system)
    context = plant.CreateDefaultContext()
    plant.set_state(context, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    with pytest.raises(SingularityError, match="cross") as refused:
        simulate(plant, context, 2.0, fixed_step(0.125))
    assert refused.value.constraints == ("cross",)
