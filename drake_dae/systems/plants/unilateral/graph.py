"""The graph of modes, guards and resets of opening contacts, as text or drawing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations


@dataclass(frozen=True)
class Transition:
    """A transition from a mode to another, or to itself.

    Attributes:
        source: The contacts that are closed before.
        target: The contacts that are closed after it, if none of the others opens at once.
        contact: The contact concerned.
        guard: The condition of the transition.
        reset: The change of the state; empty for none.
    """

    source: tuple[str, ...]
    target: tuple[str, ...]
    contact: str
    guard: str
    reset: str

    def __str__(self) -> str:
        text = f"{_shown(self.source)} -> {_shown(self.target)} when {self.guard}"
        return f"{text}: {self.reset}" if self.reset else text


@dataclass(frozen=True)
class ContactGraph:
    """All modes of a plant and their transitions; `str` has one line for each.

    Attributes:
        name: The plant.
        contacts: The names of the contacts.
        ending: Those with a surface that ends.
    """

    name: str
    contacts: tuple[str, ...]
    ending: tuple[str, ...] = ()

    @property
    def modes(self) -> tuple[tuple[str, ...], ...]:
        """The contacts that are closed in each mode, fewest first."""
        counts = range(len(self.contacts) + 1)
        return tuple(mode for count in counts for mode in combinations(self.contacts, count))

    @property
    def transitions(self) -> tuple[Transition, ...]:
        """Guards and resets."""
        return tuple(self._transitions())

    def _transitions(self) -> Iterator[Transition]:
        for mode in self.modes:
            for name in self.contacts:
                if name in mode:
                    remaining = tuple(other for other in mode if other != name)
                    yield Transition(mode, remaining, name, f"lambda({name}) falls to 0", "")
                    if name in self.ending:
                        yield Transition(mode, remaining, name, f"{name} leaves its face", "")
                    continue
                joined = tuple(other for other in self.contacts if other in mode or other == name)
                falls = f"phi({name}) falls to 0"
                falls += " on its face" if name in self.ending else ""
                rate = f"phi'({name})"
                yield Transition(mode, mode, name, falls, f"{rate} := -e {rate}")
                settles = f"{falls} and bouncing would end within the settling time"
                yield Transition(mode, joined, name, settles, f"{rate} := 0")

    def __str__(self) -> str:
        return "\n".join([f"{self.name}: {len(self.modes)} modes", *map(str, self.transitions)])

    def graphviz(self) -> str:
        """The graph in the language of Graphviz: `dot -Tsvg` draws it."""
        lines = [f'digraph "{self.name}" {{', "  rankdir=LR;", "  node [shape=box];"]
        lines += [f'  "{_shown(mode)}";' for mode in self.modes]
        for transition in self.transitions:
            label = "\\n".join(filter(None, (transition.guard, transition.reset)))
            ends = f'"{_shown(transition.source)}" -> "{_shown(transition.target)}"'
            lines.append(f'  {ends} [label="{label}"];')
        return "\n".join([*lines, "}"]) + "\n"


def _shown(closed: Sequence[str]) -> str:
    return "{" + ", ".join(closed) + "}"
