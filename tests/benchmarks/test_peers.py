"""The dynamics of constrained arms beside Pinocchio and MuJoCo: the same arm, the same constraint.

Accelerations are compared first: with Pinocchio's to 1e-9, with MuJoCo's without constraint to 1e-9
and with it to 2e-3, since its constraints are soft and 0.9999 is the hardest that it takes. All are
called from Python; less what a call takes there is what a program in C++ would see. Ours in C is a
loop over 200 states in generated code. `mj_forward` also does what a robot without contact and
sensors has little of. Of a peer that is not installed a line says so.
"""

import numpy as np
import pytest
from arms import parse
from numpy.testing import assert_allclose
from peers import Tree, mujoco_model, pinocchio_model, se3
from pydrake.math import RigidTransform
from timing import calls, times
from two_arms import GRASP, two_arms

from drake_dae import CoincidentPoints, DaePlant, JointPositions, RobotModel
from drake_dae.systems.ideal_plants import dae_block
from drake_dae.trace.functions import TracedFunction

HELD = np.array([0.0, -0.1938, 0.0, -1.936, 0.0, 0.559, 0.0])


def pinned() -> RobotModel:
    """The seven-joint arm, its tool held at a point of the world by a ball joint."""
    plant = parse("seven_joint_arm")
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, HELD)
    point = plant.GetFrameByName("tool").CalcPoseInWorld(context).translation()
    pin = CoincidentPoints("world", point, "tool", np.zeros(3))
    outputs = [JointPositions(["joint1", "joint3", "joint5", "joint7"])]
    return RobotModel.from_multibody(plant, [pin], outputs, HELD, "pinned")


def ends(name: str, tree: Tree, model: RobotModel):
    """The frames that the constraint holds together: joint and pose of both."""
    if name == "7 joints, tool on a point":
        point = model.constraints[0].point_a
        return tree.place("tool"), (-1, RigidTransform(point))
    return tree.place("object", GRASP.pose), tree.place("right::tool")


def pinocchio_calls(name, tree, model, q, v, u, wanted):
    """`constraintDynamics`, and the same of a joint alone: what a call from Python takes."""
    import pinocchio

    robot = pinocchio_model(tree)
    (one, there), (other, here) = ends(name, tree, model)
    kind = pinocchio.ContactType
    held = pinocchio.RigidConstraintModel(
        kind.CONTACT_3D if name.startswith("7") else kind.CONTACT_6D,
        robot,
        one + 1,
        se3(there),
        other + 1,
        se3(here),
        pinocchio.ReferenceFrame.LOCAL,
    )
    lone = pinocchio.Model()
    lone.addJoint(0, pinocchio.JointModelRZ(), pinocchio.SE3.Identity(), "lone")
    lone.appendBodyToJoint(1, pinocchio.Inertia.Random(), pinocchio.SE3.Identity())

    def call(robot, constraints, *given):
        data, settings = robot.createData(), pinocchio.ProximalSettings(1e-12, 0.0, 1)
        contacts = pinocchio.StdVec_RigidConstraintModel()
        for constraint in constraints:
            contacts.append(constraint)
        rooms = pinocchio.StdVec_RigidConstraintData()
        for constraint in constraints:
            rooms.append(constraint.createData())
        pinocchio.initConstraintDynamics(robot, data, contacts, rooms)
        dynamics = pinocchio.constraintDynamics
        return lambda: dynamics(robot, data, *given, contacts, rooms, settings)

    whole = call(robot, [held], q, v, u)
    assert_allclose(whole(), wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
    return whole, call(lone, [], *np.zeros((3, 1)))


def mujoco_calls(name, tree, model, q, v, u, wanted):
    """`mj_forward`, and a call that does next to nothing."""
    import mujoco

    kind = "connect" if name.startswith("7") else "weld"
    hard = 'solimp="0.9999 0.9999 0.001 0.5 2"'
    equality = f'<{kind} site1="site0" site2="site1" {hard}/>'
    robot = mujoco_model(tree, equality, *ends(name, tree, model))
    data = mujoco.MjData(robot)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, u
    mujoco.mj_forward(robot, data)
    plant, context = tree.plant, tree.plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
    free = np.linalg.solve(plant.CalcMassMatrix(context), u - bias)
    assert_allclose(data.qacc_smooth, free, rtol=1e-9, atol=1e-9 * np.abs(free).max())
    assert_allclose(data.qacc, wanted, atol=2e-3 * np.abs(wanted).max())
    return lambda: mujoco.mj_forward(robot, data), lambda: mujoco.mj_isSparse(robot)


def dynamics_of(plant: DaePlant, compiled: bool) -> TracedFunction:
    """(x, u, parameters) -> x' of the ideal plant."""
    block = dae_block(plant.structure, project=False)
    inputs = {"x": block.state, "u": block.inputs["control"], "p": block.parameters}
    return TracedFunction("dynamics", inputs, {"rate": block.derivative}, compiled=compiled)


PEERS = {"Pinocchio": pinocchio_calls, "MuJoCo": mujoco_calls}


@pytest.mark.parametrize("name", ["7 joints, tool on a point", "14 joints, welded into a loop"])
def test_dynamics(name, compare):
    model = pinned() if name.startswith("7") else two_arms()
    plant, random = DaePlant(model.dae), np.random.default_rng(0)
    dynamics = [dynamics_of(plant, compiled) for compiled in (False, True)]
    nominal = model.dae.nominal_state
    state = plant.structure.manifold.project(nominal + 0.1 * random.normal(size=nominal.size))
    q, v = np.split(state, 2)
    u, p = random.normal(size=q.size), model.dae.parameter_values
    wanted = dynamics[0](state, u, p)[0][q.size :]
    functions = calls(dynamics, state, u, p)
    ours, missing = list(functions), []
    for peer, make in PEERS.items():
        try:
            both = make(name, Tree(model.links.plant), model, q, v, u, wanted)
        except ModuleNotFoundError:
            missing.append(peer)
        else:
            functions |= dict(zip((peer, f"{peer}, nothing"), both, strict=True))
    took = times(functions)
    for peer in PEERS:
        if peer in missing:
            compare(f"dynamics, {name}", took[ours[-1]], f"{peer} is missing, see [benchmark]")
            continue
        for how in ours:
            # What a loop in C computes stands beside what a call takes less its way from Python.
            in_c = how == "in C"
            other = took[peer] - took[f"{peer}, nothing"] * in_c
            wanted_ratio = "" if how == "interpreted" else 1.0
            label = f"{peer} less its call" if in_c else f"{peer} from Python"
            compare(f"dynamics, {name}: {how}", took[how], label, other, wanted_ratio)
