"""A robot from its own M and H: a turning, telescoping arm that follows a curved bench.

The polar arm of textbooks (Spong, Hutchinson, Vidyasagar, Robot Modeling and Control): q = (angle,
reach), a hub of inertia 0.5 kg m^2 and a tip of 4 kg,

    M = diag(0.5 + 4 r^2, 4),    H = (8 r r' a' + 4 g r cos a, -4 r a'^2 + 4 g sin a).

Claim: the errors are the exact responses of (60) to 1e-11, on a surface given by an expression.
"""

import sys
from pathlib import Path

import casadi as ca
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd
from drake_dae.dae import gain_coefficients


def main(folder: Path) -> float:
    """Returns the largest distance of the errors from what theory predicts, in m and N."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    angle, reach = q[0], q[1]
    mass, hub, gravity = 4.0, 0.5, 9.81
    links = dd.LinkExpressions(
        q=q,
        v=v,
        mass_matrix=ca.diag(ca.vertcat(hub + mass * reach**2, mass)),
        bias=ca.vertcat(
            2 * mass * reach * v[0] * v[1] + mass * gravity * reach * ca.cos(angle),
            -mass * reach * v[0] ** 2 + mass * gravity * ca.sin(angle),
        ),
        frames={"tip": ca.vertcat(reach * ca.cos(angle), 0, reach * ca.sin(angle))},
    )

    # A wavy bench below the tip, z = -0.5 + 0.05 sin(6 x), free above.
    bench = dd.ImplicitSurface(lambda p: p[2] + 0.5 - 0.05 * ca.sin(6 * p[0]))
    model = dd.RobotModel(
        links,
        constraints=[dd.PointOnSurface("tip", bench, name="bench")],
        outputs=[dd.PointCoordinates("tip", "x")],
        nominal_positions=[-0.6, 1.0],
    )
    law = dd.TrackingLaw(model.dae, gain_coefficients([36.0, 9.0]))
    loop = dd.make_closed_loop(
        dd.DaePlant(law.structure.system, structure=law.structure),
        law,
        references=[
            dd.PointToPointReference(0.6, 1.2, start_time=1.0, end_time=3.0),
            dd.ExpressionReference(lambda t: 30.0 - 10.0 * ca.exp(-t) * ca.cos(4 * t)),
        ],
    )
    context = loop.diagram.CreateDefaultContext()
    start = [*model.configuration([0.65], guess=[-0.6, 1.0]), 0.0, 0.0]
    loop.plant.set_consistent_state(loop.plant.GetMyMutableContextFromRoot(context), start)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 4.0, config)

    record = loop.record(context)
    off = np.max(np.abs(record["tracking_error"] - loop.predicted_error(record)))
    print(f"errors off the exact responses by at most {off:.1e} (claim: 1e-11)")
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    labels = ("x of the tip [m]", "contact force [N]")
    for i, (axis, label) in enumerate(zip(axes, labels, strict=True)):
        axis.plot(record.time, record["desired_output"][:, i], "--")
        axis.plot(record.time, record["controlled_output"][:, i])
        axis.set_ylabel(label)
    axes[0].legend(["desired", "simulated"])
    axes[1].set_xlabel("time [s]")
    figure.savefig(folder / "textbook_robot.png", dpi=120)
    plt.close(figure)
    return float(off)


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
