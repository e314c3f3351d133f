"""Peaucellier's linkage of 1864, whose point goes along a straight line without a guide.

Wikipedia, "Peaucellier-Lipkin linkage", and unseel.com, "Peaucellier-Lipkin Linkage", which prints
OP OQ = m^2 - l^2.
"""

import numpy as np
from arms import error_controlled
from numpy.testing import assert_allclose
from referee.description import Mechanism
from referee.engines.ours import model_of
from referee.planar import pin, rod

from drake_dae import RobotPlant, simulate

ARM, BAR, CRANK = 0.5, 0.2, 0.18

LINKAGE = Mechanism(
    "peaucellier",
    (
        rod("left", ARM, 0.6),
        rod("left_near", BAR, 0.3, parent="left", at=(ARM, 0.0, 0.0)),
        rod("left_far", BAR, 0.3, parent="left", at=(ARM, 0.0, 0.0)),
        rod("right", ARM, 0.6),
        rod("right_near", BAR, 0.3, parent="right", at=(ARM, 0.0, 0.0)),
        rod("right_far", BAR, 0.3, parent="right", at=(ARM, 0.0, 0.0)),
        rod("crank", CRANK, 0.2, at=(CRANK, 0.0, 0.0)),
    ),
    (
        pin("near", "left_near", (BAR, 0.0), "right_near", (BAR, 0.0)),
        pin("driven", "crank", (CRANK, 0.0), "left_near", (BAR, 0.0)),
        pin("far", "left_far", (BAR, 0.0), "right_far", (BAR, 0.0)),
    ),
    q=(0.55, -2.5, -1.0, 0.05, 2.5, 1.0, 0.6),
    free=(6,),
    gravity=(0.0, -9.81, 0.0),
)


def ends(q):
    """P and Q, from O."""
    elbow = ARM * np.array([np.cos(q[0]), np.sin(q[0])])
    return [elbow + BAR * np.array([np.cos(q[0] + q[i]), np.sin(q[0] + q[i])]) for i in (1, 2)]


def test_peaucelliers_point_goes_along_a_straight_line():
    """While it swings: x = (m^2 - l^2) / (2 d) to round-off of the projection, and OP OQ too."""
    plant = RobotPlant(model_of(LINKAGE))
    assert plant.structure.manifold.dimension == 2
    context = plant.CreateDefaultContext()
    plant.set_consistent_state(context, [*LINKAGE.q, *np.zeros(7)])
    seen = []
    config = error_controlled(1e-7)
    simulate(
        plant, context, 0.3, config, after_step=lambda now: seen.append(ends(plant.state(now)))
    )
    near, far = np.array(seen).swapaxes(0, 1)
    assert np.ptp(far[:, 1]) > 0.1
    assert_allclose(far[:, 0], (ARM**2 - BAR**2) / (2 * CRANK), atol=1e-10)
    product = np.linalg.norm(near, axis=1) * np.linalg.norm(far, axis=1)
    assert_allclose(product, ARM**2 - BAR**2, atol=1e-10)
