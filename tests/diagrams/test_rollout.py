"""Rollouts against Drake's Simulator on the same closed loop."""

import shutil

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from runs import run, scenario

from drake_dae import (
    build_scenario,
    rollout,
    start_values,
)

with_compiler = pytest.param(
    True, marks=pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
)
both = pytest.mark.parametrize("compiled", [False, with_compiler])

LARGE = {"two_arms", "two_arms_free_box", "three_fingers", "biped"}
"""They take the compiler long."""


def fixed(scheme: str = "runge_kutta3", step: float = 1e-3) -> list[str]:
    return [
        f"integrator.integration_scheme={scheme}",
        "integrator.use_error_control=false",
        f"integrator.max_step_size={step}",
        "compiled=false",
    ]


def grid(duration: float, step: float) -> np.ndarray:
    return np.linspace(0.0, duration, round(duration / step) + 1)


def assert_equal_records(found, wanted, tolerance) -> None:
    """Drake adds its steps up, and so may take one of 1e-13 s more at the end."""
    assert list(found.signals) == list(wanted.signals)
    last = found.time.size - 1
    for name, recorded in wanted.signals.items():
        assert found.signals[name].signals == recorded.signals
        scale = max(1.0, np.max(np.abs(recorded.values), initial=0.0))
        same = [*range(last - 1), -1]
        np.testing.assert_allclose(
            found[name][same], recorded.values[same], rtol=0.0, atol=tolerance * scale
        )


@both
@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        ("two_link_wall", "runge_kutta3"),
        ("two_link_wall", "runge_kutta5"),
        ("two_link_wall", "runge_kutta2"),
        ("two_link_wall", "bogacki_shampine3"),
        ("two_link_wall", "explicit_euler"),
        ("two_link_motors", "runge_kutta3"),
        ("two_link_measured_force", "runge_kutta3"),
        pytest.param("seven_joint_wall", "runge_kutta3", marks=pytest.mark.slow),
        pytest.param("seven_joint_moving_plate", "runge_kutta3", marks=pytest.mark.slow),
    ],
)
def test_equal_fixed_steps_are_equal(name, scheme, compiled):
    """To 1e-12 of the largest value: both do the same, in another order of additions.

    The states of both are rounded 200 times; forces and controls of some 1e3 are cancelled.
    """
    chosen = scenario(name, "duration=0.2", *fixed(scheme))
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, 0.2, chosen.integrator)
    seeds = [chosen.force.seed] if chosen.force.is_measured else None
    (found,) = rollout(
        loop,
        start,
        parameters,
        grid(0.2, 1e-3),
        config=chosen.integrator,
        compiled=compiled,
        seeds=seeds,
    )
    assert found.failure is None
    assert found.steps == 200
    assert_equal_records(found.record, wanted, 1e-12)


@both
@pytest.mark.parametrize(
    "name",
    [
        "two_link_wall",
        pytest.param("seven_joint_wall", marks=pytest.mark.slow),
        pytest.param("seven_joint_moving_plate", marks=pytest.mark.slow),
    ],
)
def test_error_control_agrees(name, compiled):
    """To 1e-9: Drake at an accuracy of 1e-12 is the truth, and the rollout at 1e-8 is held to it.

    Its steps are long, so that this holds between them, too.
    """
    chosen = scenario(name, "duration=1", "integrator.accuracy=1e-12", "compiled=false")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, 1.0, chosen.integrator)
    config = SimulatorConfig()
    config.accuracy = 1e-8
    (found,) = rollout(loop, start, parameters, wanted.time, config=config, compiled=compiled)
    assert found.failure is None
    assert found.steps < 40
    for signal in ("state", "controlled_output", "constraint_force"):
        np.testing.assert_allclose(found.record[signal], wanted[signal], rtol=1e-9, atol=1e-9)
    assert np.max(np.abs(found.record["constraint_residual"])) < 1e-13
