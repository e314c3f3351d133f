"""Tasks on ideal contact whose surface ends, beside Drake's Simulator and the place of the edge."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.systems.analysis import SimulatorConfig
from runs import scenario

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.systems.plants.contact_events import ContactChange

# The wall ends 20 mm above the tool, which moves over that edge under 10 N.
TEXT = """
robot: {{file: "package://drake_dae_models/two_link_arm.urdf"}}
constraints:
- name: wall
  frame: tool
  surface: !Plate {{point: [1.2, 0, 0.3], normal: [-1, 0, 0], half_widths: [0.2, 0.02]}}
  friction: {friction}
outputs: [!PointCoordinates {{frame: tool, axes: z}}]
gains: !Poles {{all: [-10]}}
sampling: {{period: 0.001, delay: 0.001}}
plant: {plant}
task:
  patience: 0.05
  phases:
  - !Approach {{speed: 0.04, over: 0.1}}
  - !Press {{force: 10, over: 0.1}}
  - !Move {{references: {{tool.z: 0.34, wall.force: 10}}, duration: 1, over: 0.5, if_lost: away}}
  - !Release {{over: 0.1}}
  - !Retreat {{name: away, distance: 0.02, over: 0.2}}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
duration: 2.1
integrator: {{integration_scheme: runge_kutta3, max_step_size: 0.001, use_error_control: false,
  accuracy: 1.0e-8}}
"""
IDEAL, OPENING = "!IdealConstraints {}", "!Unilateral {restitution: {wall: 0}}"


def column(record, name):
    names = [signal.name for signal in record.signals["controlled_output"].signals]
    return record["controlled_output"][:, names.index(name)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "friction"),
    [(OPENING, 0.3), pytest.param(IDEAL, 0.0, marks=pytest.mark.thorough)],
)
def test_a_task_that_moves_over_an_edge_loses_its_contact_there(plant, friction, tmp_path):
    """At the edge itself, in a rollout as in Drake's run: to 1e-9, as all such runs."""
    (tmp_path / "task.yaml").write_text(TEXT.format(plant=plant, friction=friction))
    completed, loop = build_completed(load_scenario(tmp_path / "task.yaml"))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    assert found.failure is None
    lost = next(c for c in loop.changes(found.context) if "is lost" in c.reason)
    assert lost.phase == "away"
    opening = [e for e in found.record.events if e.kind is ContactChange.OPENING][-1]
    assert opening.closed == ()
    # The samples that do not feel the contact are those of the patience and the delays.
    assert 0.05 < lost.time - opening.time < 0.055
    config = SimulatorConfig(
        integration_scheme="runge_kutta3",
        max_step_size=1e-3,
        use_error_control=False,
        accuracy=1e-8,  # windows of 1e-13 s
    )
    simulate(loop.diagram, context, 2.1, config)
    record = loop.record(context)
    wanted = [e for e in record.events if e.kind is ContactChange.OPENING][-1]
    assert_allclose(opening.time, wanted.time, rtol=0.0, atol=1e-9)
    assert_allclose(found.record["state"][-1], record["state"][-1], rtol=0.0, atol=1e-9)
    # Drake's run has a row there: found to within 1e-12 s, at 0.05 m/s.
    row = int(np.argmin(np.abs(record.time - wanted.time)))
    assert_allclose(column(record, "tool.z")[row], 0.32, rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_a_search_for_an_edge_finds_it_on_ideal_contact():
    """The plate is 4 mm and 1 degree off; the tool is on its edge when the contact opens."""
    chosen = scenario("edge_search", f"plant={IDEAL}", "duration=4.4")
    loop, context = build_scenario(chosen)
    found = roll_scenario(chosen, loop, context)
    assert found.failure is None
    changes = loop.changes(found.context)
    assert changes[3].phase == "Retreat"
    assert "is lost" in changes[3].reason
    assert [e.kind for e in found.record.events].count(ContactChange.OPENING) == 1
    record, closed = found.record, found.record["mode"][:, 0] == 1.0
    rows = (record.time > changes[2].time) & (record.time < changes[3].time)
    # On the plate, its first coordinate; beyond the edge it is less than 3 mm from it.
    along = (column(record, "tool.y") - 0.004) / np.cos(0.0175)
    assert along[rows & closed].max() < 0.05
    assert along[rows & ~closed].min() > 0.05 - 0.003 * 0.0175
    assert along[rows & closed].max() > 0.05 - 0.03 * 0.0201  # its speed, and two rows


@pytest.mark.parametrize("plant", [IDEAL, OPENING])
def test_an_insertion_on_ideal_contact_is_refused_before_the_run(plant):
    """Its hole has no sides, and the peg would be free in it."""
    with pytest.raises(ScenarioError, match=r"plant: .* face that ends, and no sides") as caught:
        build_scenario(scenario("peg_in_hole", f"plant={plant}"))
    assert "Insert enters a hole" in str(caught.value)


PEG = "plant=!IdealConstraints {pegs: [{constraint: wall, radius: 0.00495, length: 0.02}]}"


def test_pegs_of_ideal_contact_need_a_contact_that_opens_and_do_not_end_in_the_hole():
    with pytest.raises(ScenarioError, match=r"plant\.pegs: a peg is for a contact that opens"):
        build_scenario(scenario("two_link_wall", PEG))
    with pytest.raises(
        ScenarioError, match=r"task\.phases: Insert is 0\.02 m deep, .* less than 0\.02"
    ):
        build_scenario(scenario("peg_in_hole", PEG, "task.phases.4.depth=0.02"))


@pytest.mark.slow
@pytest.mark.thorough
def test_a_peg_is_inserted_in_ideal_contact():
    """Into a hole that is 2 mm and 0.3 degrees off, in which it may tilt by 0.4 degrees."""
    tilted = "plant_parameters.wall.rpy=[0, 0.0042, 0.00315]"
    chosen = scenario("peg_in_hole", PEG, tilted)
    loop, context = build_scenario(chosen)
    found = roll_scenario(chosen, loop, context)
    assert found.failure is None
    last = loop.changes(found.context)[-1]
    assert (last.phase, last.reason) == ("done", "after a depth of 0.015 m")
    record = found.record
    # It slides through the chamfer, and then along the side or at the rim.
    assert 0.1 < record["hole_force"].max() < 1.0
    assert {"wall.chamfer"} < {name for event in record.events for name in event.contacts}
    inside = record["gap"][:, 0] < -0.002
    assert record["hole_gap"][inside][:, 1:].min() > -1e-9
    assert 0.0 < record["hole_gap"][inside][:, 1:].max() <= 1e-4 + 1e-9
