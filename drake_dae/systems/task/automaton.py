"""The automaton of a task with the laws that it switches, as one block."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import factorial, inf

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.blocks.block import TIME, Block, Held, Requirement, stacked
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.references import ConstantReference
from drake_dae.references.by_name import assign, in_order
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.control.references import traced_references
from drake_dae.systems.task.contacts import CONTACT, FREE, OpeningContact
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.task import Task

CHANGE = (
    *(Signal("number of changes"), Signal("phase"), Signal("in contact"), Signal("start", "s")),
    *(Signal("cause"), Signal("force", "N"), Signal("distance", "m")),
    *(Signal("distance rate", "m/s"), Signal("ending"), Signal("phase before")),
)
"""The last change of phase: how many there were, the index of the phase, whether the law in contact
is active, when and why it began (BEGUN, ..., GUARD), the force and distance then, how the task has
ended, and the index of the phase before."""

BEGUN, SUCCESS, LATE, LOST, GUARD = range(5)
"""Why a phase began: the task begins, or the phase before has ended by this; by its guard i with
GUARD + i."""

GOING, ALL_DONE, RESTING, GIVEN_UP = range(4)
"""The endings of a task."""

SMOOTH = 2
"""The least number of continuous derivatives of a fade, even if a law needs fewer."""

LET_GO = 1e-3
"""A contact ceases to be felt this share below `contact_force`, so that a force that stays there,
apart from round-off, does not begin and cease to be felt all the time."""

EARLY = 2e-12
"""A margin below this has ended, so that margins with different round-off end together."""


@cache
def fading(order: int) -> FloatArray:
    """Rows k: factors of 1, x, ..., x^(2 n + 1) whose derivative k alone, of n, is 1 at 0."""
    powers = np.arange(2 * order + 2)
    # Row j: the j-th derivatives of the powers at 1.
    at_end = np.array(
        [[float(np.prod(powers[p] - np.arange(j))) for p in powers] for j in range(order + 1)]
    )
    factors = np.zeros((order + 1, 2 * order + 2))
    factors[:, : order + 1] = np.diag([1.0 / factorial(k) for k in range(order + 1)])
    remaining = at_end[:, : order + 1] @ factors[:, : order + 1].T
    factors[:, order + 1 :] = -np.linalg.solve(at_end[:, order + 1 :], remaining).T
    return factors


def faded(offset: ca.SX, degrees: Sequence[int], passed: ca.SX, over: ca.SX) -> ca.SX:
    """What is left of offsets d = (d_1, d_1', ..., d_p^(mu_p)) after a time, with derivatives.

    For each output it is the polynomial of degree 2 n + 1, n = max(mu, SMOOTH), in t with

        p^(k)(0) = d^(k) (0 for k > mu),    p^(k)(over) = 0,    k = 0, ..., n,

    and 0 afterwards; shape as d.
    """
    left, first = [], 0
    for mu in degrees:
        factors = fading(max(mu, SMOOTH))[: mu + 1]
        powers = [ca.SX(1)]
        for _ in range(factors.shape[1] - 1):
            powers.append(powers[-1] * (passed / over))
        own = offset[first : first + mu + 1]
        for j in range(mu + 1):
            row = ca.vertcat(*powers[: factors.shape[1]])
            left.append(
                sum(own[k] * over ** (k - j) * ca.dot(factors[k], row) for k in range(mu + 1))
            )
            factors = factors[:, 1:] * np.arange(1, factors.shape[1])
        first += mu + 1
    return ca.if_else(passed < over, ca.vertcat(*left), 0)


def chosen(place: ca.SX, values: Sequence[ca.SX | float | FloatArray]) -> ca.SX:
    """The value with an index; what the others are does not matter."""
    value = ca.SX(0)
    for i, each in enumerate(values):
        value += ca.if_else(ca.fabs(place - i) < 0.5, each, 0)
    return value


class Automaton:
    """Phases, guards, changes and references of a task, and the two laws, as expressions.

    The references of a phase that began at t_0 are, with t = time - t_0,

        R(t) = goal(t) + base + rate t + faded(offset, t),

    where base and rate are 0 for outputs with goals; before the first sample, R is that of the
    present outputs. `laws` are that of the free robot, and that in contact.
    """

    def __init__(
        self,
        task: Task,
        contact: OpeningContact,
        laws: tuple[TrackingLaw, TrackingLaw],
        period: float,
    ) -> None:
        self.task, self.contact, self.laws, self.period = task, contact, laws, period
        self.phases, self.end = task.all_phases, len(task.all_phases)
        closed, free = laws[CONTACT].system, laws[FREE].system
        self.state, self.values = closed.state, closed.parameter_symbol
        self.gains = [
            ca.SX.sym("gains", law.all_parameters().size - self.values.numel()) for law in laws
        ]
        self.force = ca.SX.sym("measured_force", closed.num_constraints)
        self.hold = ca.SX.sym("hold")
        self.signals = {name: ca.SX.sym(name) for name in task.watched("signal")}
        # By the model: z, z', ... of both laws, the distance and its derivative, all outputs in m.
        self.chains = []
        for law in laws:
            own = [law.system.state, law.system.parameter_symbol]
            chain = ca.Function("chain", own, [law.structure.chain])
            self.chains += chain.call([self.state, self.values])
        starts, chain, places = laws[FREE].layout.starts, self.chains[FREE], list(contact.places)
        self.distance, self.rate = (
            ca.sum1(chain[(starts[places] + order).tolist()]) / contact.size for order in (0, 1)
        )
        in_metres = [i for i, each in enumerate(free.output_signals) if each.unit == "m"]
        rest = starts[[i for i in in_metres if i not in places]].tolist()
        self.moved = ca.vertcat(self.distance, chain[rest])
        self.first_force = task.contact_force * task.contacts[0]
        self._declare(free.num_outputs)
        self._filter()
        self.goals = [self._goals_of(place) for place in range(self.end)]
        self.references = [self._reference(which) for which in (FREE, CONTACT)]

    def _declare(self, count: int) -> None:
        """The held values, and their present ones: before the task begins those of its begin."""
        size = max(law.layout.reference_size for law in self.laws)
        columns = {"change": len(CHANGE), "entered": self.end, "filter": 2 * self.contact.size + 1}
        columns |= {"over": 1, "touched": 1, "felt": 2, "moved": self.moved.numel()}
        columns |= {"base": count, "rate": count, "offset": size}
        self.held = {name: ca.SX.sym(name, size) for name, size in columns.items()}
        number, place, law, start, _, _, distance, _, ending, _ = ca.vertsplit(self.held["change"])
        self.has_begun = number > 0.5
        self.place, self.ending, self.away = place, ending, self.distance - distance
        self.passed = TIME - start
        self.is_closed = ca.if_else(self.has_begun, law, float(self.task.contacts[0])) > 0.5

    def _filter(self) -> None:
        """The low-pass of the contact's forces minus their bias, the mean of the first samples."""
        size, own = self.contact.size, self.force[list(self.contact.forces)]
        low, bias, count = (
            self.held["filter"][i : i + n] for i, n in ((0, size), (size, size), (2 * size, 1))
        )
        tares, unbiased = self.task.tare_samples(self.period), own
        self.waits = count < tares - 0.5
        if tares:
            count = ca.if_else(self.waits, count + 1, count)
            bias = ca.if_else(self.waits, bias + (own - bias) / count, bias)
            unbiased = ca.if_else(self.waits, ca.SX.zeros(size), own - bias)
        self.each = low + self.task.force_gain * (unbiased - low)
        self.filtered, self.total = ca.vertcat(self.each, bias, count), ca.sum1(self.each)
        self.tared = ca.SX(self.force)
        self.tared[list(self.contact.forces)] -= bias

    # The references.

    def _goals_of(self, place: int) -> tuple[list[int], ca.SX, ca.SX, FloatArray]:
        """The outputs with goals in a phase, R at its start and now, and rates of the others."""
        phase, contact, is_closed = self.phases[place], self.contact, self.task.contacts[place]
        law = self.laws[int(is_closed)]
        names, where = [s.name for s in law.system.output_signals], self.task.where(place)
        main, rates, time = names[contact.main], np.zeros(len(names)), ca.SX.sym("time")
        for name, rate in phase.rates(main).items():
            if name not in names:
                raise ModelError(f"{where}: {unknown_name('output', name, names)}")
            rates[names.index(name)] = rate
        if not is_closed:
            rates[contact.others] = rates[contact.main]
        wanted = dict(phase.goals(main))
        try:
            found = [assign(name, goal, names, law.degrees) for name, goal in wanted.items()]
            named = [i for each in found for i in each.places]
            for each in [each for each in found if list(each.places) == [contact.main]]:
                for i in contact.others:
                    if i not in named:
                        goal = ConstantReference(0.0) if is_closed else each.reference
                        found.append(assign(names[i], goal, names, law.degrees))
                        named.append(i)
            found += [
                assign(name, ConstantReference(0.0), names, law.degrees)
                for i, name in enumerate(names)
                if i not in named
            ]
            row = traced_references(in_order(found, names), law.degrees, time)
        except ReferenceSignalError as error:
            raise ModelError(f"{where}: {error}") from error
        rates[named] = 0.0
        return named, ca.substitute(row, time, 0.0), ca.substitute(row, time, self.passed), rates

    def _goals_at(self, which: int, place: ca.SX, is_start: bool) -> ca.SX:
        """R of the goals of a phase, for a law; zero if it is not that of the phase."""
        zero = ca.SX.zeros(self.laws[which].layout.reference_size)
        values = [
            (start if is_start else now) if self.task.contacts[i] == (which == CONTACT) else zero
            for i, (_, start, now, _) in enumerate(self.goals)
        ]
        return zero + chosen(place, values)

    def _along(self, which: int, base: ca.SX, rate: ca.SX, passed: ca.SX | float) -> ca.SX:
        """R of base + rate t."""
        law = self.laws[which]
        rows = ca.SX.zeros(law.layout.reference_size)
        for i, (first, mu) in enumerate(zip(law.layout.lowest.tolist(), law.degrees, strict=True)):
            rows[first] = base[i] + rate[i] * passed
            if mu:
                rows[first + 1] = rate[i]
        return rows

    def _reference(self, which: int) -> ca.SX:
        """R of a law now, zero while the other one is active."""
        held, law = self.held, self.laws[which]
        size = law.layout.reference_size
        reference = self._goals_at(which, self.place, is_start=False)
        reference += self._along(which, held["base"], held["rate"], self.passed)
        reference += faded(held["offset"][:size], law.degrees, self.passed, held["over"])
        if which == CONTACT:  # For an observer, whose estimates the present outputs may depend on.
            acts = ca.logic_and(self.has_begun, self.is_closed)
            self.contact_reference = ca.if_else(acts, reference, 0)
        begins = ca.if_else(self.has_begun, reference, self._present(which, self.first_force))
        return ca.if_else(self.is_closed == (which == CONTACT), begins, 0)

    def _present(self, which: int, force: ca.SX | float) -> ca.SX:
        """R of a law from the present outputs, z_i, z_i', ...; zero for the highest derivatives.

        A force of degree 0 is the measured one; differences of such forces begin at zero.
        """
        law, main = self.laws[which], self.contact.main
        reference = ca.SX.zeros(law.layout.reference_size)
        reference[law.layout.chained.tolist()] = self.chains[which]
        if which == CONTACT and law.degrees[main] == 0:
            reference[int(law.layout.lowest[main])] = force
        return reference

    # The changes.

    def _moment(self, control: ca.SX) -> Moment:
        """The measurements, with the force after its low-pass."""
        contact, controls = self.contact, {}
        wanted = ca.SX(0)
        for which, law in enumerate(self.laws):
            places = [contact.main] if which == CONTACT else list(contact.places)
            rows = law.layout.lowest[places].tolist()
            wanted += ca.sum1(self.references[which][rows]) / len(places)
        names = [signal.name for signal in self.laws[FREE].system.control_signals]
        for name in self.task.watched("control"):
            if name and name not in names:
                raise ModelError(f"condition of a control: {unknown_name('control', name, names)}")
            own = control[names.index(name)] if name else control
            controls[name] = ca.mmax(ca.fabs(own))
        travel = ca.norm_2(self.moved - self.held["moved"])
        motion = self.distance, self.rate, wanted, self.away, travel
        return Moment(self.passed, self.total, *motion, self.signals, controls)

    def _causes(self, now: Moment) -> ca.SX:
        """Why the present phase ends; BEGUN while it goes on."""
        task, force = self.task, self.task.contact_force
        felt, is_felt = ca.vertsplit(self.held["felt"])
        can_lose = ca.logic_and(self.is_closed, is_felt < 0.5)
        lost = ca.if_else(can_lose, task.patience - (TIME - felt), 1.0)
        causes = []
        for phase in self.phases:
            ends = [(now.margin(guard), GUARD + i) for i, guard in enumerate(phase.guards)]
            ends.append((ca.if_else(self.waits, 1.0, phase.success(now, force)), SUCCESS))
            ends += [(lost, LOST)] * phase.holds_contact
            ends.append((phase.remaining(now), LATE))
            causes.append(_first(ends))
        return chosen(self.place, [*causes, _first([(lost, LOST)])])

    def _following(self, cause: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The index of the next phase, and the ending of the task."""
        task, end, follow = self.task, self.end, []
        is_leaving = len(task.phases)
        failed = cause > SUCCESS + 0.5
        for place in range(end):
            rows = []
            for outcome in ("success", "late", "lost", "guard"):
                chain, is_done = task.successors(place, outcome)
                row = ca.vertcat(ca.SX(end), ALL_DONE if is_done else RESTING)
                for to in reversed(chain):
                    allowed = self.held["entered"][to] <= task.retries_of(to)
                    row = ca.if_else(allowed, ca.vertcat(to, GOING), row)
                rows.append(row)
            # Which has ended after "leave" is given up if what led there has failed.
            follow.append(chosen(ca.fmin(cause, GUARD) - 1, rows))
        to, ending = ca.vertsplit(chosen(self.place, [*follow, ca.vertcat(end, RESTING)]))
        before = self.held["change"][4]
        left = ca.logic_and(ca.fabs(self.place - is_leaving) < 0.5, before > SUCCESS + 0.5)
        is_given_up = ca.logic_and(ending == RESTING, ca.logic_or(failed, left))
        return to, ca.if_else(is_given_up, GIVEN_UP, ending)

    def _closed_after(self, cause: ca.SX, to: ca.SX) -> ca.SX:
        """Whether the law in contact acts in the next phase, or while the robot rests."""
        after = [self.task.is_closed_after(place, "success") for place in range(self.end)]
        succeeds = ca.fabs(cause - SUCCESS) < 0.5
        touches = ca.if_else(
            succeeds, chosen(self.place, [float(each) for each in after]), self.is_closed
        )
        rests = ca.logic_and(touches, self.total >= self.task.contact_force)
        return chosen(to, [*(float(each) for each in self.task.contacts), rests])

    def update(self, control: ca.SX) -> dict[str, ca.SX]:
        """The held values after a sample."""
        held, begins = self.held, ca.logic_not(self.has_begun)
        cause = ca.if_else(begins, BEGUN, self._causes(self._moment(control)))
        changes = ca.logic_or(begins, cause > 0.5)
        to, ending = self._following(cause)
        to, ending = ca.if_else(begins, 0, to), ca.if_else(begins, GOING, ending)
        closed = self._closed_after(cause, to)
        closed = ca.if_else(begins, float(self.task.contacts[0]), closed)
        force = ca.if_else(begins, self.first_force, self.total)
        motion = force, self.distance, self.rate
        after = {
            "change": ca.vertcat(
                held["change"][0] + 1, to, closed, TIME, cause, *motion, ending, self.place
            ),
            "touched": ca.logic_and(self.has_begun, ca.logic_not(self.is_closed)),
            "moved": self.moved,
            "entered": held["entered"]
            + ca.vertcat(*(ca.fabs(to - i) < 0.5 for i in range(self.end))),
            **self._segment(to, closed, force),
        }
        after = {name: ca.if_else(changes, value, held[name]) for name, value in after.items()}
        last, is_felt = ca.vertsplit(held["felt"])
        excess = self.total - self.task.contact_force
        is_open = ca.if_else(is_felt > 0.5, excess + LET_GO * self.task.contact_force, -excess)
        turned = ca.if_else(is_open <= EARLY, 1 - is_felt, is_felt)
        last = ca.if_else(ca.logic_or(begins, is_felt > 0.5), TIME, last)
        return {**after, "felt": ca.vertcat(last, turned), "filter": self.filtered}

    def _segment(self, to: ca.SX, closed: ca.SX, force: ca.SX) -> dict[str, ca.SX]:
        """The references of a phase that begins now."""
        count = self.held["base"].numel()
        over = chosen(to, [*(phase.over for phase in self.phases), self.task.phases[-1].over])
        goes = chosen(to, [*(rates for _, _, _, rates in self.goals), np.zeros(count)])
        free = [np.isin(np.arange(count), named, invert=True) for named, *_ in self.goals]
        is_free = chosen(to, [*(each.astype(float) for each in free), np.ones(count)])
        both = []
        for which, law in enumerate(self.laws):
            present, lowest = self._continued(which, force), law.layout.lowest.tolist()
            moves = [present[i + 1] if mu else 0 for i, mu in zip(lowest, law.degrees, strict=True)]
            # With the mean of both rates during the fade, the outputs do not overshoot.
            base = is_free * (present[lowest] + (ca.vertcat(*moves) - goes) * over / 2)
            goal = self._goals_at(which, to, is_start=True) + self._along(which, base, goes, 0.0)
            offset = ca.SX.zeros(self.held["offset"].numel())
            offset[: law.layout.reference_size] = present - goal
            both.append(ca.vertcat(base, offset))
        sums = ca.if_else(closed > 0.5, both[CONTACT], both[FREE])
        return {"over": over, "rate": goes, "base": sums[:count], "offset": sums[count:]}

    def _continued(self, which: int, force: ca.SX) -> ca.SX:
        """R of a law from its references now, or those of the other law and the present contact."""
        own, other, law = self.references[which], self.references[1 - which], self.laws[which]
        met, starts = self._present(which, force), self.laws[1 - which].layout.lowest.tolist()
        for i, (first, mu) in enumerate(zip(law.layout.lowest.tolist(), law.degrees, strict=True)):
            if i not in self.contact.places:
                met[first : first + mu + 1] = other[starts[i] : starts[i] + mu + 1]
        return ca.if_else(self.is_closed == (which == CONTACT), own, met)

    # The laws.

    def holds(self, which: int) -> ca.SX:
        """Whether the integrals of a law do not move."""
        waits = ca.logic_or(self.hold != 0, self.is_closed != (which == CONTACT))
        if which == FREE:
            return waits
        # In contact also while no force is measured, and during the transition after a touch: the
        # force of an impact is no error.
        least = self.contact.size * ca.mmin(self.each)
        settles = ca.logic_and(self.held["touched"], self.passed < self.held["over"])
        return ca.logic_or(waits, ca.logic_or(least < self.task.contact_force, settles))

    def block(self) -> Block:
        """The block; see `TaskController`."""
        closed, task = self.laws[CONTACT].system, self.task
        controls, requirements, integrals = [], list[Requirement](), dict[str, Held]()
        desired = ca.SX.zeros(closed.num_outputs + self.contact.size)
        rest = [i for i in range(self.force.numel()) if i not in self.contact.forces]
        for which, law in enumerate(self.laws):
            sums = ca.SX.sym("integral", len(law.integral.outputs))
            reference = self.references[which]
            given = {
                "state": self.state,
                "reference": reference,
                "measured_force": self.tared if which == CONTACT else self.tared[rest],
                "integral": sums,
                "parameters": ca.vertcat(self.values, self.gains[which]),
            }
            regular = Requirement.regular(law.pivot, law.regular)
            values = [*(regular.of(value) for value in law.outputs.values()), regular.margin]
            function = ca.Function("law", list(law.inputs.values()), values)
            results = function.call([given[name] for name in law.inputs])
            named = dict(zip([*law.outputs, "margin"], results, strict=True))
            controls.append(named["control"])
            is_active = self.is_closed == (which == CONTACT)
            margin = ca.if_else(is_active, named["margin"], 1.0)
            requirements.append(replace(regular, margin=margin))
            columns = columns_of(self.contact, desired.numel(), which)
            desired[columns] += reference[law.layout.lowest.tolist()]
            if sums.numel():
                moves = ca.if_else(self.holds(which), 0, named["integral_rate"])
                name = "integral" if which == CONTACT else "free_integral"
                integrals[name] = self._kept(sums, sums + self.period * moves)
        control = ca.if_else(self.is_closed, controls[CONTACT], controls[FREE])
        after = self.update(control)
        inputs = {"estimated_state": self.state, "measured_force": self.force, "hold": self.hold}
        inputs |= {SIGNAL + name: symbol for name, symbol in self.signals.items()}
        own = [law.all_parameters()[self.values.numel() :] for law in self.laws]
        start = [closed.parameter_values, own[CONTACT], own[FREE]]
        return Block(
            "task_controller",
            inputs,
            {
                "control": control,
                "phase": self.place,
                "ending": self.ending,
                "change": self.held["change"],
                "desired_output": desired,
                "contact_reference": self.contact_reference,
                **({"tared_force": self.tared} if task.tare_time else {}),
                **{name: each.symbol for name, each in integrals.items()},
            },
            held=integrals | {name: self._kept(self.held[name], after[name]) for name in after},
            parameters=stacked([self.values, self.gains[CONTACT], self.gains[FREE]]),
            start={"parameters": np.concatenate(start)},
            defaults={name: ca.SX.zeros(1) for name in list(inputs)[2:]},
            requirements=tuple(requirements),
            signals={
                "estimated_state": closed.state_signals,
                "measured_force": closed.constraint_input_signals,
                "control": closed.control_signals,
                "contact_reference": self.laws[CONTACT].reference_signals,
                "change": CHANGE,
                "phase": (Signal("phase"),),
                "ending": (Signal("ending"),),
                "parameters": closed.parameter_signals,
            },
        )

    def _kept(self, symbol: ca.SX, after: ca.SX) -> Held:
        return Held(symbol, after, np.zeros(symbol.numel()), self.period)


def columns_of(contact: OpeningContact, size: int, which: int) -> list[int]:
    """The columns of the outputs of a law among those of the law in contact, then all distances."""
    columns = list(range(size - contact.size))
    if which == FREE:
        for place, column in zip(contact.places, range(len(columns), size), strict=True):
            columns[place] = column
    return columns


def _first(ends: Sequence[tuple[ca.SX | float, int]]) -> ca.SX:
    """The number of the first margin that has ended, 0 if none has."""
    number = ca.SX(0)
    for margin, cause in reversed(ends):
        if not (isinstance(margin, float) and margin == inf):
            number = ca.if_else(margin <= EARLY, cause, number)
    return number
