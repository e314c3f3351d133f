"""The double four-bar mechanism, which passes singular configurations at every half turn.

IFToMM, Library of Computational Benchmark Problems; González, Dopico, Lugrís, Cuadrado, A
Benchmarking System for MBS Simulation Software, Multibody System Dynamics 16, 2006: five rods of
1 m and 1 kg. Where they lie on one line there are three freedoms in place of one.
"""

import numpy as np
import pytest
from arms import error_controlled
from numpy.testing import assert_allclose
from parallel_bars import bars, energy, parallelogram, swung
from pydrake.multibody.tree import JacobianWrtVariable
from runs import some

from drake_dae import simulate

GRAVITY = 9.81


def forces_by_hand(model, q, v, acceleration):
    """What holds the pins, by M, H and J of MultibodyPlant; four rows, all independent."""
    plant = model.links.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    needed = plant.CalcMassMatrix(context) @ acceleration + plant.CalcBiasTerm(context)
    needed -= plant.CalcGravityGeneralizedForces(context)
    world, rows = plant.world_frame(), []
    for pin in model.constraints:
        ends = [
            plant.CalcJacobianTranslationalVelocity(
                context,
                JacobianWrtVariable.kV,
                plant.GetFrameByName(frame),
                [1.0, 0.0, 0.0],
                world,
                world,
            )[[0, 2]]
            for frame in (pin.frame_b, pin.frame_a)
        ]
        rows.append(ends[0] - ends[1])
    return np.linalg.lstsq(np.vstack(rows).T, needed, rcond=None)[0]


@pytest.mark.slow
@pytest.mark.parametrize("windows", some([2, 4]))
def test_it_turns_for_ten_seconds_as_one_pendulum_does(windows):
    """Upright and pushed: through a dozen singular configurations, and right to 8 digits after.

    The energy of 35 J is kept to 1e-7 J, multipliers of 100 N are right to six digits.
    """
    model, plant = bars(windows, GRAVITY)
    context = plant.CreateDefaultContext()
    start = np.pi / 2, -1.0
    plant.set_state(context, parallelogram(model.links.plant, *start))
    simulate(plant, context, 10.0, error_controlled(1e-11))
    angle, rate = swung(windows, GRAVITY, *start, 10.0)
    assert angle < start[0] - 6 * np.pi
    state = plant.state(context)
    wanted = parallelogram(model.links.plant, angle, rate)
    assert_allclose(state, wanted, rtol=1e-8, atol=1e-8)
    found = energy(windows, GRAVITY, state[0], state[wanted.size // 2])
    assert_allclose(found, energy(windows, GRAVITY, *start), atol=1e-7)
    inertia, lever = (windows + 1) / 3 + windows, (windows + 1) / 2 + windows
    second = -GRAVITY * lever / inertia * np.cos(angle)
    half = wanted.size // 2
    acceleration = parallelogram(model.links.plant, second, 0.0)[:half]
    force = forces_by_hand(model, wanted[:half], wanted[half:], acceleration)
    port = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(port, force, atol=1e-6 * np.abs(force).max())
