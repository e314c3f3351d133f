"""Which contacts push: complementarity by its own conditions, and what impacts do to energy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import some
from scipy.optimize import brentq

from drake_dae.systems.plants.unilateral.frictional import FrictionalContact, impact
from drake_dae.systems.plants.unilateral.impacts import (
    TouchRows,
    complementary,
    is_p_matrix,
    rows_of,
    stopping,
)


def rows(*numbers):
    return np.array(numbers, dtype=int)


TOUCHES = [TouchRows(i, rows(i)) for i in range(1, 5)]


@pytest.mark.parametrize("seed", range(20))
def test_what_fits_is_complementary(seed):
    """Row 0 is kept, the others are contacts."""
    random = np.random.default_rng(seed)
    root, b = random.standard_normal((5, 7)), random.standard_normal(5)
    A = root @ root.T
    fit = complementary(A, b, rows(0), TOUCHES)
    w = A @ fit.values + b
    assert abs(w[0]) < 1e-10
    for place, touch in enumerate(TOUCHES):
        if place in fit.pushing:
            assert fit.values[touch.normal] > 0.0
            assert_allclose(w[touch.rows], 0.0, atol=1e-10)
        else:
            assert w[touch.normal] > 0.0
            assert_allclose(fit.values[touch.rows], 0.0, atol=0.0)


@pytest.mark.parametrize("seed", range(10))
def test_which_contacts_push_does_not_depend_on_units(seed):
    """Rows in other units: A_ij s_i s_j and b_i s_i have y_i / s_i."""
    random = np.random.default_rng(seed)
    root, b = random.standard_normal((5, 7)), random.standard_normal(5)
    A, s = root @ root.T, 10.0 ** random.uniform(-12.0, 12.0, 5)
    fit = complementary(A, b, rows(0), TOUCHES)
    other = complementary(A * s * s[:, None], b * s, rows(0), TOUCHES)
    assert other.pushing == fit.pushing
    assert_allclose(other.values * s, fit.values, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_a_contact_that_would_pull_opens_in_any_units(scale):
    """Held, row 0 would keep both closed, with y_0 = -1: so it opens, and row 1 has y_1 = 1/2."""
    A, b, s = np.array([[1.0, -0.9], [-0.9, 1.0]]), np.array([1.0, -0.5]), np.array([scale, 1.0])
    touches = [TouchRows(0, rows(0)), TouchRows(1, rows(1))]
    fit = complementary(A * s * s[:, None], b * s, rows(), touches)
    assert fit.pushing == (1,)
    assert_allclose(fit.values, [0.0, 0.5], rtol=1e-14)


@pytest.mark.parametrize("seed", range(20))
def test_an_impact_gains_no_energy_and_pierces_nothing(seed):
    """c+ = c- + A Lambda with coefficients of restitution of each contact; it changes by
    Lambda . (c- + c+) / 2. Four contacts of three freedoms depend on each other."""
    random = np.random.default_rng(seed)
    J = np.column_stack([np.ones(4), random.uniform(-1.0, 1.0, (4, 2))])
    before = J @ np.array([-1.0, *random.uniform(-0.5, 0.5, 2)])
    e = random.uniform(0.0, 1.0, 4)
    fit = complementary(
        J @ J.T, (1.0 + e) * before, rows(), [TouchRows(i, rows(i)) for i in range(4)]
    )
    after = before + J @ J.T @ fit.values
    assert np.all(after >= -1e-10)
    assert fit.values @ (before + after) <= 1e-12


def test_of_a_table_with_four_feet_two_carry_it_and_it_comes_to_rest():
    """A body on feet at (+-1, +-1): any three normals are independent, all four are not."""
    feet = np.array([[1.0, x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    A = feet @ feet.T
    touches = [TouchRows(i, rows(i)) for i in range(4)]
    fit = complementary(A, np.full(4, -1.0), rows(), touches)
    assert_allclose(A @ fit.values, 1.0, rtol=1e-14)
    assert len(fit.pushing) == 2
    assert rows_of(A, rows(), touches) is None
    assert rows_of(A, rows(), touches[:3]).tolist() == [0, 1, 2]
    # Two feet that stick need one of their tangential rows.
    J = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    pair = [TouchRows(0, rows(0, 1)), TouchRows(2, rows(2, 3))]
    assert rows_of(J @ J.T, rows(), pair).tolist() == [0, 2, 1]
    stopped = stopping(J @ J.T, np.array([-1.0, 0.3, -1.0, 0.3]), rows(0, 1, 2, 3))
    assert_allclose(J @ J.T @ stopped, [1.0, -0.3, 1.0, -0.3], atol=1e-14)


def test_friction_may_leave_none_or_two():
    turned, smooth = np.diag([-1.0, 2.0]), np.diag([1.0, 2.0])
    assert is_p_matrix(smooth, smooth, [0, 1])
    assert not is_p_matrix(turned, smooth, [0, 1])
    assert complementary(turned, np.array([-1.0, 1.0]), rows(), TOUCHES[:0]) is not None
    touches = [TouchRows(0, rows(0)), TouchRows(1, rows(1))]
    assert complementary(turned, np.array([-1.0, 1.0]), rows(), touches) is None


def rubbing_bodies(seed, tangents, count=2):
    """A random body of 6 freedoms with some contacts and one kept row; rates along them.

    With two tangents two contacts and the kept row depend on each other, so that they can wedge it.
    """
    random = np.random.default_rng(seed)
    J = random.standard_normal((1 + count * (1 + tangents), 6))
    root = random.standard_normal((6, 6))
    velocity = random.standard_normal(6)
    velocity -= J[0] * (J[0] @ velocity) / (J[0] @ J[0])
    contacts = []
    for start in range(1, len(J), 1 + tangents):
        J[start] *= -np.sign(J[start] @ velocity)
        along = np.arange(start + 1, start + 1 + tangents)
        contacts.append(
            FrictionalContact(start, along, random.uniform(0.0, 1.0), random.uniform(0.0, 1.0))
        )
    return J @ np.linalg.inv(root @ root.T + 0.5 * np.eye(6)) @ J.T, J @ velocity, contacts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tangents", "count", "seeds"),
    some([(1, 1, 40), (1, 2, 40), (1, 3, 20), (2, 1, 40), (2, 2, 20), (2, 3, 10)], first=1),
)
def test_impacts_with_friction_are_in_their_cones_and_gain_no_energy(tangents, count, seeds):
    """By the conditions themselves; some bodies bounce less, as Kane says."""
    seen, less = set(), 0
    for seed in range(seeds):
        A, before, contacts = rubbing_bodies(seed, tangents, count)
        impulses = impact(A, before, rows(0), contacts)
        after, size = before + A @ impulses, np.abs(before).max()
        assert impulses @ (before + after) <= 1e-12 * size**2
        assert abs(after[0]) < 1e-11 * size
        factors, opened = [], []
        for one in contacts:
            push, along = impulses[one.normal], impulses[one.along]
            if push == 0.0:
                assert not along.any()
                opened.append((after[one.normal], one.restitution * before[one.normal]))
                seen.add("open")
                continue
            assert push > 0.0
            factors.append(-after[one.normal] / before[one.normal] / one.restitution)
            slip, most = after[one.along], one.friction * push
            if np.linalg.norm(slip) < 1e-10 * size:
                assert np.linalg.norm(along) <= most * (1.0 + 1e-10)
                seen.add("stick")
            else:
                assert_allclose(along, -most * slip / np.linalg.norm(slip), atol=1e-9 * size)
                seen.add("slip")
        # Newton's law: all bounce as they shall, or all by one factor less.
        assert_allclose(factors, np.max(factors, initial=0.0), atol=1e-8)
        assert all(rate + factors[0] * bounce >= -1e-8 * size for rate, bounce in opened)
        assert np.max(factors, initial=0.0) <= 1.0 + 1e-9
        less += bool(factors) and factors[0] < 1.0 - 1e-6
    assert seen == {"open", "stick", "slip"} if count > 1 else {"stick", "slip"}
    assert less > 0 or count == 1


@pytest.mark.slow
def test_contacts_of_a_mechanism_of_one_freedom_find_impulses():
    """Each moves along its own slope; impulses pierce nothing, and are in their friction cones."""
    for seed in range(6):
        random = np.random.default_rng(seed)
        J = random.standard_normal(4)
        J[::2] = -np.abs(J[::2])
        contacts = [
            FrictionalContact(i, rows(i + 1), random.uniform(0.0, 1.0), 0.5) for i in (0, 2)
        ]
        impulses = impact(np.outer(J, J), J, rows(), contacts)
        after = J * (1.0 + J @ impulses)
        assert impulses @ (J + after) <= 1e-12
        for one, push, along in zip(contacts, impulses[::2], impulses[1::2], strict=True):
            assert push >= 0.0
            assert abs(along) <= one.friction * push * (1.0 + 1e-10)
            assert after[one.normal] >= -1e-9


def test_a_box_that_lands_on_four_feet():
    """Twelve rows on six freedoms: impulses are in their cones, and obey Coulomb's law."""
    for seed in range(30):
        random = np.random.default_rng(seed)
        a, b, h = random.uniform(0.1, 1.0, 3)
        inertia = np.array([1.0, 1.0, 1.0, b * b + h * h, a * a + h * h, a * a + b * b])
        inertia[3:] /= 3.0
        mu, e = random.uniform(0.0, 1.0, 2)
        feet = [(x, y, -h) for x in (a, -a) for y in (b, -b)]
        # The velocity of a point is v + w x p, its height's first.
        J = np.vstack([np.hstack([np.eye(3), -np.cross(np.eye(3), p)])[[2, 0, 1]] for p in feet])
        velocity = random.standard_normal(6) * [1.0, 1.0, 1.0, 0.2, 0.2, 1.0]
        velocity[2] = -1.0 - abs(velocity[2])
        contacts = [FrictionalContact(3 * i, rows(3 * i + 1, 3 * i + 2), mu, e) for i in range(4)]
        A, before = J / inertia @ J.T, J @ velocity
        impulses = impact(A, before, rows(), contacts)
        after = before + A @ impulses
        assert impulses @ (before + after) <= 1e-12
        for push, slip, rise in zip(
            impulses.reshape(4, 3), after.reshape(4, 3), before[::3], strict=True
        ):
            assert push[0] >= 0.0
            assert np.linalg.norm(push[1:]) <= mu * push[0] + 1e-12
            assert slip[0] >= -e * max(rise, 0.0) - 1e-10
            # Friction acts against the slip, with all that the cone has.
            assert push[1:] @ slip[1:] == pytest.approx(
                -mu * push[0] * np.linalg.norm(slip[1:]), abs=1e-9
            )


@pytest.mark.slow
def test_a_wedged_body_bounces_less_or_not_at_all():
    """Between two walls with friction as it sinks in: no impulse moves it along, nor apart.

    A point between planes that lean by 10 degrees, mu = 1: each impulse of one is held by the
    other's, so that Newton's law of impact asks for rates that no impulse brings.
    """
    lean = np.radians(10.0)
    rises = np.array([[np.sin(lean), np.cos(lean)], [np.sin(lean), -np.cos(lean)]])
    ways = np.array([[np.cos(lean), -np.sin(lean)], [np.cos(lean), np.sin(lean)]])
    J = np.array([rises[0], ways[0], rises[1], ways[1]])
    before = J @ np.array([-1.0, 0.0])
    contacts = [FrictionalContact(0, rows(1), 1.0, 0.5), FrictionalContact(2, rows(3), 1.0, 0.5)]
    impulses = impact(J @ J.T, before, rows(), contacts)
    assert_allclose(before + J @ J.T @ impulses, 0.0, atol=1e-9)


def test_one_contact_in_space_always_finds_its_impulse():
    """Masses differ by up to 1e4, so that directions of sliding lie close to each other."""
    random, slid = np.random.default_rng(0), 0
    for _ in range(300):
        J = random.standard_normal((3, 5)) * 10.0 ** random.uniform(-1.0, 1.0, (3, 1))
        A = J * 10.0 ** random.uniform(-2.0, 2.0, 5) @ J.T
        before, mu = J @ random.standard_normal(5), random.choice([0.1, 0.5, 1.0, 3.0])
        before[0] = -abs(before[0])
        impulses = impact(A, before, rows(), [FrictionalContact(0, rows(1, 2), mu, 0.0)])
        assert impulses is not None
        after, most = before + A @ impulses, mu * impulses[0]
        assert abs(after[0]) < 1e-10 * np.abs(before).max()
        if np.linalg.norm(impulses[1:]) < most * (1.0 - 1e-10):
            assert_allclose(after, 0.0, atol=1e-8 * np.abs(before).max())
            continue
        slid += 1
        way = after[1:] / np.linalg.norm(after[1:])
        assert_allclose(impulses[1:], -most * way, atol=1e-6 * most)
    assert slid > 100


@pytest.mark.parametrize(
    ("entries", "before", "mu"),
    [
        ([47.428, 4.333, 29.59, 5.253, 7.049, 22.429], [-0.134, 1.425, 1.425], 1.74),
        ([33.125, 37.055, -18.584, 43.27, -26.511, 34.743], [-0.321, 0.139, -1.104], 0.72),
        ([8.066, -0.874, -5.023, 3.117, -2.38, 5.996], [-0.683, 2.021, -1.613], 1.37),
        ([10.3, -10.249, -1.429, 10.297, 1.461, 0.615], [-0.795, -1.186, -1.269], 0.99),
    ],
)
def test_of_several_directions_of_sliding_it_is_that_which_goes_on_most_as_it_came(
    entries, before, mu
):
    """All of them by a fine grid of angles: where what is across a direction changes its sign."""
    A, before = np.zeros((3, 3)), np.array(before)
    A[np.triu_indices(3)] = entries
    A += np.triu(A, 1).T

    def slid(angle):
        way = np.array([np.cos(angle), np.sin(angle)])
        push = np.array([1.0, *(-mu * way)])
        impulses = push * -before[0] / (A[0] @ push)
        return impulses, (before + A @ impulses)[1:], way

    def across(angle):
        _, after, way = slid(angle)
        return way[0] * after[1] - way[1] * after[0]

    angles = np.linspace(0.0, 2.0 * np.pi, 2001)
    values = [across(angle) for angle in angles]
    crossings = np.flatnonzero(np.diff(np.sign(values)))
    found = []
    for k in crossings.tolist():
        impulses, after, way = slid(brentq(across, angles[k], angles[k + 1], xtol=1e-13))
        # Where no impulse would do the sign changes at a pole.
        if 0.0 < impulses[0] < 1e6 and after @ way >= 0.0:
            found.append((before[1:] @ after, impulses))
    assert len(found) == 3
    _, wanted = max(found, key=lambda one: one[0])
    impulses = impact(A, before, rows(), [FrictionalContact(0, rows(1, 2), mu, 0.0)])
    # Directions lie as close as 1e-3 to each other, and zeros are good to 1e-13.
    assert_allclose(impulses, wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.parametrize("bounce", [0.0, 0.5])
@pytest.mark.parametrize("slope", [0.2, -3.0, 3.0])
def test_a_lever_of_one_freedom_with_friction(slope, bounce):
    """Its tip moves along (1, slope) alone; with slope > 1 / mu sliding on would lock it.

    At rest it may be held by many pairs of impulses, each with the same sum: the motion is one.
    """
    mu, J = 0.5, np.array([1.0, slope])
    A, before = np.outer(J, J), -2.0 * J
    impulses = impact(A, before, rows(), [FrictionalContact(0, rows(1), mu, bounce)])
    after = before + A @ impulses
    assert impulses[0] > 0.0
    assert abs(impulses[1]) <= mu * impulses[0] * (1.0 + 1e-12)
    # Leaving, the tip slides along slope, where its friction is -mu sign(slope).
    locks = 1.0 - mu * abs(slope) <= 0.0
    assert_allclose(after, 0.0 if locks else 2.0 * bounce * J, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tangents", [1, 2])
def test_of_equally_sticking_impulses_those_with_least_friction_are_taken(tangents, seed):
    """One freedom less than rows: Lambda + s n sticks alike for each s, where J^T n = 0."""
    random = np.random.default_rng(seed)
    J = random.standard_normal((1 + tangents, tangents))
    n = np.linalg.svd(J.T)[2][-1]
    # By impulses that push more than the friction, so that they are in the cone.
    given = np.array([3.0, *random.uniform(-1.0, 1.0, tangents)])
    before = -J @ J.T @ given
    if before[0] > 0.0:
        J[0], n[0] = -J[0], -n[0]
        before = -J @ J.T @ given
    along = np.arange(1, 1 + tangents)
    impulses = impact(J @ J.T, before, rows(), [FrictionalContact(0, along, 10.0, 0.0)])
    assert_allclose(before + J @ J.T @ impulses, 0.0, atol=1e-12 * np.abs(before).max())
    best = given - n * (n[1:] @ given[1:]) / (n[1:] @ n[1:])
    if best[0] > 0.0 and np.linalg.norm(best[1:]) < 10.0 * best[0]:
        assert_allclose(impulses, best, rtol=1e-9, atol=1e-10)


def test_a_block_that_lands_on_one_foot_sticks_or_slides():
    """A point mass: A is 1 / m. It sticks where |c_t| <= mu |c_n|, else it slows down."""
    contact = [FrictionalContact(0, rows(1, 2), 0.5, 0.0)]
    A = np.eye(3) / 2.0
    sticks = impact(A, np.array([-1.0, 0.3, 0.3]), rows(), contact)
    assert_allclose(A @ sticks, [1.0, -0.3, -0.3], atol=1e-14)
    slides = impact(A, np.array([-1.0, 3.0, 4.0]), rows(), contact)
    assert_allclose(slides, [2.0, -0.6, -0.8], atol=1e-12)
