"""A contact force that wears a tool evenly along a path of uneven speed.

What a tool loses in a second is proportional to force times speed (Archard). The two-link arm
wipes along its wall at 0.05 to 0.25 m/s; with a constant force of 20 N the wear changes by a factor
of five. The force is now 20 N and a sum of cosines, whose amplitudes are parameters of the
reference. They are chosen such that the wear is as even as it can be, with the same mean, and a
force within 5 and 40 N.

Claims: the wear varies by less than a third of what it did (rms), and by at most 5 % more than with
the best force of any form within these limits; its mean is the same within 1e-6 W.

    python examples/even_wear.py [FOLDER]
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
from scipy.optimize import brentq

import drake_dae as dd

PERIOD, MEAN, LOW, HIGH = 1.5, 20.0, 5.0, 40.0
"""The period of the speed in s, and the mean, the least and the largest force in N."""

COSINES = 10


def height(t: ca.SX) -> ca.SX:
    """The path in m: the speed is 0.15 + 0.1 cos(2 pi t / PERIOD) m/s."""
    pace = 2.0 * np.pi / PERIOD
    return 0.1 + 0.15 * t + 0.1 * ca.sin(pace * t) / pace


def force(t: ca.SX, mean: ca.SX, amplitudes: ca.SX) -> ca.SX:
    """The force in N."""
    pace = 2.0 * np.pi / PERIOD
    return mean + sum(amplitudes[k] * ca.cos((k + 1) * pace * t) for k in range(COSINES))


def main(folder: Path) -> tuple[float, float, float]:
    """Returns the variation over what it was, its excess over the least, and the mean's error."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    plant.Finalize()
    wall = dd.PointOnSurface("tool", dd.Plane(point=(1.2, 0, 0), normal=(-1, 0, 0)), name="wall")
    model = dd.RobotModel.from_multibody(
        plant, [wall], outputs=[dd.PointCoordinates("tool", "z")], nominal_positions=[1.2, -1.6]
    )
    law = dd.TrackingLaw(model.dae, dd.poles(-4.0))
    push = dd.ExpressionReference(force, {"mean": MEAN, "amplitudes": np.zeros(COSINES)})
    references = {"tool.z": dd.ExpressionReference(height), "wall.force": push}
    loop = dd.make_closed_loop(dd.RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    start = dd.ZeroDynamics(model.dae, structure=law.structure).state(
        loop.reference.reference(0.0), model.dae.nominal_state
    )
    loop.set_state(context, start)

    times = np.linspace(0.0, 2.0 * PERIOD, 121)[:-1]  # Whole periods.
    wanted = MEAN * 0.15
    found = dd.optimize(
        loop,
        context,
        times,
        {"mean": (0.0, 60.0), "amplitudes": (-30.0, 30.0)},
        config=SimulatorConfig(
            integration_scheme="runge_kutta3", use_error_control=False, max_step_size=0.025
        ),
        cost=lambda run: ca.sumsqr(wear(run) - wanted),
        limits=lambda run: {
            "force": (LOW, run["constraint_force"], HIGH),
            "mean wear": (wanted, ca.sum1(wear(run)) / times.size, wanted),
        },
    )
    print(found.text())

    record = found.run.record
    speed = record["reference"][:, 1]
    after = record["constraint_force"][:, 0] * speed
    best = np.clip(level(speed, wanted) / speed, LOW, HIGH) * speed
    rms = [float(np.sqrt(np.mean((w - wanted) ** 2))) for w in (MEAN * speed, after, best)]
    share, more, off = rms[1] / rms[0], rms[1] / rms[2] - 1.0, abs(after.mean() - wanted)
    print(
        f"variation of the wear {rms[0]:.3f} W before, {rms[1]:.3f} W after, {rms[2]:.3f} W at best"
    )
    print(
        f"{share:.3f} of what it was (claim: 0.333), {more:.1e} more than the least (claim: 0.05)"
    )
    print(f"the mean of {wanted:g} W is off by {off:.1e} W (claim: 1e-6)")
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    axes[0].plot(times, record["constraint_force"])
    axes[0].axhline(HIGH, linestyle="--", color="gray")
    axes[0].set_ylabel("force [N]")
    axes[1].plot(times, MEAN * speed, label="constant force")
    axes[1].plot(times, after, label="found")
    axes[1].plot(times, best, ":", label="best of any form")
    axes[1].set(ylabel="force times speed [W]", xlabel="time [s]")
    axes[1].legend()
    figure.savefig(folder / "even_wear.png", dpi=120)
    plt.close(figure)
    return share, more, off


def wear(run: dd.RunSymbols) -> ca.MX:
    """Force times speed at each time, in W."""
    return run["constraint_force"] * run["reference", "tool.z'"]


def level(speed: np.ndarray, wanted: float) -> float:
    """The wear where the force is within its limits, with the wanted mean."""

    def off(found: float) -> float:
        return float(np.mean(np.clip(found / speed, LOW, HIGH) * speed)) - wanted

    return float(brentq(off, 0.1, 20.0))


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
