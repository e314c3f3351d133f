"""Trial and accepted: what leaves its domain in a stage of a step that is then made shorter."""

import casadi as ca
import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from runs import some

from drake_dae import DaePlant, DaeSystem, simulate
from drake_dae.errors import NonFiniteError, SingularityError

ERROR_CONTROLLED = (
    "bogacki_shampine3",
    "implicit_euler",
    "radau1",
    "radau3",
    "runge_kutta3",
    "runge_kutta5",
    "velocity_implicit_euler",
)


def tank(f=lambda x: -500 * (ca.sqrt(x) - 0.1), start=1.0):
    """x' = f(x) + u; by default a tank that runs empty to 0.01 within some hundredths of a s."""
    return DaeSystem.from_functions(
        ["x"],
        f=lambda s: [f(s[0])],
        h=lambda s: [1],
        l=lambda s: [s[0]],
        nominal_state=[start],
        name="tank",
    )


def alone(block, control=0.0):
    """A block with a constant control, and the log of its state."""
    builder = DiagramBuilder()
    builder.AddSystem(block)
    source = builder.AddSystem(ConstantVectorSource([control]))
    builder.Connect(source.get_output_port(), block.GetInputPort("control"))
    logger = LogVectorOutput(block.GetOutputPort("state"), builder)
    return builder.Build(), logger


def by_drake(diagram, duration, config, context=None):
    context = diagram.CreateDefaultContext() if context is None else context
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(duration)
    return context


def by_us(diagram, duration, config, context=None):
    context = diagram.CreateDefaultContext() if context is None else context
    simulate(diagram, context, duration, config)
    return context


def scheme(name, accuracy=1e-6):
    return SimulatorConfig(integration_scheme=name, accuracy=accuracy, use_error_control=True)


def level(time):
    """s = sqrt(x) has 2 s s' = -500 (s - 0.1): 2 (1 - s) + 0.2 log(0.9 / (s - 0.1)) = 500 t."""
    low, high = 0.1, 1.0
    for _ in range(200):
        s = (low + high) / 2
        passed = 2 * (1 - s) + 0.2 * np.log(0.9 / (s - 0.1)) if s > 0.1 else np.inf
        low, high = (s, high) if passed > 500 * time else (low, s)
    return high**2


@pytest.mark.slow
@pytest.mark.parametrize("name", some(ERROR_CONTROLLED, of=3, first=1))
def test_a_trial_that_leaves_the_domain_makes_the_step_shorter(name):
    """The first step of 0.1 s tries x = -44, and the motion never does."""
    diagram, logger = alone(DaePlant(tank()))
    context = by_us(diagram, 0.02, scheme(name))
    log = logger.FindLog(context)
    assert log.data().min() >= 0.01 - 1e-5
    # The accuracy that was asked for is one for each step, and there are up to 1300.
    np.testing.assert_allclose(log.data()[0], [level(t) for t in log.sample_times()], atol=1e-3)


@pytest.mark.parametrize("name", ["bogacki_shampine3", "runge_kutta3"])
@pytest.mark.parametrize("run", [by_drake, by_us])
def test_a_fixed_step_that_fails_names_where_it_began(run, name):
    """No nan gets into the log, and the state is one that was reached."""
    diagram, logger = alone(DaePlant(tank()))
    config = SimulatorConfig(integration_scheme=name, max_step_size=0.05, use_error_control=False)
    reason = r"t = 0 s, .*\[1\.\].*t = 0\.05 s"
    context = diagram.CreateDefaultContext()
    with pytest.raises(NonFiniteError, match=reason) as caught:
        run(diagram, 1.0, config, context)
    assert (caught.value.time, *caught.value.state) == (0.0, 1.0)
    assert np.isfinite(logger.FindLog(context).data()).all()


def test_when_no_step_leads_on_the_state_is_the_last_one_reached():
    """x' = 1 - sqrt(-x) reaches x = 0 with speed 1, and no trial beyond it has a value."""
    diagram, _ = alone(DaePlant(tank(lambda x: 1 - ca.sqrt(-x), start=-0.5)))
    with pytest.raises(NonFiniteError, match="tank") as caught:
        by_drake(diagram, 10.0, scheme("runge_kutta3"))
    # From s = sqrt(-x): dt = 2 s ds / (1 - s) backwards, t = 2 (-s0 - log(1 - s0)), s0^2 = 1/2.
    root = np.sqrt(0.5)
    assert caught.value.time == pytest.approx(2 * (-root - np.log(1 - root)), abs=1e-3)
    assert -1e-3 < caught.value.state[0] <= 0.0


class Broken(LeafSystem):
    """A control that is nan from a time on."""

    def __init__(self, since):
        super().__init__()
        self.DeclareVectorOutputPort(
            "u", 1, lambda c, out: out.SetFromVector([np.nan if c.get_time() >= since else 0.0])
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "since"),
    [("runge_kutta3", 0.0), ("runge_kutta3", 0.3), ("runge_kutta5", 0.3), ("radau3", 0.3)],
)
def test_nan_from_a_block_of_someone_else_ends_the_run(name, since):
    """Where Drake's error control alone would make steps shorter for ever."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(tank(lambda x: -x)))
    source = builder.AddSystem(Broken(since))
    builder.Connect(source.get_output_port(), plant.get_input_port())
    logger = LogVectorOutput(plant.GetOutputPort("state"), builder)
    simulator = Simulator(builder.Build())
    ApplySimulatorConfig(scheme(name), simulator)
    with pytest.raises(NonFiniteError, match="u0") as caught:
        simulator.AdvanceTo(1.0)
    assert caught.value.time == pytest.approx(since, abs=1e-6)
    assert np.isfinite(logger.FindLog(simulator.get_context()).data()).all()


class Reading(LeafSystem):
    """Compares each entry of a plant's ports with those of its state, in each derivative."""

    def __init__(self, plant):
        super().__init__()
        self.plant, self.count, self.stale = plant, 0, 0
        self.DeclareVectorInputPort("x", 1)
        self.DeclareContinuousState(1)

    def DoCalcTimeDerivatives(self, context, derivatives):
        (x,) = self.get_input_port().Eval(context)
        self.count += 1
        self.stale += x != self.plant.state(self.own)[0]
        derivatives.get_mutable_vector().SetFromVector([0.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bogacki_shampine3", "runge_kutta3", "runge_kutta5"])
def test_after_a_rejected_step_no_port_shows_the_state_of_the_trial(name):
    """Drake's own DeclareStateOutputPort does, with two of its integrators.

    A tank that follows sin 50 t quickly: some per cent of the steps are rejected.
    """
    system = DaeSystem.from_functions(
        ["x", "s", "c"],
        f=lambda x: [-200 * (x[0] - x[1]), 50 * x[2], -50 * x[1]],
        h=lambda x: [1, 0, 0],
        l=lambda x: [x[0]],
        nominal_state=[0.0, 0.0, 1.0],
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(system))
    reading = builder.AddSystem(Reading(plant))
    source = builder.AddSystem(ConstantVectorSource([0.0]))
    builder.Connect(source.get_output_port(), plant.get_input_port())
    builder.Connect(plant.GetOutputPort("controlled_output"), reading.get_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    reading.own = plant.GetMyContextFromRoot(context)
    by_drake(diagram, 0.2, scheme(name, 1e-4), context)
    assert reading.count > 50
    assert reading.stale == 0


def test_nothing_is_a_trial_outside_of_a_simulation():
    """A context that was simulated: at its time, and before it, a failure raises."""
    plant = DaePlant(tank())
    diagram, _ = alone(plant)
    context = by_drake(diagram, 0.1, scheme("runge_kutta3"))
    own = plant.GetMyMutableContextFromRoot(context)
    for time in (0.1, 0.05):
        context.SetTime(time)
        plant.set_state(own, [-1.0])
        with pytest.raises(NonFiniteError, match="tank"):
            plant.EvalTimeDerivatives(own)
    fresh = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(fresh, [0.0])
    fresh.SetTime(7.0)
    plant.set_state(fresh, [-1.0])
    with pytest.raises(NonFiniteError, match="tank"):
        plant.EvalTimeDerivatives(fresh)


def test_an_overflow_is_not_called_singular():
    """det [[1 + x^2, x], [x, 1]] = 1 for all x, and at 1e40 cancels to 0."""
    system = DaeSystem.from_functions(
        ["x", "a", "b"],
        f=lambda s: [s[0], 0, 0],
        g=lambda s: [[0, 0], [1 + s[0] ** 2, s[0]], [s[0], 1]],
        h=lambda s: [1, 0, 0],
        k=lambda s: [s[1], s[2]],
        l=lambda s: [s[0]],
        m=lambda s: [[0, 0]],
        name="growth",
    )
    plant = DaePlant(system)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0])
    plant.set_state(context, [1e40, 0.0, 0.0])
    with pytest.raises(NonFiniteError, match=r"\bx\b") as caught:
        plant.EvalTimeDerivatives(context)
    assert not isinstance(caught.value, SingularityError)
