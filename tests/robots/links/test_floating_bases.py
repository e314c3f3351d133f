"""Robots whose q' = N(q) v is not v, in contact: MultibodyPlant alone says what they must do."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, RpyFloatingJoint

from drake_dae import DaePlant, JointPositions, Plane, PointOnSurface, RobotModel

BODY = (
    '<inertial><origin xyz="0.1 0.2 0"/><mass value="{mass}"/><inertia ixx="0.3" iyy="0.4" '
    'izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial>'
)

URDF = f"""<robot name="space"><link name="base">{BODY.format(mass=9)}</link>
<link name="upper">{BODY.format(mass=2)}</link><link name="lower">{BODY.format(mass=1)}</link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0.3 0 0" rpy="0.2 0 0.4"/><axis xyz="0 1 0"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.5 0 0" rpy="0 0.3 0"/><axis xyz="0 0 1"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type>
<joint name="shoulder"/><actuator name="shoulder"/></transmission>
<transmission><type>transmission_interface/SimpleTransmission</type>
<joint name="elbow"/><actuator name="elbow"/></transmission></robot>"""

POINT = (0.4, 0.0, 0.1)


@pytest.fixture(scope="module")
def floating() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(URDF, "urdf")
    base = plant.GetFrameByName("base")
    plant.AddJoint(RpyFloatingJoint("base", plant.world_frame(), base))
    plant.Finalize()
    return plant


def test_motion_and_contact_force_on_a_floating_base_are_those_of_drake(floating: MultibodyPlant):
    normal = np.array([-0.6, 0.0, 0.8])
    q = np.array([0.4, 0.7, -0.5, 0.1, 0.2, 0.3, 0.6, -0.9])
    context = floating.CreateDefaultContext()
    floating.SetPositions(context, q)
    lower, world = floating.GetFrameByName("lower"), floating.world_frame()
    touched = floating.CalcPointsPositions(context, lower, np.array(POINT), world)[:, 0]
    contact = PointOnSurface("lower", Plane(tuple(touched), tuple(normal)), POINT)
    model = RobotModel.from_multibody(floating, [contact], [JointPositions(["elbow"])], q)
    plant = DaePlant(model.dae)
    own = plant.CreateDefaultContext()
    random = np.random.default_rng(0)
    guess = np.concatenate([q, random.normal(size=8)])
    state = plant.set_consistent_state(own, guess)
    control = np.array([3.0, -2.0])
    plant.GetInputPort("control").FixValue(own, control)
    rate = plant.EvalTimeDerivatives(own).CopyToVector()
    force = plant.GetOutputPort("constraint_force").Eval(own)

    floating.SetPositionsAndVelocities(context, state)
    arguments = JacobianWrtVariable.kV, lower, np.array(POINT), world, world
    jacobian = normal @ floating.CalcJacobianTranslationalVelocity(context, *arguments)
    bias = normal @ floating.CalcBiasTranslationalAcceleration(context, *arguments)[:, 0]
    needed = (
        floating.CalcMassMatrix(context) @ rate[8:]
        + floating.CalcBiasTerm(context)
        - floating.CalcGravityGeneralizedForces(context)
    )
    given = jacobian * force + floating.MakeActuationMatrix() @ control
    # Round-off of numbers up to 100.
    np.testing.assert_allclose(rate[:8], floating.MapVelocityToQDot(context, state[8:]), atol=1e-12)
    np.testing.assert_allclose(needed, given, atol=1e-9)
    np.testing.assert_allclose(jacobian @ rate[8:] + bias, 0.0, atol=1e-9)
