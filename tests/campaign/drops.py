"""Random drops of a box onto its four corners, each with a coefficient of restitution."""

import traceback
from functools import cache
from pathlib import Path

import numpy as np
from campaign.outcomes import RAW, RESULT, WRONG, Outcome
from falling import CORNERS, GRAVITY, INERTIA, MASS, box, simulator_of

from drake_dae.errors import DrakeDaeError

STEP = 0.02

DEPTH = 1e-9
"""How deep a corner may be in the floor, and how far a closed one off it, in m."""


@cache
def plant():
    return box(dict.fromkeys(CORNERS, 0.5), driven=False)


def attempt(seed: int, folder: Path, duration: float = 2.0) -> Outcome:
    """Drops a box, and watches it at each step for a while, in s."""
    random = np.random.default_rng(seed)
    start = np.array([0.0, 0.7, *random.standard_normal(4) * [0.8, 0.5, 0.5, 2.0]])
    start[1] += 0.3 * random.random()
    outcome = Outcome(f"drop {seed}")
    try:
        problems = _drop(start, random.uniform(0.0, 0.9, 4), duration)
    except DrakeDaeError as error:
        outcome.kind, outcome.text = WRONG, f"{type(error).__name__}: {error}"
    except Exception:
        outcome.kind, outcome.text = RAW, traceback.format_exc()
    else:
        outcome.kind, outcome.text = (WRONG, problems[0]) if problems else (RESULT, "")
    return outcome


def _drop(start, restitution, duration):
    """What was wrong, in words."""
    robot, problems = plant(), []
    simulator, context = simulator_of(robot, start, STEP, accuracy=5e-7)
    for name, e in zip(robot.contacts, restitution, strict=True):
        robot.set_parameter(context, f"{name}.restitution", e)
    force, mode = (robot.GetOutputPort(name) for name in ("constraint_force", "mode"))

    def watch(at):
        gaps, forces, closed = robot.gaps(at), force.Eval(at), mode.Eval(at) == 1.0
        if gaps.min() < -DEPTH or np.any(np.abs(gaps[closed]) > DEPTH):
            problems.append(f"gaps {gaps} at t = {at.get_time()}, closed {closed}")
        if np.any(forces < 0.0) or np.any(forces[~closed] != 0.0):
            problems.append(f"forces {forces} at t = {at.get_time()}, closed {closed}")

    simulator.set_monitor(watch)
    simulator.AdvanceTo(duration)
    events = robot.events(context)
    before, after = _energy(start), _energy(robot.state(context))
    lost = [event.energy_lost for event in events]
    if min(lost, default=0.0) < -1e-12 * before:
        problems.append(f"an impact gains {-min(lost)} J")
    # Windows of 1e-10 s move the floor by less than 1e-9 m at each event.
    if abs(before - after - sum(lost)) > 1e-8 * before:
        problems.append(f"{before - after} J are lost, but impacts took {sum(lost)} J")
    return problems


def _energy(state):
    moved = 0.5 * state[3:] ** 2 @ [MASS, MASS, INERTIA]
    return MASS * GRAVITY * state[1] + moved
