"""A run ends at a singular configuration of its constraints, with time, state and their names."""

import pytest
from arms import error_controlled, fixed_step
from parallel_bars import bars, parallelogram

from drake_dae import simulate
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
