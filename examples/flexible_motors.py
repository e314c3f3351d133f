"""A 7-joint arm with DC motors behind flexible joints presses on a wall: the longest chain.

Voltages drive currents, currents turn shafts, and springs pull the joints: position outputs have
degree 5, the contact force has degree 3 and starts 5 N off. The paper has no formula for this; the
law (28) follows from the chain of stages. Rotor inertias and gears are what the URDF says.

Claims: the position errors are the exact responses of fifth order to 1e-5 m or rad, the force error
is that of third order to 1e-6 N.
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

SPRINGS = dd.FlexibleJoints(stiffness=[2e4, 2e4, 1e4, 1e4, 5e3, 2e3, 2e3])
MOTORS = dd.DcMotors(torque_constant=0.1, inductance=2e-3, resistance=0.5)


def main(folder: Path) -> tuple[float, float]:
    """Returns the largest distances from the prediction: of a position, and of the force in N."""
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
        actuation=[SPRINGS, MOTORS],
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
    # A fixed step: the law leaves nothing stiff, and a step that adapts only adds errors of the
    # angles, which springs and light links amplify.
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=2.5e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 2.0, config)

    record = loop.record(context)
    off = np.max(np.abs(record["tracking_error"] - loop.predicted_error(record)), axis=0)
    position, force = float(np.max(off[:6])), float(off[6])
    print(f"degrees: r = {law.structure.constraint_degrees}, mu = {law.degrees}")
    print(f"position errors off the exact responses by at most {position:.1e} (claim: 1e-5)")
    print(f"force error off its exact response by at most {force:.1e} N (claim: 1e-6)")
    state, names = record["state"], [f"joint {i + 1}" for i in range(7)]
    figure, axes = plt.subplots(4, 1, sharex=True, figsize=(8, 9), layout="constrained")
    axes[0].plot(record.time, record["control"])
    axes[0].set_ylabel("voltage [V]")
    axes[1].plot(record.time, state[:, 28:35])
    axes[1].set_ylabel("current [A]")
    axes[2].plot(record.time, 1e3 * (state[:, 14:21] - state[:, :7]))
    axes[2].set_ylabel("deflection q2 - q1 [mrad]")
    figure.legend(axes[0].lines, names, loc="outside upper center", ncols=4)
    axes[3].plot(record.time, record["desired_output"][:, 6], "--", label="desired")
    axes[3].plot(record.time, record["constraint_force"], label="simulated")
    axes[3].set(xlabel="time [s]", ylabel="contact force [N]")
    axes[3].legend()
    figure.savefig(folder / "flexible_motors.png", dpi=120)
    plt.close(figure)
    return position, force


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
