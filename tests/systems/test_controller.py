"""TrackingController as a Drake system."""

import re
import warnings

import numpy as np
import pytest
from arms import law

from drake_dae import DaeSystem, TrackingController, TrackingLaw, poles
from drake_dae.dae import gain_matrices
from drake_dae.errors import GainError, NonMinimumPhaseWarning, SingularityError


def controller(name="two_link"):
    system = TrackingController(law(name))
    return system, system.CreateDefaultContext()


def test_a_stretched_arm_is_named_singular():
    """Straight and horizontal onto the wall: no torque moves the tip along the normal."""
    system, context = controller()
    context.SetTime(1.5)
    system.GetInputPort("estimated_state").FixValue(context, [0.0, 0.0, 0.0, 0.0])
    system.GetInputPort("reference").FixValue(context, np.zeros(4))
    with pytest.raises(SingularityError, match=r"wall\.force") as info:
        system.GetOutputPort("control").Eval(context)
    assert info.value.time == 1.5


@pytest.mark.parametrize(("rate", "unstable"), [(0.7, True), (-0.7, False), (0.0, False)])
def test_a_non_minimum_phase_system_is_named_so(rate, unstable):
    """b' = rate b - a beside a' = u with output a: the zero dynamics have the pole `rate`."""
    system = DaeSystem.from_functions(
        ["a", "b"],
        f=lambda x: [0, rate * x[1] - x[0]],
        h=lambda x: [1, 0],
        l=lambda x: [x[0]],
        name="tank",
    )
    law = TrackingLaw(system, poles(-2.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        TrackingController(law)
    assert [w.category for w in caught] == [NonMinimumPhaseWarning] * unstable
    if unstable:
        assert re.search(r"^tank: .* 0\.7 1/s", str(caught[0].message))


def test_gains_change_in_a_context():
    """The control is then that of a law with these gains, and the context keeps its masses."""
    system, context = controller()
    system.set_parameter(context, "link1.mass", 3.0)
    system.set_gains(context, poles(-9.0))
    state, reference = [1.2, -1.6, 0.1, 0.0], np.array([0.3, 0.1, 0.0, 20.0])
    system.GetInputPort("estimated_state").FixValue(context, state)
    system.GetInputPort("reference").FixValue(context, reference)
    np.testing.assert_array_equal(
        system.GetOutputPort("control").Eval(context),
        law("two_link", poles(-9.0)).control(
            state, reference, parameters=system.parameters(context)
        ),
    )
    with pytest.raises(GainError, match="values"):
        system.set_gains(context, poles("fast"))


def test_gains_that_the_law_does_not_have_are_refused():
    """Errors that the law does not couple stay so: its function has no place for the gain."""
    system = DaeSystem.from_functions(
        4,
        f=lambda x: [x[2], x[3], 0, 0],
        h=lambda x: [[0, 0], [0, 0], [1, 0], [0, 1]],
        l=lambda x: [x[0], x[1]],
    )
    block = TrackingController(TrackingLaw(system, poles(-1.0)))
    coupled = gain_matrices([np.array([[2.0, 0.5], [0.0, 2.0]]), 3.0 * np.eye(2)])
    with pytest.raises(GainError, match="z1 to z0"):
        block.set_gains(block.CreateDefaultContext(), coupled)
