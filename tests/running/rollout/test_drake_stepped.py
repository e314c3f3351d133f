"""Loops on Drake's own contact, rolled out, against Drake's Simulator."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import first_quick, mostly_compiled, run_scenario, scenario, some

from drake_dae import build_scenario, rollout
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running import export_loop, start_values
from drake_dae.running import rollout as rollouts
from drake_dae.running.merged_run import MergedRun
from drake_dae.running.rollout_program import program_of
from drake_dae.scenario.build import roll_scenario, rollout_times

STIFF = "plant=!MultibodyPlant {time_step: 1.0e-3, stiffness: 1.0e5, radius: 1.0e-5}"
CONTINUOUS = (
    STIFF,
    "law.constraint_damping=!Poles {all: [-50.0]}",
    "law.gains.all=[-25.0]",
    "references={tool.z: 0.3, wall.force: 20}",
)
NOISE = "sensors.force={sample_period: 0.001, noise_deviation: 0.1, seed: 7}"
LATE = "sampling={period: 2.0e-3, delay: 3.0e-3}"

LOOPS = {
    "a law with observer and integrals": ("wall_point_contact",),
    "a continuous law": ("two_link_wall", *CONTINUOUS),
    "a law that acts late, at another period": ("two_link_wall", *CONTINUOUS, LATE),
    "a sensor that lags": ("two_link_wall", *CONTINUOUS, "sensors.force={time_constant: 0.002}"),
    "noise": ("wall_point_contact", NOISE),
    "a push": (
        "two_link_wall",
        *CONTINUOUS,
        "plant.disturbances=[{frame: link2, start_time: 0.01, end_time: 0.03, force: [5, 0, 5]}]",
    ),
    "a start between two steps": ("wall_point_contact", "integrator.start_time=0.0104"),
}


def chosen(name, duration=0.06):
    robot, *settings = LOOPS[name]
    return scenario(robot, *settings, f"duration={duration}")


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(first_quick(LOOPS)))
def test_the_record_is_that_of_simulate(name, compiled):
    """Drake makes the same steps of the plant in both, so that only round-off differs.

    Contact multiplies it: by 1e5 N/m in the forces, and by some 10 in each of 60 steps at worst;
    1e-9 of a signal's size is far below what one step, or a sample more, would change.
    """
    found = chosen(name)
    loop, _, expected = run_scenario(found)
    loop, context = build_scenario(found)
    program_of(loop).choice = compiled
    rolled = roll_scenario(found, loop, context)
    assert rolled.failure is None
    record = rolled.record
    # Between steps Drake logs nothing, at a start or an end there, but at samples of the law.
    rows, own = np.nonzero(np.abs(expected.time[:, None] - record.time) < 1e-12)
    assert len(own) >= len(record.time) - 2
    assert set(record.signals) == set(expected.signals)
    for signal in record.signals:
        size = np.abs(expected[signal]).max(initial=1e-6)
        assert_allclose(record[signal][own], expected[signal][rows], rtol=0, atol=1e-9 * size)


def test_any_diagram_with_such_a_plant_rolls_out_and_is_not_exported(tmp_path):
    found = chosen("a law that acts late, at another period", 0.02)
    loop, context = build_scenario(found)
    times = rollout_times(found, loop.plant.time_step)
    (expected,) = rollout(loop, *start_values(loop, context), times)
    (rolled,) = rollout(loop.diagram, *start_values(loop.diagram, context), times)
    assert_allclose(rolled.record["state"], expected.record["state"], rtol=0, atol=0)
    for refused in (loop, loop.diagram):
        with pytest.raises(ModelError, match="CompliantPlant"):
            export_loop(refused, context, "arm", tmp_path)


@pytest.mark.slow
def test_a_step_that_drake_cannot_make_ends_the_run_with_its_reason(monkeypatch):
    """Its contact solver may find no step; what was recorded is kept."""

    class Failing(MergedRun):
        def row(self, time):
            if time > 0.0105:
                raise RuntimeError("no convergence.")
            return super().row(time)

    monkeypatch.setattr(rollouts, "MergedRun", Failing)
    found = chosen("a law with observer and integrals")
    rolled = roll_scenario(found, *build_scenario(found))
    assert isinstance(rolled.failure, SimulationError)
    assert "at t = 0.01 s" in str(rolled.failure)
    assert "no convergence. If" in str(rolled.failure)
    assert rolled.record.time[-1] == pytest.approx(0.01)
