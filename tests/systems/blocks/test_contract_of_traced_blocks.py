"""The rules of `Traced`, on every block of ours: against Drake, in the same context."""

from dataclasses import replace

import casadi as ca
import numpy as np
import polishing
import pytest
from actuated import actuated
from alone import alone
from arms import arm, law
from problems import PROBLEMS
from pydrake.systems.analysis import Simulator
from runs import some

from drake_dae import (
    Approach,
    CompliantPlant,
    DaePlant,
    ExpressionReference,
    ForceSensor,
    Press,
    ReferenceGenerator,
    Release,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    StateEstimator,
    Task,
    TaskController,
    TrackingController,
    TrackingLaw,
    poles,
)
from drake_dae.blocks.computations import DERIVATIVE, HELD, Traced
from drake_dae.compiler.compile import compile_diagram
from drake_dae.compiler.wires import Wires
from drake_dae.dae import with_disturbance
from drake_dae.systems import CommandedReferences, Observing, PointMaterial
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.sampling import ControlHold, Sampling
from drake_dae.systems.sensing.encoders import Encoders, StateSensor


def measured_law(integral, gain=0.5):
    found = arm("two_link")
    gains = poles(-4.0)
    return TrackingLaw(
        found.model.dae,
        gains,
        structure=found.structure,
        measured_force=True,
        force_gain=gain,
        integral=integral,
    )


def references():
    height, force = SinusoidReference(0.3, 0.3, 1.5), SinusoidReference(20.0, 5.0, 2.0)
    return ReferenceGenerator([height, force], law("two_link").degrees)


def commanded():
    of = law("two_link")
    own, signals = references().references, of.system.output_signals
    return CommandedReferences(own, of.degrees, signals)


def references_with_parameters():
    def push(t, level, wave):
        return level + wave[0] * ca.sin(wave[1] * t)

    height = SinusoidReference(0.3, 0.3, 1.5)
    force = ExpressionReference(push, {"level": 20.0, "wave": [5.0, 2.0]})
    return ReferenceGenerator([height, force], law("two_link").degrees)


def robot(kind):
    found = arm("two_link") if kind is None else actuated("two_link", kind)
    return RobotPlant(found.model, structure=found.structure)


def found_friction(is_measured=True):
    """The law of the arm on a wall whose friction is found."""
    found = arm("two_link")
    smooth = found.model.constraints[0]
    wall = replace(smooth, friction=0.2, stiction_tolerance=0.1)
    model = RobotModel(found.model.links, [wall], found.model.outputs, [1.2, -1.6])
    names = [signal.name for signal in model.links.velocity_signals]
    dae = with_disturbance(model.dae, names, ["wall.friction"])
    return TrackingLaw(dae, poles(-4.0), measured_force=is_measured)


def observer(**more):
    """Of a contact that sticks, is lost, or neither."""
    rates = Observing(20.0, force_rate=30.0, **more)
    return StateEstimator(found_friction(), rates, 0.01, 0.5, 0.02)


def estimator(lag, law=None, **more):
    rates = Observing(10.0, force_rate=15.0, state_rate=30.0, **more)
    return StateEstimator(
        law or found_friction(), rates, 0.01, lag, 0.02, lag * 0.01, 1e-3, [1e-2, 0.0]
    )


def observer_behind_springs():
    system = actuated("two_link", "flexible").model.dae
    dae = with_disturbance(system, [signal.name for signal in system.state_signals[2:4]])
    return StateEstimator(TrackingLaw(dae, poles(-4.0)), Observing(20.0), 0.01)


BLOCKS = {
    "RobotPlant": lambda: robot(None),
    "RobotPlant with springs": lambda: robot("flexible"),
    "RobotPlant with motors": lambda: robot("motor"),
    "RobotPlant with hydraulic servos": lambda: robot("hydraulic"),
    "CompliantPlant": lambda: CompliantPlant(arm("two_link").model, PointMaterial(0.01)),
    "CompliantPlant that is continuous": lambda: CompliantPlant(
        arm("two_link").model, PointMaterial(0.0, dissipation=1.0)
    ),
    "CompliantPlant with springs": lambda: CompliantPlant(
        actuated("two_link", "flexible").model, PointMaterial(0.01, friction=0.3)
    ),
    "ReferenceGenerator": references,
    "CommandedReferences": commanded,
    "ReferenceGenerator with parameters": references_with_parameters,
    "TrackingController": lambda: TrackingController(law("two_link")),
    "TrackingController of a measured force": lambda: TrackingController(measured_law(())),
    "TrackingController with an integral": lambda: TrackingController(
        measured_law(("tool.z",)), integral_limits=0.3
    ),
    "TrackingController with the integral of a force": lambda: TrackingController(
        measured_law(("wall.force",), 0.0)
    ),
    "TrackingController with a sampled integral": lambda: TrackingController(
        measured_law(("tool.z", "wall.force"), 0.0), integral_limits=1.0, sample_period=0.01
    ),
    "ControlLimits": lambda: ControlLimits([0.5, 2.0]),
    "ForceSensor with a lag": lambda: ForceSensor(2, 0.01, bias=0.1),
    "ForceSensor with samples": lambda: ForceSensor(2, sample_period=0.01, bias=[0.1, 0.2]),
    "TaskController": lambda: TaskController(
        Task([Approach(), Press(20.0), Release()]), *polishing.laws(), sample_period=0.01
    ),
    "ControlHold": lambda: ControlHold(2, Sampling(0.01)),
    "ControlHold that acts late": lambda: ControlHold(2, Sampling(0.01, 0.02)),
    "ControlHold of one control": lambda: ControlHold(1, Sampling(0.01)),
    "StateEstimator of exact states": lambda: observer(least_force=1e-3),
    "StateEstimator of exact states of a contact that sticks": lambda: observer(
        least_speed=1e3, least_force=1e-3
    ),
    "StateEstimator of exact states of a contact that is lost": lambda: observer(least_force=1e3),
    "StateEstimator of exact states behind springs": observer_behind_springs,
    "StateEstimator": lambda: estimator(0.5, least_force=1e-3),
    "StateEstimator without a force sensor": lambda: estimator(0.5, law=found_friction(False)),
    "StateEstimator of a discrete plant": lambda: estimator(1.0, least_force=1e-3),
    "StateEstimator of a contact that sticks": lambda: estimator(
        0.5, least_speed=1e3, least_force=1e-3
    ),
    "StateSensor": lambda: StateSensor(5, 2, Encoders(resolution=[0.1, 0.0]), 0.01),
    "StateSensor with differences": lambda: StateSensor(
        4, 2, Encoders(resolution=1e-3, velocity_bandwidth=200.0, position_bias=0.1), 0.01
    ),
    "StateSensor with noise": lambda: StateSensor(
        4, 2, Encoders(position_noise=0.1, velocity_noise=0.2), 0.01
    ),
    "ForceSensor with all of it": lambda: ForceSensor(2, 0.02, 0.01, 0.3, [0.1, 0.2], 0.4),
    "ForceSensor that drifts": lambda: ForceSensor(2, 0.02, drift=[0.4, -0.3]),
}


def in_context(name):
    """A block alone, compiled, and a context in which it has values."""
    system = BLOCKS[name]()
    diagram, context = alone(system)
    own = system.GetMyMutableContextFromRoot(context)
    if isinstance(system, DaePlant):
        state = system.structure.states[1]
        system.set_consistent_state(own, state)
    elif isinstance(system, TrackingController):
        state = system.law.structure.states[1]
        system.GetInputPort("estimated_state").FixValue(own, state)
        if name.endswith("its references"):
            context = diagram.CreateDefaultContext()
            context.SetTime(0.4)
            own = system.GetMyMutableContextFromRoot(context)
            diagram.GetInputPort("in 0").FixValue(context, state)
        else:
            diagram.GetInputPort("in 0").FixValue(context, state)
    return system, diagram, context, compile_diagram(diagram, context=context)


@pytest.mark.parametrize("name", some(BLOCKS, of=3, first=1))
def test_outputs_derivatives_and_updates_are_those_of_the_block(name):
    """Rules 2 to 4, to 1e-12 of the largest value: other common subexpressions are removed."""
    system, diagram, context, compiled = in_context(name)
    given = context.get_time(), *compiled.start(context), compiled.values(context)

    def assert_same(found, wanted):
        scale = max(1.0, np.max(np.abs(wanted), initial=0.0))
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * scale)

    wanted = [diagram.GetOutputPort(output).Eval(context) for output in compiled.outputs]
    row, valid = compiled.row(*given)
    assert_same(row.full()[:, 0], np.concatenate(wanted))
    assert np.isfinite(float(valid))
    rate, valid = compiled.rate(*given)
    assert_same(rate.full()[:, 0], diagram.EvalTimeDerivatives(context).CopyToVector())
    assert np.isfinite(float(valid))
    for update in compiled.rates:
        held = compiled.start(context)[1]
        held[list(update.places)] = update.function(*given, [])[0].full()[:, 0]
        # The events of this instant, a multiple of the period.
        simulator = Simulator(diagram, context.Clone())
        simulator.Initialize()
        simulator.AdvancePendingEvents()
        own = system.GetMyContextFromRoot(simulator.get_context())
        groups = range(own.num_discrete_state_groups())
        assert_same(held, np.concatenate([own.get_discrete_state(i).value() for i in groups]))


@pytest.mark.parametrize("name", some(BLOCKS, of=3, first=2))
def test_a_block_reports_the_same_each_time_and_all_of_it(name):
    """Rules 1 and 6."""
    system = BLOCKS[name]()
    assert isinstance(system, Traced)
    one, other = system.traced(), system.traced()
    assert [c.sources for c in one.computations] == [c.sources for c in other.computations]
    told = {output for each in one.computations for output in each.outputs}
    context = system.CreateDefaultContext()
    ports = {system.get_output_port(i).get_name() for i in range(system.num_output_ports())}
    assert ports <= told
    assert (DERIVATIVE in told) == bool(context.num_continuous_states())
    updated = [HELD in update.computation.outputs for update in one.updates]
    assert all(updated)
    assert bool(updated) == bool(context.num_discrete_state_groups())


@pytest.mark.parametrize("name", some(BLOCKS, of=3))
def test_feedthrough_is_that_of_the_block(name):
    """Rule 5: so an algebraic loop is one for both."""
    system, diagram, _context, compiled = in_context(name)
    depends = np.zeros((compiled.row.numel_out(0), compiled.sizes["parameters"]), dtype=bool)
    depends[tuple(np.array(compiled.row.jac_sparsity(0, 3).get_triplet(), dtype=int))] = True
    columns = {port: part for _, port, part in compiled.fixed}
    wires = Wires.of(diagram)
    first = 0
    for output, signals in compiled.signals.items():
        rows = depends[first : first + len(signals)]
        first += len(signals)
        _, j = wires.outputs[output]
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i).get_name()
            part = columns.get(port, slice(0, 0))
            if rows[:, part].any():
                assert system.HasDirectFeedthrough(i, j), (output, port)


@pytest.mark.parametrize("name", sorted(PROBLEMS))
def test_any_plant_of_equations_is_traced(name):
    """To 1e-12 of the largest value, at a state on N*."""
    system = PROBLEMS[name]().system
    plant = DaePlant(system)
    diagram, context = alone(plant)
    plant.set_consistent_state(
        plant.GetMyMutableContextFromRoot(context), plant.structure.states[0]
    )
    compiled = compile_diagram(diagram, context=context)
    given = context.get_time(), *compiled.start(context), compiled.values(context)
    wanted = [diagram.GetOutputPort(output).Eval(context) for output in compiled.outputs]
    wanted += [diagram.EvalTimeDerivatives(context).CopyToVector()]
    found = [compiled.row(*given)[0].full()[:, 0], compiled.rate(*given)[0].full()[:, 0]]
    wanted_column = np.concatenate(wanted)
    scale = max(1.0, np.abs(wanted_column).max(initial=0.0))
    np.testing.assert_allclose(np.concatenate(found), wanted_column, rtol=0.0, atol=1e-12 * scale)
