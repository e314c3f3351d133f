"""The shipped task on one plant after the other: how it touches, and how it polishes.

    python tests/campaign/polish.py

prints one line for each contact: the speed just before it touches, the largest force, what the
outputs are off while it polishes, from 2 s on (rms), and how long it took.
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from runs import run_scenario, scenario

SAMPLED = "sampling={period: 0.001, delay: 0.001}"
DRAKE = "plant=!MultibodyPlant"
PLANTS = {
    "equations": (),
    "point 1e5 N/m": (f"{DRAKE} {{stiffness: 1.0e5}}",),
    "point, friction 0.3": (f"{DRAKE} {{radius: 1.0e-5, friction: 0.3}}",),
    "the same, sampled": (f"{DRAKE} {{radius: 1.0e-5, friction: 0.3}}", SAMPLED),
    "hydroelastic 1e8 Pa": (f"{DRAKE} {{contact_model: hydroelastic, modulus: 1.0e8}}", SAMPLED),
    "hydroelastic 1e7 Pa": (f"{DRAKE} {{contact_model: hydroelastic, modulus: 1.0e7}}", SAMPLED),
}


def main() -> int:
    """Runs all; returns 1 if one does not come to its end."""
    failures = 0
    for name, settings in PLANTS.items():
        began = time.perf_counter()
        loop, context, record = run_scenario(scenario("wall_polish", *settings))
        took = time.perf_counter() - began
        changes = loop.changes(context)
        failures += changes[-1].phase != "done"
        force, places = record["constraint_force"][:, 0], np.argmax(record["phase"], axis=1)
        touching = record.time < next(c.time for c in changes if c.in_contact) - 2e-3
        speed = -record["distance"][touching][-1, 1]
        polishing = (places == 3) & (record.time > changes[3].time + 2.0)
        pressed = (record.time > changes[2].time) & (places < 5)
        errors = record["tracking_error"][polishing]
        way = 1e3 * np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))
        off = np.sqrt(np.mean(errors[:, 6] ** 2))
        print(
            f"{name:38} touches at {speed:.5f} m/s, {force.max():.1f} N at most, "
            f"{force[pressed].min():.2g} N at least until it leaves, "
            f"{way:.2g} mm, {off:.2g} N, {changes[-1].phase} in {took:.0f} s",
            flush=True,
        )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
