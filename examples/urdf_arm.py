"""A URDF arm presses on a wall while its tool follows a circle: about 30 lines.

Claim: 5 s after a start 5 cm off, the tool is on its path to 1e-6 m, and the force was right all
the time.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd


def main(folder: Path) -> tuple[float, float]:
    """Returns the final position error in m and the largest force error in N."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(dd.shipped_model("seven_joint_arm.urdf")))
    multibody.WeldFrames(multibody.world_frame(), multibody.GetFrameByName("base"))
    multibody.Finalize()
    wall = dd.PointOnSurface("tool", dd.Plane((0.7, 0, 0), (-1, 0, 0)), name="wall")
    model = dd.RobotModel.from_multibody(
        multibody,
        constraints=[wall],
        outputs=[
            dd.PointCoordinates("tool", "yz"),
            dd.AxisCoordinates("tool", "z", "yz"),
            dd.JointPositions(["joint3", "joint7"]),
        ],
        nominal_positions=[0.0, -0.19, 0.0, -1.94, 0.0, 0.56, 0.0],
    )
    law = dd.TrackingLaw(model.dae, dd.poles(-4.0))
    loop = dd.make_closed_loop(
        dd.RobotPlant(model, structure=law.structure),
        law,
        references=[
            dd.SinusoidReference(0.0, 0.1, 2.0, np.pi / 2),
            dd.SinusoidReference(0.6, 0.1, 2.0),
            dd.ConstantReference([0.0, 0.0, 0.0, 0.0]),
            dd.SinusoidReference(20.0, 5.0, 3.0),
        ],
    )
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration([0.05, 0.6, 0, 0, 0, 0], guess=model.dae.nominal_state[:7])
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), np.concatenate([q, np.zeros(7)])
    )
    config = SimulatorConfig(integration_scheme="runge_kutta5", accuracy=1e-9)
    dd.simulate(loop.diagram, context, 5.0, config)

    record = loop.record(context)
    error = record["tracking_error"]
    final, force = np.max(np.abs(error[-1, :2])), np.max(np.abs(error[:, 6]))
    print(f"position error after 5 s: {final:.1e} m (claim: 1e-6)")
    print(f"force error at most {force:.1e} N (claim: 1e-9)")
    figure, axis = plt.subplots(layout="constrained")
    axis.plot(*record["desired_output"][:, :2].T, "--", *record["controlled_output"][:, :2].T)
    axis.set(xlabel="y [m]", ylabel="z [m]", aspect="equal", title="tool on the wall")
    axis.locator_params(axis="x", nbins=5)  # Equal axes are narrow.
    axis.legend(["desired", "simulated"])
    figure.savefig(folder / "urdf_arm.png", dpi=120)
    plt.close(figure)
    return float(final), float(force)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
