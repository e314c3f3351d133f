"""The two-link arm driven by electrohydraulic servos, the last model of section 3.3.

The cylinders act on lever arms that change with the joints: G(q) = diag(5 + 2 sin q_i) cm. Position
outputs have degree 3, the contact force has degree 1.

Claim: the errors are the exact responses of third and first order to 1e-7.
"""

import sys
from pathlib import Path

import casadi as ca
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd

SERVOS = dd.ElectrohydraulicServos(
    stiffness=1e6, leakage=1e-6, geometry=lambda q: ca.diag(0.05 + 0.02 * ca.sin(q))
)


def main(folder: Path) -> float:
    """Returns the largest distance of an error from its prediction, in m and N."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = dd.RobotModel.from_multibody(
        multibody,
        constraints=[dd.PointOnSurface("tool", dd.Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[dd.PointCoordinates("tool", "z")],
        nominal_positions=[1.2, -1.6],
        actuation=[SERVOS],
    )
    law = dd.TrackingLaw(model.dae, dd.poles({"tool.z": [-4, -5, -6], "wall.force": -8.0}))
    references = [dd.SinusoidReference(0.3, 0.2, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)]
    loop = dd.make_closed_loop(dd.RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration([0.32], guess=[1.2, -1.6])
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), model.rest_state(q, forces=[15.0])
    )
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 3.0, config)

    record = loop.record(context)
    off = float(np.max(np.abs(record["tracking_error"] - loop.predicted_error(record))))
    print(f"errors off the exact responses by at most {off:.1e} (claim: 1e-7)")
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    axes[0].plot(record.time, record["state"][:, 4:])
    axes[0].set_ylabel("actuator force [N]")
    axes[0].legend(["joint 1", "joint 2"])
    axes[1].plot(record.time, record["desired_output"][:, 1], "--", label="desired")
    axes[1].plot(record.time, record["constraint_force"], label="simulated")
    axes[1].set(xlabel="time [s]", ylabel="contact force [N]")
    axes[1].legend()
    figure.savefig(folder / "hydraulic_servos.png", dpi=120)
    plt.close(figure)
    return off


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
