"""The rules of `Controller`, on every member: those of the package and one of `members`."""

import numpy as np
import pytest
from arms import arm, fixed_step, law
from members import RestingController
from polishing import PERIOD, laws, soft_wall

import drake_dae as dd
from drake_dae.diagrams import LoopSettings, wire_loop
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems import Observing
from drake_dae.systems.controller import Controller

GOALS = [0.3, 20.0]


def integrating():
    found = arm("two_link")
    chosen = dd.TrackingLaw(
        found.model.dae, dd.poles(-4.0), structure=found.structure, integral=["tool.z"]
    )
    return dd.TrackingController(chosen)


def task():
    return dd.TaskController(
        dd.Task([dd.Approach(), dd.Press(20.0)]), *laws(), sample_period=PERIOD
    )


MEMBERS = {
    "law": lambda: dd.TrackingController(law("two_link")),
    "with integral": integrating,
    "task": task,
    "resting": lambda: RestingController(law("two_link")),
}


def robot(controller):
    """The plant that a controller is for, and its state at rest at the goals."""
    if controller.takes_over:
        return soft_wall(), None
    q = arm("two_link").model.configuration([0.3], [1.2, -1.6])
    found, state = arm("two_link"), [*q, 0.0, 0.0]
    return dd.RobotPlant(found.model, structure=found.structure), state


def wired(controller, **settings):
    """A loop of a controller, at rest where it begins."""
    (plant, state), generator = robot(controller), None
    if controller.HasInputPort("reference"):
        generator = dd.ReferenceGenerator(
            [dd.ConstantReference(goal) for goal in GOALS], controller.law.degrees
        )
    loop = wire_loop(plant, controller, generator, LoopSettings(**settings))
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    if controller.takes_over:
        plant.set_state(own, controller.rest_state([0.3, 0.02], plant.dae.nominal_state))
    else:
        plant.set_consistent_state(own, state)
    return loop, context


def test_no_member_is_left_out():
    own = [cls for cls in Controller.__subclasses__() if cls.__module__.startswith("drake_dae")]
    package = {cls for cls in own if not cls.__name__.startswith("_")}
    assert package <= {type(make()) for make in MEMBERS.values()}


@pytest.fixture(params=MEMBERS)
def controller(request):
    return MEMBERS[request.param]()


def test_rules_1_and_2_what_it_reads_and_gives(controller):
    dae, optional = robot(controller)[0].dae, {"reference", "measured_force", "exogenous", "hold"}
    assert controller.GetInputPort("estimated_state").size() == dae.num_states
    names = {controller.get_input_port(i).get_name() for i in range(controller.num_input_ports())}
    assert names - {"estimated_state"} <= optional
    assert controller.GetOutputPort("control").size() == dae.num_controls
    for name, signals in controller.further_signals.items():
        assert controller.GetOutputPort(name).size() == len(signals), name
    for name in controller.shown:
        assert controller.HasOutputPort(name)
        assert name not in controller.further_signals


def test_rule_3_laws(controller):
    context = controller.CreateDefaultContext()
    values = controller.all_parameters(context)
    assert values.shape == controller.law.all_parameters().shape
    if controller.takes_over or isinstance(controller, RestingController):
        with pytest.raises(ModelError, match=type(controller).__name__):
            controller.set_gains(context, dd.poles(-9.0))
    else:
        controller.set_gains(context, dd.poles(-9.0))
        assert not np.array_equal(controller.all_parameters(context), values)


def test_rule_4_plants(controller):
    with pytest.raises(WiringError, match=r"14.*7"):
        controller.check_plant(
            dd.RobotPlant(arm("seven_joint").model, structure=arm("seven_joint").structure)
        )


def test_what_takes_references_is_refused_where_there_are_none():
    with pytest.raises(WiringError, match="observer"):
        wired(MEMBERS["resting"](), observer=Observing(10.0))


def test_references_are_where_the_controller_takes_them(controller):
    plant, _ = robot(controller)
    if controller.HasInputPort("reference"):
        with pytest.raises(WiringError, match="ReferenceGenerator"):
            wire_loop(plant, controller)
    else:
        generator = dd.ReferenceGenerator([dd.ConstantReference(g) for g in GOALS], [2, 0])
        with pytest.raises(WiringError, match="reference"):
            wire_loop(plant, controller, generator)


def test_a_sensor_that_nothing_reads_is_refused(controller):
    if not controller.HasInputPort("measured_force"):
        with pytest.raises(WiringError, match=r"measured.force"):
            wired(controller, sensor=dd.ForceSensor(1, 0.01))


@pytest.mark.slow
def test_rules_5_and_6_its_record_has_what_follows_and_theory(controller):
    """At rest at its goals a law has no error: round-off, and that of steps of 1 ms."""
    loop, context = wired(controller)
    config = fixed_step()
    dd.simulate(loop.diagram, context, 0.05, config)
    record = loop.record(context)
    assert {"desired_output", "tracking_error", "control"} <= {*record.signals}
    outputs, desired = record["controlled_output"], record["desired_output"]
    np.testing.assert_allclose(record["tracking_error"], outputs - desired, atol=1e-12)
    predicted = loop.predicted_error(record)
    assert predicted.shape == record["tracking_error"].shape
    np.testing.assert_allclose(record["tracking_error"], predicted, atol=1e-6)
    own = controller.GetMyContextFromRoot(context)
    plant = loop.plant.GetMyContextFromRoot(context)
    compared = controller.compared(own, lambda name: loop.plant.GetOutputPort(name).Eval(plant))
    assert (compared is None) is not ("reference" in loop.signals or controller.takes_over)
    if compared is not None:
        found, wanted, last = *compared[:2], outputs[-1]
        if controller.takes_over:  # The log of a plant that steps ends one step of it before.
            last = 2.0 * outputs[-1] - outputs[-2]
        np.testing.assert_allclose(found, last, atol=1e-6)
        np.testing.assert_allclose(wanted, desired[-1], atol=1e-6)
    assert len(loop.changes(record)) == (1 if controller.takes_over else 0)


def test_rule_7_starts(controller):
    manifold = controller.start_structure.manifold
    assert manifold.system.num_states == controller.law.system.num_states
    assert manifold.is_consistent(manifold.project(manifold.system.nominal_state))
