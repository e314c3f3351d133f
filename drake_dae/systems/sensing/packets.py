"""The way from the sensors to a sampled law: measurements that are late, or do not arrive."""

from collections.abc import Sequence
from statistics import NormalDist

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.systems.blocks.traced import HELD, TIME, Block, Computation, Update
from drake_dae.systems.control.sampling import Packets
from drake_dae.trace.functions import TracedFunction

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""


class MeasurementLink(LeafSystem):
    """Passes the measurements of each sample t_k = k period to a law, late or not at all.

    A packet has the state and the constraint forces of its sample. With probability `loss` a packet
    is lost, and with it the next burst - 1 ones; with probability `late` one that is not lost comes
    after the law has computed, and before the next sample. The law gets the newest packet that has
    arrived: of this sample; or a late one of the sample before; or again what it had. The first
    packet always arrives.

    Like encoders, it passes at t_k itself the measurement of that instant.

    Input ports:
        state: The measured x, shape (n,).
        force: The measured constraint forces, shape (m,); only with forces.
        noise: Two independent random numbers of deviation 1 in each period, as of Drake's
            RandomSource.

    Output ports:
        estimated_state: x in the newest packet, shape (n,); direct feedthrough.
        measured_force: The forces in it, shape (m,); only with forces; direct feedthrough.
        missed: The number of samples since that packet, 0 if it is of this sample, shape (1,).

    Args:
        size: n.
        forces: m; 0 for a law without measured force.
        packets: Late and lost packets.
        period: The time between samples, in s.

    Attributes:
        packets: The argument.
        signals: Names and units of `missed`.

    Raises:
        SimulationError: During a run: the law has had no new measurement for `most_lost` samples,
            at which it stops the robot.
    """

    __slots__ = SHARED_DICTIONARY
    measures = True
    """It is part of the machine, not of a controller that is exported alone."""
    signals = (Signal("lost_measurements"),)

    def __init__(self, size: int, forces: int, packets: Packets, period: float) -> None:
        super().__init__()
        self.set_name("measurement_link")
        self.packets, self.sample_period = packets, positive("period", period)
        self._ports = {"estimated_state": self.DeclareVectorInputPort("state", size)}
        if forces:
            self._ports["measured_force"] = self.DeclareVectorInputPort("force", forces)
        self._noise = self.DeclareVectorInputPort("noise", 2)
        # The index of the sample, the samples since the newest packet, the packets of the burst
        # that are still to be lost, and whether a packet is late; the newest packet; the late one.
        self._held = self.DeclareDiscreteState(np.full(4 + 2 * (size + forces), np.nan))
        self._update, self._outputs = self._traced()
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.sample_period, 0.0, weakly(self._sample))
        always = {self.time_ticket(), self.discrete_state_ticket(self._held)}
        always |= {self.input_port_ticket(self._noise.get_index())}
        for name, function in self._outputs.items():
            port = self._ports.get(name)
            read = set() if port is None else {self.input_port_ticket(port.get_index())}
            value = port_value(self._output, name)
            self.DeclareVectorOutputPort(name, function.numel_out(), value, always | read)

    def _traced(self) -> tuple[TracedFunction, dict[str, ca.Function]]:
        """The next HELD, and the output ports, of the time, HELD, the noise and the inputs."""
        packets = self.packets
        inputs = {name: ca.SX.sym(name, port.size()) for name, port in self._ports.items()}
        count = sum(symbol.numel() for symbol in inputs.values())
        time, held, noise = ca.SX.sym("time"), ca.SX.sym("held", 4 + 2 * count), ca.SX.sym("n", 2)
        index, since, to_lose, has_late = (held[i] for i in range(4))
        newest, late = held[4 : 4 + count], held[4 + count :]
        sample = ca.floor(time / self.sample_period + _SAME)
        is_first = ca.logic_not(ca.fabs(index) < np.inf)
        begins = noise[1] < _level(packets.loss)
        is_lost = ca.logic_and(ca.logic_or(to_lose > 0.5, begins), ca.logic_not(is_first))
        comes_late = ca.logic_and(noise[0] < _level(packets.late), ca.logic_not(is_first))
        left = ca.if_else(to_lose > 0.5, to_lose - 1, ca.if_else(begins, packets.burst - 1, 0))
        arrives = ca.logic_not(ca.logic_or(is_lost, comes_late))
        is_old = ca.eq(index, sample)

        def passed(new: ca.SX, late: ca.SX, before: ca.SX) -> ca.SX:
            """The value at the present sample: of a packet that arrives, a late one, or before."""
            now = ca.if_else(arrives, new, ca.if_else(has_late > 0.5, late, before))
            return ca.if_else(is_old, before, now)

        missed = ca.if_else(arrives, 0, ca.if_else(has_late > 0.5, 1, since + 1))
        missed = ca.if_else(is_old, since, missed)
        values, first = list[ca.SX](), 0
        for symbol in inputs.values():
            part = slice(first, first := first + symbol.numel())
            values.append(passed(symbol, late[part], newest[part]))
        is_late = ca.logic_and(comes_late, ca.logic_not(is_lost))
        own = ca.vertcat(sample, missed, ca.if_else(is_first, 0, left), is_late)
        after = ca.vertcat(own, *values, *inputs.values())
        after = ca.if_else(is_old, held, after)
        always = {"time": time, "held": held, "noise": noise}
        most = packets.most_lost
        update = TracedFunction(
            "the measurements of a law",
            {**always, **inputs},
            {"held": after},
            doubt=None if most is None else most - 0.5 - missed,
            outside="the law stops the robot",
        )
        outputs = {
            name: ca.Function(name, [*always.values(), inputs[name]], [ca.densify(value)])
            for name, value in zip(inputs, values, strict=True)
        }
        return update, outputs | {"missed": ca.Function("missed", [*always.values()], [missed])}

    def _always(self, context: Context) -> list[FloatArray]:
        held = context.get_discrete_state(self._held).value()
        return [np.array([context.get_time()]), held, self._noise.Eval(context)]

    def _output(self, name: str, context: Context) -> FloatArray:
        arguments = self._always(context)
        if name in self._ports:
            arguments.append(self._ports[name].Eval(context))
        value: FloatArray = np.asarray(self._outputs[name](*arguments)).ravel()
        return value

    def _sample(self, context: Context, state: State) -> EventStatus:
        read = [port.Eval(context) for port in self._ports.values()]
        arguments = [*self._always(context), *read]
        after = self._update.evaluate(*arguments)[0]
        if not self._update.is_valid:
            raise self._failure(context.get_time(), arguments)
        state.get_mutable_discrete_state().set_value(self._held, after)
        return EventStatus.Succeeded()

    def _failure(self, time: float, arguments: Sequence[FloatArray]) -> SimulationError:
        return SimulationError(
            f"the law stops the robot at t = {time:.6g} s, since no measurement has arrived for "
            f"{self.packets.most_lost} samples (sampling.measurements.most_lost): its brakes are "
            "not simulated, so that the run ends there",
            time,
            arguments[3],
        )

    def traced(self) -> Block:
        sources = TIME, HELD, "noise"
        named = {"estimated_state": "state", "measured_force": "force"}
        read = tuple(named[name] for name in self._ports)
        computations = tuple(
            Computation(
                function, (*sources, *((named[name],) if name in self._ports else ())), (name,)
            )
            for name, function in self._outputs.items()
        )
        sampled = Computation.of(self._update, (*sources, *read), (HELD,))
        # The first packet arrives, whatever the noise is.
        nothing = ca.SX.nan(self._update.function.size1_in(1), 1)
        symbols = [
            ca.SX.sym("input", self._update.function.size1_in(i)) for i in range(3 + len(read))
        ]
        begun = self._update.function(symbols[0], nothing, *symbols[2:])
        first = ca.Function("first", [symbols[0], *symbols[2:]], [begun[0]])
        return Block(
            self,
            computations,
            (Update(sampled, self.sample_period, 0.0, True),),
            initial=Computation(first, (TIME, "noise", *read), (HELD,)),
            ports={"missed": self.signals},
            failure=self._failure,
        )


def _level(probability: float) -> float:
    """A normal number is below this with a probability."""
    return NormalDist().inv_cdf(probability) if probability else -np.inf
