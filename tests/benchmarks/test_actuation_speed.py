"""Cost of the law and of the closed loop for each actuation, reported and never judged.

Traced is the law alone. Runs are at fixed steps of 5 ms; the last column tells how far the errors
are from those that were predicted.
"""

import time
import timeit

import numpy as np
import pytest
from arms import fixed_step, touching
from two_arms import APART, two_arms

from drake_dae import (
    ConstantReference,
    DcMotors,
    ElectrohydraulicServos,
    FlexibleJoints,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    make_closed_loop,
    poles,
    simulate,
)

SPRINGS = FlexibleJoints(8000.0, inertia=1.0)
MOTORS = DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
CASES = {
    "rigid": [],
    "flexible": [SPRINGS],
    "motors": [MOTORS],
    "hydraulics": [ElectrohydraulicServos(1e6, 1e-6, 0.05)],
    "flexible + motors": [SPRINGS, MOTORS],
}
MODELS = {
    "two_link": lambda stages: touching("two_link", stages),
    "seven_joint": lambda stages: touching("seven_joint", stages),
    "two_arms": two_arms,
}
FORCE = SinusoidReference(20.0, 5.0, 2.0)
REFERENCES = {
    "two_link": [SinusoidReference(0.3, 0.1, 1.5), FORCE],
    "seven_joint": [
        SinusoidReference(0.0, 0.1, 1.5),
        SinusoidReference(0.6, 0.1, 1.5),
        ConstantReference(np.zeros(4)),
        FORCE,
    ],
    "two_arms": [
        SinusoidReference(APART / 2, 0.05, 1.5),
        SinusoidReference(0.0, 0.1, 1.5),
        SinusoidReference(0.4, 0.05, 1.5),
        ConstantReference(np.zeros(5)),
        FORCE,
        ConstantReference(np.zeros(5)),
    ],
}
LAW_TARGETS = {("seven_joint", "flexible"): 80.0, ("two_arms", "flexible"): 150.0}
"""us."""
TRACING_TARGETS = {("two_arms", "flexible"): 5.0}
"""s."""
STEP = 5e-3


def microseconds(function):
    arrays = [np.zeros(size) for size in function.sizes]
    return 1e6 * min(timeit.repeat(lambda: function.evaluate(*arrays), number=300, repeat=5)) / 300


def wanted(targets, key):
    return f" (<{targets[key]:g})" if key in targets else ""


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", MODELS)
def test_law_and_closed_loop(name, case, report):
    """At a fixed step: the law leaves nothing stiff in the loop, whose poles are all at -8."""
    model, key = MODELS[name](CASES[case]), (name, case)
    began = time.perf_counter()
    law = TrackingLaw(model.dae, poles(-8.0))
    traced = time.perf_counter() - began
    plant = RobotPlant(model, structure=law.structure)
    loop = make_closed_loop(plant, law, REFERENCES[name])
    context = loop.diagram.CreateDefaultContext()
    starts = np.cumsum([0, *[degree + 1 for degree in law.degrees]])[:-1]
    first = loop.reference.reference(0.0)[starts]
    count = len(model.position_signals)
    q = model.configuration(first[:count], model.dae.nominal_state[: model.links.q.numel()])
    plant.set_consistent_state(
        plant.GetMyMutableContextFromRoot(context), model.rest_state(q, first[count:])
    )
    run = simulate(loop.diagram, context, 1.0, fixed_step(STEP))
    record = loop.record(context)
    off = np.max(np.abs(record["tracking_error"] - loop.predicted_error(record)))
    report(
        f"{name}, {case}",
        {
            "law [operations]": f"{law.function.num_operations}",
            "law [us]": f"{microseconds(law.function):.1f}{wanted(LAW_TARGETS, key)}",
            "plant [operations]": f"{plant.dynamics.num_operations}",
            "plant [us]": f"{microseconds(plant.dynamics):.1f}",
            "traced [s]": f"{traced:.2f}{wanted(TRACING_TARGETS, key)}",
            "x real time": f"{run.times_real_time:.1f}",
            "steps": f"{run.steps}",
            "off prediction": f"{off:.0e}",
        },
    )
