"""Four tanks, two pumps: whether a law that follows exactly may be used is up to the zero dynamics.

The pumps fill the lower tanks 1 and 2 whose levels are to be held, and through two valves the upper
tanks 3 and 4 above them, crosswise (Johansson, IEEE Transactions on Control Systems Technology
8(3), 2000). The outputs obey the law in both settings of the valves. The upper levels are what the
outputs do not show: they settle if most of the water goes down, and run away if it goes up.

Claims: the errors are the closed-form solutions of (30) to 1e-12 cm, in both settings; and the
eigenvalues of the zero dynamics are the zeros of Johansson's formula to 1e-12 of their size.
"""

import sys
import warnings
from pathlib import Path

import casadi as ca
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd
from drake_dae.errors import NonMinimumPhaseWarning

AREA = np.array([28.0, 32.0, 28.0, 32.0])  # cm^2
HOLE = np.array([0.071, 0.057, 0.071, 0.057])  # cm^2
GRAVITY = 981.0  # cm/s^2

# Levels in cm, gains of the pumps in cm^3/(V s), and how much of each goes down.
SETTINGS = {
    "most goes down": ([12.4, 12.7, 1.8, 1.4], (3.33, 3.35), (0.70, 0.60)),
    "most goes up": ([12.6, 13.0, 4.8, 4.9], (3.14, 3.29), (0.43, 0.34)),
}


def tanks(levels: list[float], gains: tuple, down: tuple) -> dd.DaeSystem:
    """A_i h_i' = inflow - a_i sqrt(2 g h_i)."""

    def drift(x: ca.SX) -> list[ca.SX]:
        out = [HOLE[i] * ca.sqrt(2 * GRAVITY * x[i]) for i in range(4)]
        balance = [out[2] - out[0], out[3] - out[1], -out[2], -out[3]]
        return [flow / area for flow, area in zip(balance, AREA, strict=True)]

    (k1, k2), (g1, g2) = gains, down
    inflow = np.array([[g1 * k1, 0], [0, g2 * k2], [0, (1 - g2) * k2], [(1 - g1) * k1, 0]])
    return dd.DaeSystem.from_functions(
        [dd.Signal(f"h{i + 1}", "cm") for i in range(4)],
        f=drift,
        h=lambda x: inflow / AREA[:, None],
        l=lambda x: [x[0], x[1]],
        control_signals=[dd.Signal("pump1", "V"), dd.Signal("pump2", "V")],
        output_signals=[dd.Signal("h1", "cm"), dd.Signal("h2", "cm")],
        nominal_state=levels,
        name="quadruple tank",
    )


def zeros_of_johansson(levels: np.ndarray, down: tuple) -> np.ndarray:
    """(1 + s T_3)(1 + s T_4) = (1 - g_1)(1 - g_2)/(g_1 g_2), in 1/s."""
    t3, t4 = (AREA / HOLE * np.sqrt(2 * levels / GRAVITY))[2:]
    ratio = (1 - down[0]) * (1 - down[1]) / (down[0] * down[1])
    return np.roots([t3 * t4, t3 + t4, 1 - ratio])


def main(folder: Path) -> tuple[float, float]:
    """Returns the largest distances of errors (cm) and of eigenvalues (relative) from theory."""
    figure, axes = plt.subplots(2, 2, sharex=True, figsize=(10, 6), layout="constrained")
    errors, zeros = [], []
    for column, (name, (levels, gains, down)) in zip(axes.T, SETTINGS.items(), strict=True):
        system = tanks(levels, gains, down)
        law = dd.TrackingLaw(system, dd.poles(-0.1))
        stability = dd.ZeroDynamics(law.structure.system, structure=law.structure).stability()
        found = np.sort(stability.eigenvalues.real)
        expected = np.sort(zeros_of_johansson(stability.state, down))
        zeros.append(np.max(np.abs(found / expected - 1.0)))
        print(f"{name}: zero dynamics {stability.verdict}, {np.round(found, 4)} 1/s")

        # From rest the lower levels rise by 0.3 and 0.1 cm.
        start = stability.state
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", NonMinimumPhaseWarning)
            loop = dd.make_closed_loop(
                dd.DaePlant(law.structure.system, structure=law.structure),
                law,
                references=[dd.ConstantReference([start[0] + 0.3, start[1] + 0.1])],
            )
        for warning in caught:
            print(f"the controller warns: {warning.message}")
        context = loop.diagram.CreateDefaultContext()
        loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), start)
        config = SimulatorConfig(
            integration_scheme="runge_kutta5", max_step_size=0.1, use_error_control=False
        )
        dd.simulate(loop.diagram, context, 150.0, config)
        record = loop.record(context)
        errors.append(np.max(np.abs(record["tracking_error"] - loop.predicted_error(record))))

        for axis, part, label in zip(
            column, (slice(2), slice(2, 4)), ("held", "free"), strict=True
        ):
            axis.plot(record.time, record["state"][:, part] - start[part])
            axis.set_ylabel(f"change of the levels {label} [cm]")
        column[0].set_title(f"{name}: {stability.verdict}")
        column[0].legend(["h1", "h2"])
        column[1].legend(["h3", "h4"])
        column[1].set_xlabel("time [s]")
    off, missed = float(max(errors)), float(max(zeros))
    print(f"errors off the solutions of (30) by at most {off:.1e} cm (claim: 1e-12)")
    print(f"eigenvalues off Johansson's zeros by at most {missed:.1e} (claim: 1e-12)")
    figure.savefig(folder / "quadruple_tank.png", dpi=120)
    plt.close(figure)
    return off, missed


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
