"""Forces that the drives of a robot cannot hold: where the examination of a task ends."""

import time

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record, RecordAfter

TOO_MUCH = 1.5
"""The share of a drive's limit by contact forces alone at which the examination ends."""

_PERIOD = 0.2
"""The time by the clock between checks, in s; the result does not depend on it."""

_UNBALANCED = 1e-6
"""The part of the contact forces, relative to all, that drives may leave without balance."""


class HoldingWatch:
    """Ends a run at the first row in which contact forces alone need far more than a drive has.

    At rest drives balance the forces of contact where

        h u + g v = 0

    of (1): u is what they need for these forces alone, without weight and motion. Its smallest
    solution is taken. Where there is none, as with springs between drive and link, nothing ends.

    Without this end an explicit method takes very short steps: with a force F friction slows down
    a mass m at a rate of F mu / (m v_s), where v_s is the speed at which it is full.

    Args:
        model: The robot.

    Attributes:
        failure: The reason of the end, with time and state; None without one.
    """

    def __init__(self, model: RobotModel) -> None:
        dae, self._limits = model.dae, model.control_limits
        v = ca.SX.sym("v", dae.num_constraints)
        outputs = {"h": ca.densify(dae.h), "push": ca.densify(ca.mtimes(dae.g, v))}
        self._fields = dae.trace("holding", outputs, {"v": v}, often=False)
        self._dae, self._next = dae, 0.0
        self._time: float | None = None
        self.failure: SimulationError | None = None

    def look(self, record: RecordAfter, *, always: bool = False) -> bool:
        """Checks the rows of a run since the last check; returns whether the run ends.

        Args:
            record: Time in s, or None -> the record after it.
            always: Whether to check now, as at the end of the run.
        """
        if self.failure is None and (always or time.perf_counter() >= self._next):
            self._check(record(self._time))
            self._next = time.perf_counter() + _PERIOD
        return self.failure is not None

    def _check(self, rows: Record) -> None:
        forces = rows["constraint_force"]
        if forces.shape[1] != self._dae.num_constraints or not np.isfinite(self._limits).any():
            return
        for moment, state, force in zip(rows.time, rows["state"], forces, strict=True):
            if not force.any():
                continue
            needs = self._needs(state, force)
            drive = int(np.argmax(needs / self._limits))
            if needs[drive] > TOO_MUCH * self._limits[drive]:
                signal = self._dae.control_signals[drive]
                limit = f"{self._limits[drive]:.4g} {signal.unit}"
                text = (
                    f"{signal.name} cannot hold the forces of contact: at {moment:.4g} s they "
                    f"alone need {needs[drive]:.4g} {signal.unit} of it, and its limit is {limit}. "
                    "What follows is not examined; lower the force in task.phases, or choose "
                    "another posture"
                )
                self.failure = SimulationError(text, float(moment), state)
                return
        if rows.time.size:
            self._time = float(rows.time[-1])

    def _needs(self, state: FloatArray, force: FloatArray) -> FloatArray:
        """|u| for the forces alone, shape (p,); zero where drives do not balance them."""
        h, push = self._fields(state, force, self._dae.parameter_values)
        h, push = h.reshape(state.size, -1), push.ravel()
        u = np.linalg.lstsq(h, -push)[0]
        left = np.linalg.norm(h @ u + push)
        balanced = left <= _UNBALANCED * np.linalg.norm(push)
        return np.abs(u) if balanced else np.zeros(u.size)
