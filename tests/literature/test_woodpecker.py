"""Glocker's woodpecker toy: impacts with friction, sticking and sliding, by two methods.

Its limit cycle takes longer: `python tests/support/woodpecker.py`, a part of `make campaign`,
prints it.
"""

import pytest
from woodpecker import by_hand, by_plant


@pytest.mark.slow
def test_a_woodpecker_strikes_as_an_integration_by_hand_says():
    """Where friction is smooth below v_s it creeps where it shall stick: the beak is 7e-4, 1.6e-4
    and 3e-5 s early for 1e-2, 1e-3 and 1e-4 m/s, as v_s^(2/3) says.
    """
    hits = by_hand(0.083)
    events, _ = by_plant(1e-3, 0.083)
    found = [event for event in events if event.impulses]
    assert [event.contacts for event in found] == [tuple(impulses) for _, impulses, _ in hits]
    assert [event.contacts for event in found] == [("lower",), ("upper",), ("beak",), ("upper",)]
    assert [e.time for e in found] == pytest.approx([t for t, *_ in hits], abs=2.5e-4)
    # The upper edge strikes softly, and at its speed of that moment.
    impulses = [impulse for _, by_name, _ in hits for impulse in by_name.values()]
    assert [e.impulses[0] for e in found] == pytest.approx(impulses, rel=0.1)
    assert found[0].time == pytest.approx(hits[0][0], abs=1e-8)
    assert found[0].impulses[0] == pytest.approx(impulses[0], rel=1e-3)
    assert all(event.energy_lost > 0.0 for event in found)
