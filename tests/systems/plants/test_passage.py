"""Through singular configurations: along one branch, wherever steps end, or not at all."""

import numpy as np
import pytest
from arms import error_controlled, fixed_step
from numpy.testing import assert_allclose
from parallel_bars import bars, parallelogram, swung
from problems import system_of
from pydrake.systems.analysis import SimulatorConfig
from runs import some

from drake_dae import DaePlant, find_constraint_structure, simulate
from drake_dae.dae.structure.passage import Passage
from drake_dae.errors import SimulationError, SingularityError


def after(plant, state, duration, config):
    context = plant.CreateDefaultContext()
    plant.set_state(context, state)
    simulate(plant, context, duration, config)
    return plant.state(context)


CONFIGURATIONS = {
    "accuracy 1e-4": (error_controlled(1e-4), 1e-4),
    "accuracy 1e-6": (error_controlled(1e-6), 1e-6),
    "accuracy 1e-8": (error_controlled(1e-8), 1e-8),
    "accuracy 1e-10": (error_controlled(1e-10), 1e-9),
    "step 1e-2": (fixed_step(1e-2), 1e-9),
    "step 1e-3": (fixed_step(1e-3), 1e-8),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    some(
        [
            pytest.param(name, marks=pytest.mark.slow if "1e-3" in name else ())
            for name in CONFIGURATIONS
        ],
        of=3,
    ),
)
@pytest.mark.parametrize("tilt", [0.0, 0.7])
@pytest.mark.parametrize("windows", [1, 2])
def test_it_passes_at_any_accuracy_and_step(windows, tilt, name):
    """From above the line of pivots to below it; as a pendulum, to what the integrator allows.

    On a level line the gradient of a row vanishes, on a slope it depends on the other one. With two
    windows two gradients are lost at once.
    """
    config, tolerance = CONFIGURATIONS[name]
    model, plant = bars(windows, 9.81, tilt)
    for angle in (0.2, 0.237, 0.25):
        start = parallelogram(model.links.plant, angle, -1.0)
        angle, rate = swung(windows, 9.81, angle, -1.0, 0.35, tilt)
        assert angle < -0.3
        wanted = parallelogram(model.links.plant, angle, rate)
        assert_allclose(after(plant, start, 0.35, config), wanted, atol=10 * tolerance)


@pytest.mark.slow
def test_it_passes_in_short_steps():
    """Steps of 0.1 ms: a dozen of them within the window."""
    model, plant = bars(1, 9.81, 0.7)
    start = parallelogram(model.links.plant, 0.2, -1.0)
    wanted = parallelogram(model.links.plant, *swung(1, 9.81, 0.2, -1.0, 0.35, 0.7))
    assert_allclose(after(plant, start, 0.35, fixed_step(1e-4)), wanted, atol=1e-8)


@pytest.mark.parametrize("scheme", ["runge_kutta5", "runge_kutta3", "explicit_euler"])
@pytest.mark.parametrize("step", [0.05, 0.02, 0.01, 1e-3])
def test_it_passes_where_a_step_ends_right_there(step, scheme):
    """Without gravity the angle is that of a clock, and -0.2 rad are so many steps of 1 rad/s."""
    model, plant = bars(1, 0.0)
    config = SimulatorConfig(integration_scheme=scheme, max_step_size=step, use_error_control=False)
    found = after(plant, parallelogram(model.links.plant, -0.2, 1.0), 0.5, config)
    assert_allclose(found, parallelogram(model.links.plant, 0.3, 1.0), atol=1e-8)


@pytest.mark.parametrize(
    ("rates", "end"),
    [
        ((1.0, -1.0, 1.0), (1.0, -1.0, 1.0)),
        # The tip of bar 0 lies on the pivot of bar 1: the coupler turns with that bar.
        ((0.0, 1.0, 1.0), (0.0, 1.0, 1.0)),
    ],
)
@pytest.mark.parametrize("config", [fixed_step(1e-2), error_controlled(1e-6)])
def test_the_velocity_chooses_the_branch(rates, end, config):
    """From the flat configuration itself, one second on."""
    _, plant = bars(1, 0.0)
    found = after(plant, [0.0, 0.0, 0.0, *rates], 1.0, config)
    assert_allclose(found, [*end, *end], atol=1e-9)


@pytest.mark.parametrize(
    "rates",
    [
        pytest.param((0.0, 0.0, 0.0), id="at rest"),
        # J v = 0, but J' v is not: between the branches.
        pytest.param((1.0, 0.0, 2.0), id="between"),
    ],
)
def test_where_nothing_leads_through_it_says_so(rates):
    _, plant = bars(1, 9.81)
    context = plant.CreateDefaultContext()
    plant.set_state(context, [0.0, 0.0, 0.0, *rates])
    with pytest.raises((SingularityError, SimulationError), match="velocity"):
        simulate(plant, context, 0.1, fixed_step(1e-2))


@pytest.mark.parametrize("rate", [1.0, 0.1, 0.01])
def test_slow_crossings_pass_too(rate):
    """From the flat configuration at a speed that gravity changes at once."""
    model, plant = bars(1, 9.81)
    found = after(plant, parallelogram(model.links.plant, 0.0, rate), 0.1, error_controlled(1e-9))
    wanted = parallelogram(model.links.plant, *swung(1, 9.81, 0.0, rate, 0.1))
    assert_allclose(found, wanted, atol=1e-7)


def test_acceleration_and_forces_are_those_of_the_branch():
    """In the flat configuration: a'' of the pendulum, and forces with J^T lambda where it acts.

    Of the forces those have no bound that hold the coupler level; the port leaves them out, and
    tells nothing that is not finite.
    """
    model, plant = bars(1, 9.81, 0.7)
    context = plant.CreateDefaultContext()
    plant.set_state(context, parallelogram(model.links.plant, 0.0, 2.0))
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    wanted = -9.81 * 2.0 / (5 / 3) * np.cos(0.7)
    assert_allclose(rates[3:], [wanted, -wanted, wanted], atol=1e-12)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert np.all(np.isfinite(force))
    # Next to it, outside of the window, it is the same motion.
    plant.set_state(context, parallelogram(model.links.plant, 2e-3, 2.0))
    beside = plant.EvalTimeDerivatives(context).CopyToVector()
    wanted = -9.81 * 2.0 / (5 / 3) * np.cos(0.702)
    assert_allclose(beside[3:], [wanted, -wanted, wanted], atol=1e-8)


def test_a_state_at_a_singular_configuration_can_be_set():
    _, plant = bars(1, 0.0)
    context = plant.CreateDefaultContext()
    state = plant.set_consistent_state(context, [0.0, 0.0, 0.0, 1.0, -1.0, 1.0])
    assert_allclose(state, [0.0, 0.0, 0.0, 1.0, -1.0, 1.0], atol=1e-12)


@pytest.mark.slow
def test_a_cusp_is_no_passage():
    """y^2 = x^3: the point comes to the tip, and nowhere on, whatever the steps are."""
    system = system_of(
        4,
        f=lambda x: [x[2], x[3], -1, 0],
        g=lambda x: [[0], [0], [-3 * x[0] ** 2], [2 * x[1]]],
        k=lambda x: [x[1] ** 2 - x[0] ** 3],
        nominal_state=[1.0, 1.0, 0.0, 0.0],
    )
    structure = find_constraint_structure(system)
    passage = Passage(structure)
    assert passage.motion(np.zeros(4), np.zeros(0), np.zeros(0)) is None
    plant = DaePlant(system, structure=structure)
    for config in (*map(error_controlled, (1e-4, 1e-6)), *map(fixed_step, (1e-2, 1e-3))):
        context = plant.CreateDefaultContext()
        with pytest.raises(SimulationError):
            simulate(plant, context, 10.0, config)
        # When it gets there.
        assert context.get_time() == pytest.approx(2.2128, abs=0.02)


@pytest.mark.parametrize("miss", some([1e-2, 1e-3, 3e-4], of=3))
@pytest.mark.parametrize("accuracy", [1e-4, 1e-6, 1e-9])
def test_a_near_miss_is_no_passage(miss, accuracy):
    """On z^2 - x^2 = miss^2 a point that comes down on one side goes up again on the other one."""
    system = system_of(
        4,
        f=lambda x: [x[2], x[3], 0, 0],
        g=lambda x: [[0], [0], [-2 * x[0]], [2 * x[1]]],
        k=lambda x: [x[1] ** 2 - x[0] ** 2 - miss**2],
        nominal_state=[-1.0, 1.0, 1.0, -1.0],
    )
    plant = DaePlant(system)
    context = plant.CreateDefaultContext()
    plant.set_consistent_state(context, [-1.0, 1.0, 1.0, -1.0])
    simulate(plant, context, 2.0, error_controlled(accuracy))
    x, z, *_ = plant.state(context)
    assert x > 0.5
    assert z > 0.5


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
def test_units_do_not_matter(length):
    """A point where two lines cross, (z - x) (z + x) = 0, in any unit of length: straight on."""
    system = system_of(
        4,
        f=lambda x: [x[2], x[3], 0, 0],
        g=lambda x: [[0], [0], [-2 * x[0] / length**2], [2 * x[1] / length**2]],
        k=lambda x: [(x[1] ** 2 - x[0] ** 2) / length**2],
        nominal_state=np.array([-1.0, -1.0, 1.0, 1.0]) * length,
    )
    plant = DaePlant(system)
    for config in (fixed_step(0.125), fixed_step(0.1), error_controlled(1e-6)):
        found = after(plant, np.array([-1.0, -1.0, 1.0, 1.0]) * length, 2.0, config)
        assert_allclose(found, np.array([1.0, 1.0, 1.0, 1.0]) * length, rtol=1e-9)
