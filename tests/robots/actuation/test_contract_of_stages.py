"""The rules of `Stage`, on every member: those of the package and one of `members`."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, touching
from grippers import gripper, parsed
from members import TorqueLag, subclasses

from drake_dae import DcMotors, ElectrohydraulicServos, FlexibleJoints, RobotPlant
from drake_dae.errors import ModelError
from drake_dae.robots import MultibodyExpressions, Stage, chain
from drake_dae.trace.functions import TracedFunction

MEMBERS = {
    "flexible": FlexibleJoints(8e3, inertia=[1.0, 0.6]),
    "damped": FlexibleJoints(8e3, inertia=1.0, damping=[[8.0, 1.0], [1.0, 6.0]]),
    "motors": DcMotors(0.1, 2e-3, 0.5, [100.0, 80.0]),
    "hydraulics": ElectrohydraulicServos(1e6, 1e-6, lambda q: ca.diag(0.05 + 0.01 * ca.sin(q))),
    "lag": TorqueLag([0.02, 0.03]),
}


def test_no_member_is_left_out():
    assert subclasses(Stage) <= {type(stage) for stage in MEMBERS.values()}


@pytest.fixture(params=MEMBERS)
def stage(request):
    return MEMBERS[request.param]


def links():
    return arm("two_link").model.links


def test_sizes_and_names(stage):
    own, load = stage.attach(links()), [ca.SX.sym("q", 2), ca.SX.sym("v", 2)]
    k = own.state.numel()
    assert len(own.state_signals) == k
    assert own.mass.shape == (k, k)
    assert own.drift(*load).shape == (k, 1)
    assert own.force(*load).shape == (2, 1)
    assert own.drive_matrix.shape == (k, 2)
    assert len(own.drive_signals) == 2
    assert len({s.name for s in own.state_signals}) == k
    for part in own.ports.values():
        assert 0 <= part.start < part.stop <= k
    kinds = {p.name.split(".")[0] for p in own.parameters}
    assert len(kinds) == 1
    assert len({p.name for p in own.parameters}) == len(own.parameters) > 0


def test_equations_are_of_the_state_the_load_and_parameters(stage):
    """And E is symmetric positive definite."""
    own, load = stage.attach(links()), [ca.SX.sym("q", 2), ca.SX.sym("v", 2)]
    symbols = ca.vertcat(*[p.symbol for p in own.parameters])
    inputs = {"s": own.state, "q": load[0], "v": load[1], "p": symbols}
    values = np.concatenate([p.value for p in own.parameters])
    random = np.random.default_rng(0)
    numbers = [random.uniform(-1.0, 1.0, e.numel()) for e in (own.state, *load)]
    # A symbol that is none of these would be refused here.
    mass, *rest = TracedFunction(
        "stage", inputs, {"E": own.mass, "drift": own.drift(*load), "force": own.force(*load)}
    )(*numbers, values)
    np.testing.assert_array_equal(mass, mass.T)
    assert np.linalg.eigvalsh(mass)[0] > 0.0
    assert all(np.all(np.isfinite(part)) for part in rest)


def test_it_can_be_attached_again(stage):
    first, second = stage.attach(links()), stage.attach(links())
    assert not ca.depends_on(first.state, second.state)
    for one, other in zip(first.parameters, second.parameters, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.value, other.value)


def test_only_a_shaft_can_be_driven_by_a_stage(stage):
    behind = [stage, MEMBERS["motors"]]
    if stage.attach(links()).shaft is None:
        with pytest.raises(ModelError, match=f"DcMotors.*{type(stage).__name__}"):
            chain(behind, links())
    else:
        assert len(chain(behind, links()).stages) == 2


def test_rotors_turn_once(stage):
    own = stage.attach(links())
    if own.carries_rotors:
        with pytest.raises(ModelError, match=type(stage).__name__):
            chain([stage, stage], links())


@pytest.mark.parametrize("driven", [("arm",), ("left",), ("arm", "left")])
def test_shafts_have_the_units_of_the_joints_that_they_drive(driven):
    """The arm of a gripper turns, and its left finger slides."""
    links = MultibodyExpressions(parsed(gripper(driven)))
    own = FlexibleJoints(8e3, inertia=1.0).attach(links)
    wanted = ["rad" if name == "arm" else "m" for name in driven]
    assert [s.unit for s in own.state_signals] == [*wanted, *(f"{unit}/s" for unit in wanted)]


def test_motors_may_have_no_resistance():
    """L I' = u - K_m N q' then, which is (75) without R I."""
    own = DcMotors(0.1, 2e-3, 0.0, [100.0, 80.0]).attach(links())
    velocity = ca.SX.sym("v", 2)
    symbols = ca.vertcat(*[p.symbol for p in own.parameters])
    values = np.concatenate([p.value for p in own.parameters])
    drift = ca.Function("drift", [own.state, velocity, symbols], [own.drift(velocity, velocity)])
    found = drift([3.0, -4.0], [0.2, 0.5], values).full()[:, 0]
    np.testing.assert_allclose(found, [-0.1 * 100.0 * 0.2, -0.1 * 80.0 * 0.5], rtol=1e-14)


@pytest.mark.slow
def test_a_drive_holds_any_force_at_rest(stage):
    """And the control does not reach the constraint force in the same instant."""
    model = touching("two_link", [stage])
    plant = RobotPlant(model)
    control = plant.GetInputPort("control").get_index()
    for name in ("constraint_force", "joint_torque", *stage.attach(links()).ports):
        assert not plant.HasDirectFeedthrough(control, plant.GetOutputPort(name).get_index())
    q = model.configuration([0.3], [1.2, -1.6])
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(2))
    for force in (-7.0, 0.0, 40.0):
        plant.set_state(context, model.rest_state(q, [force]))
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        # Springs of 8e3 N m/rad on 0.2 kg m^2: round-off of the shafts gives 1e-11 rad/s^2.
        np.testing.assert_allclose(rate[:4], 0.0, atol=1e-9)
        found = plant.GetOutputPort("constraint_force").Eval(context)
        np.testing.assert_allclose(found, force, atol=1e-9)
