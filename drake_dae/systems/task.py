"""A task: phases, which of them may follow which, and the contact that it opens."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, count
from math import ceil, inf

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import listed, positive, unknown_name
from drake_dae.dae import DaeSystem, TrackingLaw
from drake_dae.dae.redundancy import with_constraints
from drake_dae.errors import ModelError
from drake_dae.systems.phases import (
    APPROACH,
    DONE,
    ENDS,
    FAILURES,
    HOLD,
    LEAVE,
    NEXT,
    Outcome,
    Phase,
    Release,
    Watched,
)

_STEADY, _STRONGEST = 6.0, 10.0
"""The least `contact_force` in standard deviations of the filtered noise, which one sample in 1e9
exceeds; and by how much the low-pass reduces noise at most, with a time constant of 50 samples."""


@checked(ModelError)
@dataclass(frozen=True)
class Task:
    """Phases in order, or in the order that they choose; after the last one the robot rests.

    If it rests in contact and the contact is lost, the law of the free robot keeps it at rest.

    Attributes:
        phases: The phases, with distinct names. If the first one begins in contact, its force
            starts at `contact_force`.
        contact_force: Forces below this, in N, count as zero: at this force the robot has touched,
            and below it the contact is open.
        patience: How long the force may be below `contact_force` before a contact that a phase
            holds counts as lost, in s; a compliant contact may bounce at first.
        force_noise: The standard deviation of the force sensor's noise, in N; 0 without noise. For
            guards the force passes a low-pass, after which the standard deviation is at most a
            sixth of `contact_force`, so that noise does not count as a touch.
        tare_time: The time in s at the start of a task that starts free, over which the mean of the
            measured force is taken as the sensor's bias. No phase ends before; then the bias is
            subtracted for guards, laws and observers. 0 for no taring.
        retries: How many times a phase may be entered again, where it does not say it itself.

    Raises:
        ModelError: There are no phases; one begins in contact although the one before does not end
            in contact, or the other way round; a successor is no phase; or a number is not valid.
    """

    phases: Sequence[Phase]
    contact_force: float = 0.5
    patience: float = 0.25
    force_noise: float = 0.0
    tare_time: float = 0.0
    retries: int = 10

    def __post_init__(self) -> None:
        positive("contact_force", self.contact_force)
        positive("patience", self.patience)
        for name in ("force_noise", "tare_time", "retries"):
            if not 0.0 <= getattr(self, name) < inf:
                raise ModelError(f"{name} must be 0 or more, got {getattr(self, name):g}")
        least = self.force_noise * _STEADY / _STRONGEST
        if self.contact_force < least:
            raise ModelError(
                f"contact_force: noise of {self.force_noise:g} N hides a force of "
                f"{self.contact_force:g} N; it must be {least:.2g} N or more"
            )
        object.__setattr__(self, "phases", _named(self.phases))
        if not self.phases:
            raise ModelError("a task needs phases, such as Approach(0.05), Press(20.0), Release()")
        if self.tare_time and self.phases[0].begins_in_contact:
            raise ModelError("tare_time: a task that begins in contact finds no bias; leave it out")
        for place, phase in enumerate(self.phases):
            if (force := phase.felt(self.contact_force)) < self.contact_force:
                raise ModelError(
                    f"{self.where(place)}: force: {force:g} N counts as no force, since it is less "
                    f"than the contact_force of {self.contact_force:g} N; give more, or a smaller "
                    "contact_force"
                )
            can_lose = phase.holds_contact and self.contacts[place]
            self._check(place, "success")
            for outcome in FAILURES[: 3 if can_lose else 2]:
                self._check(place, outcome)

    @cached_property
    def all_phases(self) -> tuple[Phase, ...]:
        """The phases, then the Release of "leave" if one of them chooses it."""
        keys = "on_success", "on_failure", "if_late", "if_lost", "if_spent"
        words = {getattr(phase, key) for phase in self.phases for key in keys}
        # A model error may be larger than contact_force, and holds the tool.
        leave = Release(name=LEAVE, within=5.0, on_success=HOLD)
        return (*self.phases, *([leave] if LEAVE in words else []))

    @cached_property
    def contacts(self) -> tuple[bool, ...]:
        """Whether each of `all_phases` begins in contact.

        At the start the robot is in contact if the first phase that says so begins in contact. One
        without a say that ends by a force begins without it.
        """
        known = (
            bool(phase.begins_in_contact)
            for phase in self.phases
            if phase.begins_in_contact is not None or phase.in_contact_after(False)
        )
        is_closed, contacts = next(known, False), []
        for phase in self.all_phases:
            if phase.begins_in_contact is not None:
                is_closed = phase.begins_in_contact
            contacts.append(is_closed)
            is_closed = phase.in_contact_after(is_closed)
        return tuple(contacts)

    def is_closed_after(self, place: int, outcome: Outcome) -> bool:
        """Whether the robot is in contact after a phase, as far as its outcome says."""
        before = self.contacts[place]
        return self.all_phases[place].in_contact_after(before) if outcome == "success" else before

    def successors(self, place: int, outcome: Outcome) -> tuple[list[int], bool]:
        """The indices of phases, of which the first follows whose retries are not used up.

        Also whether the task is done if there is none, or the robot rests for another reason.
        """
        found, at, word = list[int](), place, self.all_phases[place].successor(outcome)[0]
        while True:
            to = self.place_of(at, word)
            if word == LEAVE and not self.is_closed_after(place, outcome):
                to = None
            if to is None or to in found:
                return found, word in (NEXT, DONE) and to is None
            found.append(to)
            at, word = to, self.all_phases[to].if_spent

    def place_of(self, place: int, word: str) -> int | None:
        """The index of the phase to which a word of a phase leads; None where the robot rests."""
        if word == NEXT:
            return place + 1 if place + 1 < len(self.phases) else None
        if word == APPROACH:  # Back to the last phase that leads into contact.
            leads = [
                i for i in range(place + 1) if self.is_closed_after(i, "success") > self.contacts[i]
            ]
            return leads[-1] if leads else None
        names = [phase.name for phase in self.all_phases]
        return names.index(word) if word in names else None

    def retries_of(self, place: int) -> int:
        """How many times a phase may be entered again."""
        own = self.all_phases[place].retries
        return self.retries if own is None else own

    def where(self, place: int) -> str:
        """A phase, for messages."""
        return f"phase {place + 1} of the task, {self.all_phases[place].name}"

    def watched(self, of: Watched) -> tuple[str, ...]:
        """The names of the "signal" or "control" that phases watch; "" for the largest control."""
        conditions = [each for phase in self.phases for each in (*phase.until, *phase.guards)]
        return tuple(dict.fromkeys(each.name for each in conditions if each.of == of))

    @property
    def force_gain(self) -> float:
        """The gain of the low-pass of the force, y += gain (F - y) at each sample, from 0 to 1.

        Its output has gain / (2 - gain) of the variance of white noise.
        """
        if not self.force_noise:
            return 1.0
        kept = min((self.contact_force / (_STEADY * self.force_noise)) ** 2, 1.0)
        return 2.0 * kept / (1.0 + kept)

    def tare_samples(self, sample_period: float) -> int:
        """The number of samples in the mean for the bias of the force; 0 without a tare_time."""
        samples = ceil(self.tare_time / sample_period - 1e-9)
        needed = ceil((_STEADY * self.force_noise / self.contact_force) ** 2)
        if 0 < samples < needed:
            raise ModelError(
                f"tare_time: a mean over {self.tare_time:g} s keeps too much of the force sensor's "
                f"noise of {self.force_noise:g} N; it must be {needed * sample_period:g} s or more"
            )
        return samples

    def _check(self, place: int, outcome: Outcome) -> None:
        """Refuses words that lead nowhere, and phases that cannot follow another one."""
        phase, names = self.phases[place], [each.name for each in self.phases]
        successor = phase.successor(outcome)
        for word, key in (successor, (phase.if_spent, "if_spent")):
            text = ""
            if word == APPROACH and self.place_of(place, word) is None:
                text = "approach goes back to an Approach, and there is none before it"
            elif word not in (*ENDS, *names):
                text = f"{unknown_name('phase', word, names)}; or take {', '.join(ENDS)}"
            if text:
                raise ModelError(f"{self.where(place)}: {key}: {text}")
        is_closed = self.is_closed_after(place, outcome)
        for to in self.successors(place, outcome)[0]:
            begins, text = self.contacts[to], ""
            if outcome == "lost" and begins and self.is_closed_after(to, "success"):
                text = "in contact, but the contact is lost; choose another by if_lost"
            elif begins and not is_closed:
                text = "in contact, but the robot is free; an Approach must lead there"
            elif outcome == "success" and is_closed and not begins:
                text = "with a free robot, but it is in contact; a Release must lead there"
            if text:
                where = f"{self.where(to)}, after {phase.name} by {successor[1]}"
                raise ModelError(f"{where}: it begins {text}")

    def __repr__(self) -> str:
        return f"Task({', '.join(phase.name for phase in self.phases)})"


def _named(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """The phases with distinct names: those with the name of their class are numbered."""
    chosen = [phase.name for phase in phases if phase.name != type(phase).__name__]
    taken, renamed = {*chosen}, list[Phase]()
    for index, phase in enumerate(phases):
        where, name = f"phase {index + 1} of the task", phase.name
        if name in (*ENDS, "held", "end") or name != name.strip():
            raise ModelError(f"{where}: '{name}' is no name of a phase; give it another one")
        if chosen.count(name) > 1:
            raise ModelError(f"{where}: more than one phase has the name '{name}'")
        if name == type(phase).__name__:
            numbered = (f"{name} {number}" for number in count(2))
            name = next(each for each in chain([name], numbered) if each not in taken)
        taken.add(name)
        renamed.append(replace(phase, name=name))
    return tuple(renamed)


FREE, CONTACT = 0, 1
"""The indices of the two laws of a task."""


@checked(ModelError)
def open_contact(system: DaeSystem, force: str) -> DaeSystem:
    """A system one of whose contacts is open:

        x' = f + g_o v_o + h u,    0 = k_o(x),    z = (l_o(x) + m_o(x) v_o, k_i(x)),

    where o are all constraints except i, that of the named force: it does not hold, and the output
    that was its force is its distance k_i(x).
    """
    names = [signal.name for signal in system.constraint_input_signals]
    if force not in names:
        raise ModelError(f"{system.name}: {unknown_name('constraint force', force, names)}")
    if system.sharing is not None:
        raise ModelError(
            f"{system.name}: redundant constraints share their forces, and none of them opens; "
            "leave `compliances` out"
        )
    row = names.index(force)
    place = _output_of(system, row)
    reduced = with_constraints(system, [i for i in range(len(names)) if i != row])
    drift, signals = ca.SX(reduced.l), list(reduced.output_signals)
    drift[place], signals[place] = system.k[row], system.constraint_output_signals[row]
    return replace(
        reduced,
        l=drift,
        output_signals=tuple(signals),
        implicit=reduced.implicit if reduced.num_constraints else None,
    )


def _output_of(system: DaeSystem, row: int) -> int:
    """The output that is a constraint force by itself, which no other output has."""
    m = ca.sparsify(system.m)
    places = [j for j in range(system.num_outputs) if m[j, row].nnz()]
    alone = [j for j in places if m[j, row].is_one() and m[j, :].nnz() == 1]
    if len(places) == 1 and alone and system.l[places[0]].is_zero():
        return places[0]
    raise ModelError(
        f"{system.name}: '{system.constraint_input_signals[row].name}' must be an output by "
        "itself, so that its distance can be in its place where the contact is open; the outputs "
        f"are {listed(signal.name for signal in system.output_signals)}"
    )


def opening_contact(law: TrackingLaw, free_law: TrackingLaw) -> tuple[int, int]:
    """The output and the constraint force of the contact that is open in the second law."""
    closed, free = law.system, free_law.system
    names, others = (
        [signal.name for signal in system.constraint_input_signals] for system in (closed, free)
    )
    gone = [row for row, name in enumerate(names) if name not in others]
    sizes = {(system.num_states, system.num_controls) for system in (closed, free)}
    if len(gone) != 1 or len(sizes) > 1:
        raise ModelError(
            f"a task needs the laws of one robot with and without one contact, as of its system "
            f"and of open_contact(system, force); these hold {', '.join(names) or 'nothing'} and "
            f"{', '.join(others) or 'nothing'}"
        )
    if law.deflection is not None:
        raise ModelError(f"{closed.name}: a contact_stiffness is not for tasks; leave it out")
    if law.exogenous_degrees != free_law.exogenous_degrees:
        raise ModelError(
            f"{closed.name}: the law in contact needs {law.exogenous_degrees} derivatives of its "
            f"exogenous signals, as of an observer's estimates, the free law "
            f"{free_law.exogenous_degrees}; leave them, or the observer, out"
        )
    row, place = gone[0], _output_of(closed, gone[0])
    distance = closed.constraint_output_signals[row].name
    if free.output_signals[place].name != distance:
        raise ModelError(
            f"the free law must have the output '{distance}' where the law has "
            f"'{closed.output_signals[place].name}'; make its system by open_contact"
        )
    if free_law.degrees[place] < 2:
        raise ModelError(f"'{distance}' must have degree 2 or more, as where forces move it")
    for i, (degree, freed) in enumerate(zip(law.degrees, free_law.degrees, strict=True)):
        if i != place and degree != freed:
            raise ModelError(
                f"'{free.output_signals[i].name}' has degree {degree} in contact and {freed} "
                "without, so that no reference leads from one to the other"
            )
    return place, row
