"""Gains of seven joints on compliant contact, and of a vendor's arm as `drake-dae new` has it."""

import sysconfig
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from runs import scenario

from drake_dae import build_scenario, load_scenario, optimize, simulate
from drake_dae.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.thorough]

ROBOTS = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")

FIXED = "integrator={integration_scheme: runge_kutta3, use_error_control: false, max_step_size: %g}"


@pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")
def test_a_vendors_arm_comes_to_its_path_faster_within_a_torque(tmp_path):
    """20 mm and 10 mm off: from poles(-4) to a seventh of the sum of squares with 17.5 N m."""
    task = tmp_path / "task.yaml"
    file = ROBOTS / "ur_description/urdf/ur5_robot.urdf"
    assert main(["new", str(file), "--out", str(task)]) == 0
    errors = "start.errors={tool0.x: 0.02, tool0.y: -0.01}"
    chosen = load_scenario(task, [FIXED % 0.004, errors])
    loop, context = build_scenario(chosen)
    result = optimize(
        loop,
        context,
        np.linspace(0.0, 0.4, 101),
        {"gains.tool0.x": (1.0, 900.0), "gains.tool0.y": (1.0, 900.0)},
        cost=lambda run: ca.sumsqr(run["tracking_error"][:, :2]),
        limits=lambda run: {"lift": (-17.5, run["control", "shoulder_lift_motor"], 17.5)},
        config=chosen.integrator,
    )
    assert result.converged
    assert result.cost < result.cost_before / 6.0
    assert "lift" in result.active
    # The same steps in Drake's Simulator: 100 of them, to round-off.
    simulate(loop.diagram, result.context, 0.4, chosen.integrator)
    record = loop.record(result.context)
    assert np.abs(record["control"][:, 1]).max() < 17.5 * (1.0 + 1e-4)
    last = result.run.record["state"][-1]
    np.testing.assert_allclose(record["state"][-1], last, atol=1e-9)


def test_gains_of_a_law_in_compliant_contact():
    """1 mm off its path, at 1 kHz with observer, friction unknown: less error within a torque."""
    chosen = scenario(
        "wall_point_contact",
        "plant=!CompliantContact {stiffness: 1.0e5, friction: 0.3}",
        "start.errors={tool.y: 0.001}",
        FIXED % 0.001,
    )
    loop, context = build_scenario(chosen)
    result = optimize(
        loop,
        context,
        np.linspace(0.0, 0.1, 51),
        {"gains.tool.y[0]": (400.0, 20000.0), "gains.tool.y[1]": (50.0, 2000.0)},
        cost=lambda run: 1e6 * ca.sumsqr(run["tracking_error", "tool.y"]),
        limits=lambda run: {"torque": (-40.0, run["control"], 40.0)},
        config=chosen.integrator,
        iterations=12,
    )
    assert result.cost < 0.9 * result.cost_before
    assert result.violated == ()
    # The plant itself in Drake's Simulator.
    simulate(loop.diagram, result.context, 0.1, chosen.integrator)
    record = loop.record(result.context)
    same = result.run.record["tracking_error"][-2]
    at = int(np.argmin(np.abs(record.time - result.run.record.time[-2])))
    np.testing.assert_allclose(record["tracking_error"][at, :2], same[:2], atol=1e-9)
