"""Sampled laws: inputs at samples, with delay, held between samples."""

from dataclasses import dataclass
from math import ceil, floor, isfinite

import casadi as ca
import numpy as np
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number
from drake_dae.blocks.computations import HELD, Block, Computation, Update
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.errors import ModelError, NonFiniteError, WiringError

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""

MOST_ON_THE_WAY = 10_000
"""The largest number of computations in progress: each is stored and shifted at every sample."""


@checked(ModelError)
@dataclass(frozen=True)
class Sampling:
    """A law samples its inputs at t_k = k period; its control acts from t_k + delay on.

    Attributes:
        period: T in s, positive.
        delay: The time to compute and send, in s, 0 or more; it may exceed a period, with several
            computations in progress.

    Raises:
        ModelError: The period is not positive, or the delay negative or very many periods.
    """

    period: float
    delay: float = 0.0

    def __post_init__(self) -> None:
        if not (isfinite(self.period) and self.period > 0.0):
            raise ModelError(f"a sampling's period must be positive, got {self.period:g} s")
        if not (isfinite(self.delay) and self.delay >= 0.0):
            raise ModelError(f"a sampling's delay must be 0 or more, got {self.delay:g} s")
        if not self.delay / self.period <= MOST_ON_THE_WAY:
            raise ModelError(
                f"a sampling's delay may be {MOST_ON_THE_WAY} periods at most, here "
                f"{MOST_ON_THE_WAY * self.period:g} s, got {self.delay:g} s"
            )

    @property
    def whole_periods(self) -> int:
        """The number of whole periods in the delay."""
        return floor(self.delay / self.period + _SAME)

    @property
    def rest(self) -> float:
        """The remainder of the delay, in s: at least 0, and less than a period."""
        rest = self.delay - self.whole_periods * self.period
        return rest if rest > _SAME * self.period else 0.0

    @property
    def late_samples(self) -> int:
        """The largest number of samples until a sampled value acts."""
        return ceil(self.delay / self.period - _SAME)


@checked(ModelError)
class ControlHold(LeafSystem):
    """Makes any controller a sampled one: between samples the control is held,

        u(t) = control(t_k)    for    t_k + delay <= t < t_(k+1) + delay,    t_k = k period.

    The controller is evaluated only at samples. Before the first control acts, that of the start is
    held, as if the robot had been at rest there.

    The updates are unrestricted, which Drake computes before discrete ones and all from the same
    instant: so the controller sees time, state and reference at t_k, even if a discrete
    MultibodyPlant steps at t_k (also an unrestricted update). That plant uses the previously held
    control, and so sees a delay longer by one of its steps.

    Input port:
        control: The present control of the controller, shape (p,).

    Output port:
        control: The held control, shape (p,); no direct feedthrough.

    Args:
        size: The number of controls, p.
        sampling: Period and delay.

    Raises:
        WiringError: At the start of a run: the first control depends on itself.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, size: int, sampling: Sampling) -> None:
        super().__init__()
        check_whole_number("size", size, 1)
        self.set_name("control_hold")
        self.sampling = sampling
        self.sample_period = sampling.period
        self._port = self.DeclareVectorInputPort("control", size)
        # The held control; then the waiting ones, the oldest first.
        waiting = sampling.whole_periods + (sampling.rest > 0.0)
        self._state = self.DeclareDiscreteState(np.full((1 + waiting) * size, np.nan))
        self.DeclareInitializationUnrestrictedUpdateEvent(weakly(self._begin))
        read = self._read if sampling.rest else self._read_and_act
        self.DeclarePeriodicUnrestrictedUpdateEvent(sampling.period, 0.0, weakly(read))
        if sampling.rest:
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                sampling.period, sampling.rest, weakly(self._act)
            )
        self.DeclareVectorOutputPort("control", size, weakly(self._calc), {self.xd_ticket()})

    def _begin(self, context: Context, state: State) -> EventStatus:
        rows = self._rows(context)
        if not np.isnan(rows).any():
            return EventStatus.DidNothing()  # A run that is continued.
        try:
            rows[:] = self._port.Eval(context)
        except NonFiniteError as error:
            raise WiringError(
                "the first control cannot be found, as where a law reads the force that its own "
                "control makes: put a ForceSensor with a sample_period between, which has a force "
                "at the start, or set what control_hold holds before the first sample by "
                "SetDiscreteState"
            ) from error
        return self._set(state, rows)

    def _read_and_act(self, context: Context, state: State) -> EventStatus:
        return self._set(state, np.vstack([self._rows(context)[1:], self._port.Eval(context)]))

    def _read(self, context: Context, state: State) -> EventStatus:
        rows = self._rows(context)
        return self._set(state, np.vstack([rows[:1], rows[2:], self._port.Eval(context)]))

    def _act(self, context: Context, state: State) -> EventStatus:
        rows = self._rows(context)
        rows[0] = rows[1]
        return self._set(state, rows)

    def _rows(self, context: Context) -> np.ndarray:
        vector = context.get_discrete_state(self._state).CopyToVector()
        return vector.reshape(-1, self._port.size())

    def _set(self, state: State, rows: np.ndarray) -> EventStatus:
        state.get_mutable_discrete_state().set_value(self._state, rows.ravel())
        return EventStatus.Succeeded()

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._rows(context)[0])

    def traced(self) -> Block:
        size = self._port.size()
        waiting = self.sampling.whole_periods + (self.sampling.rest > 0.0)
        rows, control = ca.SX.sym("held", (1 + waiting) * size), ca.SX.sym("control", size)

        def computation(*parts: ca.SX) -> Computation:
            function = ca.Function("held", [rows, control], [ca.vertcat(*parts)])
            return Computation(function, (HELD, "control"), (HELD,))

        now, later = rows[:size, 0], rows[size:, 0]
        period, rest = self.sampling.period, self.sampling.rest
        updates = [Update(computation(later, control), period, 0.0, True)]
        if rest:
            read = computation(now, later[size:, 0], control)
            act = ca.Function("act", [rows], [ca.vertcat(later[:size, 0], later)])
            updates = [
                Update(read, period, 0.0, True),
                Update(Computation(act, (HELD,), (HELD,)), period, rest, True),
            ]
        shown = Computation(ca.Function("shown", [rows], [now]), (HELD,), ("control",))
        first = ca.Function("first", [control], [ca.repmat(control, 1 + waiting, 1)])
        return Block(
            self, (shown,), tuple(updates), initial=Computation(first, ("control",), (HELD,))
        )
