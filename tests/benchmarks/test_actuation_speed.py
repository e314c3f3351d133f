"""Cost of the law and of the closed loop for each actuation, reported and never judged."""

import time
import timeit

import numpy as np
import pytest
from arms import touching
from pydrake.systems.analysis import SimulatorConfig
from two_arms import two_arms

from drake_dae import (
    DcMotors,
    ElectrohydraulicServos,
    FlexibleJoints,
    RobotPlant,
    TrackingLaw,
    constant,
    make_closed_loop,
    poles,
    simulate,
    sinusoids,
)

SPRINGS = FlexibleJoints(8000.0, inertia=1.0)
MOTORS = DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
CASES = {
    "rigid": [],
    "flexible": [SPRINGS],
    "motors": [MOTORS],
    "servos": [ElectrohydraulicServos(1e5, 1e-5, 0.05)],
    "flexible + motors": [SPRINGS, MOTORS],
}
MODELS = {
    "two_link": lambda stages: touching("two_link", stages),
    "seven_joint": lambda stages: touching("seven_joint", stages),
    "two_arms": two_arms,
}
WANTED = {("seven_joint", "flexible"): 80, ("two_arms", "flexible"): 150}


def microseconds(function):
    arrays = [np.zeros(size) for size in function.sizes]
    return 1e6 * min(timeit.repeat(lambda: function.evaluate(*arrays), number=300, repeat=5)) / 300


@pytest.mark.parametrize(
    ("name", "case"),
    [(n, c) for n in ("two_link", "seven_joint") for c in CASES]
    + [("two_arms", c) for c in ("rigid", "flexible")],
)
def test_law(name, case, report):
    model = MODELS[name](CASES[case])
    began = time.perf_counter()
    law = TrackingLaw(model.dae, poles(-8.0))
    traced = time.perf_counter() - began
    plant = RobotPlant(model, law.structure)
    wanted = WANTED.get((name, case))
    text = (
        f"{name}, {case}: law {law.function.num_operations} operations, "
        f"{microseconds(law.function):.1f} us"
        + (f" (wanted at most {wanted})" if wanted else "")
        + f"; plant {plant.dynamics.num_operations}, {microseconds(plant.dynamics):.1f} us; "
        f"traced in {traced:.2f} s"
    )
    if name != "two_arms":
        count = len(model.position_signals)
        references = [sinusoids(0.3, 0.1, 1.5), sinusoids(20.0, 5.0, 2.0)]
        if count > 1:
            references = [
                sinusoids(0.0, 0.1, 1.5),
                sinusoids(0.6, 0.1, 1.5),
                constant(np.zeros(count - 2)),
                sinusoids(20.0, 5.0, 2.0),
            ]
        loop = make_closed_loop(plant, law, references)
        context = loop.diagram.CreateDefaultContext()
        starts = np.cumsum([0, *[degree + 1 for degree in law.degrees]])[:-1]
        first = loop.reference.reference(0.0)[starts]
        q = model.configuration(first[:count], model.dae.nominal_state[: model.links.q.numel()])
        plant.set_consistent_state(
            plant.GetMyMutableContextFromRoot(context), model.rest_state(q, first[count:])
        )
        config = SimulatorConfig(integration_scheme="runge_kutta5", accuracy=1e-6)
        run = simulate(loop.diagram, context, 3.0, config)
        text += f"; closed loop {run.times_real_time:.0f} times real time at accuracy 1e-6"
    report(text)
