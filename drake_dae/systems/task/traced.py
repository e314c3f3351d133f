"""The outputs and guards of a task as traced functions of the numbers of its current segment."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import (
    HELD,
    MARGINS,
    PARAMETERS,
    TIME,
    Computation,
)
from drake_dae.errors import ModelError
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.control.references import traced_references
from drake_dae.systems.task.contacts.force_filter import ForceFilter
from drake_dae.systems.task.contacts.open_contact import CONTACT, FREE, LAWS, ContactLaws
from drake_dae.systems.task.contacts.outputs import TaskOutputs
from drake_dae.systems.task.phases import Moment, Phase
from drake_dae.systems.task.phases.phase import APPROACH, DONE, FAIL, HOLD, LEAVE, NEXT, STOP
from drake_dae.systems.task.planner import TaskPlanner
from drake_dae.systems.task.progress import LET_GO, ReferenceSegment, TaskProgress
from drake_dae.systems.task.task import Task
from drake_dae.trace.functions import TracedFunction

NAMES = (
    "place",
    "law",
    "start",
    "over",
    "touched",
    "felt",
    "is_felt",
    "distance",
    "approaches",
    "ending",
)
"""The first numbers of a task in a context: the current segment, the number of times that it went
back by "approach", and one of `ENDINGS`. The force filter, then base, rate and fade follow."""

ENDINGS = {NEXT: 1.0, DONE: 1.0, STOP: 2.0, LEAVE: 2.0, HOLD: 3.0, FAIL: 4.0}
"""Key word after which the robot rests -> the number of this ending; 0 while the task goes on."""

EARLY = 1e-12
"""A margin below this has ended, so that margins with different round-off end together."""


class TracedTask:
    """The functions of a `TaskSupervisor` of the numbers of its current segment.

    Args:
        task, pair, columns: Those of the supervisor.
        plan: The planner of its references.
        num_forces: The number of measured constraint forces.
        sample_period: The period of its samples, in s.

    Attributes:
        task: The argument.
        size: The number of these numbers.
        filter: The filter of the measured forces.
    """

    def __init__(
        self,
        task: Task,
        pair: ContactLaws,
        columns: TaskOutputs,
        plan: TaskPlanner,
        num_forces: int,
        sample_period: float,
    ) -> None:
        self.task, self._contact, self._columns, self._plan = task, pair.contact, columns, plan
        self._laws = laws = pair.laws
        tares = task.tare_samples(sample_period)
        self.filter = ForceFilter(pair.contact, task.force_gain, tares)
        self._phases = task.plan.phases
        count = len(laws[FREE].degrees)
        rows = max(law.layout.reference_size for law in laws)
        self._shape = (rows, 2 * max(2, *(max(law.degrees) for law in laws)) + 2)
        sizes = [len(NAMES), self.filter.size, count, count, rows * self._shape[1], plan.moved]
        sizes += [len(self._phases)]
        ends = np.cumsum(sizes).tolist()
        self.size = ends[-1]
        self._time, self._held = ca.SX.sym("time"), ca.SX.sym("held", self.size)
        self._segment, self._entered_places = slice(ends[1], ends[5]), slice(ends[5], ends[6])
        self._filter_places = slice(ends[0], ends[1])
        before, self._base, self._rate, fade, self._origin, self._entered = (
            self._held[a:b] for a, b in pairwise(ends)
        )
        self._faded = ca.reshape(fade, *self._shape)
        self._named = {name: self._held[i] for i, name in enumerate(NAMES)}
        self._forces = ca.SX.sym("force", num_forces)
        self._control = ca.SX.sym("control", laws[FREE].system.num_controls)
        self._filtered = self.filter.after(before, self._forces)
        given = {"before": before, "forces": self._forces}
        self._filter_function = TracedFunction("filter", given, {"after": self._filtered})
        self._each = self._filtered[: pair.contact.size]
        self._force = ca.sum1(self._each)

    def _acts(self, law: int) -> ca.SX:
        """Whether a law is active."""
        return ca.fabs(self._named["law"] - law) < 0.5

    def filtered(self, held: FloatArray, measured: FloatArray) -> FloatArray:
        """The state of the force filter after a sample, shape (filter.size,).

        Args:
            held: The numbers before it, shape (size,).
            measured: All measured forces, in N and N m.
        """
        return self._filter_function.evaluate(held[self._filter_places], measured)[0].copy()

    def tares(self, held: FloatArray) -> bool:
        """Whether the bias of the force is still being estimated."""
        return bool(held[self._filter_places][-1] < self.filter.tares - 0.5)

    def numbers(self, progress: TaskProgress, force: FloatArray) -> FloatArray:
        """The numbers of a task from its progress and the force filter.

        Shape (size,); zero before a run.
        """
        if not progress.segments:
            return np.zeros(self.size)
        segment = progress.segments[-1]
        change, touched = segment.change, self.touched(progress.segments)
        felt = progress.felt if np.isfinite(progress.felt) else change.time
        chosen, places = zip(*((each.chosen, each.place) for each in progress.changes), strict=True)
        ending = ENDINGS[change.chosen] if change.place == len(self._phases) else 0.0
        flags = [change.place, segment.law, change.time, segment.over, touched, felt]
        flags += [progress.is_felt, change.distance, chosen.count(APPROACH), ending]
        entered = [places.count(place) for place in range(len(self._phases))]
        faded = np.zeros(self._shape)
        faded[: segment.faded.shape[0], : segment.faded.shape[1]] = segment.faded
        sums = segment.base, segment.rate, faded.ravel(order="F"), segment.origin
        return np.hstack([flags, force, *sums, entered])

    @staticmethod
    def touched(segments: Sequence[ReferenceSegment]) -> bool:
        """Whether the contact was open in the previous segment, so that a touch began this one."""
        return len(segments) > 1 and not segments[-2].change.in_contact

    def _in_phase(self, values: Callable[[int], ca.SX], otherwise: ca.SX) -> ca.SX:
        """A function of the phase at the current phase; `otherwise` after the last one."""
        place, count = self._named["place"], len(self._phases)
        value = ca.if_else(place > count - 0.5, otherwise, 0)
        for i in range(count):
            value += ca.if_else(ca.fabs(place - i) < 0.5, values(i), 0)
        return value

    def _reference(self, which: int) -> ca.SX:
        """R of a law, zero while the other one is active; see `ReferenceSegment`."""
        law, passed = self._laws[which], self._time - self._named["start"]
        size, lowest = law.layout.reference_size, law.layout.lowest.tolist()

        def goals(index: int) -> ca.SX:
            references = self._plan.goals[index].references
            if self.task.plan.contacts[index] != (which == CONTACT):
                return ca.SX.zeros(size)
            time = ca.SX.sym("time")
            rows = traced_references(references, law.degrees, time)
            return ca.substitute(rows, time, passed)

        reference = self._in_phase(goals, ca.SX.zeros(size))
        reference[lowest] += self._base + self._rate * passed
        for i, degree in enumerate(law.degrees):
            if degree:
                reference[lowest[i] + 1] += self._rate[i]
        share, powers = passed / self._named["over"], [ca.SX(1)]
        for _ in range(self._shape[1] - 1):
            powers.append(powers[-1] * share)
        fading = ca.mtimes(self._faded[:size, :], ca.vertcat(*powers))
        reference += ca.if_else(passed < self._named["over"], fading, 0)
        return ca.if_else(self._acts(which), reference, 0)

    def computations(self) -> tuple[Computation, ...]:
        """The computations of all vector output ports."""
        computations = []
        contact, size = self._contact, self._contact.size
        desired = ca.SX.zeros(self._columns.size)
        for which, law in enumerate(self._laws):
            row, name = self._reference(which), f"{LAWS[which]}_reference"
            function = TracedFunction(name, {"time": self._time, "held": self._held}, {"R": row})
            computations.append(Computation.of(function, (TIME, HELD), (name,)))
            desired[self._columns.of_law(which)] += row[law.layout.lowest.tolist()]
        is_closed = self._named["law"] == CONTACT
        settles = self._named["touched"] * (self._time < self._named["start"] + self._named["over"])
        least = size * ca.mmin(self._each)
        is_open = ca.logic_or(ca.logic_not(is_closed), least < self.task.contact_force)
        inputs, hold = [self._time, self._held], ca.SX.sym("hold")
        outputs = ["desired_output", "phase", "law", "ending"]
        values = [desired, *(self._named[name] for name in ("place", "law", "ending"))]
        shown = ca.Function("shown", inputs, values)
        computations.append(Computation(shown, (TIME, HELD), tuple(outputs)))
        waits = ca.Function("free_hold", [self._held, hold], [ca.logic_or(is_closed, hold)])
        computations.append(Computation(waits, (HELD, "hold"), ("free_hold",)))
        stands = ca.logic_or(ca.logic_or(is_open, settles), hold)
        holds = ca.Function("hold", [*inputs, self._forces, hold], [stands])
        sources = (TIME, HELD, "measured_force", "hold")
        computations.append(Computation(holds, sources, ("contact_hold",)))
        if self.filter.tares:
            tared = ca.SX(self._forces)
            tared[list(contact.forces)] -= self._filtered[size : 2 * size]
            function = ca.Function("tared", [self._held, self._forces], [tared])
            computations.append(Computation(function, (HELD, "measured_force"), ("tared_force",)))
        return tuple(computations)

    def unchanged(self) -> Computation:
        """The numbers after a sample at which the phase goes on."""
        held = ca.SX(self._held)
        held[self._filter_places] = self._filtered
        function = ca.Function("held", [self._held, self._forces], [held])
        return Computation(function, (HELD, "measured_force"), (HELD,))

    def _moment(self) -> tuple[Moment, list[ca.SX], tuple[str, ...]]:
        """The measurements, and the symbols and sources of their inputs."""
        named, system = self._named, self._laws[FREE].system
        x, parameters = system.state, system.parameter_symbol
        motion = self._motion(x, parameters)
        wanted = ca.SX(0)
        for which, each in enumerate(self._laws):
            places = [self._contact.main] if which == CONTACT else list(self._contact.places)
            rows = each.layout.lowest[places].tolist()
            wanted += ca.sum1(self._reference(which)[rows]) / len(places)
        signals = {name: ca.SX.sym(name) for name in self.task.signals}
        inputs = [self._time, self._held, x, self._forces, parameters, *signals.values()]
        sources = [TIME, HELD, "estimated_state", "measured_force", PARAMETERS]
        sources += [SIGNAL + name for name in signals]
        controls = dict[str, ca.SX]()
        if self.task.controls:
            inputs, sources = [*inputs, self._control], [*sources, "control"]
            sizes = ca.fabs(self._control)
            controls = {name: sizes[i] for name, i in self._plan.control_places.items()}
            controls[""] = ca.mmax(sizes)
        moment = Moment(
            self._time - named["start"],
            self._force,
            motion[0],
            motion[1],
            wanted,
            motion[0] - named["distance"],
            ca.norm_2(motion[2:] - self._origin),
            signals,
            controls,
        )
        return moment, inputs, tuple(sources)

    def _motion(self, state: ca.SX, parameters: ca.SX) -> ca.SX:
        """The values of `TaskPlanner.motion_function`."""
        return self._plan.motion_function.function.call([state, parameters])[0]

    def guard(self) -> Computation:
        """The margins of a phase, the same as those of the supervisor.

        Raises:
            ModelError: The margin of a phase cannot be traced.
        """
        margins, inputs, sources = self._margins()
        function = ca.Function("guard", inputs, [ca.densify(margins - EARLY)])
        return Computation(function, sources, (MARGINS,))

    def _margins(self) -> tuple[ca.SX, list[ca.SX], tuple[str, ...]]:
        """The margins of `PhaseDecision`, and the symbols and sources of their inputs."""
        named, task = self._named, self.task
        moment, inputs, sources = self._moment()
        tares = self._held[self._filter_places][-1] < self.filter.tares - 0.5
        excess = self._force - task.contact_force

        waits = ca.logic_and(named["law"], named["is_felt"] < 0.5)
        lost = ca.if_else(waits, task.patience - (self._time - named["felt"]), 1)
        felt = ca.if_else(named["is_felt"] > 0.5, excess + LET_GO * task.contact_force, -excess)

        def margins(index: int) -> ca.SX:
            phase = self._phases[index]
            end, late = self._ends(phase, moment)
            guards = [ca.fmin(moment.margin(guard), 1e9) for guard in phase.guards]
            if self.filter.tares:
                end = ca.if_else(tares, 1, end)
            trips = ca.mmin(ca.vertcat(1e9, *guards))
            return ca.vertcat(trips, end, lost if phase.holds_contact else 1, late, felt)

        return self._in_phase(margins, ca.vertcat(1, 1, lost, 1, felt)), inputs, sources

    def _ends(self, phase: Phase, now: Moment) -> tuple[ca.SX, ca.SX]:
        """The margins of a phase until it succeeds and until it is late."""
        try:
            end = ca.SX(phase.success(now, self.task.contact_force))
            return end, ca.fmin(ca.SX(phase.remaining(now)), 1e9)
        except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
            raise ModelError(
                f"the margin of {phase.name} takes numbers alone, so that a rollout does not "
                "know it: take ca.fmax, ca.fmin and abs in its place; or run it by simulate"
            ) from error
