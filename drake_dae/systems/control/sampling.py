"""Sampled laws: inputs at samples, with delay, held between samples."""

from dataclasses import dataclass
from math import ceil, floor, isfinite

import casadi as ca
import numpy as np
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number
from drake_dae.errors import ModelError, NonFiniteError, WiringError
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import HELD, Block, Computation, Update

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""

MOST_ON_THE_WAY = 10_000
"""The largest number of computations in progress: each is stored and shifted at every sample."""


@checked(ModelError)
@dataclass(frozen=True)
class Packets:
    """Measurements on their way to a sampled law: one packet for each sample, with x and forces.

    The law uses the newest packet that has arrived. So do the guards of a task: they see a touch
    when its packet comes, and a value that is repeated counts as a sample. An observer knows which
    packets are new: at a sample without one it goes on by its model, and learns nothing.

    Attributes:
        late: The probability that a packet comes after its sample, and before the next one; less
            than 1.
        loss: The probability at each sample that packets begin to be lost, less than 1.
        burst: The number of packets in a row that are lost each time.
        most_lost: The number of samples without a new measurement after which the law stops the
            robot, which ends the run with an error. None for never.

    Raises:
        ModelError: A number is out of range.
    """

    late: float = 0.0
    loss: float = 0.0
    burst: int = 1
    most_lost: int | None = None

    def __post_init__(self) -> None:
        for name in ("late", "loss"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ModelError(
                    f"the {name} of measurements is a probability of 0 or more and less than 1, "
                    f"got {getattr(self, name):g}"
                )
        check_whole_number("the burst of measurements", self.burst, 1)
        if self.most_lost is not None:
            check_whole_number("the most_lost of measurements", self.most_lost, 1)

    @property
    def longest(self) -> int:
        """The largest number of samples in a row without a new packet, with one loss at a time."""
        return (self.burst if self.loss else 0) + (1 if self.late else 0)


@checked(ModelError)
@dataclass(frozen=True)
class Sampling:
    """A law samples its inputs at t_k = k period; its control acts from t_k + delay on.

    With `jitter` some controls act later, with `loss` some do not arrive; then the drives hold the
    last control that arrived. The law does not know it: its integrals and its references go on. An
    observer uses the control at the drives. Measurements have `Packets` of their own.

    Attributes:
        period: T in s, positive.
        delay: The time to compute and send, in s, 0 or more; it may exceed a period, with several
            computations in progress.
        jitter: A further delay in s, less than a period: each control has it with probability 1/2.
            No other distribution of delays up to this one has a larger variance.
        loss: The probability p at each sample that controls begin to be lost, less than 1.
        burst: The number n of controls in a row that are lost each time; in all a share of
            n p / (n p + 1 - p).
        most_lost: The number of lost controls in a row at which the robot stops by itself, which
            ends the run with an error; 20 for a Franka arm. None for never.
        seed: The seed of jitter and loss in a scenario; in Python see `ClosedLoop.set_seed`.
        measurements: Late and lost measurements; None if all arrive at once.

    Raises:
        ModelError: The period is not positive, the delay is negative or very many periods, or
            another number is out of range.
    """

    period: float
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    burst: int = 1
    most_lost: int | None = None
    seed: int = 0
    measurements: Packets | None = None

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
        if not 0.0 <= self.jitter < self.period:
            raise ModelError(
                f"a sampling's jitter must be 0 or more and less than its period of "
                f"{self.period:g} s, got {self.jitter:g} s"
            )
        if not 0.0 <= self.loss < 1.0:
            raise ModelError(
                "a sampling's loss is a probability of 0 or more and less than 1, got "
                f"{self.loss:g}"
            )
        check_whole_number("a sampling's burst", self.burst, 1)
        if self.most_lost is not None:
            check_whole_number("a sampling's most_lost", self.most_lost, 1)
        check_whole_number("a sampling's seed", self.seed, 0)

    @property
    def is_exact(self) -> bool:
        """Whether each control arrives at the drives, with the same delay."""
        return not (self.jitter or self.loss)

    @property
    def mean_delay(self) -> float:
        """The mean delay of the controls that arrive, in s."""
        return self.delay + self.jitter / 2.0

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
        return ceil((self.delay + self.jitter) / self.period - _SAME)


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
