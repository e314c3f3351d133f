"""Gains with the least peak torque for a given error.

The two-link arm starts 5 cm off its path on the wall. From one second on its error has to be below
1 mm, with as little torque as possible on the way: the peak is one more variable, which bounds all
torques and is made small.

Claims: in Drake's Simulator the peak is at most 0.9 of what it was, and the late error below 1 mm
to a thousandth. (They fall from 81.0 to 72.5 N m and from 3.7 to 1 mm.)

    python examples/least_torque.py [FOLDER]
"""

import sys
from pathlib import Path

import casadi as ca
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import drake_dae as dd
from drake_dae.scenario.shipped import find_scenario

SETTINGS = (
    "start.errors.tool.z=0.05",
    "integrator={integration_scheme: runge_kutta3, use_error_control: false, max_step_size: 0.005}",
)

LATE = 200
"""The row from which the error is bounded: 1 s."""

LARGEST = 1e-3
"""The largest error from then on, in m."""


def main(folder: Path) -> tuple[float, float]:
    """Returns the peak torque over what it was, and the late error in m."""
    scenario = dd.load_scenario(find_scenario("two_link_wall"), SETTINGS)
    loop, context = dd.build_scenario(scenario)
    times = np.linspace(0.0, 1.5, 301)
    (before,) = dd.rollout(loop, *dd.start_values(loop, context), times, config=scenario.integrator)

    found = dd.optimize(
        loop,
        context,
        times,
        {"gains.tool.z": (1.0, 400.0)},
        config=scenario.integrator,
        more={"peak": 200.0},
        cost=lambda run: run["peak"],
        limits=lambda run: {
            "torque": (None, ca.fabs(run["control"]) - run["peak"], 0.0),
            "error": (-LARGEST, run["tracking_error", "tool.z"][LATE:], LARGEST),
        },
    )
    print(found.text())

    # The same in Drake's Simulator.
    again = found.context.Clone()
    dd.simulate(loop.diagram, again, times[-1], scenario.integrator)
    after = loop.record(again)
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
    peaks = []
    for name, record in (("before", before.record), ("after", after)):
        peaks.append(float(np.abs(record["control"]).max()))
        axes[0].plot(record.time, 1e3 * record["tracking_error"][:, 0], label=name)
        axes[1].plot(record.time, np.abs(record["control"]).max(axis=1), label=name)
    late = [
        float(np.abs(each["tracking_error"][LATE:, 0]).max()) for each in (before.record, after)
    ]
    share = peaks[1] / peaks[0]
    print(
        f"peak torque {peaks[0]:.2f} N m before, {peaks[1]:.2f} N m after: {share:.3f} (claim: 0.9)"
    )
    print(f"late error {late[0]:.2e} m before, {late[1]:.6f} m after (claim: {1.001 * LARGEST:g})")
    axes[0].set_ylabel("error [mm]")
    axes[1].set(ylabel="larger torque [N m]", xlabel="time [s]")
    axes[0].legend()
    figure.savefig(folder / "least_torque.png", dpi=120)
    plt.close(figure)
    return share, late[1]


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    if not folder.is_dir():
        sys.exit(f"no folder '{folder}'; the picture goes into a folder that is there")
    main(folder)
