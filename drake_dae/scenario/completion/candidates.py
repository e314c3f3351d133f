"""The outputs that may complete the outputs of a scenario."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from drake_dae.dae.system.signals import Signal
from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Links
from drake_dae.robots.outputs import (
    AxisCoordinates,
    JointPositions,
    PointCoordinates,
    PositionOutput,
)
from drake_dae.scenario.completion.postures import Posture
from drake_dae.scenario.completion.tool_axis import ToolAxis, tool_axis
from drake_dae.scenario.parts.written import TiltFromNormalForm, WrittenOutput, make
from drake_dae.scenario.scenario import Scenario


@dataclass(frozen=True, eq=False)
class _ToolContact:
    """A contact of a tool: the constraint's name, the contact, and the tool's axis there."""

    constraint: str
    touch: Touch
    axis: ToolAxis


class Candidates:
    """The rows of the scenario's outputs, then the rows that may complete them, one output each.

    Args:
        scenario: The scenario.
        links: Its robot.
        outputs: The outputs of the scenario.
        bound: The constraints.

    Attributes:
        signals: Names and units of all rows.
        expression: All rows, shape (c, 1).
        outward: The contacts of tools, with their outward axes in the world, shape (3, 1).
        tilts: The rows that are zero where tools are normal to their surfaces; none if `tool_axis`
            of the scenario is free.
        axes: The rows of the tools' directions that may be outputs, by `tool_axis`.
        joints: The rows of positions of joints.
    """

    def __init__(
        self,
        scenario: Scenario,
        links: Links,
        outputs: Sequence[PositionOutput],
        bound: ConstraintSet,
    ) -> None:
        self._forms: list[WrittenOutput] = []
        self.signals: list[Signal] = [s for output in outputs for s in output.signals(links)]
        self._given = len(self.signals)
        rows = [output.expression(links) for output in outputs]
        touching = [(c.name, c.touch(links)) for c in bound.constraints]
        places = [
            _ToolContact(name, t, tool_axis(links, t)) for name, t in touching if t is not None
        ]

        def add(forms: Iterable[WrittenOutput]) -> list[int]:
            first = len(self.signals)
            for form in forms:
                output = make(form, bound.constraints)
                rows.append(output.expression(links))
                self._forms.append(form)
                self.signals += output.signals(links)
            return list(range(first, len(self.signals)))

        self._points = [add(_points(place, {s.name for s in self.signals})) for place in places]
        kind = scenario.tool_axis
        self.tilts = add(form for place in places for form in _tilts(place) if kind != "free")
        fixed = [form for place in places for form in _directions(place) if kind == "fixed"]
        self.axes = add(fixed) if fixed else self.tilts
        self.joints = add(JointPositions([signal.name]) for signal in links.position_signals)
        self.expression = ca.vertcat(ca.SX(0, 1), *rows)
        self.outward = [
            (p.touch, p.axis.sign * links.rotation(p.touch.frame)[:, p.axis.column]) for p in places
        ]

    def points(self, posture: Posture) -> list[int]:
        """The rows along each surface: of the world's axes all but that closest to the normal."""
        normals = abs(posture.normals.reshape(-1, 3))
        across = normals.argmax(axis=1)
        return [
            row
            for rows, axis in zip(self._points, across, strict=True)
            for k, row in enumerate(rows)
            if k != axis
        ]

    def form(self, row: int) -> WrittenOutput:
        """The form of a completed row in a scenario."""
        return self._forms[row - self._given]


def _points(place: _ToolContact, taken: set[str]) -> list[WrittenOutput]:
    frame, point = place.touch.frame, place.touch.point
    # Names are unique: the constraint's name is used if the frame's is taken.
    other = f"{place.constraint}_point"
    return [
        PointCoordinates(frame, axis, point, other if f"{frame}.{axis}" in taken else "")
        for axis in "xyz"
    ]


def _tilts(place: _ToolContact) -> list[WrittenOutput]:
    axis = place.axis.axis
    return [TiltFromNormalForm(place.constraint, axis, other) for other in "xyz".replace(axis, "")]


def _directions(place: _ToolContact) -> list[WrittenOutput]:
    axis = place.axis.axis
    return [AxisCoordinates(place.touch.frame, axis, component) for component in "xyz"]


_JOINED: dict[type, str] = {
    PointCoordinates: "axes",
    AxisCoordinates: "components",
    TiltFromNormalForm: "components",
    JointPositions: "joints",
}
"""Which attribute of an output holds its rows."""


def merged(forms: Iterable[WrittenOutput]) -> list[WrittenOutput]:
    """The same rows in fewer outputs: neighbours that differ only in their rows are joined."""
    outputs: list[Any] = []
    form: Any
    for form in forms:
        key = _JOINED[type(form)]
        last: Any = outputs[-1] if outputs else None
        if type(last) is type(form) and replace(form, **{key: getattr(last, key)}) == last:
            outputs[-1] = replace(form, **{key: getattr(last, key) + getattr(form, key)})
        else:
            outputs.append(form)
    return outputs
