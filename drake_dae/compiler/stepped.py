"""Samples of a diagram in which Drake steps one block; one call computes all other blocks."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from pydrake.systems.analysis import InitializeParams
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.drake_steps import DrakeSteps
from drake_dae.trace.compiled import Compiled
from drake_dae.trace.functions import TracedFunction

NO_EVENTS = InitializeParams(suppress_initialization_events=True)
"""The initialization of a Simulator that goes on from a context."""


Places = slice | np.ndarray
"""The places of some entries of a column."""


class Sample(NamedTuple):
    """A time at which blocks are updated.

    Attributes:
        time: The time, in s.
        due: The rates of the diagram that are due, as bits.
        noise: The random numbers of these updates.
    """

    time: float
    due: int
    noise: FloatArray


class SteppedDiagram:
    """A diagram in which Drake steps one block, and no block has a continuous state.

    At each sample, the input of that block and the unrestricted updates are computed from the
    values before the sample. Then Drake steps the block, and the discrete updates follow. The
    discrete updates of a sample and the unrestricted ones of the next sample are one call.

    Args:
        compiled: The diagram.
        start: A context of the system that Drake steps, at the start; it is changed in place.
        held: The discrete states of all blocks at the start.
        parameters: The parameters of the diagram.
        choice: Whether the functions become machine code.

    Attributes:
        before: The discrete states of all blocks before the updates of the next sample.
    """

    def __init__(
        self,
        compiled: CompiledDiagram,
        start: Context,
        held: FloatArray,
        parameters: FloatArray,
        choice: Compiled,
    ) -> None:
        self._rates, self._sizes, self._choice = compiled.rates, compiled.sizes, choice
        self._parameters = parameters
        self._functions: dict[tuple[int, int], tuple[Places, Places, TracedFunction]] = {}
        rate, block = compiled.stepped
        assert block.stepped is not None
        self._bit, self._steps = 1 << compiled.rates.index(rate), DrakeSteps(block.stepped, start)
        self._held, self.before, self._input = held.copy(), held.copy(), np.zeros(0)
        self._stepped = self._held[rate.places[0] : rate.places[-1] + 1]

    def begin(self, sample: Sample) -> bool:
        """Makes the unrestricted updates of a sample; returns whether all values are valid."""
        return self._call(sample._replace(due=0), sample)

    def step(self, sample: Sample, following: Sample) -> bool:
        """Makes Drake's step and the discrete updates of a sample, and begins the following one.

        Returns whether all values are valid.

        Raises:
            RuntimeError: Drake's step fails.
        """
        if sample.due & self._bit:
            self._steps.step(sample.time, self._input, self._stepped)
        return self._call(sample, following)

    def _call(self, sample: Sample, following: Sample) -> bool:
        """Makes discrete updates of a sample and unrestricted ones of the following sample."""
        key = sample.due, following.due
        if key not in self._functions:
            self._functions[key] = self._traced(*key)
        discrete, unrestricted, function = self._functions[key]
        held = self._held
        after, begun, given, _ = function.evaluate(
            sample.time, following.time, held, sample.noise, following.noise, self._parameters
        )
        if not function.is_valid:
            return False
        held[discrete] = after
        self.before[:] = held
        held[unrestricted] = begun
        if given.size:
            self._input = given
        return True

    def _traced(self, due: int, following: int) -> tuple[Places, Places, TracedFunction]:
        """Returns the places of discrete and of unrestricted updates, and their function.

        Its arguments are time, following time, held, noise, following noise and parameters.
        """
        sizes = {"after": 1, "noise after": self._sizes["noise"], **self._sizes}
        names = ("time", "after", "held", "noise", "noise after", "parameters")
        inputs = {name: ca.SX.sym(name, sizes[name]) for name in names}
        time, after, held, noise, noise_after, parameters = inputs.values()
        places: tuple[list[int], list[int]] = [], []
        outputs = {"discrete": ca.SX(0, 1), "unrestricted": ca.SX(0, 1), "input": ca.SX(0, 1)}
        valid = ca.SX(0)
        for number, rate in enumerate(self._rates):
            if due >> number & 1 and not rate.is_unrestricted:
                values, finite = rate.function(time, ca.SX(0, 1), held, parameters, noise)
                outputs["discrete"], valid = ca.vertcat(outputs["discrete"], values), valid + finite
                places[0].extend(rate.places)
        updated = ca.SX(held)
        updated[places[0]] = outputs["discrete"]
        for number, rate in enumerate(self._rates):
            if following >> number & 1 and rate.is_unrestricted:
                values, finite = rate.function(after, ca.SX(0, 1), updated, parameters, noise_after)
                name = "input" if rate.stepped is not None else "unrestricted"
                outputs[name], valid = ca.vertcat(outputs[name], values), valid + finite
                places[1].extend(rate.places if rate.stepped is None else ())
        outputs["valid"] = valid
        function = TracedFunction("a sample", inputs, outputs, compiled=self._choice, lean=True)
        return _indexed(places[0]), _indexed(places[1]), function


def _indexed(places: list[int]) -> Places:
    """The places as what NumPy indexes with least time."""
    if not places:
        return slice(0)
    is_one_piece = places == list(range(places[0], places[-1] + 1))
    return slice(places[0], places[-1] + 1) if is_one_piece else np.array(places)
