"""A 7-joint arm with flexible joints presses on a wall (64)-(73).

The torque reaches the joints through springs of 8000 N m/rad: position outputs have degree 4, the
contact force has degree 2 and starts 5 N off.

Claim: both errors are the solutions of (72) and (73) to 1e-7.
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


def main(folder: Path) -> float:
    """Returns the largest distance of an error from its prediction, in m, rad and N."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(dd.shipped_model("seven_joint_arm.urdf")))
    multibody.WeldFrames(multibody.world_frame(), multibody.GetFrameByName("base"))
    multibody.Finalize()
    model = dd.RobotModel.from_multibody(
        multibody,
        constraints=[dd.PointOnSurface("tool", dd.Plane((0.7, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[
            dd.PointCoordinates("tool", "yz"),
            dd.AxisCoordinates("tool", "z", "yz"),
            dd.JointPositions(["joint3", "joint7"]),
        ],
        nominal_positions=[0.0, -0.19, 0.0, -1.94, 0.0, 0.56, 0.0],
        actuation=[dd.FlexibleJoints(stiffness=8000.0)],  # rotor inertia: what the URDF says
    )
    law = dd.TrackingLaw(model.dae, dd.poles({"wall.force": -12.0, "*": -6.0}))
    loop = dd.make_closed_loop(
        dd.RobotPlant(model, structure=law.structure),
        law,
        references=[
            dd.SinusoidReference(0.0, 0.1, 1.5),
            dd.SinusoidReference(0.6, 0.1, 1.5, np.pi / 2),
            dd.ConstantReference([0.0, 0.0, 0.0, 0.0]),
            dd.SinusoidReference(20.0, 5.0, 2.0),
        ],
    )
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration([0.02, 0.7, 0, 0, 0, 0], guess=model.dae.nominal_state[:7])
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), model.rest_state(q, forces=[15.0])
    )
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 2.0, config)

    record = loop.record(context)
    off = float(np.max(np.abs(record["tracking_error"] - loop.predicted_error(record))))
    print(f"degrees: r = {law.structure.constraint_degrees}, mu = {law.degrees}")
    print(f"errors off the solutions of (72), (73) by at most {off:.1e} (claim: 1e-7)")
    state = record["state"]
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 5), layout="constrained")
    axes[0].plot(record.time, 1e3 * (state[:, 14:21] - state[:, :7]))
    axes[0].set_ylabel("deflection q2 - q1 [mrad]")
    axes[0].legend([f"joint {i + 1}" for i in range(7)], loc="center left", bbox_to_anchor=(1, 0.5))
    axes[1].plot(record.time, record["desired_output"][:, 6], "--", label="desired")
    axes[1].plot(record.time, record["constraint_force"], label="simulated")
    axes[1].set(xlabel="time [s]", ylabel="contact force [N]")
    axes[1].legend(loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(folder / "flexible_joints.png", dpi=120)
    plt.close(figure)
    return off


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
