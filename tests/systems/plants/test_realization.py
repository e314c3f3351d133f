"""The state realization (26) against DaePlant, hand calculation, and its own ports."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from actuated import actuated
from arms import arm, consistent_states, fixed_step, law
from problems import PROBLEMS, bead
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Sine
from runs import some

from drake_dae import DaePlant, DaeSystem, TrackingController, find_structure
from drake_dae.dae.normal_form import NormalForm
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import (
    InconsistentStateError,
    ModelError,
    NonFiniteError,
    SimulationError,
    SingularityError,
)
from drake_dae.systems.plants.realization import StateRealization


@cache
def structure(name: str) -> Structure:
    match name.split():
        case [arm_name, *kind] if kind:
            return actuated(arm_name, " ".join(kind)).structure
        case ["two_link" | "seven_joint"]:
            return arm(name).structure
    return find_structure(PROBLEMS[name]().system)


def realization(name: str) -> StateRealization:
    return StateRealization(NormalForm(structure(name).system, structure=structure(name)))


def through(system) -> set[str]:
    """Output ports that the control feeds through to."""
    return {
        system.get_output_port(i).get_name()
        for i in range(system.num_output_ports())
        if system.HasDirectFeedthrough(0, i)
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_ports_and_minimal_dimension(name):
    problem, system = PROBLEMS[name](), realization(name)
    dae = problem.system
    assert system.CreateDefaultContext().num_continuous_states() == problem.manifold_dimension
    sizes = {
        "state": dae.num_states,
        "coordinates": problem.manifold_dimension,
        "constraint_force": dae.num_constraints,
        "controlled_output": dae.num_controls,
    }
    assert system.num_output_ports() == len(sizes)
    assert {port: system.GetOutputPort(port).size() for port in sizes} == sizes
    assert system.GetInputPort("control").size() == dae.num_controls


@pytest.mark.parametrize("name", [*PROBLEMS, "two_link", "two_link flexible"])
def test_direct_feedthrough_is_that_of_the_plant(name):
    assert through(realization(name)) == through(
        DaePlant(structure(name).system, structure=structure(name))
    )


def test_direct_feedthrough_is_exact():
    assert through(realization("pendulum")) == {"constraint_force"}
    assert through(realization("pendulum_tension")) == {"constraint_force", "controlled_output"}
    assert through(realization("two_link flexible")) == set()


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.equation(26, 27)
def test_vector_field_and_outputs_by_hand(name):
    """zeta' ends in a + B u, xi' follows x', and v and z are those of the closed forms."""
    problem, system = PROBLEMS[name](), realization(name)
    dae, completion = system.dae, system.normal_form.completion
    numbers = ca.Function(
        "numbers",
        [dae.state, dae.parameter_symbol],
        [
            ca.densify(e)
            for e in (dae.f, dae.g, dae.h, dae.l, dae.m, ca.jacobian(completion, dae.state))
        ],
    )
    random = np.random.default_rng(2)
    context = system.CreateDefaultContext()
    for _ in range(3):
        x, u = problem.consistent(random), random.standard_normal(dae.num_controls)
        f, g, h, el, em, gradient = (np.array(e) for e in numbers(x, dae.parameter_values))
        known = problem.known(x)
        v = known.alpha + known.beta @ u
        highest = known.drift + known.control_matrix @ u
        system.set_state(context, x)
        system.GetInputPort("control").FixValue(context, u)
        coordinates = context.get_continuous_state_vector().CopyToVector()
        rate = np.zeros(0)
        if coordinates.size:  # Drake skips the calculation where there is no state.
            rate = system.EvalTimeDerivatives(context).CopyToVector()
        expected, start = [], 0
        for i, degree in enumerate(problem.output_degrees):
            if degree:
                expected += [*coordinates[start + 1 : start + degree], highest[i]]
            start += degree
        expected += list(gradient.reshape(-1, x.size) @ (f[:, 0] + g @ v + h @ u))
        scale = max(1.0, np.abs(expected).max(initial=0.0))
        # Some hundred operations on numbers of this size.
        np.testing.assert_allclose(rate, expected, rtol=0, atol=1e-12 * scale)
        for port, value in (
            ("state", x),
            ("coordinates", coordinates),
            ("constraint_force", v),
            ("controlled_output", el[:, 0] + em @ v),
        ):
            found = system.GetOutputPort(port).Eval(context)
            scale = max(1.0, np.abs(value).max(initial=0.0))
            np.testing.assert_allclose(found, value, rtol=0, atol=1e-12 * scale)


def driven(system, amplitude, mean):
    """u_i = mean_i + amplitude_i sin(3 t + i)."""
    builder = DiagramBuilder()
    builder.AddSystem(system)
    size = len(amplitude)
    sine = builder.AddSystem(Sine(np.array(amplitude), np.full(size, 3.0), np.arange(float(size))))
    constant = builder.AddSystem(ConstantVectorSource(np.array(mean)))
    adder = builder.AddSystem(Adder(2, size))
    builder.Connect(sine.get_output_port(0), adder.get_input_port(0))
    builder.Connect(constant.get_output_port(), adder.get_input_port(1))
    builder.Connect(adder.get_output_port(), system.GetInputPort("control"))
    simulator = Simulator(builder.Build())
    return simulator, system.GetMyMutableContextFromRoot(simulator.get_mutable_context())


RUNS = {
    "pendulum": ([2.0], [0.0], 1.0),
    "pendulum_tension": ([1.0], [0.5], 1.0),
    "two_link_arm": ([4.0, 2.0], [45.0, 12.0], 0.5),
    "knife_edge": ([1.0, 0.3], [0.2, 0.1], 1.0),
    "mixed_degrees": ([0.5, 0.5], [0.0, 0.2], 0.5),
    "held_point": ([1.0], [0.5], 0.5),
    "two_link": ([6.0, 3.0], [70.0, 25.0], 0.5),
    "two_link damped": ([20.0, 10.0], [90.0, 30.0], 0.3),
}
"""Amplitude and mean of the control, and for how many s the motion stays in the coordinates."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(RUNS, of=3))
def test_simulation_agrees_with_the_plant(name):
    """State, force and output over time by two vector fields, of n and of n - sum r_i states."""
    amplitude, mean, horizon = RUNS[name]
    plant, minimal = DaePlant(structure(name).system, structure=structure(name)), realization(name)
    runs = [driven(system, amplitude, mean) for system in (plant, minimal)]
    start = structure(name).states[3]
    for system, (simulator, context) in zip((plant, minimal), runs, strict=True):
        system.set_state(context, start)
        ApplySimulatorConfig(fixed_step(1e-3 if "damped" in name else 2e-3), simulator)
    moved = 0.0
    for time in np.linspace(0.0, horizon, 6)[1:]:
        for simulator, _ in runs:
            simulator.AdvanceTo(time)
            simulator.AdvancePendingEvents()
        for port in ("state", "constraint_force", "controlled_output"):
            first, second = (
                system.GetOutputPort(port).Eval(context)
                for system, (_, context) in zip((plant, minimal), runs, strict=True)
            )
            # Both are of fifth order: at 2 ms round-off is left of slow motions; the flexible
            # joints ring at 97 rad/s, of which (97/s * 1 ms)^6 / 720 = 1e-9 a step is left.
            atol = 1e-7 if "damped" in name else 1e-12
            scale = max(1.0, np.abs(amplitude).max(), np.abs(first).max(initial=0.0))
            np.testing.assert_allclose(second, first, rtol=0, atol=atol * scale)
        moved = max(moved, np.abs(minimal.state(runs[1][1]) - start).max())
        residual = structure(name).manifold.residual(minimal.state(runs[1][1]))
        assert np.abs(residual).max() < 1e-12
    assert moved > 0.02 or name == "held_point"


@pytest.mark.slow
def test_the_tracking_law_closes_the_loop():
    """(28) around the realization leaves (30), (31): errors as predicted, no algebraic loop."""
    builder = DiagramBuilder()
    tracking = law("two_link")
    minimal = builder.AddSystem(realization("two_link"))
    controller = builder.AddSystem(TrackingController(tracking))
    reference = np.array([0.5, 0.0, 0.0, 17.0])
    source = builder.AddSystem(ConstantVectorSource(reference))
    builder.Connect(minimal.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(source.get_output_port(), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), minimal.GetInputPort("control"))
    simulator = Simulator(builder.Build())
    context = minimal.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    start = consistent_states("two_link", 1)[0]
    minimal.set_state(context, start)
    ApplySimulatorConfig(fixed_step(2e-3), simulator)
    times = np.linspace(0.0, 1.0, 5)
    predicted = tracking.predicted_error(times, start, reference)
    assert np.abs(predicted[0, 0]) > 0.05
    for time, error in zip(times, predicted, strict=True):
        simulator.AdvanceTo(time)
        found = minimal.GetOutputPort("controlled_output").Eval(context) - reference[[0, 3]]
        # Poles at -4/s: (4/s * 2 ms)^6 / 720 a step is below round-off; joint torques and forces
        # are of order 100.
        np.testing.assert_allclose(found / [1.0, 100.0], error, rtol=0, atol=1e-13)


def test_the_state_does_not_depend_on_what_was_computed_before():
    minimal = realization("seven_joint")
    fresh, used = minimal.CreateDefaultContext(), minimal.CreateDefaultContext()
    for x in consistent_states("seven_joint", 5):
        coordinates = minimal.normal_form.coordinates(x)[2:]
        used.SetContinuousState(coordinates)
        minimal.state(used)
        copy = fresh.Clone()
        copy.SetContinuousState(coordinates)
        # Round-off times a condition of order 10.
        np.testing.assert_allclose(minimal.state(copy), minimal.state(used), rtol=0, atol=1e-13)
        np.testing.assert_allclose(minimal.state(used), x, rtol=0, atol=1e-13)


def test_a_manifold_of_two_points():
    """x' = -x + 3 v + u held at x^2 = 4: no coordinates, and yet two branches; v = (x - u)/3."""
    system = DaeSystem.from_functions(
        1,
        f=lambda x: -x,
        g=lambda x: 3,
        h=lambda x: 1,
        k=lambda x: x**2 - 4,
        l=lambda x: x,
        m=lambda x: 1,
        nominal_state=[2.0],
    )
    minimal = StateRealization(NormalForm(system))
    context = minimal.CreateDefaultContext()
    minimal.GetInputPort("control").FixValue(context, [0.5])
    for x in (2.0, -2.0, 2.0):
        minimal.set_state(context, [x])
        assert minimal.state(context)[0] == pytest.approx(x, abs=1e-15)
        force = minimal.GetOutputPort("constraint_force").Eval(context)[0]
        assert force == pytest.approx((x - 0.5) / 3.0, abs=1e-15)


def test_set_state_chooses_the_branch():
    """Below and above its pivot the pendulum has the same (x, x')."""
    minimal = realization("pendulum")
    contexts = [minimal.CreateDefaultContext() for _ in range(2)]
    y = np.sqrt(0.8**2 - 0.5**2)
    for context, sign in zip(contexts, (-1.0, 1.0), strict=True):
        start = [0.5, sign * y, 0.3, -0.15 / (sign * y)]
        minimal.set_state(context, start)
        np.testing.assert_allclose(minimal.state(context), start, rtol=0, atol=1e-15)
        context.SetContinuousState([-0.6, 0.3])
        end = sign * np.sqrt(0.28)
        np.testing.assert_allclose(
            minimal.state(context), [-0.6, end, 0.3, 0.18 / end], rtol=0, atol=1e-14
        )
        # A copy stays on the branch of its original.
        copy = context.Clone()
        copy.SetContinuousState([-0.5, 0.3])
        assert np.sign(minimal.state(copy)[1]) == sign


def test_outputs_follow_parameters():
    """The declared prerequisites are complete: no cached value is stale."""
    minimal = realization("pendulum")
    context = minimal.CreateDefaultContext()
    minimal.GetInputPort("control").FixValue(context, [0.3])
    context.SetContinuousState([0.5, 0.2])
    for length in (0.8, 1.1):
        minimal.set_parameter(context, "length", length)
        y = -np.sqrt(length**2 - 0.25)
        x = np.array([0.5, y, 0.2, -0.1 / y])
        np.testing.assert_allclose(minimal.state(context), x, rtol=0, atol=1e-14)
        closed_form = -2.0 * (x[2] ** 2 + x[3] ** 2 - 9.81 * y) / length**2 - 0.15 / length**2
        force = minimal.GetOutputPort("constraint_force").Eval(context)[0]
        assert force == pytest.approx(closed_form, rel=1e-13)
    with pytest.raises(ModelError, match="'len'"):
        minimal.set_parameter(context, "len", 1.0)


def test_outputs_without_feedthrough_need_no_control():
    minimal = realization("two_link flexible")
    context = minimal.CreateDefaultContext()
    for name in ("state", "coordinates", "constraint_force", "controlled_output"):
        minimal.GetOutputPort(name).Eval(context)


def test_the_end_of_the_coordinates_stops_the_run():
    """Pulled sideways with 60 N the pendulum comes to x = L, where B = y^2/(m L^2) is zero."""
    minimal = realization("pendulum")
    simulator, _ = driven(minimal, [0.0], [60.0])
    with pytest.raises(SimulationError) as info:
        simulator.AdvanceTo(2.0)
    assert 0.0 < info.value.time < 2.0
    assert info.value.state.shape == (4,)
    assert info.value.state[0] == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_raise_instead_of_looping(bad):
    builder = DiagramBuilder()
    minimal = builder.AddSystem(realization("pendulum"))
    source = builder.AddSystem(ConstantVectorSource([bad]))
    builder.Connect(source.get_output_port(), minimal.GetInputPort("control"))
    simulator = Simulator(builder.Build())
    with pytest.raises(NonFiniteError, match=r"u0.*t = 0 s") as info:
        simulator.AdvanceTo(1.0)
    assert info.value.state.shape == (4,)
    context = minimal.CreateDefaultContext()
    context.SetContinuousState([bad, 0.0])
    with pytest.raises(NonFiniteError, match="coordinates"):
        minimal.state(context)


def test_a_singular_constraint_matrix_raises_with_time_and_state():
    system = bead()
    structure = find_structure(system)
    minimal = StateRealization(NormalForm(structure.system, system.state[0], structure=structure))
    context = minimal.CreateDefaultContext()
    minimal.GetInputPort("control").FixValue(context, [0.0])
    minimal.set_state(context, [0.0, 0.0])
    with pytest.raises((SingularityError, NonFiniteError), match=r"A\(x\)"):
        minimal.EvalTimeDerivatives(context)


def test_wrong_inputs():
    minimal = realization("pendulum")
    context = minimal.CreateDefaultContext()
    with pytest.raises(InconsistentStateError, match="project") as info:
        minimal.set_state(context, [0.5, -0.6, 0.0, 0.0])
    np.testing.assert_allclose(info.value.residual, [(0.61 - 0.64) / 2, 0.0], atol=1e-15)
    with pytest.raises(ModelError, match="state"):
        minimal.set_state(context, [np.nan, -0.6, 0.0, 0.0])
    with pytest.raises(ModelError, match="state"):
        minimal.set_state(context, [0.5, 0.0])
    with pytest.raises(ModelError, match="AutoDiffXd"):
        minimal.ToAutoDiffXd()


def test_a_system_is_as_good_as_its_normal_form():
    known = realization("pendulum")
    same = StateRealization(NormalForm(known.dae))
    contexts = []
    for plant in (known, same):
        context = plant.CreateDefaultContext()
        plant.GetInputPort("control").FixValue(context, [0.7])
        contexts.append(plant.EvalTimeDerivatives(context).CopyToVector())
    np.testing.assert_array_equal(*contexts)
    with pytest.raises(ModelError, match=r"normal_form.*None"):
        StateRealization(None)
