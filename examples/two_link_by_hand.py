"""The two-link arm on a wall, every block wired by hand.

Claim: with fixed steps of 1 ms the position error is the solution of (60) to round-off, and the
contact force is the desired one at all times.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from drake_dae import (
    Plane,
    PointCoordinates,
    PointOnSurface,
    ReferenceGenerator,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    TrackingController,
    TrackingLaw,
    poles,
    shipped_model,
)


def main(folder: Path) -> tuple[float, float]:
    """Returns the largest distance of position (m) and force (N) from what theory predicts."""
    # The robot: links from a URDF, the tip on the wall x = 1.2.
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = RobotModel.from_multibody(
        multibody,
        constraints=[PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[PointCoordinates("tool", axes="z")],
        nominal_positions=[1.2, -1.6],
    )

    # The law (28): both poles of the position error at -4 1/s; the force needs no gain.
    law = TrackingLaw(model.dae, poles(-4.0))

    # The blocks and their wires.
    builder = DiagramBuilder()
    robot = builder.AddSystem(RobotPlant(model, structure=law.structure))
    controller = builder.AddSystem(TrackingController(law))
    height, force = SinusoidReference(0.3, 0.3, 1.5), SinusoidReference(20.0, 5.0, 2.0)
    reference = builder.AddSystem(ReferenceGenerator([height, force], law.degrees))
    builder.Connect(robot.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), robot.GetInputPort("control"))
    outputs = LogVectorOutput(robot.GetOutputPort("controlled_output"), builder)
    desired = LogVectorOutput(reference.GetOutputPort("reference"), builder)
    diagram = builder.Build()

    # A start on the wall, 5 cm above the reference.
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    q = model.configuration([0.35], guess=[1.2, -1.6])
    state = robot.set_consistent_state(robot.GetMyMutableContextFromRoot(context), [*q, 0, 0])

    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(10.0)

    # Theory against what happened.
    log = outputs.FindLog(context)
    r = desired.FindLog(context).data()
    error = log.data() - r[[0, 3]]
    predicted = law.predicted_error(log.sample_times(), state, r[:, 0]).T
    position, pressing = np.max(np.abs(error - predicted), axis=1)
    print(f"position error off the solution of (60) by at most {position:.1e} m (claim: 1e-12)")
    print(f"force error at most {pressing:.1e} N (claim: 1e-11)")

    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    axes[0].semilogy(log.sample_times(), np.abs(predicted[0]) + 1e-17, linewidth=4, alpha=0.5)
    axes[0].semilogy(log.sample_times(), np.abs(error[0]) + 1e-17)
    axes[0].set_ylabel("|height error| [m]")
    axes[0].legend(["predicted by (60)", "simulated"])
    axes[1].plot(log.sample_times(), r[3], "--", log.sample_times(), log.data()[1])
    axes[1].set_ylabel("contact force [N]")
    axes[1].set_xlabel("time [s]")
    axes[1].legend(["desired", "simulated"])
    figure.savefig(folder / "two_link_by_hand.png", dpi=120)
    plt.close(figure)
    return float(position), float(pressing)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
