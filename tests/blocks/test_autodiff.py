"""Conversion to AutoDiffXd: gradients by finite differences and by hand, and Drake's own tools."""

import casadi as ca
import numpy as np
import pytest
from actuated import actuated, slope, states
from arms import arm, consistent_states, law
from problems import PROBLEMS, hanging_pendulum
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import InputPortSelection, OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation, Linearize
from pydrake.trajectories import PiecewisePolynomial
from runs import some

import drake_dae as dd
from drake_dae import poles
from drake_dae.errors import ModelError, NonFiniteError
from drake_dae.systems import TrajectoryReference

GRADIENT = 3e-9
"""Of finite differences, relative to the largest entry: sixth order at steps of 1e-3, where the
round-off is 1e-16 / 1e-3 of values up to some 1e3 times as large as their derivatives."""


def plant_of(name):
    """A plant with a state on N* and a control: a problem, or an arm with a kind of actuation."""
    random = np.random.default_rng(1)
    if name in PROBLEMS:
        problem = PROBLEMS[name]()
        plant, state = dd.DaePlant(problem.system), problem.consistent(random)
    elif " " in name:
        robot, kind = name.split(maxsplit=1)
        found = actuated(robot, kind)
        plant = dd.RobotPlant(found.model, structure=found.structure)
        state = states(robot, kind, 1)[0]
    else:
        plant = dd.RobotPlant(arm(name).model, structure=arm(name).structure)
        state = consistent_states(name, 1)[0]
    return plant, state, random.standard_normal(plant.dae.num_controls)


PLANTS = [*PROBLEMS, "two_link", "seven_joint", "two_link flexible motor", "two_link hydraulic"]


def all_parameters(system):
    context = system.CreateDefaultContext()
    if not context.num_numeric_parameter_groups():
        return np.zeros(0)
    return context.get_numeric_parameter(0).CopyToVector()


def evaluate(system, inputs, state, parameters, numbers):
    """Rate and all outputs of a system of either scalar type, below each other."""
    context = system.CreateDefaultContext()
    for name, value in inputs.items():
        if value.size:
            system.GetInputPort(name).FixValue(context, value)
    if state.size:
        context.SetContinuousState(state)
    if parameters.size:
        context.get_mutable_numeric_parameter(0).SetFromVector(parameters)
    parts = [system.EvalTimeDerivatives(context).CopyToVector()] if state.size else []
    parts += [
        system.get_output_port(i).Eval(context)
        for i in range(system.num_output_ports())
        if system.get_output_port(i).size()
    ]
    return np.concatenate([numbers(part).reshape(-1) for part in parts])


def check_gradient(system, inputs, state=()):
    """Value and derivatives along three random directions in all arguments at once."""
    random = np.random.default_rng(2)
    names = list(inputs)
    parameters = all_parameters(system)
    parts = [*map(np.asarray, inputs.values()), np.asarray(state), parameters]
    point = np.concatenate(parts).astype(float)
    ends = np.cumsum([part.size for part in parts])[:-1]
    # Parameters may be small, like an inertia: they move in proportion.
    scale = np.concatenate([*(np.ones(part.size) for part in parts[:-1]), np.abs(parts[-1])])
    directions = scale[:, None] * random.standard_normal((point.size, 3))

    def value(at, target=system, numbers=np.asarray):
        *given, x, p = np.split(at, ends)
        return evaluate(target, dict(zip(names, given, strict=True)), x, p, numbers)

    converted = system.ToAutoDiffXd()
    moving = InitializeAutoDiff(point, directions).reshape(-1)
    np.testing.assert_array_equal(value(moving, converted, ExtractValue), value(point))
    found = ExtractGradient(value(moving, converted, lambda part: part))
    # Along a direction as a function of one number: parameters are large or small.
    expected = np.array(
        [
            slope(lambda s, d=d: value(point + s * d), np.zeros(1), np.ones(1), 1e-3)
            for d in directions.T
        ]
    ).T
    for row, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(row, wanted, rtol=0, atol=GRADIENT * (1 + np.abs(wanted).max()))


@pytest.mark.slow
@pytest.mark.parametrize("name", some(PLANTS, of=3, first=1))
def test_plants(name):
    plant, state, control = plant_of(name)
    check_gradient(plant, {"control": control}, state)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_dae.errors.NonMinimumPhaseWarning")
@pytest.mark.parametrize("name", some(PLANTS, of=3))
def test_controllers(name):
    plant, state, _ = plant_of(name)
    system = dd.TrackingController(dd.TrackingLaw(plant.dae, poles(-3.0)))
    reference = np.random.default_rng(3).standard_normal(len(system.law.reference_signals))
    inputs = {"estimated_state": state, "reference": reference}
    check_gradient(system, inputs)


@pytest.mark.parametrize(
    "make",
    [
        lambda: plant_of("two_link hydraulic")[0],
        lambda: plant_of("pendulum_tension")[0],
        lambda: dd.TrackingController(law("seven_joint")),
        lambda: dd.ReferenceGenerator([dd.ConstantReference([1.0, 2.0])], [2, 0]),
        lambda: dd.ForceSensor(1, time_constant=0.1, noise_deviation=1.0),
    ],
)
def test_ports_parameters_and_feedthrough_are_kept(make):
    system = make()
    converted = system.ToAutoDiffXd()
    assert converted.get_name() == system.get_name()
    assert converted.num_input_ports() == system.num_input_ports()
    assert converted.num_output_ports() == system.num_output_ports()
    for i in range(system.num_output_ports()):
        own, other = system.get_output_port(i), converted.get_output_port(i)
        assert (own.get_name(), own.size()) == (other.get_name(), other.size())
        for j in range(system.num_input_ports()):
            assert system.HasDirectFeedthrough(j, i) == converted.HasDirectFeedthrough(j, i)
    for j in range(system.num_input_ports()):
        own, other = system.get_input_port(j), converted.get_input_port(j)
        assert (own.get_name(), own.size()) == (other.get_name(), other.size())
    context = converted.CreateDefaultContext()
    context.SetTimeStateAndParametersFrom(system.CreateDefaultContext())
    assert isinstance(context.get_time(), AutoDiffXd)


def test_references_move_with_the_time():
    """dR/dt is the table of the next higher derivatives: of t^4, 24 t follows 12 t^2."""
    t = 0.7
    line = PiecewisePolynomial.LagrangeInterpolatingPolynomial(
        np.linspace(0, 1, 5), (np.linspace(0, 1, 5) ** 4)[None]
    )
    quartic = TrajectoryReference(line)
    generator = dd.ReferenceGenerator([quartic, dd.SinusoidReference(0.0, 1.0, 2.0)], [2, 1])
    converted = generator.ToAutoDiffXd()
    context = converted.CreateDefaultContext()
    context.SetTime(AutoDiffXd(t, [3.0]))
    port = converted.GetOutputPort("reference").Eval(context)
    s, c = np.sin(2 * t), np.cos(2 * t)
    # The trajectory's coefficients are solved for, with some digits lost.
    np.testing.assert_allclose(
        ExtractValue(port)[:, 0], [t**4, 4 * t**3, 12 * t**2, s, 2 * c], rtol=1e-11
    )
    np.testing.assert_allclose(
        ExtractGradient(port)[:, 0],
        3.0 * np.array([4 * t**3, 12 * t**2, 24 * t, 2 * c, -4 * s]),
        rtol=1e-11,
    )


def assert_poles(loop, context, poles, zeros, tolerance):
    """The eigenvalues of a loop at rest are given poles and a number of zeros.

    They are compared as coefficients of the characteristic polynomial, each relative to the one
    that poles of the same size but one sign have: a multiple eigenvalue is not well determined.
    """
    none = (InputPortSelection.kNoInput, OutputPortSelection.kNoOutput)
    matrix = Linearize(loop.diagram, context, *none).A()  # Refuses what is no equilibrium.
    found, wanted = np.poly(matrix), np.poly([*poles, *np.zeros(zeros)])
    size = np.poly(-np.abs(poles))
    size = np.append(size, np.full(zeros, size[-1]))
    np.testing.assert_array_less(np.abs(found - wanted) / size, tolerance)


def resting_loop(model, structure, gains):
    """A loop at rest at its reference, pressing with 20 N, and its context."""
    plant = dd.RobotPlant(model, structure=structure)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(model.dae.num_controls))
    q = model.configuration(None, model.dae.nominal_state[: model.links.q.numel()])
    plant.set_state(context, model.rest_state(q, [20.0]))
    outputs = plant.GetOutputPort("controlled_output").Eval(context)
    loop = dd.make_closed_loop(
        plant,
        dd.TrackingLaw(model.dae, gains, structure=structure),
        [dd.ConstantReference(outputs[:-1]), dd.ConstantReference(20.0)],
    )
    whole = loop.diagram.CreateDefaultContext()
    plant.set_state(plant.GetMyMutableContextFromRoot(whole), plant.state(context))
    return loop, whole


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("seven_joint", None), ("two_link", "flexible motor")])
def test_closed_loops_have_the_assigned_poles(name, kind):
    """mu_i poles for each output, and sum r_i zeros: k^(r) = 0 lets a drift off N* stay."""
    found = actuated(name, kind) if kind else arm(name)
    model, structure = found.model, found.structure
    degrees = structure.output_degrees
    assigned = {
        signal.name: [-2.0 - 0.3 * i - j for j in range(degree)]
        for i, (signal, degree) in enumerate(zip(model.dae.output_signals, degrees, strict=True))
        if degree
    }
    loop, context = resting_loop(model, structure, poles(assigned))
    # Round-off of A, whose largest entries belong to stiff joints and small inductances.
    assert_poles(loop, context, np.concatenate([*assigned.values()]), 2, 2e-9)


def test_a_function_without_derivative_is_named():
    """x' = sqrt(x) + u is 0 at x = 0, where its derivative is infinite."""
    system = dd.DaeSystem.from_functions(
        1, f=lambda x: ca.sqrt(x), h=lambda x: 1, l=lambda x: x, nominal_state=[1.0], name="root"
    )
    plant = dd.DaePlant(system)
    context = plant.CreateDefaultContext()
    context.SetContinuousState([0.0])
    plant.GetInputPort("control").FixValue(context, [0.0])
    assert plant.EvalTimeDerivatives(context).CopyToVector() == [0.0]
    with pytest.raises(NonFiniteError, match="root"):
        FirstOrderTaylorApproximation(plant, context)


def test_what_does_not_convert_says_why():
    class Watched(dd.DaePlant):
        def __init__(self, system):
            super().__init__(system)
            self.DeclareVectorOutputPort("energy", 1, lambda context, output: None)

    with pytest.raises(ModelError, match="'energy'"):
        Watched(hanging_pendulum()).ToAutoDiffXd()
