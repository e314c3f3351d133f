"""Gains of the other laws, all by one search: the same plant, runs, cost and limits of bandwidth.

The plant is the point contact of 1e5 N/m with the friction known, to laws with observers unknown,
once without noise and once with it. Gains are sought on a logarithmic scale, first at points of
Halton's sequence, then from the best of them by Nelder and Mead; each point takes two runs.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from contact_peers.laws import LAWS
from contact_peers.measure import run_law
from contact_peers.plants import CONDITIONS, FRICTION
from contact_peers.task_laws import WithObserver
from drake_dae.arrays import FloatArray

GAINS = Path(__file__).with_name("gains.json")

SPREAD, DESCENT = 8, 20
"""How many points of each kind; laws with an observer start from their law without it."""

FIRST_RATE = 100.0
"""The first rate of an observer, in 1/s."""

QUIET, NOISY = (3.5, 2.0), (1.5, 1.0)
"""How long the runs are, and from when on they count, in s."""


def cost(law: type, gains: Mapping[str, float]) -> float:
    """The errors in units of what the shipped scenarios shall keep.

    The root of the sum of squares of position / 0.02 mm and force / 0.03 N without noise, and with
    noise of position / 0.02 mm, force / 0.1 N and roughness / 0.4 N m.
    """
    by_title = {condition.title: condition for condition in CONDITIONS}
    friction = FRICTION if law.KNOWS else 0.0
    still = run_law(by_title["point 1e5 N/m"], law, gains, friction, *QUIET)
    if still.is_lost:
        return 1e6
    noisy = run_law(by_title["noise"], law, gains, friction, *NOISY)
    parts = (
        still.position / 0.02,
        still.force / 0.03,
        noisy.position / 0.02,
        noisy.force / 0.1,
        noisy.roughness / 0.4,
    )
    return min(float(np.linalg.norm(parts)), 1e6)


def search(law: type) -> dict[str, Any]:
    """The best gains, their cost, and how many points it took."""
    names = list(law.LIMITS)
    low, high = np.log(np.array([law.LIMITS[name] for name in names])).T

    def gains(place: FloatArray) -> dict[str, float]:
        found = np.exp(low + np.clip(place, 0.0, 1.0) * (high - low))
        return {name: float(f"{value:.4g}") for name, value in zip(names, found, strict=True)}

    tried: list[tuple[float, FloatArray]] = []

    def tell(place: FloatArray) -> float:
        # The limits are a wall that leans: the cost at its foot, and the way beyond it.
        beyond = float(np.linalg.norm(place - np.clip(place, 0.0, 1.0)))
        found = cost(law, gains(place)) * (1.0 + beyond)
        tried.append((found, np.clip(place, 0.0, 1.0)))
        print(f"{law.__name__} {len(tried)}: {found:.3g} {gains(place)}", flush=True)
        return float(np.log(found))

    if issubclass(law, WithObserver):
        before = {LAWS[name]: gains for name, gains in load_gains().items()}[law.LAW]
        start = np.log([(before | {"observer": FIRST_RATE})[name] for name in names])
        best = (start - low) / (high - low)
    else:
        # The first of the sequence is the corner.
        for place in qmc.Halton(len(names), scramble=False).fast_forward(1).random(SPREAD):
            tell(place)
        best = min(tried, key=lambda one: one[0])[1]
    steps = np.where(best > 0.8, -0.2, 0.2)
    simplex = np.vstack([best, best + np.diag(steps)])
    minimize(
        tell, best, method="Nelder-Mead", options={"maxfev": DESCENT, "initial_simplex": simplex}
    )
    value, best = min(tried, key=lambda one: one[0])
    return {"gains": gains(best), "cost": round(value, 3), "points": len(tried)}


def load_gains() -> dict[str, dict[str, float]]:
    """Name of a law -> its gains, as they were found."""
    return {name: one["gains"] for name, one in json.loads(GAINS.read_text()).items()}


def search_all(only: str = "") -> None:
    """Searches for the gains of all laws whose name contains a text, and writes them."""
    found: dict[str, Any] = json.loads(GAINS.read_text()) if only else {}
    for name, law in LAWS.items():
        if only in name:
            found[name] = search(law)
        GAINS.write_text(json.dumps(found, indent=1) + "\n")
