"""What noise does to signals by runs with it, beside closed forms."""

import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.symbolic import Variable, sqrt
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import RandomSource, SymbolicVectorSystem

from drake_dae import rollout, start_values
from drake_dae.errors import ModelError
from drake_dae.running.rollout.spread.runs import noisy_runs, off_proportion

PERIOD, CONFIG = 0.01, SimulatorConfig()


def sums(also=lambda n: 0.0, distribution=RandomDistribution.kGaussian):
    """Noise n through y+ = 0.5 y + n + also(n): a diagram, its start and parameters."""
    builder = DiagramBuilder()
    noise = builder.AddSystem(RandomSource(distribution, 1, PERIOD))
    n, y = Variable("n"), Variable("y")
    system = builder.AddSystem(
        SymbolicVectorSystem(
            state=[y],
            input=[n],
            dynamics=[0.5 * y + n + also(n)],
            output=[y],
            time_period=PERIOD,
        )
    )
    builder.Connect(noise.get_output_port(), system.get_input_port())
    builder.ExportOutput(system.get_output_port(), "y")
    diagram = builder.Build()
    return diagram, *start_values(diagram, diagram.CreateDefaultContext())


def runs(count, also):
    """The same diagram, with the starts of several runs."""
    diagram, start, parameters = sums(also)
    return diagram, np.tile(start, (count, 1)), parameters


def square(n):
    return 0.3 * n * n


def test_an_answer_with_a_square_is_off_proportion_by_it():
    """e(s) is the sum of n + 0.3 s n^2 with weights 0.5^j.

    That of n^2 has the mean 2 and the variance 2 / 0.75, that of n the variance 1 / 0.75, and n and
    n^2 are uncorrelated. Of 1000 samples, of which a third is independent, the ratio is known to
    some 5 per cent.
    """
    (found,), quiet = off_proportion(*sums(square), (5.0, 10.0), CONFIG, "y")
    bent = 0.3 * np.sqrt(4.0 + 2.0 / 0.75)
    assert found == pytest.approx(1.1 * bent / np.hypot(bent, 0.75**-0.5), rel=0.15)
    assert quiet.shape == (501, 1)
    assert not quiet.any()


def test_an_answer_to_first_order_is_in_proportion():
    """About numbers at their mean, 1 of e^-n, whose sum is 2; to round-off."""
    case = sums(distribution=RandomDistribution.kExponential)
    (found,), quiet = off_proportion(*case, (1.0, 2.0), CONFIG, "y")
    assert found < 1e-12
    np.testing.assert_allclose(quiet, 2.0, rtol=1e-12)


def test_runs_have_deviations_and_means():
    """Mean 0.6 and variance 1.18 / 0.75, as changes by 2 (1 - 0.5) of it.

    Of 8 runs of 500 samples, a third of which is independent, a deviation is known to 2 per cent,
    and the mean to 0.03.
    """
    found = noisy_runs(*runs(8, square), (5.0, 10.0), CONFIG, ("y",))
    wanted = np.sqrt(1.18 / 0.75)
    assert found.spread.rms("y")[0] == pytest.approx(wanted, rel=0.05)
    assert found.spread.roughness("y") == pytest.approx(wanted, rel=0.05)
    assert np.mean(found.means["y"]) == pytest.approx(0.6, abs=0.1)
    np.testing.assert_allclose(found.spread.times[[0, -1]], [5.0, 10.0])


def test_a_run_that_ends_early_is_refused_with_its_seed():
    """A square root of a negative number."""
    with pytest.raises(ModelError, match="a run with noise, with the seed 1, ended early: "):
        noisy_runs(*runs(2, sqrt), (0.5, 1.0), CONFIG, ("y",))


def test_each_run_begins_at_its_own_start_with_the_seed_of_its_place():
    """Also where not all runs are recorded at once: exact, since the numbers are the same."""
    diagram, starts, parameters = runs(19, square)
    starts += np.arange(19.0)[:, None]
    found = noisy_runs(diagram, starts, parameters, (0.01, 0.05), CONFIG, ("y",))
    times = PERIOD * np.arange(6)
    each = rollout(diagram, starts, parameters, times=times, seeds=range(1, 20))
    values = np.array([one.record["y"][1:] for one in each])
    np.testing.assert_array_equal(found.means["y"], values.mean(axis=0))
    deviation = found.spread.deviations["y"]
    np.testing.assert_array_equal(deviation, values.std(axis=0, ddof=1))
