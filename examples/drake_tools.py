"""Drake's own tools on an arm in contact: Linearize and DirectCollocation, with exact gradients.

Claims: the linearized force and position loop has the assigned poles, the pole -(1 + G) / T of its
force sensor, and two zeros, for the directions off N*, in which nothing drives or damps. A motion
along the wall that DirectCollocation planned with least effort ends, replayed open loop, within
0.1 mm of its goal.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.planning import DirectCollocation
from pydrake.solvers import MathematicalProgramResult, SnoptSolver
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, InputPortSelection, OutputPortSelection
from pydrake.systems.primitives import Linearize, LogVectorOutput, TrajectorySource, VectorLog
from pydrake.trajectories import PiecewisePolynomial

from drake_dae import (
    ConstantReference,
    ForceSensor,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    shipped_model,
)
from drake_dae.dae import Structure
from drake_dae.diagrams import LoopSettings

LOW, HIGH = 0.0, 0.6
"""Heights of the tip, m."""

LEAST, MOST = 5.0, 50.0
"""Contact force, N."""

DURATION, SAMPLES = 1.0, 21


def main(folder: Path) -> tuple[float, float]:
    """Returns how far off the poles (1/s) and the goal (m) are."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = RobotModel.from_multibody(
        multibody,
        constraints=[PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[PointCoordinates("tool", axes="z")],
        nominal_positions=[1.2, -1.6],
    )
    structure = find_structure(model.dae)

    off = linearize(model, structure)
    print(f"eigenvalues of the closed loop off by at most {off:.1e} 1/s (claim: 1e-6)")

    low = np.append(model.configuration([LOW], guess=[1.2, -1.6]), [0.0, 0.0])
    high = np.append(model.configuration([HIGH], guess=low[:2]), [0.0, 0.0])
    problem, plan = collocate(RobotPlant(model, structure=structure), low, high)
    control = problem.ReconstructInputTrajectory(plan)
    outputs = replay(RobotPlant(model, structure=structure), control, low)
    missed = abs(outputs.data()[0, -1] - HIGH)
    print(f"the planned motion, replayed, misses its goal by {missed:.1e} m (claim: 1e-4)")

    times = outputs.sample_times()
    figure, axes = plt.subplots(3, 1, sharex=True, layout="constrained")
    axes[0].plot(times, outputs.data()[0])
    axes[0].set_ylabel("tip height [m]")
    axes[1].plot(times, outputs.data()[1])
    axes[1].axhline(LEAST, linestyle="--", color="gray")
    axes[1].axhline(MOST, linestyle="--", color="gray")
    axes[1].set_ylabel("contact force [N]")
    axes[2].plot(times, control.vector_values(times).T)
    axes[2].set_ylabel("torque [N m]")
    axes[2].legend(["joint 1", "joint 2"])
    axes[2].set_xlabel("time [s]")
    figure.savefig(folder / "drake_tools.png", dpi=120)
    plt.close(figure)
    return off, missed


def linearize(model: RobotModel, structure: Structure) -> float:
    """The largest distance of an eigenvalue of the closed loop from where it should be."""
    gain, lag, height, force = 3.0, 0.05, 0.3, 20.0
    law = TrackingLaw(
        model.dae, poles([-3.0, -5.0]), structure=structure, measured_force=True, force_gain=gain
    )
    sensor = ForceSensor(1, time_constant=lag)
    references = [ConstantReference(height), ConstantReference(force)]
    loop = make_closed_loop(
        RobotPlant(model, structure=structure), law, references, LoopSettings(sensor=sensor)
    )

    # Linearize takes equilibria alone: at rest at the reference, with the sensor settled.
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration([height], guess=[1.2, -1.6])
    state = model.rest_state(q, [force])
    loop.plant.set_consistent_state(loop.plant.GetMyMutableContextFromRoot(context), state)
    sensor.set_force(sensor.GetMyMutableContextFromRoot(context), [force])
    linear = Linearize(
        loop.diagram, context, InputPortSelection.kNoInput, OutputPortSelection.kNoOutput
    )
    found = np.sort_complex(np.linalg.eigvals(linear.A()))
    print("eigenvalues of the closed loop:", np.array2string(found, precision=6))
    off_wall = sum(structure.constraint_degrees)
    print(f"{off_wall} of them are zero, sum r_i: the directions off N*, in which nothing drives")
    expected = [-(1.0 + gain) / lag, -5.0, -3.0, 0.0, 0.0]
    return float(np.max(np.abs(found - expected)))


def collocate(
    plant: RobotPlant, start: np.ndarray, end: np.ndarray
) -> tuple[DirectCollocation, MathematicalProgramResult]:
    """From rest to rest with the least integral of u'u, always pressing on the wall."""
    context = plant.CreateDefaultContext()
    step = DURATION / (SAMPLES - 1)
    problem = DirectCollocation(plant, context, SAMPLES, step, step)
    program = problem.prog()

    # The start is on N*, and the motion stays there: so one joint fixes the whole end. To fix the
    # other as well would be to ask twice for the same.
    program.AddBoundingBoxConstraint(start, start, problem.initial_state())
    one = [0, 2]
    program.AddBoundingBoxConstraint(end[one], end[one], problem.final_state()[one])
    problem.AddRunningCost(sum(u * u for u in problem.input()))

    converted = plant.ToAutoDiffXd()
    moving = converted.CreateDefaultContext()

    def pressing(variables: np.ndarray) -> np.ndarray:
        gradients = variables.dtype == object
        system, own = (converted, moving) if gradients else (plant, context)
        own.SetContinuousState(variables[: start.size])
        system.GetInputPort("control").FixValue(own, variables[start.size :])
        return system.GetOutputPort("constraint_force").Eval(own)

    for k in range(SAMPLES):
        variables = np.concatenate([problem.state(k), problem.input(k)])
        program.AddConstraint(pressing, [LEAST], [MOST], variables)

    line = PiecewisePolynomial.FirstOrderHold([0.0, DURATION], np.column_stack([start, end]))
    problem.SetInitialTrajectory(PiecewisePolynomial(), line)
    result = SnoptSolver().Solve(program)
    if not result.is_success():
        raise RuntimeError(f"no plan found: {result.get_solution_result()}")
    return problem, result


def replay(plant: RobotPlant, control: PiecewisePolynomial, start: np.ndarray) -> VectorLog:
    """The controlled outputs under a control that is given beforehand."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    source = builder.AddSystem(TrajectorySource(control))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    outputs = LogVectorOutput(plant.GetOutputPort("controlled_output"), builder)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant.set_consistent_state(plant.GetMyMutableContextFromRoot(context), start)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(DURATION)
    return outputs.FindLog(context)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
