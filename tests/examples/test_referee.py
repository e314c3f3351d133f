"""The referee of `tests/benchmarks`: its values by other routes, and drake_dae beside them."""

import importlib

import numpy as np
import pytest
from mpmath import mp, mpf
from numpy.testing import assert_allclose
from referee.compare import compare_state, find_engines, state_of, table, wanted_forces
from referee.derive import exact, frames, rows_of, state
from referee.description import force_names
from referee.engines import ours
from referee.reference import STATES, lines_of, load
from referee.spatial import MECHANISMS
from runs import some

WIDE = ("two_arms", "humanoid")
"""Those that take more than half a second to build."""

EACH = [pytest.param(name, marks=pytest.mark.slow if name in WIDE else ()) for name in MECHANISMS]


@pytest.fixture(scope="module")
def stated():
    return load(STATES)


@pytest.mark.parametrize("name", [name for name in MECHANISMS if name not in WIDE])
def test_the_values_are_those_that_are_derived_now(name, stated):
    """All 40 digits but the last."""
    mechanism = MECHANISMS[name]
    for _, key, value in lines_of(mechanism, state(mechanism)):
        assert mpf(value) == pytest.approx(mpf(stated[name][key]), rel=1e-38, abs=1e-44), key


@pytest.mark.parametrize("name", some(EACH))
def test_drake_dae_has_twelve_digits_of_all_forces(name, stated):
    assert compare_state(ours, MECHANISMS[name], stated) >= 12


def test_a_pendulum_is_held_as_in_a_textbook(stated):
    """A uniform rod at the angle a: m w^2 l / 2 inward and its weight, 3/4 of it accelerated."""
    own = {key: mpf(value) for key, value in stated["pendulum"].items()}
    c, s, m, g, half = mp.cos(own["q2"]), mp.sin(own["q2"]), mpf("1.3"), mpf("9.81"), mpf("0.4")
    # The moment of inertia in the description is rounded to six decimals.
    about = m * half**2 + mpf("0.069333")
    turning = -m * g * half * c / about
    inward, across = m * half * own["v2"] ** 2, m * half * turning
    assert own["pivot.fx"] == pytest.approx(-inward * c - across * s, rel=1e-38)
    assert own["pivot.fy"] == pytest.approx(-inward * s + across * c + m * g, rel=1e-38)


@pytest.mark.parametrize("name", ["two_rods", "top", "sliding_rod", "table"])
def test_the_world_pushes_as_much_as_momentum_changes(name):
    """sum f = sum m (a - g) where bodies touch the world through closures alone: by Newton."""
    mechanism = MECHANISMS[name]
    found = state(mechanism)
    bodies = frames(mechanism, found.q, found.v)
    needed = exact((0.0, 0.0, 0.0))
    for body in mechanism.bodies:
        frame = bodies[body.name]
        place, _, acceleration = frame.point(exact(body.center))
        _, C = frame.columns(place, mechanism.size)
        rate = acceleration + found.acceleration @ C - exact(mechanism.gravity)
        needed = needed + rate * mpf(repr(body.mass))
    pushed = dict.fromkeys("xyz", mpf(0))
    for closure in mechanism.closures:
        if closure.body_a == "world":
            for key in force_names(closure):
                pushed[key[-1]] += found.forces[key]
    for axis, force in zip("xyz", needed, strict=True):
        assert abs(pushed[axis] - force) < mpf(10) ** -45


@pytest.mark.parametrize("name", ["table", "bricard"])
def test_redundant_forces_are_the_least_of_all_with_their_sum(name, stated):
    """They have no part that does not act: G f = 0 has only solutions across to them."""
    mechanism = MECHANISMS[name]
    q, v = state_of(mechanism, stated)
    bodies = frames(mechanism, exact(q), exact(v))
    closures = mechanism.closures
    rows = [row for c in closures for row in rows_of(mechanism, c, bodies, exact(q))]
    J = np.array([[float(g) for g in row.gradient] for row in rows])
    _, sizes, axes = np.linalg.svd(J.T)
    idle = axes[np.sum(sizes > 1e-10) :]
    assert len(idle) == 1
    values = wanted_forces(mechanism, stated)
    if name == "table":
        values = values[2::3]
    else:
        # Its moments about the axes of body A that are held.
        axes = bodies[closures[0].body_a].rotation.T.astype(float)
        held = axes[np.array(closures[0].direction) == 0.0]
        values = np.concatenate([held @ values[:3], values[3:]])
    assert_allclose(idle @ values, 0.0, atol=1e-10 * np.abs(values).max())


def test_an_engine_that_is_missing_is_one_sentence(monkeypatch):
    real = importlib.import_module

    def absent(name):
        if name.endswith("pinocchio_engine"):
            raise ImportError("No module named 'pinocchio'")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    engines, missing = find_engines(("ours", "pinocchio_engine"))
    assert engines == [ours]
    assert missing == ["pinocchio_engine: left out, since No module named 'pinocchio'."]
    text = table("mechanism", [ours.NAME], {"pendulum": {ours.NAME: "it cannot"}})
    assert "| pendulum | - |" in text
    assert "- drake_dae, pendulum: it cannot." in text
