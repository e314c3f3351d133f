"""When a force sensor samples, and the noise that it feels."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import RandomSource

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop


@dataclass(frozen=True, eq=False)
class Samples:
    """The times at which a sensor samples, or at which its noise changes.

    Attributes:
        events: These times, in s.
        size: The number of forces.
        period: The time between them in s; 0 if there are none.
        holds: Whether the sensor holds what it measured.
        noisy: Whether it has noise.
        start: When the run begins, in s.
    """

    events: FloatArray
    size: int
    period: float
    holds: bool
    noisy: bool
    start: float

    @classmethod
    def of(cls, loop: ClosedLoop, times: FloatArray) -> Self:
        """The samples of a closed loop.

        Args:
            loop: The closed loop.
            times: When rows are written, in s.
        """
        sensor, size, start = loop.sensor, loop.plant.dae.num_constraints, float(times[0])
        if sensor is None or not (sensor.sample_period or loop.noise is not None):
            return cls(np.zeros(0), size, 0.0, False, False, start)
        period = sensor.sample_period or sensor.time_constant
        slack = 1e-9
        first = int(np.ceil(start / period - slack))
        last = int(np.floor(times[-1] / period + slack))
        events: FloatArray = period * np.arange(max(first, 0), last + 1.0)
        # A sample at the time of a row makes no step of its own.
        near = np.clip(np.searchsorted(times, events), 1, times.size - 1)
        for candidate in (times[near - 1], times[near]):
            near_enough = np.abs(candidate - events) <= 1e-9 * period
            events[near_enough] = candidate[near_enough]
        holds = bool(sensor.sample_period)
        return cls(events, size, period, holds, loop.noise is not None, start)

    def noise(self, seed: int | None) -> FloatArray:
        """The noise at the start, and then from each event on, shape (len(events) + 1, m).

        It is that of Drake's RandomSource.

        Args:
            seed: The seed; that of every run without one if None.
        """
        if not self.noisy:
            return np.zeros((self.events.size + 1, self.size))
        source = RandomSource(RandomDistribution.kGaussian, self.size, self.period)
        context = source.CreateDefaultContext()
        context.SetTime(self.start)
        if seed is not None:
            source.SetRandomContext(context, RandomGenerator(seed))
        simulator, port = Simulator(source, context), source.get_output_port()
        values = [port.Eval(context)]
        for event in self.events:
            simulator.AdvanceTo(event + 0.5 * self.period)
            values.append(port.Eval(context))
        return np.array(values)
