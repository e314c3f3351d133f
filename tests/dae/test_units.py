"""No verdict depends on units: each problem in four systems of units has one answer.

The natural sizes of the states, which all of this stands on, are held against sizes that follow by
hand: those of a pendulum, a spring that hardens, a tank.
"""

import numpy as np
import pytest
from problems import PROBLEMS, in_other_units
from runs import some

from drake_dae.analysis import analyze
from drake_dae.dae import DaeSystem


def answer(system: DaeSystem) -> tuple[dict, np.ndarray]:
    """What `analyze` finds, without numbers that have units, and eigenvalues in 1/s."""
    found = analyze(system, count=8).to_dict()
    dynamics = found["zero_dynamics"]
    verdicts = {
        "degrees": (found["constraint_degrees"], found["output_degrees"], found["output_order"]),
        "dimensions": (found["manifold_dimension"], found["zero_dynamics_dimension"]),
        "examined": found["examined_at"],
        "assumptions": [(a["number"], a["finding"]) for a in found["assumptions"]],
        "problems": len(found["problems"]),
        "stability": dynamics and dynamics["verdict"],
    }
    return verdicts, np.array(dynamics["eigenvalues"] if dynamics else [])


def other_units(system: DaeSystem):
    """The system in four systems of units; inputs and equations by up to 1000."""
    random = np.random.default_rng(1)
    counts = (
        system.num_constraints,
        system.num_controls,
        system.num_constraints,
        system.num_outputs,
    )
    # From nanometres to giga-units, all states alike or each in a unit of its own.
    for exponent in (-9.0, 9.0, None, None):
        own = random.uniform(-9.0, 9.0, system.num_states)
        states = 10.0 ** (own if exponent is None else np.full(own.size, exponent))
        yield (
            states,
            in_other_units(
                system, states, *(10.0 ** random.uniform(-3.0, 3.0, count) for count in counts)
            ),
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", some(PROBLEMS, of=8, dear=["aircraft"]))
def test_four_systems_of_units_have_one_answer(name):
    system = PROBLEMS[name]().system
    expected, known = answer(system)
    for _, other in other_units(system):
        found, values = answer(other)
        assert found == expected
        # The held outputs are those at a nominal state that sizes, known to 1e-6, helped to find.
        np.testing.assert_allclose(values, known, rtol=1e-5, atol=1e-7)
