"""The tasks of `examples/arms` on a UR5, a Panda and pairs of them, by rollouts."""

import numpy as np
import pytest
from found_places import found_off
from programs import loaded
from pydrake.math import RollPitchYaw

from drake_dae import followed_lines, load_scenario
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import for_rollout, roll_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario

pytestmark = [
    pytest.mark.slow,
    pytest.mark.thorough,
    pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning"),
]


@pytest.fixture(scope="module")
def example():
    with loaded("arms") as module:
        if not module.DATA.exists():
            pytest.skip("pip install example-robot-data")
        yield module


def rolled(example, run, *settings):
    """The loop, the rollout and the changes of phase of a run."""
    file = find_scenario(run.split("-")[0])
    chosen, _ = for_rollout(load_scenario(file, [*example.settings(run), *settings]))
    completed, loop = build_completed(chosen)
    found = roll_scenario(completed.scenario, loop, start_scenario(completed.scenario, loop))
    return loop, found, loop.changes(found.context)


@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_inserts_the_peg_with_no_more_force_than_predicted(arm, example):
    run = f"peg_in_hole-{arm}"
    with loaded("insertions") as insertions:
        peaks = insertions.predicted("peg_in_hole", example.settings(run))
    _, found, changes = rolled(example, run)
    assert found.failure is None
    assert (changes[-1].phase, changes[-1].reason) == ("done", "after a depth of 0.015 m")
    forces = np.linalg.norm(found.record["contact_force"], axis=1)
    assert 1.0 < forces.max() < max(peaks.values())


@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_inserts_the_peg_in_ideal_contact_into_a_hole_that_is_half_a_degree_off(
    arm, example
):
    peg = "plant=!IdealConstraints {pegs: [{constraint: wall, radius: 0.00495, length: 0.02}]}"
    tilted = "plant_parameters.wall.rpy=[0.007, 0.00525, 0]"
    _, found, changes = rolled(example, f"peg_in_hole-{arm}", peg, tilted)
    assert found.failure is None
    assert (changes[-1].phase, changes[-1].reason) == ("done", "after a depth of 0.015 m")
    assert found.record["hole_force"].max() < 15.0


def test_pegs_that_are_too_thick_are_counted_as_not_inserted(example, capsys):
    """The command of many pegs is that of `examples/insertions`, with the settings of the arm."""
    thick = "plant.pegs.0.radius=0.0051"
    assert example.main(["peg_in_hole-ur5", "--pegs", "1", "--set", thick]) == 1
    assert "0 of 1 inserted" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        example.main(["flat_press-ur5", "--pegs", "1"])
    assert "no run 'flat_press-ur5'" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        example.main(["peg_in_hole-ur5", "--pegs", "0"])
    assert "--pegs is their number, 1 or more, got 0" in capsys.readouterr().err


IDEAL = "plant=!IdealConstraints {}"


@pytest.mark.parametrize("settings", [[], pytest.param([IDEAL], marks=pytest.mark.thorough)])
@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_finds_two_edges_of_a_plate_that_is_4_mm_off(arm, settings, example):
    """Beyond the edge by the path in `patience`, 0.05 s at 30 mm/s, and less than 1.5 mm more."""
    _, found, changes = rolled(example, f"edge_search-{arm}", *settings)
    assert found.failure is None
    assert changes[-1].phase == "done"
    record, edges = found.record, {0: 0.454 + 0.05, 1: -0.004 + 0.04}
    searches = [i for i, change in enumerate(changes) if change.phase in ("side", "top")]
    for axis, index in enumerate(searches):
        row = np.searchsorted(record.time, changes[index + 1].time)
        place = record["controlled_output"][row, axis]
        assert edges[axis] < place < edges[axis] + 3e-3


@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_finds_the_line_of_an_edge_that_is_6_mm_off(arm, example):
    """The law has the planes turned by 0.0175 rad about the edge: 3 mm and 4 mm times that."""
    loop, found, changes = rolled(example, f"edge_follow-{arm}")
    assert found.failure is None
    assert changes[-1].phase == "done"
    (line,) = followed_lines(loop, found.record, found.context)
    turned = RollPitchYaw(0.0175, -0.0175, -0.035).ToRotationMatrix()
    edge = turned @ [1.0, 0.0, 0.0]
    place = np.array([0.447, 0.07, 0.197]) + turned @ [0.0, -0.05, 0.0]
    assert np.linalg.norm(np.cross(line.point - place, edge)) < 0.0175 * np.hypot(0.003, 0.004)
    assert np.linalg.norm(np.cross(line.direction, edge)) < 1e-4


@pytest.mark.parametrize(
    ("plant", "most"),
    [
        (["plant=!CompliantContact {friction: 0.3, radius: 0.01}"], 1e-4),
        (["plant=!IdealConstraints {}", "plant_parameters.part.friction=0.3"], 2e-5),
    ],
    ids=["springs", "ideal"],
)
@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_finds_and_polishes_a_part_that_is_5_mm_and_5_degrees_off(
    arm, plant, most, example
):
    """On springs, since a rollout has no hydroelastic contact, and in ideal contact.

    Within 0.1 mm under the tool at each time, and 0.1 mm rms along the whole way: 0.06 mm with the
    Panda, whose tool is 4 degrees beside the normal in its nominal posture, so that a ball of 10 mm
    is 0.03 mm off the surface. A rigid point has no such ball: twice the 0.01 mm of the Panda.
    """
    loop, found, changes = rolled(example, f"polish_unknown_part-{arm}", *plant)
    assert found.failure is None
    assert changes[-1].phase == "done"
    record, times = found.record, {change.phase: change.time for change in changes}
    chosen = load_scenario(
        find_scenario("polish_unknown_part"), example.settings(f"polish_unknown_part-{arm}")
    )
    polish = (record.time > times["polish"]) & (record.time < times["Release"])
    rows = np.flatnonzero(polish)[::50]
    errors = [found_off(chosen, loop, record, np.array([row]), row)[0] for row in rows]
    assert np.abs(found_off(chosen, loop, record, rows, 0)).max() > 5e-3
    assert np.abs(errors).max() < 1e-4
    way = [found_off(chosen, loop, record, rows, row) for row in rows]
    assert np.sqrt(np.mean(np.square(way))) < most
    names = [signal.name for signal in record.signals["tracking_error"].signals]
    late = record.time[polish] > times["polish"] + 1.0  # After the transition.
    force = record["tracking_error"][polish][late, names.index("part.force")]
    assert np.sqrt(np.mean(force**2)) < 0.05


@pytest.mark.parametrize("settings", [(), ("plant=!IdealConstraints {}",)], ids=["drake", "ideal"])
@pytest.mark.parametrize("arm", ["ur5", "panda"])
def test_each_arm_presses_flat_on_a_table_that_is_tilted_by_a_degree(arm, settings, example):
    """The center of pressure is 6 mm off the middle: within 0.5 mm of its path, 0.3 at its end.

    While the face slides to and fro it is up to 5 mm off, where 15 mm are the edge.
    """
    _, found, changes = rolled(example, f"flat_press-{arm}", *settings)
    assert found.failure is None
    assert changes[-1].phase == "done"
    record = found.record
    names = [signal.name for signal in record.signals["tracking_error"].signals]
    force, *moments = (names.index(f"face.{name}") for name in ("force", "mx", "my"))
    errors = record["tracking_error"]
    off = np.linalg.norm(errors[:, moments], axis=1) / 30.0

    def during(begin, end):
        return (record.time > begin) & (record.time < end)

    rows = during(changes[4].time + 1.5, changes[5].time)
    assert np.abs(errors[rows, force]).max() < 0.05
    assert off[rows].max() < 5e-4
    assert off[rows][-1] < 3e-4
    assert changes[5].phase == "Move 3"
    slides = during(changes[5].time, changes[6].time)
    forces = record["constraint_force"][slides]
    assert 1e-4 < off[slides].max() < 5e-3
    assert (1.0 - 3.0 * forces.min(1) / forces.sum(1)).max() < 0.6
