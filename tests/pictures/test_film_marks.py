"""Friction cones, moments and events in the pictures of a film."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from pydrake.systems.analysis import SimulatorConfig
from runs import run, scenario

from drake_dae import build_scenario
from drake_dae.pictures.film_marks import FilmMarks, told
from drake_dae.pictures.moments import RunEvent, RunEventKind
from drake_dae.pictures.run_motion import follow

QUICK = SimulatorConfig(
    integration_scheme="runge_kutta3", max_step_size=0.01, use_error_control=False
)


@pytest.fixture(scope="module")
def course():
    """0.4 s of a tool on a wall with friction 0.4."""
    loop, context = build_scenario(scenario("two_link_wall", "constraints.0.friction=0.4"))
    return follow(loop, run(loop, context.Clone(), 0.4, QUICK), context, 10.0)


def flat(points):
    """Pixels of points, seen along y."""
    return 1000.0 * np.atleast_2d(points)[:, [0, 2]]


def test_a_cone_holds_the_forces_that_friction_allows(course):
    marks = FilmMarks(course, flat, 0.5)
    normal = np.array([-1.0, 0.0, 0.0])
    tip, *rim = marks.cone(np.array([1.2, 0.0, 0.5]), normal, 0.4)
    np.testing.assert_allclose(tip, [1.2, 0.0, 0.5])
    # A force along a line from the rim to the tip is at the edge: |F_t| = mu F_n.
    for force in tip - np.array(rim):
        assert np.linalg.norm(force) == pytest.approx(0.25)
        assert np.linalg.norm(force - (force @ normal) * normal) == pytest.approx(
            0.4 * (force @ normal)
        )
    # The coefficient is that of the plant.
    assert marks.scale == "cone 0.4"


def test_moments_have_a_scale_and_negligible_ones_none(course):
    turned = [
        SimpleNamespace(points=w.points, forces=w.forces, moments=np.array([[0.0, 0.0, m]]))
        for w, m in zip(course.wrenches, [0.5, -2.0, 1.0, 0.0, 0.0], strict=True)
    ]
    fields = ("friction", "acting", "normals", "times", "start_time")
    own = SimpleNamespace(wrenches=turned, **{name: getattr(course, name) for name in fields})
    marks = FilmMarks(own, flat, 0.5)
    assert marks.scale == "longest moment 2 N m, cone 0.4"
    tail, second, head = marks.moment(np.zeros(3), np.array([0.0, 0.0, -2.0]))
    np.testing.assert_allclose(tail, [0.0, 0.0, 0.3])
    assert tail[2] > second[2] > head[2] == 0.0
    for one in turned:
        one.moments[:] *= 1e-9
    assert FilmMarks(own, flat, 0.5).scale == "cone 0.4"


def test_events_and_phases_stand_on_the_time_of_the_run(course):
    events = [RunEvent(0.1, RunEventKind.TOUCH, "wall: touch")]
    marks = FilmMarks(course, flat, 0.5, events, [0.0, 0.2])
    said = []
    for number in range(5):
        axis = Figure().add_axes((0, 0, 1, 1))
        said.append(marks.draw(axis, number, 480.0, 400.0))
        lines = [line.get_xydata() for line in axis.lines]
        whole, passed, *phases, event = lines
        share = (passed[1, 0] - whole[0, 0]) / (whole[1, 0] - whole[0, 0])
        assert share == pytest.approx(number / 4)
        assert event[0, 0] == pytest.approx(12.0 + 456.0 * 0.1 / 0.4)
        np.testing.assert_allclose([line[0, 0] for line in phases], [12.0, 240.0])
        # One cone while there is a force.
        assert len(axis.patches) == 1
    assert said == ["", *["wall: touch"] * 4]


def test_contacts_that_touch_together_are_told_together():
    """The last two kinds, the latest at the end; each contact once."""

    def event(time, kind, names):
        return RunEvent(time, kind, f"{names}: {kind.label}")

    hits = [event(0.1 * k, RunEventKind.TOUCH, f"pad{1 + k % 3}, pad2") for k in range(5)]
    opens = event(0.6, RunEventKind.OPENING, "pad1")
    limit = RunEvent(0.05, RunEventKind.LIMIT, "joint1 is at its limit")
    assert told(hits) == "pad1, pad2, pad3: touch"
    assert told([limit, *hits]) == "joint1 is at its limit; pad1, pad2, pad3: touch"
    assert told([limit, *hits, opens]) == "pad1, pad2, pad3: touch; pad1: contact opens"
    assert told([opens, hits[0]]) == "pad1: contact opens; pad1, pad2: touch"
    assert told([]) == ""
