"""What a task computes, as traced functions of the numbers of its present segment."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.traced import (
    GAPS,
    HELD,
    MARGINS,
    PARAMETERS,
    RATES,
    TIME,
    Computation,
)
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.control.references import traced_references
from drake_dae.systems.task.phases import Moment, Phase
from drake_dae.systems.task.phases.tally import GuardMemory
from drake_dae.systems.task.planner import CONTACT, FREE, TaskPlanner
from drake_dae.systems.task.progress import ReferenceSegment, TaskProgress
from drake_dae.systems.task.task import Task
from drake_dae.trace.functions import TracedFunction

SEEN = ("force", "bias", "count")
"""What a context holds of the force: after its low-pass, its mean before a touch, and of how many
samples that is."""

NAMES = ("place", "contact", "start", "over", "touched", "felt", "is_felt", "distance", *SEEN)
"""Which numbers a context holds of a task, before base, rate and fade of its present segment."""

EARLY = 1e-12
"""A margin that is less is over: so zeros are alike whose round-off is not."""


class TracedTask:
    """The functions of a `TaskSupervisor`, by the numbers of its present segment.

    Args:
        task, laws, place, force: As of the supervisor.
        plan: What makes its references.
        num_forces: How many constraint forces are measured.
        sample_period: When guards are looked at, in s; 0 for at all times.

    Attributes:
        size: How many numbers there are.
        tally: What is counted for the guards.
    """

    def __init__(
        self,
        task: Task,
        laws: tuple[TrackingLaw, TrackingLaw],
        place: int,
        force: int,
        plan: TaskPlanner,
        num_forces: int,
        sample_period: float,
    ) -> None:
        self._task, self._laws, self._place, self._plan = task, laws, place, plan
        self._phases, self._tares = task.plan.phases, task.tare_samples(sample_period)
        self.tally = GuardMemory(self._phases, sample_period)
        count = len(laws[FREE].degrees)
        rows = max(law.layout.reference_size for law in laws)
        self._shape = (rows, 2 * max(2, *(max(law.degrees) for law in laws)) + 2)
        sizes = [len(NAMES), count, count, rows * self._shape[1], plan.moved, self.tally.size]
        ends = np.cumsum(sizes).tolist()
        self.size = ends[-1]
        self._time, self._held = ca.SX.sym("time"), ca.SX.sym("held", self.size)
        self._tallied = slice(ends[-2], ends[-1])
        self._base, self._rate, fade, self._origin, self._counts = (
            self._held[a:b] for a, b in pairwise(ends)
        )
        self._faded = ca.reshape(fade, *self._shape)
        self._named = {name: self._held[i] for i, name in enumerate(NAMES)}
        self._forces = ca.SX.sym("force", num_forces)
        self._index = force
        seen = ca.vertcat(*(self._named[name] for name in SEEN))
        self._seen = self._after(seen, self._forces[force])
        self._force, self._bias = self._seen[0], self._seen[1]
        given = [seen, self._forces[force]]
        self._seeing = ca.Function("seeing", given, [self._seen])

    def _after(self, seen: ca.SX, measured: ca.SX) -> ca.SX:
        """What is seen of the force with one more sample."""
        force, bias, count = ca.vertsplit(seen)
        if self._tares:
            waits = count < self._tares - 0.5
            count = ca.if_else(waits, count + 1, count)
            bias = ca.if_else(waits, bias + (measured - bias) / count, bias)
            known = ca.if_else(waits, 0, measured - bias)
        else:
            known = measured
        return ca.vertcat(force + self._task.force_gain * (known - force), bias, count)

    def seen(self, held: FloatArray, measured: float) -> FloatArray:
        """What is held of the force after a sample: see `SEEN`.

        Args:
            held: What was held, shape (size,).
            measured: The force of the contact, in N.
        """
        return np.array(self._seeing(held[self._places], measured)).ravel()

    def tares(self, held: FloatArray) -> bool:
        """Whether the bias of the force is still being found."""
        return bool(held[NAMES.index("count")] < self._tares - 0.5)

    def tally_of(self, held: FloatArray) -> FloatArray:
        """What has been counted for the guards; see `GuardMemory`."""
        return held[self._tallied]

    def work_of(self, held: FloatArray) -> float:
        """The work of the contact force since the phase began, in J; 0 where no guard needs it."""
        return float(self.tally.work(self.tally_of(held)))

    @property
    def _places(self) -> list[int]:
        return [NAMES.index(name) for name in SEEN]

    def numbers(self, progress: TaskProgress, seen: FloatArray, tally: FloatArray) -> FloatArray:
        """The numbers of a task that is so far, with what is seen of the force and counted."""
        found = np.zeros(self.size)
        if not progress.segments:
            return found
        segment = progress.segments[-1]
        change, touched = segment.change, self.touched(progress.segments)
        felt = progress.felt if np.isfinite(progress.felt) else change.time
        flags = [change.place, change.in_contact, change.time, segment.over, touched, felt]
        faded = np.zeros(self._shape)
        faded[: segment.faded.shape[0], : segment.faded.shape[1]] = segment.faded
        parts = [
            *flags,
            progress.is_felt,
            change.distance,
            *seen,
            *segment.base,
            *segment.rate,
            *faded.ravel(order="F"),
            *segment.origin,
            *tally,
        ]
        found[:] = parts
        return found

    @staticmethod
    def touched(segments: Sequence[ReferenceSegment]) -> bool:
        """Whether the present segment began where the robot had been free."""
        return len(segments) > 1 and not segments[-2].change.in_contact

    def _in_phase(self, values: Callable[[int], ca.SX], otherwise: ca.SX) -> ca.SX:
        """What a function of the phase gives in that which goes on; else after the last."""
        place, count = self._named["place"], len(self._phases)
        found = ca.if_else(place > count - 0.5, otherwise, 0)
        for i in range(count):
            found += ca.if_else(ca.fabs(place - i) < 0.5, values(i), 0)
        return found

    def _reference(self, which: int) -> ca.SX:
        """R of a law, zero where the other one acts; see `ReferenceSegment`."""
        law, passed = self._laws[which], self._time - self._named["start"]
        size, lowest = law.layout.reference_size, law.layout.lowest.tolist()

        def goals(index: int) -> ca.SX:
            references = self._plan.goals[index].references
            if self._task.contacts[index] != bool(which):
                return ca.SX.zeros(size)
            time = ca.SX.sym("time")
            rows = traced_references(references, law.degrees, time)
            return ca.substitute(rows, time, passed)

        found = self._in_phase(goals, ca.SX.zeros(size))
        found[lowest] += self._base + self._rate * passed
        for i, degree in enumerate(law.degrees):
            if degree:
                found[lowest[i] + 1] += self._rate[i]
        share, powers = passed / self._named["over"], [ca.SX(1)]
        for _ in range(self._shape[1] - 1):
            powers.append(powers[-1] * share)
        fading = ca.mtimes(self._faded[:size, :], ca.vertcat(*powers))
        found += ca.if_else(passed < self._named["over"], fading, 0)
        acts = self._named["contact"] > 0.5
        return ca.if_else(acts if which else ca.logic_not(acts), found, 0)

    def computations(self) -> tuple[Computation, ...]:
        """All output ports with vectors."""
        found = []
        wanted = ca.SX.zeros(len(self._laws[FREE].degrees) + 1)
        for which, name in ((FREE, "free_reference"), (CONTACT, "contact_reference")):
            row = self._reference(which)
            inputs = {"time": self._time, "held": self._held}
            function = TracedFunction(name, inputs, {"R": row})
            found.append(Computation.of(function, (TIME, HELD), (name,)))
            values = ca.vertcat(row[self._laws[which].layout.lowest.tolist()], 0)
            if which == FREE:
                values[-1], values[self._place] = values[self._place], 0
            wanted += values
        contact = self._named["contact"]
        settles = self._named["touched"] * (self._time < self._named["start"] + self._named["over"])
        is_open = ca.logic_or(contact < 0.5, self._force < self._task.contact_force)
        given, hold = [self._time, self._held], ca.SX.sym("hold")
        shown = ca.Function("shown", given, [wanted, self._named["place"], contact])
        outputs = ("desired_output", "phase", "in_contact")
        found.append(Computation(shown, (TIME, HELD), outputs))
        waits = ca.Function("free_hold", [self._held, hold], [ca.logic_or(contact > 0.5, hold)])
        found.append(Computation(waits, (HELD, "hold"), ("free_hold",)))
        stands = ca.logic_or(ca.logic_or(is_open, settles), hold)
        holds = ca.Function("hold", [*given, self._forces, hold], [stands])
        sources = (TIME, HELD, "measured_force", "hold")
        found.append(Computation(holds, sources, ("contact_hold",)))
        if self._tares:
            tared = ca.SX(self._forces)
            tared[self._index] -= self._bias
            function = ca.Function("tared", [self._held, self._forces], [tared])
            found.append(Computation(function, (HELD, "measured_force"), ("tared_force",)))
        return tuple(found)

    def unchanged(self) -> Computation:
        """What is held after a sample at which nothing changes."""
        held = ca.SX(self._held)
        held[self._places] = self._seen
        if not self.tally.size:
            function = ca.Function("held", [self._held, self._forces], [held])
            return Computation(function, (HELD, "measured_force"), (HELD,))
        moment, inputs, sources = self._sight()
        counts = self._counted()

        def after(index: int) -> ca.SX:
            return ca.vertcat(*self.tally.after(self._phases[index], counts, moment))

        held[self._tallied] = self._in_phase(after, ca.SX.zeros(self.tally.size))
        return Computation(ca.Function("held", inputs, [held]), sources, (HELD,))

    def _counted(self) -> list[ca.SX]:
        return [self._counts[i] for i in range(self.tally.size)]

    def _sight(self) -> tuple[Moment, list[ca.SX], tuple[str, ...]]:
        """What guards see, without a signal, and what that is computed from."""
        named, law, moved = self._named, self._laws[FREE], self._plan.moved
        x, parameters = law.system.state, law.system.parameter_symbol
        motion = self._plan.motion_function.function.call([x, parameters])[0]
        first, rates = motion[2 : 2 + moved], motion[2 + moved :]
        lowest = [
            self._reference(which)[int(law.layout.lowest[self._place])]
            for which, law in ((FREE, self._laws[FREE]), (CONTACT, self._laws[CONTACT]))
        ]
        inputs = [self._time, self._held, x, self._forces, parameters]
        sources, control = [TIME, HELD, "estimated_state", "measured_force", PARAMETERS], 0.0
        if self._task.watches("control"):
            u = ca.SX.sym("control", law.system.num_controls)
            inputs, sources, control = [*inputs, u], [*sources, "control"], ca.norm_inf(u)
        moment = Moment(
            self._time - named["start"],
            self._force,
            motion[0],
            motion[1],
            lowest[0] + lowest[1],
            motion[0] - named["distance"],
            speed=ca.norm_2(rates),
            travel=ca.norm_2(first - self._origin),
            work=self.tally.work(self._counted()),
            control=control,
        )
        return moment, inputs, tuple(sources)

    def guard(self) -> Computation:
        """The margins of a phase, as those of the supervisor.

        Raises:
            ModelError: A phase computes its margin from numbers alone.
        """
        named, task = self._named, self._task
        moment, inputs, sources = self._sight()
        signals = {name: ca.SX.sym(name) for name in task.signals}
        counts, tares = self._counted(), named["count"] < self._tares - 0.5
        excess = self._force - task.contact_force

        waits = ca.logic_and(named["contact"] > 0.5, named["is_felt"] < 0.5)
        lost = ca.if_else(waits, task.patience - (self._time - named["felt"]), 1)
        felt = ca.if_else(named["is_felt"] > 0.5, excess, -excess)

        def margins(index: int) -> ca.SX:
            phase = self._phases[index]
            now = replace(moment, signal=signals[phase.signal]) if phase.signal else moment
            end, late = self._ends(phase, now)
            guards = [ca.fmin(one, 1e9) for one in self.tally.margins(phase, counts, now)]
            if self._tares:
                end = ca.if_else(tares, 1, end)
            trips = ca.mmin(ca.vertcat(1e9, *guards))
            return ca.vertcat(trips, end, lost if phase.holds_contact else 1, late, felt)

        found = self._in_phase(margins, ca.vertcat(1, 1, lost, 1, felt))
        none = ca.SX(0, 1)
        inputs = [*inputs, *signals.values()]
        sources = (*sources, *(SIGNAL + name for name in signals))
        function = ca.Function("guard", inputs, [ca.densify(found - EARLY), none, none])
        return Computation(function, sources, (MARGINS, GAPS, RATES))

    def _ends(self, phase: Phase, now: Moment) -> tuple[ca.SX, ca.SX]:
        """The margins of a phase to its end and to being late."""
        try:
            end = ca.SX(phase.margin(now, self._task.contact_force))
            return end, ca.fmin(ca.SX(phase.remaining(now)), 1e9)
        except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
            raise ModelError(
                f"the margin of {phase.name} takes numbers alone, so that a rollout does not "
                "know it: take ca.fmax, ca.fmin and abs in its place; or run it by simulate"
            ) from error
