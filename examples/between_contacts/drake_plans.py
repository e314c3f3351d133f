"""Drake's DirectCollocation on the same task, in the two ways in which it can be asked.

It knows no constraint forces. So either the force is eliminated from the plant, as `RobotPlant` has
it, and a constraint at the samples holds it within its limits; or it is one more input of the arm
without the wall, and constraints at the samples put the tool on the wall.
"""

import time

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlant_
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.planning import DirectCollocation
from pydrake.solvers import SnoptSolver
from pydrake.systems.framework import LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem
from pydrake.trajectories import PiecewisePolynomial
from task import DURATION, LEAST, MOST, WALL, Plan, robot

import drake_dae as dd

SAMPLES = 51


@TemplateSystem.define("PushedArm_")
def PushedArm_(T: type) -> type:
    """The arm without a wall, (q, v)' by torques and by a force on the tool along -x."""

    class Impl(LeafSystem_[T]):
        def _construct(self, converter=None):  # type: ignore[no-untyped-def]
            LeafSystem_[T].__init__(self, converter)
            plant: MultibodyPlant = robot()
            self.arm: MultibodyPlant_[T] = plant if T is float else plant.ToScalarType[T]()
            self.own = self.arm.CreateDefaultContext()
            self.DeclareContinuousState(2, 2, 0)
            self.DeclareVectorInputPort("inputs", 3)

        def _construct_copy(self, other, converter=None):  # type: ignore[no-untyped-def]
            Impl._construct(self, converter)

        def tool(self, state):  # type: ignore[no-untyped-def]
            """Where the tool is along x, in m."""
            self.arm.SetPositionsAndVelocities(self.own, state)
            frame = self.arm.GetFrameByName("tool")
            return frame.CalcPoseInWorld(self.own).translation()[:1]

        def DoCalcTimeDerivatives(self, context, derivatives):  # type: ignore[no-untyped-def]
            arm, own = self.arm, self.own
            x = context.get_continuous_state_vector().CopyToVector()
            u = self.get_input_port().Eval(context)
            arm.SetPositionsAndVelocities(own, x)
            world, tool = arm.world_frame(), arm.GetFrameByName("tool")
            by = JacobianWrtVariable.kV
            slope = arm.CalcJacobianTranslationalVelocity(own, by, tool, np.zeros(3), world, world)
            push = u[:2] - arm.CalcBiasTerm(own) - slope[0] * u[2]
            push = push + arm.CalcGravityGeneralizedForces(own)
            a, b, c = (arm.CalcMassMatrix(own)[i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
            pivot = a * c - b * b
            rate = [(c * push[0] - b * push[1]) / pivot, (a * push[1] - b * push[0]) / pivot]
            derivatives.get_mutable_vector().SetFromVector(np.array([*x[2:], *rate]))

    return Impl


def with_force_eliminated(model: dd.RobotModel, first: np.ndarray, last: np.ndarray) -> Plan:
    """On the plant that keeps itself on the wall."""
    plant = dd.RobotPlant(model)
    problem, context = collocation(plant, first, last)
    converted = plant.ToAutoDiffXd()
    moving = converted.CreateDefaultContext()

    def force(variables: np.ndarray) -> np.ndarray:
        gradients = variables.dtype == object
        system, own = (converted, moving) if gradients else (plant, context)
        own.SetContinuousState(variables[:4])
        system.GetInputPort("control").FixValue(own, variables[4:])
        return system.GetOutputPort("constraint_force").Eval(own)

    for k in range(SAMPLES):
        variables = np.concatenate([problem.state(k), problem.input(k)])
        problem.prog().AddConstraint(force, [LEAST], [MOST], variables)
    problem.AddRunningCost(sum(u * u for u in problem.input()))
    states, inputs, seconds, converged = solved(problem)

    def force_at(t: float) -> float:
        return float(force(np.concatenate([states(t), inputs(t)]))[0])

    name = f"Drake DirectCollocation, force eliminated, {SAMPLES} samples"
    return Plan(name, seconds, states, inputs, force_at, breaks(), converged)


def with_force_as_input(model: dd.RobotModel, first: np.ndarray, last: np.ndarray) -> Plan:
    """On the arm without a wall, whose tool is on it at the samples."""
    plant = PushedArm_[float]()
    problem, _ = collocation(plant, first, last)
    converted = PushedArm_[AutoDiffXd]()

    def tool(state: np.ndarray) -> np.ndarray:
        return (converted if state.dtype == object else plant).tool(state)

    for k in range(1, SAMPLES - 1):
        problem.prog().AddConstraint(tool, [WALL], [WALL], problem.state(k))
    problem.prog().AddConstraint(tool, [WALL], [WALL], problem.final_state())
    problem.AddConstraintToAllKnotPoints(problem.input()[2] >= LEAST)
    problem.AddConstraintToAllKnotPoints(problem.input()[2] <= MOST)
    problem.AddRunningCost(sum(u * u for u in problem.input()[:2]))
    states, inputs, seconds, converged = solved(problem)
    name = f"Drake DirectCollocation, force an input, {SAMPLES} samples"
    return Plan(
        name,
        seconds,
        states,
        lambda t: inputs(t)[:2],
        lambda t: float(inputs(t)[2]),
        breaks(),
        converged,
    )


def collocation(plant, first, last):  # type: ignore[no-untyped-def]
    """The problem from rest to rest; the end is on the wall, so one joint says where."""
    context = plant.CreateDefaultContext()
    step = DURATION / (SAMPLES - 1)
    problem = DirectCollocation(plant, context, SAMPLES, step, step)
    program = problem.prog()
    program.AddBoundingBoxConstraint(first, first, problem.initial_state())
    one = [0, 2]
    program.AddBoundingBoxConstraint(last[one], last[one], problem.final_state()[one])
    line = PiecewisePolynomial.FirstOrderHold([0.0, DURATION], np.column_stack([first, last]))
    problem.SetInitialTrajectory(PiecewisePolynomial(), line)
    return problem, context


def solved(problem):  # type: ignore[no-untyped-def]
    """States and inputs by the time, how long it took, and whether it converged."""
    begun = time.perf_counter()
    result = SnoptSolver().Solve(problem.prog())
    seconds = time.perf_counter() - begun
    states = problem.ReconstructStateTrajectory(result)
    inputs = problem.ReconstructInputTrajectory(result)
    return (
        lambda t: states.value(t)[:, 0],
        lambda t: inputs.value(t)[:, 0],
        seconds,
        result.is_success(),
    )


def breaks() -> np.ndarray:
    """The times of the samples."""
    return np.linspace(0.0, DURATION, SAMPLES)
