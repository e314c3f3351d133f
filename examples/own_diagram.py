"""A diagram wired by hand, with Drake's own blocks in it, as one function.

Claim: a rollout of it is what Drake's Simulator computes, also where the drives are cut off.
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
from pydrake.systems.primitives import FirstOrderLowPassFilter, Gain, LogVectorOutput, Saturation

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
    rollout,
    shipped_model,
)
from drake_dae.running import start_values

DURATION, STEP = 2.0, 1e-3


def main(folder: Path) -> float:
    """Returns the largest distance of the tool's height and force from the Simulator's, m and N."""
    # The robot: links from a URDF, the tip on the wall x = 1.2. The law (28).
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = RobotModel.from_multibody(
        multibody,
        constraints=[PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[PointCoordinates("tool", axes="z")],
        nominal_positions=[1.2, -1.6],
    )
    law = TrackingLaw(model.dae, poles(-4.0))

    # Between law and robot: drives that give 97 %, are slow by 5 ms, and end at 70 N m.
    builder = DiagramBuilder()
    robot = builder.AddSystem(RobotPlant(model, structure=law.structure))
    controller = builder.AddSystem(TrackingController(law))
    height, force = SinusoidReference(0.3, 0.3, 1.5), SinusoidReference(20.0, 5.0, 2.0)
    reference = builder.AddSystem(ReferenceGenerator([height, force], law.degrees))
    builder.Connect(robot.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    source = controller.GetOutputPort("control")
    limits = Saturation([-70.0, -70.0], [70.0, 70.0])
    for block in (Gain(0.97, 2), FirstOrderLowPassFilter(5e-3, 2), limits):
        builder.AddSystem(block)
        builder.Connect(source, block.get_input_port())
        source = block.get_output_port()
    builder.Connect(source, robot.GetInputPort("control"))
    builder.ExportOutput(robot.GetOutputPort("controlled_output"), "outputs")
    builder.ExportOutput(source, "torques")
    log = LogVectorOutput(robot.GetOutputPort("controlled_output"), builder)
    diagram = builder.Build()

    # One start for both.
    context = diagram.CreateDefaultContext()
    q = model.configuration([0.35], guess=[1.2, -1.6])
    robot.set_consistent_state(robot.GetMyMutableContextFromRoot(context), [*q, 0, 0])
    start, parameters = start_values(diagram, context)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=STEP, use_error_control=False
    )

    # As one function, and by the Simulator.
    times = np.linspace(0.0, DURATION, round(DURATION / STEP) + 1)
    (run,) = rollout(diagram, start, parameters, times, config=config)
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)
    simulator.AdvanceTo(DURATION)
    wanted = log.FindLog(context).data().T[: times.size - 1]
    off = float(np.max(np.abs(run.record["outputs"][:-1] - wanted)))
    print(f"rollout off the Simulator by at most {off:.1e} m or N (claim: 1e-9)")

    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    axes[0].plot(times[:-1], wanted[:, 1], linewidth=4, alpha=0.4)
    axes[0].plot(times, run.record["outputs"][:, 1])
    axes[0].set_ylabel("contact force [N]")
    axes[0].legend(["Simulator", "rollout"])
    axes[1].plot(times, run.record["torques"])
    axes[1].set_ylabel("torques [N m]")
    axes[1].set_xlabel("time [s]")
    figure.savefig(folder / "own_diagram.png", dpi=120)
    plt.close(figure)
    return off


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
