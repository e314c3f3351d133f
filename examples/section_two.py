"""Section 2 of the paper, line by line, for a crane: a trolley, a rope, and a load that swings.

The rope is the constraint 0 = k(x), its tension the constraint input v; the trolley is moved by a
force u and its position is controlled. Beside it the load swings on its own: the zero dynamics.

Claims: Phi and its inverse compose to the identity; the poles of the zero dynamics are the roots
of s^2 + (drag / load) s + g / rope, from the linearized pendulum; the tracking error is predicted.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd

TROLLEY, LOAD, ROPE, DRAG, GRAVITY = 10.0, 5.0, 2.0, 3.0, 9.81
"""Masses in kg, length in m, air drag of the load in N s/m, m/s^2."""


def main(folder: Path) -> tuple[float, float, float]:
    """Returns the largest errors: of Phi^-1(Phi(x)), of a pole in 1/s, of the error in m."""
    # (1)-(3): trolley at s, load at (x, z); v is the rope's tension over its length.
    crane = dd.DaeSystem.from_functions(
        ["s", "x", "z", "vs", "vx", "vz"],
        f=lambda c: [*c[3, 4, 5].elements(), 0, -DRAG / LOAD * c[4], -GRAVITY - DRAG / LOAD * c[5]],
        g=lambda c: [0, 0, 0, (c[1] - c[0]) / TROLLEY, (c[0] - c[1]) / LOAD, -c[2] / LOAD],
        h=lambda c: [0, 0, 0, 1 / TROLLEY, 0, 0],
        k=lambda c: [(c[1] - c[0]) ** 2 + c[2] ** 2 - ROPE**2],
        l=lambda c: [c[0]],
        m=lambda c: [[0]],
        nominal_state=[0, 0, -ROPE, 0, 0, 0],
        name="crane",
    )

    # Assumptions (1)-(5) and 2.2, r, mu, the index, the margins.
    report = dd.analyze(crane)
    print(report)
    structure = report.structure

    # (4): a consistent state; (13), (14): v = alpha + beta u.
    x = structure.manifold.project([0.0, 0.8, -1.8, 0.0, 0.3, 0.0])

    # (20)-(22): the normal form, with the states that complete it, and its inverse.
    form = dd.NormalForm(structure.system, structure=structure)
    print("xi =", ", ".join(signal.name for signal in form.completion_signals))
    inverse = np.max(np.abs(form.state(form.coordinates(x)) - x))
    print(f"Phi and its inverse are off the identity by {inverse:.1e} (claim: 1e-12)")

    # (35): the zero dynamics about the load at rest.
    zeros = dd.ZeroDynamics(structure.system, structure=structure).stability().eigenvalues
    pendulum = np.roots([1.0, DRAG / LOAD, GRAVITY / ROPE])
    pole = np.max(np.abs(np.sort_complex(zeros) - np.sort_complex(pendulum)))
    print(f"poles of the zero dynamics off by {pole:.1e} 1/s (claim: 1e-9)")

    # (28): the law; (30): the error that it promises, and the one that it has.
    law = dd.TrackingLaw(crane, dd.poles(-2.0), structure=structure)
    move = dd.PointToPointReference(0.5, 2.5, 1.0, 4.0)
    loop = dd.make_closed_loop(dd.DaePlant(structure.system, structure=structure), law, [move])
    context = loop.diagram.CreateDefaultContext()
    loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), x)
    fixed = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=5e-3, use_error_control=False
    )
    dd.simulate(loop.diagram, context, 8.0, fixed)
    record = loop.record(context)
    predicted = loop.predicted_error(record)
    error = float(np.max(np.abs(record["tracking_error"] - predicted)))
    print(f"error of the trolley off its prediction by {error:.1e} m (claim: 1e-10)")

    time, states = record.time, record["state"]
    figure, axes = plt.subplots(3, 1, sharex=True, layout="constrained")
    axes[0].plot(time, record["desired_output"], "--", time, states[:, 0])
    axes[0].set_ylabel("trolley [m]")
    axes[0].legend(["desired", "simulated"])
    axes[1].semilogy(time, np.abs(predicted) + 1e-16, linewidth=4, alpha=0.5)
    axes[1].semilogy(time, np.abs(record["tracking_error"]) + 1e-16)
    axes[1].set_ylabel("|error| [m]")
    axes[1].legend(["predicted by (30)", "simulated"])
    axes[2].plot(time, np.degrees(np.arctan2(states[:, 1] - states[:, 0], -states[:, 2])))
    axes[2].set_ylabel("swing (xi) [deg]")
    axes[2].set_xlabel("time [s]")
    figure.savefig(folder / "section_two.png", dpi=120)
    plt.close(figure)
    return float(inverse), float(pole), error


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
