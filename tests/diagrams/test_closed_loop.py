"""What the library claims of a robot in contact, against theory and MultibodyPlant."""

import numpy as np
import pytest
from arms import arm, consistent_states, fixed_step, law, numbers, shipped
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from runs import run, scenario

import drake_dae as dd

ARMS = ["two_link", "seven_joint"]


@pytest.mark.parametrize(
    "references",
    [
        [dd.SinusoidReference(0.3, 0.1, 2.0), dd.ConstantReference(20.0)],
        {"wall.force": 20.0, "tool": dd.SinusoidReference(0.3, 0.1, 2.0)},
    ],
)
def test_references_come_in_order_or_by_name(references):
    plant = dd.RobotPlant(arm("two_link").model, structure=arm("two_link").structure)
    loop = dd.make_closed_loop(plant, law("two_link"), references)
    sin, cos = np.sin(1.4), np.cos(1.4)
    wanted = [0.3 + 0.1 * sin, 0.2 * cos, -0.4 * sin, 20.0]
    np.testing.assert_allclose(loop.reference.reference(0.7), wanted, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.equation(62, 63)
def test_error_is_the_closed_form_of_60():
    """Both poles at -4: e(t) = (e(0) + (e'(0) + 4 e(0)) t) exp(-4 t).

    RK5 at 1 ms leaves about 1e-15; the tolerances are those of the issue.
    """
    loop, context = shipped("two_link_wall")
    record = run(loop, context, 10.0, fixed_step())
    assert record.time[-1] == 10.0
    count = len(loop.plant.model.position_signals)
    error = record["controlled_output"][:, :count] - record["desired_output"][:, :count]
    # At rest the rate of the error is minus the reference's, which stands next to it.
    rate = -record["reference"][0, 1 : 3 * count : 3]
    t = record.time[:, None]
    theory = (error[0] + (rate + 4.0 * error[0]) * t) * np.exp(-4.0 * t)
    assert np.max(np.abs(error[0])) > 0.03
    np.testing.assert_allclose(error, theory, rtol=0, atol=1e-12)
    pressed = record["constraint_force"][:, 0]
    np.testing.assert_allclose(pressed, 20.0 + 5.0 * np.sin(2.0 * record.time), atol=1e-11)
    assert np.max(np.abs(record["constraint_residual"])) < 1e-12


COMPLIANT = "plant=!CompliantContact {time_step: 0.001, friction: 0.3}"


@pytest.mark.parametrize(
    "case",
    [("two_link_wall",), pytest.param(("wall_point_contact", COMPLIANT), marks=pytest.mark.slow)],
)
def test_a_loop_as_one_block_has_its_ports_and_its_motion(case):
    """To 1e-12 after 0.2 s: other common subexpressions are removed."""
    loop, context = dd.build_scenario(scenario(*case, "compiled=false"))
    one = dd.TracedSystem(dd.compile_diagram(loop.diagram, context=context))
    own = one.CreateDefaultContext()
    for system, its in ((loop.diagram, context), (one, own)):
        simulator = Simulator(system, its)
        ApplySimulatorConfig(fixed_step(), simulator)
        simulator.AdvanceTo(0.2)
    for i in range(loop.diagram.num_output_ports()):
        port = loop.diagram.get_output_port(i)
        wanted = port.Eval(context)
        found = one.GetOutputPort(port.get_name()).Eval(own)
        size = max(1.0, np.abs(wanted).max(initial=0.0))
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * size)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.equation(1, 37, 54, 55, 56, 57)
def test_dynamics_are_those_of_multibody_plant(name):
    """The index-1 form [[M, -J'], [J, 0]] (v', lambda) = (B u - H, -Jdot v), solved densely."""
    found, random = arm(name), np.random.default_rng(2)
    plant = dd.RobotPlant(found.model, structure=found.structure)
    context = plant.CreateDefaultContext()
    for state in consistent_states(name, 20):
        q, v = np.split(state, 2)
        u = 20.0 * random.standard_normal(plant.dae.num_controls)
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, u)
        n = numbers(name, q, v)
        j = n.constraint_jacobian
        matrix = np.block([[n.mass, -j.T], [j, np.zeros((1, 1))]])
        right = np.concatenate([u - n.bias, -n.constraint_acceleration])
        solution = np.linalg.solve(matrix, right)
        derivative = plant.EvalTimeDerivatives(context).CopyToVector()
        # Condition numbers of about 1e3 on numbers of about 1e2.
        np.testing.assert_allclose(derivative[: q.size], v, atol=0)
        np.testing.assert_allclose(derivative[q.size :], solution[: q.size], rtol=1e-9, atol=1e-9)
        force = plant.GetOutputPort("constraint_force").Eval(context)
        np.testing.assert_allclose(force, solution[q.size :], rtol=1e-9, atol=1e-9)
        z = plant.GetOutputPort("controlled_output").Eval(context)
        np.testing.assert_allclose(z, [*n.outputs, *solution[q.size :]], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.equation(59)
def test_law_is_the_explicit_law_59(name):
    """(59) with Gbar = 0, from MultibodyPlant's M, H, J, P and Q = [J; P]^-1 [0; 1].

    Qdot is a central difference along v with one Richardson step: error about 1e-12 relative.
    """
    chosen, random = law(name), np.random.default_rng(3)
    count = len(arm(name).model.position_signals)
    stiffness, damping = 16.0, 8.0

    def q_matrix(q):
        n = numbers(name, q, np.zeros_like(q))
        return np.linalg.inv(np.vstack([n.constraint_jacobian, n.output_jacobian]))[:, 1:]

    def difference(q, v, h):
        return (q_matrix(q + h * v) - q_matrix(q - h * v)) / (2.0 * h)

    for state in consistent_states(name, 20, seed=4):
        q, v = np.split(state, 2)
        n = numbers(name, q, v)
        reference = random.standard_normal(3 * count + 1)
        r, rate, acceleration = reference[:-1].reshape(count, 3).T
        force = reference[-1]
        q_rate = (4.0 * difference(q, v, 5e-4) - difference(q, v, 1e-3)) / 3.0
        wanted = (
            acceleration - stiffness * (n.outputs - r) - damping * (n.output_jacobian @ v - rate)
        )
        explicit = (
            n.mass @ q_matrix(q) @ wanted
            + n.bias
            + n.mass @ q_rate @ n.output_jacobian @ v
            - n.constraint_jacobian.T @ [force]
        )
        control = chosen.control(state, reference)
        assert np.linalg.norm(control - explicit) < 1e-9 * np.linalg.norm(explicit)
