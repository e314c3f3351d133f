"""A law on a wire: the same motion as by wires for state, reference and control."""

import copy
from functools import cache

import arms
import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_dae import (
    ClosedLoop,
    ConstantReference,
    DaePlant,
    DaeSystem,
    ReferenceGenerator,
    RobotPlant,
    SinusoidReference,
    TrackingController,
    build_scenario,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.errors import ModelError, NonFiniteError, SingularityError, WiringError
from drake_dae.systems.blocks.feedback import Feedback

REFERENCES = [SinusoidReference(0.3, 0.1, 2.0), ConstantReference(15.0)]


def loop(feedback: bool) -> ClosedLoop:
    arm = arms.arm("two_link")
    plant = RobotPlant(arm.model, structure=arm.structure, feedback=feedback)
    return make_closed_loop(plant, arms.law("two_link"), REFERENCES)


@cache
def loops() -> tuple[ClosedLoop, ClosedLoop]:
    """One in which the law is fed back, and one with wires."""
    return loop(True), loop(False)


def contexts():
    """A context of each, at the same time and state off the reference."""
    found = []
    for each in loops():
        context = each.diagram.CreateDefaultContext()
        context.SetTime(0.4)
        context.SetContinuousState(arms.consistent_states("two_link", 1)[0])
        found.append(context)
    return found


def rates(contexts):
    return [
        each.diagram.EvalTimeDerivatives(context).CopyToVector()
        for each, context in zip(loops(), contexts, strict=True)
    ]


def test_the_derivative_and_all_ports_are_those_of_the_loop_with_wires():
    """To the last bit: the same functions of the same numbers."""
    fed, wired = contexts()
    for state in arms.consistent_states("two_link", 5, seed=3):
        for context in (fed, wired):
            context.SetTime(context.get_time() + 0.3)
            context.SetContinuousState(state)
        np.testing.assert_array_equal(*rates([fed, wired]))
        for port in range(loops()[0].diagram.num_output_ports()):
            values = [
                each.diagram.get_output_port(port).Eval(context)
                for each, context in zip(loops(), (fed, wired), strict=True)
            ]
            np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("scheme", ["runge_kutta3", "runge_kutta5"])
def test_a_run_is_that_of_the_loop_with_wires(scheme):
    records = []
    for each, context in zip(loops(), contexts(), strict=True):
        config = arms.error_controlled(1e-6)
        config.integration_scheme, config.start_time = scheme, context.get_time()
        simulate(each.diagram, context, 0.3, config)
        records.append(each.record(context))
    for name in records[0].signals:
        np.testing.assert_array_equal(records[0][name], records[1][name])


def test_parameters_gains_and_fixed_values_count_in_their_context_alone_and_at_once():
    """Each change is seen without a change of time or state, by rates and by other ports."""
    (fed, wired), other = contexts(), contexts()[0]
    before = rates([fed, wired])[0]

    def force(context):
        return (
            loops()[0]
            .plant.GetOutputPort("constraint_force")
            .Eval(loops()[0].plant.GetMyContextFromRoot(context))
        )

    old = force(fed)
    for change in (
        lambda each, context: each.plant.set_parameter(
            each.plant.GetMyMutableContextFromRoot(context), "link1.mass", 9.0
        ),
        lambda each, context: each.controller.set_gains(
            each.controller.GetMyMutableContextFromRoot(context), poles(-7.0)
        ),
        lambda each, context: each.controller.GetInputPort("reference").FixValue(
            each.controller.GetMyMutableContextFromRoot(context), [0.1, 0.2, 0.3, 9.0]
        ),
        lambda each, context: each.plant.GetInputPort("control").FixValue(
            each.plant.GetMyMutableContextFromRoot(context), [3.0, -4.0]
        ),
    ):
        last = rates([fed, wired])[0]
        for each, context in zip(loops(), (fed, wired), strict=True):
            change(each, context)
        found = rates([fed, wired])
        assert np.any(found[0] != last)
        np.testing.assert_array_equal(*found)
        assert np.any(force(fed) != old)
        old = force(fed)
        clone = fed.Clone()
        clone.SetTime(clone.get_time())
        np.testing.assert_array_equal(rates([clone, wired])[0], found[0])
    np.testing.assert_array_equal(rates([other, wired])[0], before)


def test_the_value_on_the_wire_depends_on_parameters_and_a_fixed_reference_alone():
    fed, context = loops()[0].controller, contexts()[0]
    own = fed.GetMyMutableContextFromRoot(context)
    port = fed.GetOutputPort("feedback")
    value = port.Eval(own)
    assert isinstance(value, Feedback)
    context.SetTime(1.0)
    context.SetContinuousState(arms.consistent_states("two_link", 2)[1])
    assert port.Eval(own) is value
    assert copy.deepcopy(value) is value  # Contexts share it: it never changes.
    fed.set_gains(own, poles(-5.0))
    changed = port.Eval(own)
    assert changed is not value
    fed.GetInputPort("reference").FixValue(own, np.zeros(4))
    assert port.Eval(own) is not changed


def test_a_record_knows_when_gains_and_masses_changed():
    """As in the loop with wires, which notes them at each block."""
    records = []
    for each, context in zip(loops(), contexts(), strict=True):
        for gain, mass in ((-4.0, 12.0), (-9.0, 8.0), (-6.0, 10.0)):
            own = each.controller.GetMyMutableContextFromRoot(context)
            each.controller.set_gains(own, poles(gain))
            own = each.plant.GetMyMutableContextFromRoot(context)
            each.plant.set_parameter(own, "link1.mass", mass)
            config = arms.fixed_step()
            config.start_time = context.get_time()
            simulate(each.diagram, context, 0.01, config)
        records.append(each.record(context))
    assert np.abs(np.diff(records[0]["control"], axis=0)).max() > 1.0
    for name in records[0].signals:
        np.testing.assert_array_equal(records[0][name], records[1][name])


def test_gradients_are_those_of_the_loop_with_wires():
    """By time, state and all parameters, those of the law too."""
    found = []
    for each, context in zip(loops(), contexts(), strict=True):
        converted = each.diagram.ToAutoDiffXd()
        own = converted.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        state = context.get_continuous_state_vector().CopyToVector()
        block = converted.GetSubsystemByName(each.controller.get_name())
        parameters = own.get_mutable_numeric_parameter(1)
        assert block.GetMyContextFromRoot(own).get_numeric_parameter(0).size() == parameters.size()
        values = [[0.4], state, each.controller.law.all_parameters()]
        moving = InitializeAutoDiff(np.concatenate(values)).reshape(-1)
        own.SetTime(moving[0])
        own.SetContinuousState(moving[1:5])
        parameters.SetFromVector(moving[5:])
        rate = converted.EvalTimeDerivatives(own).CopyToVector()
        force = converted.GetOutputPort("constraint_force").Eval(own)
        control = converted.GetOutputPort("control").Eval(own)
        found.append(ExtractGradient(np.concatenate([rate, force, control])))
    assert np.all(found[0].any(axis=0)[[0, 1, 2, 3, 4]])
    np.testing.assert_array_equal(*found)


def test_where_the_law_has_no_value_the_error_is_that_of_the_controller():
    """Straight and horizontal onto the wall: no torque moves the tip along the normal."""
    errors = []
    for each, context in zip(loops(), contexts(), strict=True):
        context.SetContinuousState(np.zeros(4))
        with pytest.raises(SingularityError) as caught:
            each.diagram.EvalTimeDerivatives(context)
        errors.append((str(caught.value), caught.value.time, caught.value.state.tolist()))
    assert errors[0] == errors[1]


def test_a_state_that_is_not_finite_is_named():
    context = contexts()[0]
    context.SetContinuousState([1.2, -1.6, np.nan, 0.0])
    with pytest.raises(NonFiniteError, match=r"joint1_w.*t = 0\.4 s"):
        loops()[0].diagram.EvalTimeDerivatives(context)


def test_a_record_refuses_a_control_that_was_fixed():
    fed, context = loops()[0], contexts()[0]
    plant = fed.plant.GetMyMutableContextFromRoot(context)
    fed.plant.GetInputPort("control").FixValue(plant, [1.0, 2.0])
    with pytest.raises(WiringError, match="'control' of two_link"):
        fed.record(context)


def test_wires_serve_a_plant_that_could_take_a_law_as_well():
    arm = arms.arm("two_link")
    plant = RobotPlant(arm.model, structure=arm.structure, feedback=True)
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    source = builder.AddSystem(ConstantVectorSource([1.0, 2.0]))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()
    other = RobotPlant(arm.model, structure=arm.structure)
    context = other.CreateDefaultContext()
    other.GetInputPort("control").FixValue(context, [1.0, 2.0])
    np.testing.assert_array_equal(
        diagram.EvalTimeDerivatives(diagram.CreateDefaultContext()).CopyToVector(),
        other.EvalTimeDerivatives(context).CopyToVector(),
    )


def test_a_controller_with_references_needs_no_wire_for_them():
    law = arms.law("two_link")
    references = ReferenceGenerator(REFERENCES, law.degrees)
    controller = TrackingController(law, references=references)
    context = controller.CreateDefaultContext()
    context.SetTime(0.7)
    state = arms.consistent_states("two_link", 1)[0]
    controller.GetInputPort("estimated_state").FixValue(context, state)
    control = controller.GetOutputPort("control").Eval(context)
    np.testing.assert_array_equal(control, law.control(state, references.reference(0.7)))
    context.SetTime(0.9)
    control = controller.GetOutputPort("control").Eval(context)
    np.testing.assert_array_equal(control, law.control(state, references.reference(0.9)))


def test_a_scenario_is_fed_back_where_its_law_acts_at_once():
    from runs import scenario

    for settings, fed in (([], True), (["sampling={period: 0.01}"], False)):
        plant = build_scenario(scenario("two_link_wall", *settings))[0].plant
        assert plant.HasInputPort("feedback") == fed


def test_what_cannot_be_fed_back_is_refused():
    free = DaeSystem.from_functions(["a"], f=lambda x: [-x[0]], name="decay")
    with pytest.raises(ModelError, match="decay"):
        DaePlant(free, feedback=True)
    with pytest.raises(ModelError, match="references"):
        TrackingController(arms.law("two_link"), feedback=True)
