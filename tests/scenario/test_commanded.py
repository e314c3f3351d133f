"""Scenarios whose references, surfaces and links are commanded while they run."""

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from runs import run, scenario, some

from drake_dae import build_scenario
from drake_dae.blocks.compose import Leaves
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.scenario import build_commanded

FIXED = SimulatorConfig(
    integration_scheme="runge_kutta5", use_error_control=False, max_step_size=0.002
)


def jumped(built, duration, **changes):
    """A record of a run with jumps of inputs, given by parts of their names, at its start."""
    context = built.context.Clone()
    traced = [s for s in Leaves.of(built.loop.diagram).systems if isinstance(s, TracedSystem)]
    for key, value in changes.items():
        places = [
            (system, i)
            for system in traced
            for i, signal in enumerate(system.block.signals.get("parameters", ()))
            if f"{system.get_name()}.{signal.name}".endswith(key.replace("__", "."))
        ]
        assert places, key
        for system, i in places:
            own = system.GetMyMutableContextFromRoot(context)
            own.get_mutable_numeric_parameter(0).SetAtIndex(i, value)
    return run(built.loop, context, duration, FIXED)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["two_link_wall", "seven_joint_moving_plate"]))
def test_without_commands_it_is_the_scenario(name):
    plain = run(*build_scenario(scenario(name)), 0.5, FIXED)
    built = build_commanded(scenario(name))
    same = run(built.loop, built.context, 0.5, FIXED)
    for signal in ("controlled_output", "constraint_force", "reference"):
        # Round-off of other expressions, through fixed steps.
        size = np.abs(plain[signal]).max()
        np.testing.assert_allclose(same[signal], plain[signal], atol=1e-8 * size)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["two_link_flexible", "two_link_hydraulics"]))
def test_errors_stay_as_predicted_whatever_is_commanded(name):
    """The wall moves by as many lags for the plant as for the law, which needs more derivatives."""
    built = build_commanded(scenario(name, "start.errors={tool.z: 0.01}"))
    path = {"reference__tool__z": 0.05, "reference__wall__force": 12.0}
    found = jumped(built, 1.5, **path, **{"exogenous.wall.position[0]": -0.06})
    error, wanted = found["tracking_error"], built.loop.predicted_error(found)
    size = np.abs(found["desired_output"]).max(axis=0)
    assert np.abs((error - wanted) / size).max() <= 1e-6
    # All of it was followed.
    moved = found["exogenous"][-1, 0] - found["exogenous"][0, 0]
    assert moved == pytest.approx(-0.06, abs=1e-4)
    assert np.abs(found["constraint_residual"]).max() <= 1e-6
