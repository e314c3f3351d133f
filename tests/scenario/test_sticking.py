"""The sentence on fixed steps with which a continuous compliant contact does not stick."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from runs import run, scenario

from drake_dae import shipped_model
from drake_dae.scenario.advice.sticking import sticking_before, sticking_note
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.judging import find_feasibility
from drake_dae.scenario.model import scenario_model, scenario_structure
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

SLIDING = 0.02
"""v_s in m/s."""

FRICTION, FORCE = 0.5, 20.0


def creeping(step, *settings):
    """Two links that press on a wall and creep along it with half of v_s, where step5 is steepest.

    In 3 s the speed of the sinusoid decreases by 4 per cent.
    """
    return scenario(
        "two_link_wall",
        f"plant=!CompliantContact {{time_step: 0, stiffness: 1.0e+4, dissipation: 5, "
        f"friction: {FRICTION}, stiction_tolerance: {SLIDING}}}",
        "references={tool.z: !Sinusoids {offset: 0.3, amplitudes: [0.1], frequencies: [0.1]}, "
        f"wall.force: {FORCE}}}",
        "law.gains=!Poles {all: [-20]}",
        "start.errors={}",
        "duration=3",
        "integrator={integration_scheme: runge_kutta3, use_error_control: false, "
        f"max_step_size: {step}}}",
        *settings,
    )


def longest(q):
    """m v_s / (mu f_n), with 1 / m = e^T J M^-1 J^T e along the wall from a MultibodyPlant."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(shipped_model("two_link_arm.urdf")))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    world, tool = plant.world_frame(), plant.GetFrameByName("tool")
    jacobian = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, tool, [0, 0, 0], world, world
    )[2]
    mobility = jacobian @ np.linalg.solve(plant.CalcMassMatrix(context), jacobian)
    return SLIDING / (mobility * FRICTION * FORCE)


def parts(chosen):
    """A scenario with its model and structure."""
    model = scenario_model(chosen)
    return chosen, model, scenario_structure(model)


def test_the_longest_step_is_that_of_drakes_mass_along_the_surface():
    """The sentence begins within 1e-9 of it, far above the round-off of two mass matrices."""
    chosen, model, structure = parts(creeping(1e-3))
    step = longest(structure.states[0][:2])
    for factor, is_told in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
        chosen.integrator.max_step_size = step * factor
        assert bool(sticking_before(chosen, model, structure)) == is_told
    text = sticking_before(chosen, model, structure)
    assert f"'wall' sticks, m v_s / (mu f_n) = {step:.2g} s" in text
    assert f"{FRICTION:g} and {FORCE:g} N" in text


@pytest.mark.parametrize("by", ["rollout", pytest.param("simulate", marks=pytest.mark.slow)])
@pytest.mark.parametrize("factor", [0.95, 3.0])
def test_a_run_above_it_chatters_and_is_told(factor, by):
    """Below it friction is smooth over the last second; above it most steps turn its change."""
    step = 4.4e-3 * factor
    completed, loop = build_completed(creeping(step))
    context = start_scenario(completed.scenario, loop)
    if by == "simulate":
        record = run(loop, context, 3.0, completed.scenario.integrator)
    else:
        record = roll_scenario(completed.scenario, loop, context).record
    friction = record["contact_force"][record.time > 2.0, 2]
    changes = np.diff(friction)
    turning = np.mean(changes[1:] * changes[:-1] < 0.0)
    told = [note for note in completed.notes if note.startswith("Fixed steps of")]
    if factor < 1.0:
        assert (turning, told) == (0.0, [])
    else:
        assert turning > 0.5
        assert len(told) == 1
    assert 2.0 < -friction.mean() < 10.0


@pytest.mark.parametrize(
    "settings",
    [
        ["integrator.use_error_control=true"],
        ["integrator.integration_scheme=implicit_euler"],
        ["integrator.integration_scheme=radau3"],
        ["plant.time_step=0.001"],
        ["plant.friction=0"],
        ["sampling={period: 0.001, delay: 0.001}"],
        ["plant=!IdealConstraints {}"],
    ],
    ids=lambda settings: settings[0],
)
def test_what_sticks_with_any_step_is_not_told(settings):
    assert not sticking_before(*parts(creeping(0.05, *settings)))


def with_plant(chosen, parameters):
    return replace(chosen, plant=replace(chosen.plant, parameters=parameters))


def test_friction_and_mass_are_those_of_the_plant():
    """The friction of the constraint where the plant has none, and values that differ in it."""
    own = [
        "plant.friction=null",
        f"constraints.0.friction={FRICTION}",
    ]
    chosen, model, structure = parts(creeping(0.05, *own))
    same = sticking_before(*parts(creeping(0.05)))
    assert sticking_before(chosen, model, structure) == same
    rough = with_plant(chosen, {"wall.friction": 2 * FRICTION})
    assert f"{2 * FRICTION:g} and {FORCE:g} N" in sticking_before(rough, model, structure)
    heavy = with_plant(chosen, {"link2.mass": 1e3})
    text = sticking_note(heavy, model, structure.states[:1], np.array([[FORCE]]))
    assert not text


@pytest.mark.slow
def test_analyze_tells_it_along_the_reference():
    report = find_feasibility(creeping(0.05))
    assert report.sticking.startswith("Fixed steps of 0.05 s are longer")
    assert "Fixed steps of 0.05 s" in str(report)
    assert report.to_dict()["sticking"] == report.sticking
    assert not report.problems
    assert not find_feasibility(creeping(1e-3)).sticking


@pytest.mark.slow
def test_a_task_is_told_of_the_force_that_it_presses_with():
    """5e-5 s for 2 kg: the samples of 1 ms are longer."""
    fixed = "integrator={integration_scheme: runge_kutta3, use_error_control: false}"
    completed, _ = build_completed(scenario("wall_guarded", "plant.time_step=0", fixed))
    (told,) = [note for note in completed.notes if note.startswith("Fixed steps of")]
    assert told.startswith("Fixed steps of 0.001 s are longer than those with which 'wall' sticks")
    assert " 0.3 and 1" in told  # The Press of 15 N, less its tolerance.
