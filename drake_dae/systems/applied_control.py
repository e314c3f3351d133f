"""What acts on a robot of a control: it is sampled, late, held between samples, and limited."""

from dataclasses import dataclass
from math import ceil, floor

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import check_whole_number, positive
from drake_dae.blocks.block import Block, Held
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.errors import ModelError

_SAME = 1e-9  # Times that differ by less than this, in periods, count as equal.

_MOST = 10_000  # computations on the way: each is stored, and shifted at every sample


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
        positive("a sampling's period", self.period)
        if not 0.0 <= self.delay <= _MOST * self.period:
            raise ModelError(
                f"a sampling's delay must be from 0 to {_MOST} periods, got {self.delay:g} s"
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
class ControlHold(TracedSystem):
    """Makes any controller a sampled one: between samples the control is held,

        u(t) = control(t_k)    for    t_k + delay <= t < t_(k+1) + delay,    t_k = k period.

    The controller is evaluated only at samples. Before the first control acts, that of the start is
    held. A discrete MultibodyPlant that steps at t_k uses the previously held control, and so sees
    a delay longer by one of its steps.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, size: int, sampling: Sampling) -> None:
        check_whole_number("size", size, 1)
        self.sampling, self.sample_period = sampling, sampling.period
        # The control that is held, and those on the way, the oldest first.
        count, rate = sampling.whole_periods + (sampling.rest > 0.0), sampling.period
        control, now = ca.SX.sym("control", size), ca.SX.sym("now", size)
        later, unknown = ca.SX.sym("later", count * size), np.full(size, np.nan)
        first, coming = ca.vertsplit(ca.vertcat(later, control), [0, size, (count + 1) * size])
        held = {"now": Held(now, first, unknown, rate, sampling.rest, begin=control)}
        if count:
            begin = ca.repmat(control, count, 1)
            held["later"] = Held(later, coming, np.tile(unknown, count), rate, begin=begin)
        inputs, outputs = {"control": control}, {"control": now}
        super().__init__(Block("control_hold", inputs, outputs, held=held))


@checked(ModelError)
class ControlLimits(TracedSystem):
    """Limits each control, and reports the excess.

    Input port:
        control: The control before the limits, shape (p,).

    Output ports:
        control: The limited control, max(-limit, min(limit, control)), shape (p,).
        excess: The control minus the limited control, shape (p,): 0 within the limits.
        is_limited: 1 while any control is limited, else 0, shape (1,); for the `hold` of a
            `TrackingController` with integrals.

    Args:
        limits: The largest |control|, shape (p,), positive; infinite without a limit.

    Raises:
        ModelError: A limit is not positive, or there are no limits.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, limits: ArrayLike) -> None:
        self.limits = np.array(limits, dtype=float)
        if self.limits.ndim != 1 or not self.limits.size or not np.all(self.limits > 0.0):
            raise ModelError(f"limits must be positive numbers of shape (p,), got {limits!r}")
        control = ca.SX.sym("control", self.limits.size)
        limited = ca.fmax(-self.limits, ca.fmin(self.limits, control))
        outputs = {
            "control": limited,
            "excess": control - limited,
            "is_limited": ca.mmax(ca.fabs(control) - self.limits) > 0,
        }
        super().__init__(Block("control_limits", {"control": control}, outputs))
