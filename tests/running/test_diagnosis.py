"""Ends of runs say their cause: singular states, paths out of reach, wires."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from runs import scenario

from drake_dae import DaePlant, DaeSystem, simulate
from drake_dae.errors import SimulationError, SingularityError
from drake_dae.scenario.build import build_scenario, roll_scenario

REACH = "references.tool.z=!PointToPoint {start: [0.3], end: [3], end_time: 3}"
"""Two links of 1 m reach z = 1.6 m on the wall at x = 1.2 m."""


def failed(case):
    loop, context = build_scenario(case)
    with pytest.raises(SimulationError) as caught:
        simulate(loop.diagram, context, case.duration, case.integrator)
    # It ends where steps become ever shorter, and not after thousands of them.
    times = loop.record(context).time
    assert times.size < 600
    assert np.diff(times).min() > 1e-10
    return caught.value


@pytest.mark.parametrize("rolls", [False, True])
def test_a_path_that_leaves_the_reach_is_said_so(rolls):
    """10 s^3 - 15 s^4 + 6 s^5 = 1.3 / 2.7 at s = 0.49, and there the arm is stretched."""
    case = scenario("two_link_wall", REACH, "start.errors={}", "compiled=false")
    error = roll_scenario(case, *build_scenario(case)).failure if rolls else failed(case)
    assert isinstance(error, SingularityError)
    assert error.time == pytest.approx(1.4702, abs=1e-3)
    assert error.constraints == ("wall.distance",)
    for name in ("t = 1.470", "B(x)", "tool.z"):
        assert name in str(error)


def test_a_dead_point_is_a_singularity_with_its_constraint():
    """The slider of crank 0.2 m and rod 0.4 m comes to 0.6 m; the pin then holds it."""
    case = scenario(
        "slider_crank",
        "outputs=[!JointPositions {joints: [slider]}]",
        "references={slider: !PointToPoint {start: [0.4], end: [0.9], end_time: 2}}",
        "start.errors={}",
        "compiled=false",
    )
    error = failed(case)
    assert isinstance(error, SingularityError)
    assert error.constraints == ("pin.x",)
    assert "slider" in str(error)


def test_a_port_without_a_wire_is_named():
    system = DaeSystem.from_functions(["a"], f=lambda x: [0], h=lambda x: [1], name="still")
    builder = DiagramBuilder()
    builder.AddSystem(DaePlant(system))
    diagram = builder.Build()
    with pytest.raises(SimulationError, match=r"\(control\) of System ::\S*still"):
        simulate(diagram, diagram.CreateDefaultContext(), 1.0)
