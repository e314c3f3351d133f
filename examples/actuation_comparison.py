"""The same task with five actuations: none, springs, motors, servos, motors behind springs.

The two-link arm follows a line on a wall while it presses with 20 + 5 sin(2t) N; it starts with a
position error of 2 cm and a force error of 5 N. With rigid joints the force is no state and meets
its reference at once. Motors and servos have the same degrees, and so, with the same poles, the
same errors.

Claim: each error is the one that its design (60), (72)-(73), (82)-(83) predicts, to 1e-7.
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

SPRINGS = dd.FlexibleJoints(stiffness=8000.0, inertia=1.0)
MOTORS = dd.DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
SERVOS = dd.ElectrohydraulicServos(stiffness=1e6, leakage=1e-6, geometry=0.05)
ACTUATIONS = {
    "rigid joints": ([], "-"),
    "flexible joints": ([SPRINGS], "-"),
    "motors": ([MOTORS], "-"),
    "hydraulic servos": ([SERVOS], (0, (5, 5))),  # Dashed: they lie over the motors'.
    "motors behind flexible joints": ([SPRINGS, MOTORS], "-"),
}


def run(actuation: list) -> tuple[dd.Record, np.ndarray]:
    """The record of one actuation, and the predicted errors."""
    multibody = MultibodyPlant(0.0)
    Parser(multibody).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    multibody.Finalize()
    model = dd.RobotModel.from_multibody(
        multibody,
        constraints=[dd.PointOnSurface("tool", dd.Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")],
        outputs=[dd.PointCoordinates("tool", "z")],
        nominal_positions=[1.2, -1.6],
        actuation=actuation,
    )
    law = dd.TrackingLaw(model.dae, dd.poles(-5.0))
    references = [dd.SinusoidReference(0.3, 0.2, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)]
    loop = dd.make_closed_loop(dd.RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration([0.32], guess=[1.2, -1.6])
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), model.rest_state(q, forces=[15.0])
    )
    # The law leaves nothing stiff in the closed loop: its poles are all at -5.
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=5e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 3.0, config)
    record = loop.record(context)
    return record, loop.predicted_error(record)


def main(folder: Path) -> float:
    """Returns the largest distance of an error from its prediction, in m and N."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    worst = 0.0
    for number, (name, (actuation, style)) in enumerate(ACTUATIONS.items()):
        record, predicted = run(actuation)
        error = record["tracking_error"]
        worst = max(worst, float(np.max(np.abs(error - predicted))))
        print(f"{name}: off the predicted error by {np.max(np.abs(error - predicted)):.1e}")
        for axis, column in zip(axes, (0, 1), strict=True):
            colour = f"C{number}"
            axis.plot(record.time, predicted[:, column], color=colour, lw=6, alpha=0.25)
            axis.plot(record.time, error[:, column], ls=style, color=colour, label=name)
    print(f"largest of all: {worst:.1e} (claim: 1e-7)")
    axes[0].set(title="position error [m], its prediction wide", xlabel="time [s]")
    axes[1].set(title="force error [N], its prediction wide", xlabel="time [s]")
    axes[1].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(folder / "actuation_comparison.png", dpi=120)
    plt.close(figure)
    return worst


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
