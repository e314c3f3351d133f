"""Glocker's woodpecker toy: a bird on a spring at a sleeve that rattles down a pole.

Coordinates are the height y of the sleeve and the angles of sleeve and bird, small, so that all is
linear but contact. Numbers and model: Glocker, Dynamik von Starrkoerpersystemen mit Reibung und
Stoessen (1995); Leine, van Campen and Glocker, J. Vibration and Control 9 (2003).
"""

from itertools import product

import casadi as ca
import numpy as np
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from scipy.integrate import solve_ivp

from drake_dae import LinkExpressions, Plane, PointOnSurface, RobotModel, UnilateralRobotPlant

SLEEVE, BIRD = (3e-4, 5e-9), (4.5e-3, 7e-7)  # Masses in kg, moments of inertia in kg m^2.
SPRING, GRAVITY = 0.0056, 9.81
POLE, RADIUS, HALF_HEIGHT = 2.5e-3, 3.1e-3, 5.8e-3
TO_SPRING, TO_BIRD, TO_BEAK, BEAK = 0.010, 0.015, 0.0201, 0.02
FRICTION, BOUNCE = 0.3, 0.5

m, both = BIRD[0], TO_SPRING * TO_BIRD
MASS = np.array(
    [
        [m + SLEEVE[0], m * TO_SPRING, m * TO_BIRD],
        [m * TO_SPRING, SLEEVE[1] + m * TO_SPRING**2, m * both],
        [m * TO_BIRD, m * both, BIRD[1] + m * TO_BIRD**2],
    ]
)
STIFFNESS = SPRING * np.array([[0, 0, 0], [0, 1, -1], [0, -1, 1]])
WEIGHT = GRAVITY * MASS[0]

# Gaps and sliding of beak, lower and upper edge of the sleeve: phi = GAP + ACROSS q, v_t = ALONG v.
CONTACTS = ("beak", "lower", "upper")
GAP = np.array([TO_SPRING + TO_BIRD - TO_BEAK - POLE, RADIUS - POLE, RADIUS - POLE])
ACROSS = np.array([[0, 0, -BEAK], [0, HALF_HEIGHT, 0], [0, -HALF_HEIGHT, 0]])
ALONG = np.array([[1, TO_SPRING, TO_BIRD - TO_BEAK], [1, RADIUS, 0], [1, RADIUS, 0]])
RESTITUTION = np.array([BOUNCE, 0.0, 0.0])

START = np.array([0.0, -0.1034, -0.2788, -0.3411, 0.0, -7.4583])


def woodpecker(stiction_tolerance):
    """The toy, with friction that is smooth below a speed in m/s."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    places = [
        ca.vertcat(GAP[i] + ca.mtimes(ACROSS[[i]], q), 0, ca.mtimes(ALONG[[i]], q))
        for i in range(3)
    ]
    links = LinkExpressions(
        q,
        v,
        ca.SX(MASS),
        ca.mtimes(STIFFNESS, q) + WEIGHT,
        dict(zip(CONTACTS, places, strict=True)),
        actuation_matrix=np.zeros((3, 0)),
        default_positions=START[:3],
    )
    pole = Plane((0, 0, 0), (1, 0, 0))
    touching = [
        PointOnSurface(
            name, pole, name=name, friction=FRICTION, stiction_tolerance=stiction_tolerance
        )
        for name in CONTACTS
    ]
    model = RobotModel(links, touching, [], forces=[])
    return UnilateralRobotPlant(model, dict(zip(CONTACTS, RESTITUTION, strict=True)))


# By hand: friction that sticks, and events one after the other.

INVERSE = np.linalg.inv(MASS)


def moved_by(x, mode):
    """v' and (lambda, friction) in a mode: None, or a contact and the way it slides, 0 if none."""
    free = -STIFFNESS @ x[:3] - WEIGHT
    if mode is None:
        return INVERSE @ free, (1.0, 0.0)
    i, way = mode
    holds = np.vstack([ACROSS[i], ALONG[i]]) if way == 0 else ACROSS[[i]]
    push = holds.T if way == 0 else (ACROSS[i] - FRICTION * way * ALONG[i])[:, None]
    force = np.linalg.solve(holds @ INVERSE @ push, -holds @ INVERSE @ free)
    frictional = force[1] if way == 0 else -FRICTION * way * force[0]
    return INVERSE @ (free + push @ force), (force[0], frictional)


def struck(v, touching):
    """v and the impulses, normal and along, after an impact of touching contacts."""
    for ways in product((None, 0, 1, -1), repeat=len(touching)):
        pairs = [(i, way) for i, way in zip(touching, ways, strict=True) if way is not None]
        pushes, holds, wanted = [np.zeros((3, 0))], [np.zeros((0, 3))], [np.zeros(0)]
        for i, way in pairs:
            aside = -(ACROSS[i] @ v) * (1.0 + RESTITUTION[i])
            both, single = np.vstack([ACROSS[i], ALONG[i]]), ACROSS[[i]]
            holds.append(both if way == 0 else single)
            pushes.append(both.T if way == 0 else (ACROSS[i] - FRICTION * way * ALONG[i])[:, None])
            wanted.append([aside, -(ALONG[i] @ v)] if way == 0 else [aside])
        push, hold = np.hstack(pushes), np.vstack(holds)
        made = push @ np.linalg.solve(hold @ INVERSE @ push, np.concatenate(wanted))
        after = v + INVERSE @ made
        found, fits, at = {}, True, 0
        impulses = np.linalg.solve(hold @ INVERSE @ push, np.concatenate(wanted))
        for i, way in zip(touching, ways, strict=True):
            if way is None:
                fits &= ACROSS[i] @ after + RESTITUTION[i] * (ACROSS[i] @ v) >= -1e-12
                continue
            normal = impulses[at]
            if way == 0:
                fits &= abs(impulses[at + 1]) <= FRICTION * normal
            else:
                fits &= normal >= 0.0 and way * (ALONG[i] @ after) >= -1e-12
            at, found[i] = at + (2 if way == 0 else 1), normal
        if fits:
            return after, found
    raise AssertionError("no impulses fit")


def chosen(x, touching):
    """The mode that goes on from a state."""
    for i in touching:
        if i == 0 or abs(ACROSS[i] @ x[3:]) > 1e-9:
            continue
        slides = ALONG[i] @ x[3:]
        ways = (0, 1, -1) if abs(slides) < 1e-9 else (int(np.sign(slides)),)
        for way in ways:
            rate, (normal, frictional) = moved_by(x, (i, way))
            holds = abs(frictional) <= FRICTION * normal * (1.0 + 1e-9)
            starts = way == 0 or abs(slides) > 1e-9 or way * (ALONG[i] @ rate) >= 0.0
            if normal > 1e-9 and holds and starts:
                return i, way
    return None


def by_hand(end):
    """Impacts up to a time in s: (time, contact -> impulse, height)."""
    time, x, hits, mode = 0.0, START.copy(), [], None
    while time < end:
        began = time

        def rate(_, x, mode=mode):
            return np.concatenate([x[3:], moved_by(x, mode)[0]])

        def guards(t, x, mode=mode, began=began):
            gaps = GAP + ACROSS @ x[:3]
            rates = ACROSS @ x[3:]
            open_ = [
                g if t > began + 1e-7 or r < 0 else 1.0 for g, r in zip(gaps, rates, strict=True)
            ]
            if mode is None:
                return [*open_, 1.0, 1.0]
            i, way = mode
            open_[i] = 1.0
            normal, frictional = moved_by(x, mode)[1]
            edge = FRICTION * normal - abs(frictional) if way == 0 else way * (ALONG[i] @ x[3:])
            return [*open_, normal, edge if t > began + 1e-9 else 1.0]

        events = []
        for k in range(5):

            def guard(t, x, k=k, guards=guards):
                return guards(t, x)[k]

            guard.terminal, guard.direction = True, -1.0
            events.append(guard)
        found = solve_ivp(
            rate, (time, end), x, "DOP853", events=events, rtol=1e-10, atol=1e-12, max_step=2e-3
        )
        time, x = found.t[-1], found.y[:, -1].copy()
        if found.status != 1:
            break
        gaps = GAP + ACROSS @ x[:3]
        touching = [i for i in range(3) if gaps[i] < 1e-9 and ACROSS[i] @ x[3:] < 1e-9]
        if any(ACROSS[i] @ x[3:] < -1e-9 for i in touching):
            x[3:], impulses = struck(x[3:], touching)
            hits.append((time, {CONTACTS[i]: p for i, p in impulses.items() if p > 0.0}, x[0]))
        mode = chosen(x, touching)
    return hits


def by_plant(stiction_tolerance, end):
    """The same impacts by the plant, with an accuracy of 1e-6 in a step and of its windows."""
    plant = woodpecker(stiction_tolerance)
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", 0.005)
    simulator.get_mutable_integrator().set_target_accuracy(1e-6)
    context = simulator.get_mutable_context()
    context.SetAccuracy(1e-6)
    plant.set_state(context, START)
    simulator.AdvanceTo(end)
    return plant.events(context), plant.state(context)


def periods(times):
    """The time from beak to beak; the mean of two, since they swing to their limit."""
    times = np.array(times)
    return (times[2:] - times[:-2]) / 2.0


if __name__ == "__main__":
    LAST = 1.0
    hand = [time for time, impulses, _ in by_hand(LAST) if "beak" in impulses]
    print(f"by hand, friction that sticks: period {1e3 * periods(hand)[-1]:.4f} ms")
    for tolerance in (1e-2, 1e-3, 1e-4):
        events, _ = by_plant(tolerance, LAST)
        beaks = [event.time for event in events if "beak" in event.contacts]
        late = f"{1e3 * (beaks[0] - hand[0]):+.4f} ms at the first beak"
        print(f"plant, {tolerance:g} m/s: period {1e3 * periods(beaks)[-1]:.4f} ms, {late}")
