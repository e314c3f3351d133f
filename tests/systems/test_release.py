"""A release ends, whatever force the law does not know."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from polishing import push, run_on, started, task_loop
from runs import some

from drake_dae import Approach, Press, Release
from drake_dae.systems.phases import Moment

RELEASE = Release(over=0.2, within=8.0, on_success="hold")


@pytest.mark.slow
@pytest.mark.parametrize("unknown", some([0.0, 2.0]))
def test_a_release_ends_against_a_force_that_the_law_does_not_know(unknown):
    """A hand pushes with F into the wall: its force is r + F, and 0.5 N ends the phase.

    The push along the normal moves no other output, so the wall's force is off by F, but for what
    moves the wall by 5e-6 m/N: 0.05 N.
    """
    loop = task_loop([Approach(0.05, over=0.1), Press(10.0, tolerance=3.0, over=0.1), RELEASE])
    context = started(loop, 0.005)
    push(loop, context, unknown)
    run_on(loop, context, 9.0)
    changes = loop.changes(loop.record(context))
    assert [change.phase for change in changes][-2:] == ["Release", "held"]
    assert not changes[-1].failed
    lasted = changes[-1].time - changes[-2].time
    if not unknown:
        assert lasted < 0.2
        return
    goal = RELEASE.goals("wall.force")["wall.force"].derivatives([0])
    assert_allclose(goal(lasted)[0], 0.5 - unknown, atol=0.05)


def test_the_reference_of_a_release_is_zero_until_it_should_have_ended():
    goal = Release(over=0.3).goals("wall.force")["wall.force"].derivatives([0])
    assert_allclose([goal(time)[0] for time in np.linspace(0.0, 0.3, 7)], 0.0, atol=0.0)
    assert np.all(np.diff([goal(time)[0] for time in np.linspace(0.3, 60.0, 200)]) < 0.0)
    assert Release().success(Moment(9.0, 0.4, 0.0, 0.0, -4.0), 0.5) < 0.0
