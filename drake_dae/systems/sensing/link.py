"""The link from a sampled law to the drives: jitter, and controls that do not arrive."""

from collections.abc import Sequence
from statistics import NormalDist

import casadi as ca
import numpy as np
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import HELD, Block, Computation, Update
from drake_dae.systems.control.sampling import Sampling
from drake_dae.trace.functions import TracedFunction


class ControlLink(LeafSystem):
    """Passes the held control of a law to the drives, late or not at all.

    A control that changes at t_k + delay acts from then on or, with probability 1/2, from t_k +
    delay + jitter on. With probability `loss` a control is lost, and with it the next burst - 1
    ones. The drives hold the last control that arrived.

    Input ports:
        control: The output of a `ControlHold` of the same sampling, shape (p,).
        noise: Two independent random numbers of deviation 1 in each period, as of Drake's
            RandomSource.
        state: x, shape (n,), for the exception.

    Output ports:
        control: The control at the drives, shape (p,).
        lost_controls: The number of controls that were lost in a row, up to now, shape (1,).

    Args:
        size: The number of controls, p.
        num_states: n.
        sampling: The sampling of the hold, with jitter, loss, burst and most_lost.

    Attributes:
        sampling: The sampling.
        signals: Names and units of `lost_controls`.

    Raises:
        SimulationError: During a run: `most_lost` controls in a row were lost, at which the robot
            stops by itself.
    """

    __slots__ = SHARED_DICTIONARY
    signals = (Signal("lost_controls"),)

    def __init__(self, size: int, num_states: int, sampling: Sampling) -> None:
        super().__init__()
        self.set_name("control_link")
        self.sampling = sampling
        self.sample_period = sampling.period
        self._port = self.DeclareVectorInputPort("control", size)
        self._noise = self.DeclareVectorInputPort("noise", 2)
        self._state = self.DeclareVectorInputPort("state", num_states)
        # The control before this sample; whether it is kept; the controls lost in a row, and those
        # of the burst that are still to be lost.
        self._held = self.DeclareDiscreteState(size + 3)
        self._functions = self._traced()
        period, rest = sampling.period, sampling.rest
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, rest, weakly(self._arrive))
        if sampling.jitter:
            late = rest + sampling.jitter
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, late, weakly(self._arrive_late))
        held = self.discrete_state_ticket(self._held)
        sources = {held, self.input_port_ticket(self._port.get_index())}
        self.DeclareVectorOutputPort("control", size, weakly(self._calc), sources)
        self.DeclareVectorOutputPort("lost_controls", 1, weakly(self._calc_lost), {held})

    def _traced(self) -> tuple[TracedFunction, ca.Function, ca.Function]:
        """The next HELD at t_k + delay and at t_k + delay + jitter, and the outputs."""
        size, sampling = self._port.size(), self.sampling
        held, control = ca.SX.sym("held", size + 3), ca.SX.sym("control", size)
        noise, state = ca.SX.sym("noise", 2), ca.SX.sym("state", self._state.size())
        is_kept, lost, to_lose = held[size] > 0.5, held[size + 1], held[size + 2]
        acting = ca.if_else(is_kept, held[:size], control)
        # A normal number is below this with the probability `loss`.
        level = NormalDist().inv_cdf(sampling.loss) if sampling.loss else -np.inf
        begins = noise[1] < level
        left = ca.if_else(to_lose > 0.5, to_lose - 1, ca.if_else(begins, sampling.burst - 1, 0))
        is_lost = ca.logic_or(to_lose > 0.5, begins)
        count = ca.if_else(is_lost, lost + 1, 0)
        is_late = noise[0] > 0.0 if sampling.jitter else ca.SX(0)
        after = ca.vertcat(acting, ca.logic_or(is_lost, is_late), count, left)
        most = np.inf if sampling.most_lost is None else sampling.most_lost - 0.5
        arrive = TracedFunction(
            "the link to the drives",
            {"held": held, "control": control, "noise": noise, "state": state},
            {"held": after},
            doubt=most - count if np.isfinite(most) else None,
            outside="the robot stops by itself",
        )
        arrived_late = ca.vertcat(held[:size], lost > 0.5, lost, to_lose)
        late = ca.Function("late", [held], [arrived_late])
        return arrive, late, ca.Function("outputs", [held, control], [acting, lost])

    def _arrive(self, context: Context, state: State) -> EventStatus:
        held = context.get_discrete_state(self._held).value()
        ports = self._port, self._noise, self._state
        arguments = [held, *(port.Eval(context) for port in ports)]
        after = self._functions[0].evaluate(*arguments)[0]
        if not self._functions[0].is_valid:
            raise self._failure(context.get_time(), arguments)
        state.get_mutable_discrete_state().set_value(self._held, after)
        return EventStatus.Succeeded()

    def _arrive_late(self, context: Context, state: State) -> EventStatus:
        held = context.get_discrete_state(self._held).value()
        after = np.asarray(self._functions[1](held)).ravel()
        state.get_mutable_discrete_state().set_value(self._held, after)
        return EventStatus.Succeeded()

    def _failure(self, time: float, arguments: Sequence[FloatArray]) -> SimulationError:
        return SimulationError(
            f"the robot stops by itself at t = {time:.6g} s, since {self.sampling.most_lost} "
            "controls in a row were lost (sampling.most_lost): its brakes are not simulated, so "
            "that the run ends there",
            time,
            arguments[-1],
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        held = context.get_discrete_state(self._held).value()
        control = self._port.Eval(context)
        output.SetFromVector(held[: control.size] if held[-3] > 0.5 else control)

    def _calc_lost(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([context.get_discrete_state(self._held).value()[-2]])

    def traced(self) -> Block:
        arrive, late, outputs = self._functions
        period, rest = self.sampling.period, self.sampling.rest
        sources = HELD, "control", "noise", "state"
        updates = [Update(Computation.of(arrive, sources, (HELD,)), period, rest, True)]
        if self.sampling.jitter:
            computation = Computation(late, (HELD,), (HELD,))
            updates.append(Update(computation, period, rest + self.sampling.jitter, True))
        shown = Computation(outputs, (HELD, "control"), ("control", "lost_controls"))
        return Block(
            self,
            (shown,),
            tuple(updates),
            ports={"lost_controls": self.signals},
            failure=self._failure,
        )
