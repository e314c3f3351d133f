"""Disturbances and friction that an observer finds, against closed forms and MultibodyPlant."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from arms import error_controlled, numbers, touching
from numpy.testing import assert_allclose
from problems import pushed_mass
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    MatrixGain,
    RandomSource,
)

from drake_dae import (
    ConstantReference,
    DaePlant,
    DaeSystem,
    ForceSensor,
    RobotModel,
    RobotPlant,
    Sampling,
    SinusoidReference,
    StateEstimator,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.dae import ConstraintStructure, with_disturbance
from drake_dae.dae.disturbance import orthogonal_part, shares
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems import Observing

T, RATE, MASS = 0.01, 8.0, 2.5
STEPS = error_controlled(1e-10)


def pushed(
    push: float, delay: float = 0.0, sampling: Sampling | None = None, seed: int = 0, **more
):
    """The body under its law with an observer, pushed from the start on."""
    system = pushed_mass(MASS, stiffness=3.0)
    law = TrackingLaw(system, poles(-5.0))
    loop = make_closed_loop(
        DaePlant(system),
        law,
        [ConstantReference(0.0)],
        LoopSettings(sampling=sampling or Sampling(T, delay), observer=Observing(RATE), **more),
    )
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_parameter(own, "disturbance", push)
    loop.set_seed(context, seed)
    simulate(loop.diagram, context, 3.0, STEPS)
    return loop.record(context)


def at_samples(record, name, period=T):
    """A signal just before each sample."""
    times = period * np.arange(round(record.time[-1] / period))
    places = np.searchsorted(record.time, times - 1e-9)
    return times, record[name][places]


@pytest.mark.parametrize("delay", [0.0, 0.7 * T])
def test_constant_push_is_found_at_the_rate(delay):
    """r = d (1 - e^(-k_o t)) of what the sample before has seen; the control acts between samples.

    The spring's force is a mean of two samples, off by T^2 of its second derivative.
    """
    record = pushed(4.0, delay)
    times, found = at_samples(record, "disturbance")
    seen = np.maximum(times - T, 0.0)
    assert_allclose(found[:, 0], 4.0 * -np.expm1(-RATE * seen), atol=2e-3)
    assert abs(found[-1, 0] - 4.0) < 1e-3


def test_saturated_drive_does_not_wind_the_estimate_up():
    """The push is more than the drive gives: its estimate stays right, as what acts is observed."""
    record = pushed(4.0, control_limits=[1.0])
    assert np.abs(record["excess"]).max() > 0.5
    assert_allclose(record["disturbance"][-1], 4.0, atol=0.02)


def test_noise_of_velocities_comes_through_as_the_filter_says():
    """White noise n makes (1 - a) / T sqrt(2 / (1 + a)) M n, a = e^(-k_o T): about k_o M n.

    4,000 samples, of which 1 / (k_o T) are correlated, tell it to some 5 per cent.
    """
    system, noise = pushed_mass(MASS, stiffness=3.0), 0.02
    observer = StateEstimator(TrackingLaw(system, poles(-5.0)), Observing(RATE), T)
    builder = DiagramBuilder()
    builder.AddSystem(observer)
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, T))
    spread = builder.AddSystem(MatrixGain(np.array([[0.0], [noise]])))
    builder.Connect(source.get_output_port(), spread.get_input_port())
    builder.Connect(spread.get_output_port(), observer.GetInputPort("measured_state"))
    for name, size in (("control", 1), ("measured_force", 0)):
        still = builder.AddSystem(ConstantVectorSource(np.zeros(size)))
        builder.Connect(still.get_output_port(), observer.GetInputPort(name))
    log = LogVectorOutput(observer.GetOutputPort("disturbance"), builder, T)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(4000 * T)
    found = log.FindLog(simulator.get_context()).data()[0, 100:]
    a = np.exp(-RATE * T)
    wanted = (1.0 - a) / T * np.sqrt(2.0 / (1.0 + a)) * MASS * noise
    assert np.std(found) == pytest.approx(wanted, rel=0.05)
    assert wanted == pytest.approx(RATE * MASS * noise, rel=0.05)


@cache
def frictional(friction: float, arm: str = "two_link") -> tuple[RobotModel, DaeSystem]:
    """An arm on its wall, and what its law takes it for: with friction to be found."""
    smooth = touching(arm)
    wall = replace(smooth.constraints[0], friction=friction, stiction_tolerance=1e-3)
    nominal = smooth.dae.nominal_state[: smooth.links.q.numel()]
    model = RobotModel(smooth.links, [wall], smooth.outputs, nominal)
    velocities = [signal.name for signal in model.links.velocity_signals]
    return model, with_disturbance(model.dae, velocities, ["wall.friction"])


@cache
def smooth_law() -> tuple[TrackingLaw, ConstraintStructure]:
    """The law without knowledge of friction, and the structure of its plant."""
    model, dae = frictional(0.0)
    law = TrackingLaw(dae, poles(-10.0), measured_force=True)
    return law, find_structure(model.dae)


def slide(wanted, duration, observing, friction=0.3, change=None):
    """The arm on a wall with friction, of which its law knows nothing; the plant is ideal."""
    model, _ = frictional(0.0)
    law, structure = smooth_law()
    plant = RobotPlant(model, structure=structure)
    sensor = ForceSensor(1, sample_period=1e-3)
    sampling = Sampling(1e-3)
    loop = make_closed_loop(
        plant, law, wanted, LoopSettings(sensor=sensor, sampling=sampling, observer=observing)
    )
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.3], [1.2, -1.6])
    plant.set_consistent_state(own, model.rest_state(q, [20.0]))
    for name, value in {"wall.friction": friction, **(change or {})}.items():
        plant.set_parameter(own, name, value)
    sensor.set_force(sensor.GetMyMutableContextFromRoot(context), [20.0])
    simulate(loop.diagram, context, duration, error_controlled(1e-6))
    return loop, loop.record(context)


SWAY = [SinusoidReference(0.3, 0.1, 2.0), SinusoidReference(20.0, 5.0, 3.0)]


@pytest.mark.slow
def test_friction_is_identified_while_it_slides():
    """To 1 per cent: where the motion turns, the smooth law and 1 ms are not the same."""
    _, record = slide(SWAY, 1.0, Observing(20.0, friction_rate=10.0))
    assert record["friction"][0] == 0.0
    assert_allclose(record["friction"][-1], 0.3, rtol=0.01)
    assert np.abs(record["disturbance"][-1]).max() < 0.05 * 0.3 * 20.0


def test_friction_stands_still_where_the_contact_is_taken_for_lost():
    _, record = slide(SWAY, 0.1, Observing(20.0, friction_rate=10.0, least_force=100.0))
    assert np.all(record["friction"] == 0.0)
    assert np.abs(record["disturbance"][-1]).max() > 0.5


def test_wanted_velocities_are_those_of_the_reference_on_the_constraints():
    """v of P v = r' + t r'', J v = 0, with P and J of the tool by MultibodyPlant; t = 20 ms."""
    _, dae = frictional(0.3)
    law = TrackingLaw(dae, poles(-4.0))
    observation = StateEstimator(law, Observing(5.0), T).observation
    state = law.structure.states[0]
    reference = np.array([0.3, 0.25, 0.1, 20.0])
    found = observation.wanted(state, reference, [0.02], dae.parameter_values)[0]
    n = numbers("two_link", *np.split(state, 2))
    rows = np.vstack([n.output_jacobian, n.constraint_jacobian])
    assert_allclose(found[:2], state[:2], rtol=1e-15)
    assert_allclose(rows @ found[2:], [0.252, 0.0], atol=1e-12)


def given(observer, state, reference):
    """A context of an observer that measures a state and 20 N, without a control."""
    context = observer.CreateDefaultContext()
    values = {"measured_state": state, "control": [0.0, 0.0], "measured_force": [20.0]}
    for name, value in {**values, "reference": reference}.items():
        observer.GetInputPort(name).FixValue(context, value)
    return context


@pytest.mark.parametrize("velocity", [0.25, -0.005])
def test_friction_is_cancelled_against_the_motion_that_is_wanted_when_the_control_acts(velocity):
    """At rest, where up is wanted in 20 ms: -mu lambda P^T, with P by MultibodyPlant; v_s = 1 mm/s.

    r' = -5 mm/s turns by then, with r'' = 1 m/s^2, to 15 mm/s, at which friction is nearly full.
    """
    _, dae = frictional(0.4)
    law = TrackingLaw(dae, poles(-4.0))
    observer = StateEstimator(law, Observing(5.0), T, control_delay=0.02)
    state = law.structure.states[0]
    state = np.array([*state[:2], 0.0, 0.0])
    context = given(observer, state, [0.3, velocity, 1.0, 20.0])
    n = numbers("two_link", *np.split(state, 2))
    told = observer.GetOutputPort("exogenous").Eval(context)
    names = [signal.name for signal in dae.exogenous.signals]
    assert names[0] == "wall.friction"
    assert told[0] == 0.4
    assert_allclose(told[1:], -0.4 * 20.0 * n.output_jacobian[0], rtol=1e-4)
    assert_allclose(observer.GetOutputPort("disturbance").Eval(context), 0.0)


def test_law_cancels_wanted_friction_whatever_velocity_it_has():
    """mu c(x) of the law's model and its other inputs are mu c(x_w) for each x.

    So noise of a velocity near 0, where friction is steep, makes no torque. With poles at -1e-6 the
    law feeds no velocity back; what is left grows with its square.
    """
    _, dae = frictional(0.4)
    law = TrackingLaw(dae, poles(-1e-6))
    observer = StateEstimator(law, Observing(5.0), T)
    reference, controls = np.array([0.3, 0.2, 0.0, 20.0]), []
    for speed in (-1e-3, 0.0, 1e-3):
        rest = law.structure.states[0][:2]
        n = numbers("two_link", rest, np.zeros(2))
        rows = np.vstack([n.output_jacobian, n.constraint_jacobian])
        state = np.concatenate([rest, np.linalg.solve(rows, [speed, 0.0])])
        context = given(observer, state, reference)
        told = observer.GetOutputPort("exogenous").Eval(context)
        values = dae.parameter_values
        values[dae.parameter_slice("wall.friction")] = told[0]
        values[dae.parameter_slice("disturbance")] = told[1:]
        controls.append(law.control(state, reference, parameters=values))
    assert_allclose(controls[0], controls[1], atol=1e-3)
    assert_allclose(controls[2], controls[1], atol=1e-3)


def evaluated(function, *arguments):
    """The value of an expression of numbers, shape (k,); functions and lists are passed on."""
    given = [
        each if callable(each) or isinstance(each, list) else ca.SX(ca.DM(each))
        for each in arguments
    ]
    return ca.evalf(function(*given)).full()[:, 0]


def metric_of(matrix):
    return lambda columns: ca.mtimes(ca.DM(matrix), columns)


def test_sharing_is_by_the_accelerations_that_forces_make():
    """By a square root of W: the least squares of d on the columns, of which two are one."""
    random = np.random.default_rng(0)
    root = random.standard_normal((4, 4))
    matrix, d = root.T @ root, random.standard_normal(4)
    metric, column = metric_of(matrix), random.standard_normal((4, 1))
    wanted = np.linalg.lstsq(root @ column, root @ d, rcond=None)[0]
    nothing, moves = [ca.SX(4, 4)], random.standard_normal((4, 1))
    assert_allclose(evaluated(shares, column, nothing, moves, metric, d), wanted, rtol=1e-10)
    other = random.standard_normal((4, 1))
    planes = np.hstack([column, other, 2.0 * column])
    left = evaluated(orthogonal_part, planes, metric, d)
    assert_allclose(planes.T @ matrix @ left, 0.0, atol=1e-10)
    assert_allclose(np.cross((d - left)[:3], column[:3, 0]) @ other[:3, 0], 0.0, atol=1e-8)
    assert_allclose(evaluated(orthogonal_part, 0.0 * planes, metric, d), d)
    assert_allclose(evaluated(shares, 0.0 * column, nothing, moves, metric, d), 0.0)


@pytest.mark.parametrize("count", [1, 2])
def test_what_pulls_across_the_sliding_is_no_friction(count):
    """Of a force in the plane of a contact, and of any other d, by the least squares of d on both.

    With one direction in the plane there is nothing across.
    """
    random = np.random.default_rng(1)
    root, jacobian = random.standard_normal((4, 4)), random.standard_normal((count, 4))
    metric, moves = metric_of(root.T @ root), random.standard_normal(4)
    slides = jacobian @ moves
    along = slides / np.linalg.norm(slides)
    friction = -7.0 * jacobian.T @ along
    columns = [friction]
    if count == 2:
        columns.append(jacobian.T @ [-along[1], along[0]])
    d = random.standard_normal(4)
    wanted = np.linalg.lstsq(root @ np.transpose(columns), root @ d, rcond=None)[0]
    for planes in (-40.0 * jacobian.T @ jacobian, jacobian.T, jacobian.T @ np.eye(count, 3)):
        given = friction[:, None], [ca.SX(ca.DM(planes))], moves[:, None], metric
        assert_allclose(evaluated(shares, *given, d), wanted[0], rtol=1e-8)
        assert_allclose(evaluated(shares, *given, 0.3 * friction), 0.3, rtol=1e-8)
        assert_allclose(evaluated(shares, *given, columns[-1]), 2.0 - count, atol=1e-8)


@pytest.mark.slow
def test_what_cannot_be_observed_is_refused():
    system = pushed_mass(MASS, stiffness=3.0)
    with pytest.raises(ModelError, match="'w'"):
        with_disturbance(system, ["w"])
    with pytest.raises(ModelError, match="disturbance"):
        with_disturbance(system, ["v"])
    model, dae = frictional(0.3)
    with pytest.raises(ModelError, match="disturbance"):
        StateEstimator(TrackingLaw(model.dae, poles(-4.0)), Observing(5.0), T)
    law = TrackingLaw(dae, poles(-4.0))
    with pytest.raises(ModelError, match="control_lag"):
        StateEstimator(law, Observing(5.0), T, 2.0)
    with pytest.raises(ModelError, match="control_delay"):
        StateEstimator(law, Observing(5.0), T, 0.5, -1.0)
    with pytest.raises(ModelError, match="rate"):
        Observing(-5.0)
    with pytest.raises(ModelError, match="force_rate"):
        Observing(5.0, force_rate=0.0)
    wanted, plant = [ConstantReference(0.3), ConstantReference(20.0)], RobotPlant(model)
    with pytest.raises(WiringError, match="observe"):
        make_closed_loop(plant, law, wanted, LoopSettings(observer=Observing(5.0)))
    with pytest.raises(WiringError, match=r"measured.force"):
        make_closed_loop(
            RobotPlant(model),
            law,
            wanted,
            LoopSettings(observer=Observing(5.0), sampling=Sampling(T)),
        )


def test_push_behind_a_spring_is_found_with_its_derivatives_and_cancelled():
    """M q'' = K (p - q) + d, J p'' = u - K (p - q): the law for q needs d, d' and d''.

    r = d (1 - e^(-k t) (1 + k t + (k t)^2 / 2)) of what the sample before has seen; the force of
    the spring is a mean of two samples. Without the observer it would be d 6 / (M 25) off.
    """
    x, none, stiffness, rotor = ca.SX.sym("x", 4), ca.SX(0, 1), 40.0, 0.5
    force = stiffness * (x[2] - x[0])
    system = DaeSystem(
        x,
        ca.vertcat(x[1], force, x[3], -force),
        ca.SX(4, 0),
        ca.vertcat(0, 0, 0, 1),
        none,
        x[0],
        ca.SX(1, 0),
        mass_matrix=ca.diag(ca.SX([1.0, MASS, 1.0, rotor])),
        state_signals=("q", "v", "p", "p'"),
    )
    law = TrackingLaw(with_disturbance(system, ["v"]), poles(-5.0))
    assert law.exogenous_degrees == (2,)
    loop = make_closed_loop(
        DaePlant(law.system),
        law,
        [ConstantReference(0.0)],
        LoopSettings(sampling=Sampling(T), observer=Observing(RATE)),
    )

    def pushed_for(duration):
        context = loop.diagram.CreateDefaultContext()
        own = loop.plant.GetMyMutableContextFromRoot(context)
        loop.plant.set_parameter(own, "disturbance", 4.0)
        simulate(loop.diagram, context, duration, STEPS)
        return context

    record = loop.record(pushed_for(6.0))
    times, found = at_samples(record, "disturbance")
    seen = RATE * np.maximum(times - T, 0.0)
    wanted = 4.0 * (1.0 - np.exp(-seen) * (1.0 + seen + seen**2 / 2.0))
    assert_allclose(found[:, 0], wanted, atol=4e-3)
    assert np.abs(record["tracking_error"]).max() > 5e-3
    assert abs(record["tracking_error"][-1, 0]) < 1e-6
    # d k (k t)^2 / 2 e^(-k t), and its derivative, are given as r' and r''.
    context, seen = pushed_for(0.2), RATE * 0.2
    port = loop.observer.GetOutputPort("exogenous")
    told = port.Eval(loop.observer.GetMyContextFromRoot(context))
    rates = [
        1.0 - np.exp(-seen) * (1.0 + seen + seen**2 / 2.0),
        RATE * np.exp(-seen) * seen**2 / 2.0,
    ]
    rates.append(RATE**2 * np.exp(-seen) * (seen - seen**2 / 2.0))
    assert_allclose(told, 4.0 * np.array(rates), rtol=1e-3)
