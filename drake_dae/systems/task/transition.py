"""The changes of phases as traced functions of a sampled task, for exports without Python."""

import casadi as ca
import numpy as np

from drake_dae.blocks.computations import (
    HELD,
    PARAMETERS,
    TIME,
    Computation,
    TracedChanges,
    Update,
)
from drake_dae.systems.task.contacts.open_contact import CONTACT, FREE
from drake_dae.systems.task.fade import fade
from drake_dae.systems.task.phases import Outcome
from drake_dae.systems.task.phases.phase import APPROACH, FAIL, LEAVE
from drake_dae.systems.task.traced import EARLY, ENDINGS, NAMES, TracedTask

_OUTCOMES: tuple[Outcome, ...] = ("guard", "success", "lost", "late")
"""How a phase ends, in the order of the margins of `PhaseDecision`, the first of which decides."""

_Change = tuple[ca.SX, ca.SX, ca.SX]
"""The index of the next phase, 1 after a return by "approach", and one of `ENDINGS`."""


class SampledTask(TracedTask):
    """A task whose phases change within the update of its numbers, as `TaskPlanner` has it.

    A task that ends by "fail" rests as one that ends by "hold"; its number of ENDINGS differs.
    """

    def reaction(self, period: float) -> TracedChanges:
        """The begin of the task and its update.

        Args:
            period: The sample period, in s.
        """
        return TracedChanges(self._begun(), Update(self._advanced(), period, 0.0, True))

    def _begun(self) -> Computation:
        """The numbers at the start of a run, as `TaskPlanner.first`."""
        law, first = self._laws[FREE], int(self.task.plan.contacts[0])
        x, parameters = law.system.state, law.system.parameter_symbol
        force = ca.SX(self.task.contact_force if first else 0.0)
        motion = self._motion(x, parameters)
        present = [self._met(which, force) for which in range(len(self._laws))]
        held = ca.SX.zeros(self.size)
        self._begin_phase(held, ca.SX(0), ca.SX(first), present, motion)
        held[NAMES.index("felt")] = self._time
        held[self._entered_places.start] = 1
        sources = (TIME, "estimated_state", PARAMETERS)
        return Computation(
            ca.Function("begun", [self._time, x, parameters], [held]), sources, (HELD,)
        )

    def _advanced(self) -> Computation:
        """The numbers after a sample, as `TaskSupervisor` has them."""
        named, end = self._named, len(self._phases)
        margins, inputs, sources = self._margins()
        unchanged = self.unchanged()
        known = dict(zip(sources, inputs, strict=True))
        law = self._laws[FREE]
        x, parameters = law.system.state, law.system.parameter_symbol
        same = unchanged.function.call([known[source] for source in unchanged.sources])[0]

        ended = [margins[i] <= 2.0 * EARLY for i in range(len(_OUTCOMES))]
        ends = ended[0]
        for each in ended[1:]:
            ends = ca.logic_or(ends, each)
        to, approaches, ending = self._successors(ended)

        was = named["law"]
        before, present = [self._reference(which) for which in range(len(self._laws))], []
        for which, law_after in enumerate(self._laws):
            met = self._met(which, self._force)
            places = self._contact.places
            for i, first in enumerate(law_after.layout.lowest.tolist()):
                if i not in places:
                    size = law_after.degrees[i] + 1
                    # R of a law that is not active is zero.
                    starts = [int(other.layout.lowest[i]) for other in self._laws]
                    parts = [r[at : at + size] for r, at in zip(before, starts, strict=True)]
                    met[first : first + size] = sum(parts[1:], parts[0])
            present.append(ca.if_else(self._acts(which), before[which], met))
        changed = ca.SX(same)
        after_law = self._law_after(to, ended)
        motion = self._motion(x, parameters)
        self._begin_phase(changed, to, after_law, present, motion)
        values = {
            "touched": ca.logic_not(was),
            "approaches": named["approaches"] + approaches,
            "ending": ca.if_else(named["place"] > end - 0.5, named["ending"], ending),
        }
        for name, value in values.items():
            changed[NAMES.index(name)] = value
        changed[self._entered_places] = self._entered + _at(to, end + 1)[:end]

        after = ca.if_else(ends, changed, same)
        is_felt = named["is_felt"] > 0.5
        turns = margins[len(_OUTCOMES)] <= 2.0 * EARLY
        after[NAMES.index("felt")] = ca.if_else(is_felt, self._time, named["felt"])
        after[NAMES.index("is_felt")] = ca.if_else(turns, ca.logic_not(is_felt), is_felt)
        return Computation(ca.Function("advanced", inputs, [after]), sources, (HELD,))

    def _begin_phase(
        self, held: ca.SX, place: ca.SX, number: ca.SX, present: list[ca.SX], motion: ca.SX
    ) -> None:
        """Writes the segment of a phase that begins now, as `ReferenceSegment.begin`.

        Args:
            held: The numbers of the task; changed in place.
            place: The index of the phase.
            number: The number of the law that becomes active.
            present: R of all laws at the end of the phase before.
            motion: The values of `TaskPlanner.motion_function`.
        """
        phases, plan = self._phases, self._plan
        chosen, count = _at(place, len(phases) + 1), len(self._laws[FREE].degrees)
        overs = [phase.over for phase in phases]
        over = ca.mtimes(ca.DM([[*overs, overs[-1]]]), chosen)
        rates = np.column_stack([*plan.rates, np.zeros(count)])
        named = np.zeros((count, len(phases) + 1))
        for index, each in enumerate(plan.goals):
            named[list(each.named), index] = 1.0
        goes, free = ca.mtimes(ca.DM(rates), chosen), 1 - ca.mtimes(ca.DM(named), chosen)
        sums = []
        for which, law in enumerate(self._laws):
            size, lowest = law.layout.reference_size, law.layout.lowest.tolist()
            first_goals = np.zeros((size, len(phases) + 1))
            for index, each in enumerate(plan.goals):
                if self.task.plan.contacts[index] == (which == CONTACT):
                    first_goals[:, index] = each.function(0.0)
            goal = ca.mtimes(ca.DM(first_goals), chosen)
            base, rate = ca.SX.zeros(count), ca.SX(goes * free)
            for i, (first, degree) in enumerate(zip(lowest, law.degrees, strict=True)):
                moving = present[which][first + 1] if degree else 0
                base[i] = free[i] * (present[which][first] + (moving - goes[i]) * over / 2)
                goal[first] += base[i]
                if degree:
                    goal[first + 1] += rate[i]
            rows = fade(present[which] - goal, law.degrees, over)
            faded = ca.SX.zeros(*self._shape)
            for row, factors in enumerate(rows):
                faded[row, : len(factors)] = ca.horzcat(*factors)
            sums.append(ca.vertcat(base, rate, ca.vec(faded)))
        chosen_sums = ca.SX.zeros(sums[0].numel())
        for which, values_of in enumerate(sums):
            chosen_sums += ca.if_else(ca.fabs(number - which) < 0.5, values_of, 0)
        held[self._segment] = ca.vertcat(chosen_sums, motion[2:])
        values = [place, number, self._time, over, motion[0]]
        for name, value in zip(("place", "law", "start", "over", "distance"), values, strict=True):
            held[NAMES.index(name)] = value

    def _met(self, which: int, force: ca.SX) -> ca.SX:
        """R of a law from the current outputs and the measured force, as `TaskPlanner`."""
        law, free = self._laws[which], self._laws[FREE].system
        chains = [
            chain[:degree]
            for chain, degree in zip(law.structure.output_chains, law.degrees, strict=True)
        ]
        own = law.system.state, law.system.parameter_symbol
        rows = ca.vertcat(ca.SX(0, 1), *(row for chain in chains for row in chain))
        function = ca.Function("outputs", own, [rows])
        reference = ca.SX.zeros(law.layout.reference_size)
        reference[law.layout.chained.tolist()] = function(free.state, free.parameter_symbol)
        main = self._contact.main
        if which == CONTACT and law.degrees[main] == 0:
            reference[int(law.layout.lowest[main])] = force
        return reference

    def _law_after(self, to: ca.SX, ended: list[ca.SX]) -> ca.SX:
        """The number of the law of the next phase, or of the law while the robot rests."""
        end, plan = len(self._phases), self.task.plan
        numbers = [float(closed) for closed in plan.contacts[:end]]
        next_law = ca.mtimes(ca.DM([[*numbers, 0.0]]), _at(to, end + 1))
        was = self._named["law"]

        def after(place: int) -> ca.SX:
            succeeds = ca.logic_and(ca.logic_not(ended[0]), ended[1])
            return ca.if_else(succeeds, float(plan.ends_in_contact(place)), was)

        felt = self._force >= self.task.contact_force
        rests = ca.logic_and(self._in_phase(after, was), felt)
        return ca.if_else(to > end - 0.5, rests, next_law)

    def _successors(self, ended: list[ca.SX]) -> _Change:
        """The change after the current phase, by how it has ended."""
        end = len(self._phases)

        def after(place: int, number: int) -> ca.SX:
            change = ca.vertcat(*self._successor(place, _OUTCOMES[number]))
            if number == len(_OUTCOMES) - 1:
                return change
            return ca.if_else(ended[number], change, after(place, number + 1))

        to, approaches, ending = ca.vertsplit(
            self._in_phase(lambda place: after(place, 0), ca.vertcat(end, 0, 0))
        )
        return to, approaches, ending

    def _successor(self, place: int, outcome: Outcome) -> _Change:
        """The change after a phase with its outcome, as `PhasePlan.successor`."""
        plan, end = self.task.plan, len(self._phases)
        ends_free = not (
            plan.ends_in_contact(place) if outcome == "success" else plan.contacts[place]
        )

        def following(at: int, word: str, left: int) -> _Change:
            to = plan.place_of(at, word) if left else None
            if to is None and word == LEAVE and not ends_free:
                to = plan.last
            if to is None or to == end:
                return ca.SX(end), ca.SX(0), ca.SX(ENDINGS[word if left else FAIL])
            if to >= plan.last:
                return ca.SX(to), ca.SX(0), ca.SX(0)
            phase, is_return = self._phases[to], word == APPROACH
            there = ca.SX(to), ca.SX(is_return), ca.SX(0)
            count, most = self._entered[to], phase.retries
            if most is None and is_return:
                count, most = 1 + self._named["approaches"], plan.retries
            if most is None:
                return there
            word = FAIL if is_return and phase.retries is None else phase.if_spent
            otherwise = following(to, word, left - 1)
            allowed = count <= most
            return (
                ca.if_else(allowed, there[0], otherwise[0]),
                ca.if_else(allowed, there[1], otherwise[1]),
                ca.if_else(allowed, there[2], otherwise[2]),
            )

        return following(place, self._phases[place].chosen(outcome), plan.last + 1)


def _at(place: ca.SX, count: int) -> ca.SX:
    """A column with 1 at an index and 0 elsewhere, shape (count, 1)."""
    return ca.vertcat(*(ca.fabs(place - i) < 0.5 for i in range(count)))
