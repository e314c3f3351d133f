"""Andrews' squeezer, the seven-body mechanism of the literature, as the referee describes it.

Schiehlen (ed.), Multibody Systems Handbook, 1990; Hairer and Wanner, Solving Ordinary Differential
Equations II, 1996, VII.7; Mazzia and Magherini, Test Set for Initial Value Problem Solvers. Ours
are seven bodies in joints and three pins, theirs the equations of seven angles with three loops.
"""

import numpy as np
from numpy.testing import assert_allclose
from referee.engines.ours import context_of, model_of
from referee.spatial import MECHANISMS

from drake_dae import RobotPlant

# By the test set; forces act the other way here.
START_FORCES = [98.5668703962410896, -6.12268834425566266, 0.0, 0.0, 0.0, 0.0]


def test_the_start_is_the_published_one():
    """It closes the loops to round-off, and six multipliers of 100 N are met to 12 digits.

    That the motion from it is right is shown in tests/examples/test_referee.py.
    """
    mechanism = MECHANISMS["squeezer"]
    plant = RobotPlant(model_of(mechanism))
    context = context_of(plant, mechanism, np.array(mechanism.q), np.zeros(7))
    structure = plant.structure
    assert structure.constraint_degrees == (2,) * 6
    assert structure.manifold.dimension == 2
    assert_allclose(structure.manifold.residual(plant.dae.nominal_state), 0.0, atol=1e-16)
    assert plant.state(context)[0] == -0.0617138900142764496358948458001
    force = -plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, START_FORCES, rtol=1e-11, atol=1e-11)
