"""The automaton of a task with the laws that it switches, as one block."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import comb, factorial

import casadi as ca
import numpy as np
from numpy.polynomial import Polynomial

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.blocks.block import TIME, Block, Held, stacked
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.references import ConstantReference
from drake_dae.references.by_name import assign, in_order
from drake_dae.references.reference import stacked_expression
from drake_dae.systems.controller import SIGNAL, law_block
from drake_dae.systems.phases import Moment
from drake_dae.systems.task import CONTACT, FREE, Task

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

GOING, ALL_DONE, RESTING, GIVEN_UP = range(4)  # the endings of a task

SMOOTH = 2  # the least number of continuous derivatives of a fade, even if a law needs fewer

LET_GO = 1e-3
"""A contact ceases to be felt this share below `contact_force`, so that a force that stays there,
apart from round-off, does not begin and cease to be felt all the time."""

EARLY = 2e-12  # A margin below this has ended, so that those with other round-off end together.


@cache
def fading(order: int) -> FloatArray:
    """Rows k: factors of 1, x, ..., x^(2 n + 1) whose derivative k alone, of n, is 1 at 0.

    x^k / k! (1 - x)^(n + 1) sum_j (n + j over j) x^j, j = 0, ..., n - k (Hermite).
    """
    rows = []
    for k in range(order + 1):
        series = Polynomial([comb(order + j, j) for j in range(order - k + 1)])
        start = Polynomial([0.0] * k + [1.0 / factorial(k)])
        rows.append((start * Polynomial([1.0, -1.0]) ** (order + 1) * series).coef)
    return np.array(rows)


def faded(offset: ca.SX, degrees: Sequence[int], passed: ca.SX, over: ca.SX) -> ca.SX:
    """What is left of offsets d = (d_1, d_1', ..., d_p^(mu_p)) after a time, with derivatives.

    For each output it is the polynomial of degree 2 n + 1, n = max(mu, SMOOTH), in t with

        p^(k)(0) = d^(k) (0 for k > mu),    p^(k)(over) = 0,    k = 0, ..., n,

    and 0 afterwards; shape as d.
    """
    left, first = list[ca.SX](), 0
    for mu in degrees:
        factors, own = fading(max(mu, SMOOTH)), offset[first : first + mu + 1]
        for j in range(mu + 1):  # over^j p^(j)
            powers = ca.vertcat(*((passed / over) ** i for i in range(factors.shape[1])))
            terms = (own[k] * over**k * ca.dot(factors[k], powers) for k in range(mu + 1))
            left.append(sum(terms, ca.SX(0)) / over**j)
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

    The references of a phase that began at t_0 with R_0 are, with t = time - t_0,

        R(t) = goal(t) + base + rate t + faded(R_0 - goal(0) - base, t),

    where base and rate are 0 for outputs with goals; before the first sample, R is that of the
    present outputs. `laws` are that of the free robot, and that in contact.
    """

    def __init__(
        self,
        task: Task,
        contact: tuple[int, int],
        laws: tuple[TrackingLaw, TrackingLaw],
        period: float,
    ) -> None:
        (self.main, self.row), self.laws = contact, laws  # The output and the constraint force.
        self.task, self.period = task, period
        self.phases, self.end = task.all_phases, len(task.all_phases)
        closed, free = laws[CONTACT].system, laws[FREE].system
        self.state, self.values = closed.state, closed.parameter_symbol
        self.force = ca.SX.sym("measured_force", closed.num_constraints)
        self.hold = ca.SX.sym("hold")
        self.signals = {name: ca.SX.sym(name) for name in task.watched("signal")}
        # By the model: z, z', ... of both laws, the distance and its derivative, all outputs in m.
        self.chains = []
        for law in laws:
            own = [law.system.state, law.system.parameter_symbol]
            chain = ca.Function("chain", own, [law.structure.chain])
            self.chains += chain.call([self.state, self.values])
        starts, chain = laws[FREE].layout.starts.tolist(), self.chains[FREE]
        self.distance, self.rate = (chain[starts[self.main] + order] for order in (0, 1))
        units = [signal.unit for signal in free.output_signals]
        rest = [starts[i] for i, unit in enumerate(units) if unit == "m" and i != self.main]
        self.moved = ca.vertcat(self.distance, chain[rest])
        self.first_force = task.contact_force * task.contacts[0]
        # The held values, and their present ones: before the task begins those of its begin.
        columns = {"change": len(CHANGE), "entered": self.end, "filter": 3}
        columns |= {"touched": 1, "felt": 2, "moved": self.moved.numel()}
        columns |= {"begun": max(law.layout.reference_size for law in laws)}
        self.held = {name: ca.SX.sym(name, size) for name, size in columns.items()}
        number, self.place, law, start, _, _, distance, *_ = ca.vertsplit(self.held["change"])
        self.has_begun = number > 0.5
        self.away, self.passed = self.distance - distance, TIME - start
        self.is_closed = ca.if_else(self.has_begun, law, float(task.contacts[0])) > 0.5
        self.over = chosen(self.place, [*(p.over for p in self.phases), task.phases[-1].over])
        self._filter()
        self.goals = [self._goals_of(place) for place in range(self.end)]
        self.references = [self._reference(which) for which in (FREE, CONTACT)]

    def _filter(self) -> None:
        """The low-pass of the contact's force minus its bias, the mean of the first samples."""
        low, bias, count = ca.vertsplit(self.held["filter"])
        tares, unbiased = self.task.tare_samples(self.period), self.force[self.row]
        self.waits = count < tares - 0.5
        if tares:
            count = ca.if_else(self.waits, count + 1, count)
            bias = ca.if_else(self.waits, bias + (unbiased - bias) / count, bias)
            unbiased = ca.if_else(self.waits, 0, unbiased - bias)
        self.total = low + self.task.force_gain * (unbiased - low)
        self.filtered = ca.vertcat(self.total, bias, count)
        self.tared = ca.SX(self.force)
        self.tared[self.row] -= bias

    # The references.

    def _goals_of(self, place: int) -> tuple[FloatArray, ca.SX, ca.SX, FloatArray]:
        """Ones for outputs without goals in a phase, R at its start and now, and their rates."""
        phase, law = self.phases[place], self.laws[int(self.task.contacts[place])]
        names, where = [s.name for s in law.system.output_signals], self.task.where(place)
        main, rates, time = names[self.main], np.zeros(len(names)), ca.SX.sym("time")
        for name, rate in phase.rates(main).items():
            if name not in names:
                raise ModelError(f"{where}: {unknown_name('output', name, names)}")
            rates[names.index(name)] = rate
        try:
            found = [
                assign(name, goal, names, law.degrees) for name, goal in phase.goals(main).items()
            ]
            named = [i for each in found for i in each.places]
            is_free = np.isin(np.arange(len(names)), named, invert=True)
            at_rest, unnamed = ConstantReference(0.0), np.flatnonzero(is_free)
            found += [assign(names[i], at_rest, names, law.degrees) for i in unnamed]
            row = stacked_expression(in_order(found, names), law.degrees, time)
        except ReferenceSignalError as error:
            raise ModelError(f"{where}: {error}") from error
        start, now = (ca.substitute(row, time, at) for at in (ca.SX(0), self.passed))
        return is_free.astype(float), start, now, rates * is_free

    def _reference(self, which: int) -> ca.SX:
        """R of a law now, zero while the other one is active."""
        law = self.laws[which]
        lowest, size = law.layout.lowest.tolist(), law.layout.reference_size
        none, zeros = ca.SX.zeros(size), np.zeros(len(lowest))
        own = [each == (which == CONTACT) for each in self.task.contacts]
        free, starts, nows, rates = zip(*self.goals, strict=True)
        begun = self.held["begun"][:size]
        is_free = chosen(self.place, [*free, zeros + 1.0])
        rate = chosen(self.place, [*rates, zeros])
        # With the mean of both rates during the fade, the outputs do not overshoot.
        moves = [begun[i + 1] if mu else 0 for i, mu in zip(lowest, law.degrees, strict=True)]
        base = is_free * (begun[lowest] + (ca.vertcat(*moves) - rate) * self.over / 2)

        def along(goals: Sequence[ca.SX], passed: ca.SX | float) -> ca.SX:
            """The reference without its fade."""
            rows = none + chosen(
                self.place, [goal if its else none for its, goal in zip(own, goals, strict=True)]
            )
            rows[lowest] += base + rate * passed
            for i, (first, mu) in enumerate(zip(lowest, law.degrees, strict=True)):
                if mu:
                    rows[first + 1] += rate[i]
            return rows

        offset = begun - along(starts, 0.0)
        reference = along(nows, self.passed) + faded(offset, law.degrees, self.passed, self.over)
        if which == CONTACT:  # For an observer, whose estimates the present outputs may depend on.
            acts = ca.logic_and(self.has_begun, self.is_closed)
            self.contact_reference = ca.if_else(acts, reference, 0)
        begins = ca.if_else(self.has_begun, reference, self._present(which, self.first_force))
        return ca.if_else(self.is_closed == (which == CONTACT), begins, 0)

    def _present(self, which: int, force: ca.SX | float) -> ca.SX:
        """R of a law from the present outputs, z_i, z_i', ...; zero for the highest derivatives.

        A force of degree 0 is the measured one.
        """
        law, main = self.laws[which], self.main
        reference = ca.SX.zeros(law.layout.reference_size)
        reference[law.layout.chained.tolist()] = self.chains[which]
        if which == CONTACT and law.degrees[main] == 0:
            reference[int(law.layout.lowest[main])] = force
        return reference

    def _continued(self, which: int, force: ca.SX) -> ca.SX:
        """R of a law from its references now, or those of the other law and the present contact."""
        own, other, law = self.references[which], self.references[1 - which], self.laws[which]
        met, starts = self._present(which, force), self.laws[1 - which].layout.lowest.tolist()
        for i, (first, mu) in enumerate(zip(law.layout.lowest.tolist(), law.degrees, strict=True)):
            if i != self.main:
                met[first : first + mu + 1] = other[starts[i] : starts[i] + mu + 1]
        begun = ca.SX.zeros(self.held["begun"].numel())
        begun[: met.numel()] = ca.if_else(self.is_closed == (which == CONTACT), own, met)
        return begun

    # The changes.

    def _causes(self, control: ca.SX) -> ca.SX:
        """Why the present phase ends; BEGUN while it goes on. The force is after its low-pass."""
        task, controls = self.task, dict[str, ca.SX]()
        pairs = zip(self.references, self.laws, strict=True)
        wanted = sum((R[int(law.layout.lowest[self.main])] for R, law in pairs), ca.SX(0))
        names = [signal.name for signal in self.laws[FREE].system.control_signals]
        for name in task.watched("control"):
            if name and name not in names:
                raise ModelError(f"condition of a control: {unknown_name('control', name, names)}")
            own = control[names.index(name)] if name else control
            controls[name] = ca.mmax(ca.fabs(own))
        travel = ca.norm_2(self.moved - self.held["moved"])
        motion = self.distance, self.rate, wanted, self.away, travel
        now = Moment(self.passed, self.total, *motion, self.signals, controls)

        felt, is_felt = ca.vertsplit(self.held["felt"])
        can_lose = ca.logic_and(self.is_closed, is_felt < 0.5)
        lost = ca.if_else(can_lose, task.patience - (TIME - felt), 1.0)
        causes = []
        for phase in self.phases:
            ends = [(phase.margin(now, guard), GUARD + i) for i, guard in enumerate(phase.guards)]
            success = phase.success(now, task.contact_force)
            ends.append((ca.if_else(self.waits, 1.0, success), SUCCESS))
            ends += [(lost, LOST)] * phase.holds_contact
            causes.append(_first([*ends, (phase.remaining(now), LATE)]))
        return chosen(self.place, [*causes, _first([(lost, LOST)])])

    def _following(self, cause: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The index of the next phase, whether it is in contact, and the ending of the task."""
        task, end, follow = self.task, self.end, []
        for place in range(end):
            rows = []
            for outcome in ("success", "late", "lost", "guard"):
                chain, is_done = task.successors(place, outcome)
                row = ca.vertcat(ca.SX(end), ALL_DONE if is_done else RESTING)
                for to in reversed(chain):
                    allowed = self.held["entered"][to] <= task.retries_of(to)
                    row = ca.if_else(allowed, ca.vertcat(to, GOING), row)
                rows.append(row)
            follow.append(chosen(ca.fmin(cause, GUARD) - 1, rows))
        to, ending = ca.vertsplit(chosen(self.place, [*follow, ca.vertcat(end, RESTING)]))
        # What has ended after "leave" is given up if what led there has failed.
        is_leaving = ca.fabs(self.place - len(task.phases)) < 0.5
        left = ca.logic_and(is_leaving, self.held["change"][4] > SUCCESS + 0.5)
        is_given_up = ca.logic_and(ending == RESTING, ca.logic_or(cause > SUCCESS + 0.5, left))
        # At rest the law in contact acts if it did, or the phase has touched, and a force is felt.
        after = [float(task.is_closed_after(place, "success")) for place in range(end)]
        succeeds = ca.fabs(cause - SUCCESS) < 0.5
        touches = ca.if_else(succeeds, chosen(self.place, after), self.is_closed)
        rests = ca.logic_and(touches, self.total >= task.contact_force)
        closed = chosen(to, [*(float(each) for each in task.contacts), rests])
        return to, closed, ca.if_else(is_given_up, GIVEN_UP, ending)

    def _update(self, control: ca.SX) -> dict[str, ca.SX]:
        """The held values after a sample."""
        held, begins, size = self.held, ca.logic_not(self.has_begun), self.end
        cause = ca.if_else(begins, BEGUN, self._causes(control))
        first = ca.vertcat(0, float(self.task.contacts[0]), GOING, self.first_force)
        following = ca.vertcat(*self._following(cause), self.total)
        to, closed, ending, force = ca.vertsplit(ca.if_else(begins, first, following))
        met = force, self.distance, self.rate
        after = {
            "change": ca.vertcat(
                held["change"][0] + 1, to, closed, TIME, cause, *met, ending, self.place
            ),
            "entered": held["entered"] + ca.vertcat(*(ca.fabs(to - i) < 0.5 for i in range(size))),
            "touched": ca.logic_and(self.has_begun, ca.logic_not(self.is_closed)),
            "moved": self.moved,
            "begun": ca.if_else(
                closed > 0.5, self._continued(CONTACT, force), self._continued(FREE, force)
            ),
        }
        changes = ca.logic_or(begins, cause > 0.5)
        after = {name: ca.if_else(changes, value, held[name]) for name, value in after.items()}
        last, is_felt = ca.vertsplit(held["felt"])
        excess = self.total - self.task.contact_force
        is_open = ca.if_else(is_felt > 0.5, excess + LET_GO * self.task.contact_force, -excess)
        turned = ca.if_else(is_open <= EARLY, 1 - is_felt, is_felt)
        last = ca.if_else(ca.logic_or(begins, is_felt > 0.5), TIME, last)
        return {**after, "felt": ca.vertcat(last, turned), "filter": self.filtered}

    # The laws.

    def _law(self, which: int) -> tuple[Block, ca.SX]:
        """A law with the task's references, and its gains; while it rests, its margin is 1."""
        law, is_active = self.laws[which], self.is_closed == (which == CONTACT)
        waits = ca.logic_or(self.hold != 0, ca.logic_not(is_active))
        measured = self.tared
        if which == CONTACT:
            # No integral moves while no force is measured, and during the transition after a
            # touch: the force of an impact is no error.
            settles = ca.logic_and(self.held["touched"], self.passed < self.over)
            waits = ca.logic_or(waits, ca.logic_or(self.total < self.task.contact_force, settles))
        else:
            measured = measured[[i for i in range(self.force.numel()) if i != self.row]]
        block = law_block(law, self.period)
        gains = ca.SX.sym("gains", block.parameters.numel() - self.values.numel())
        given = {
            "estimated_state": self.state,
            "reference": self.references[which],
            "measured_force": measured,
            "hold": waits,
        }
        symbols = [block.parameters, *block.inputs.values()]
        values = [ca.vertcat(self.values, gains), *(given[name] for name in block.inputs)]
        block = block.mapped(lambda expressions: ca.substitute(expressions, symbols, values))
        requirements = (
            replace(each, margin=ca.if_else(is_active, each.margin, 1.0))
            for each in block.requirements
        )
        return replace(block, requirements=tuple(requirements)), gains

    def block(self) -> Block:
        """The block; see `TaskController`."""
        closed = self.laws[CONTACT].system
        (free_law, free_gains), (law, gains) = self._law(FREE), self._law(CONTACT)
        control = ca.if_else(self.is_closed, law.outputs["control"], free_law.outputs["control"])
        # The outputs of the law in contact, then the distance.
        count = closed.num_outputs
        desired, columns = ca.SX.zeros(count + 1), list(range(count))
        for which in (CONTACT, FREE):
            rows = self.laws[which].layout.lowest.tolist()
            desired[columns] += self.references[which][rows]
            columns[self.main] = count
        integrals = {
            name: its.held["integral"]
            for name, its in (("integral", law), ("free_integral", free_law))
            if its.held
        }
        held = {
            name: Held(self.held[name], after, np.zeros(after.numel()), self.period)
            for name, after in self._update(control).items()
        }
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
                "ending": self.held["change"][8],
                "change": self.held["change"],
                "desired_output": desired,
                "contact_reference": self.contact_reference,
                **({"tared_force": self.tared} if self.task.tare_time else {}),
                **{name: each.symbol for name, each in integrals.items()},
            },
            held=integrals | held,
            parameters=stacked([self.values, gains, free_gains]),
            start={"parameters": np.concatenate(start)},
            defaults={name: ca.SX.zeros(1) for name in list(inputs)[2:]},
            requirements=(*free_law.requirements, *law.requirements),
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


def _first(ends: Sequence[tuple[ca.SX | float, int]]) -> ca.SX:
    """The number of the first margin that has ended, 0 if none has."""
    number = ca.SX(0)
    for margin, cause in reversed(ends):
        number = ca.if_else(margin <= EARLY, cause, number)
    return number
