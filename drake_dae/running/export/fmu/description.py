"""The variables of an FMU, and its modelDescription.xml."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

from drake_dae.dae.system.signals import Signal
from drake_dae.running.export.steps.parts import CONTROLLER, WrittenPart
from drake_dae.running.export.steps.words import distinct, identifiers

NEVER, AT_FIRST, ALWAYS = "NEVER", "AT_FIRST", "ALWAYS"
"""When a variable may be set: the names of fmi3.c."""

BASES = {
    "kg": {"kg": 1},
    "m": {"m": 1},
    "s": {"s": 1},
    "A": {"A": 1},
    "rad": {"rad": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
    "1": {},
}
"""Units of signals in those of SI."""


@dataclass(frozen=True)
class FmuVariable:
    """A variable of an FMU.

    Attributes:
        signal: Its name and unit.
        causality, variability: As FMI 3.0 has them.
        start: Its start value; None for what is computed.
        text: What it is, where its name does not say so.
    """

    signal: Signal
    causality: str
    variability: str
    start: float | int | None = None
    text: str = ""


@dataclass(frozen=True)
class FmuVariableGroup:
    """Variables that follow each other in the memory of an FMU.

    Attributes:
        variables: They.
        place: Where the first one is in Data of fmi3.c, an expression of C.
        when: When they may be set.
        kind: "Float64" or "Int32".
    """

    variables: list[FmuVariable]
    place: str
    when: str
    kind: str = "Float64"


def groups_of(written: WrittenPart) -> list[FmuVariableGroup]:
    """The variables of a controller or a plant."""
    own = f"own.{written.kind}"
    is_controller = written.kind == CONTROLLER

    def group(
        place: str, when: str, variables: Iterable[FmuVariable], kind: str = "Float64"
    ) -> FmuVariableGroup:
        return FmuVariableGroup(list(variables), place, when, kind)

    values = zip(written.parameters, written.values.tolist(), strict=True)
    parameters = [FmuVariable(signal, "parameter", "tunable", value) for signal, value in values]
    starts = written.inputs.tolist()
    inputs = [
        FmuVariable(signal, "input", "continuous", start)
        for signal, start in zip(_named(written.part.inputs), starts, strict=True)
    ]
    kind = "discrete" if is_controller else "continuous"
    outputs = [FmuVariable(signal, "output", kind) for signal in _named(written.part.outputs)]
    found = [group(_at(f"{own}.parameters"), ALWAYS, parameters)]
    if is_controller:
        controls = [
            Signal(f"stop_{s.name}", s.unit) for s in _named({"control": _control(written)})
        ]
        settings = {"stop_time": ("s", 0.1), "max_age": ("s", 1.5 * written.part.ticks.period)}
        age = Signal("measurement_age", "s")
        patience = FmuVariable(
            Signal("patience"), "parameter", "tunable", 10, "bad steps until it stops"
        )
        found += [
            group(
                _at(f"{own}.stop_control"),
                ALWAYS,
                [FmuVariable(signal, "parameter", "tunable", 0.0) for signal in controls],
            ),
            *(
                group(
                    _at(f"{own}.{name}"),
                    ALWAYS,
                    [FmuVariable(Signal(name, unit), "parameter", "tunable", value)],
                )
                for name, (unit, value) in settings.items()
            ),
            group(f"{_at('own.in.measured_at')} + sizeof(double)", ALWAYS, inputs),
            group(_at("own.age"), ALWAYS, [FmuVariable(age, "input", "continuous", 0.0)]),
            group(_at("own.out"), NEVER, outputs),
            group(_at(f"{own}.patience"), ALWAYS, [patience], "Int32"),
            group(_at("own.out.status"), NEVER, _told(), "Int32"),
        ]
    else:
        states = zip(written.states, written.start.tolist(), strict=True)
        size = f"sizeof(double) * {len(parameters)}"
        found += [
            group(f"{_at(f'{own}.parameters')} + {size}", ALWAYS, inputs),
            group(
                _at("own.start"),
                AT_FIRST,
                [
                    FmuVariable(Signal(f"start.{s.name}", s.unit), "parameter", "fixed", value)
                    for s, value in states
                ],
            ),
            group(
                _at(f"{own}.longest"),
                ALWAYS,
                [FmuVariable(Signal("step", "s"), "parameter", "tunable", written.longest)],
            ),
            group(_at(f"{own}.row"), NEVER, outputs),
        ]
    return _distinct([each for each in found if each.variables])


def ranges(groups: Sequence[FmuVariableGroup], kind: str) -> str:
    """The rows of a table of fmi3.c. Value references count all variables, 0 is the time."""
    first, rows = 1, []
    for group in groups:
        if group.kind == kind:
            row = f"{first}, {len(group.variables)}, {group.place}, {group.when}"
            rows.append(f"  {{{row}}},\n")
        first += len(group.variables)
    return "".join(rows)


def model_description(
    groups: Sequence[FmuVariableGroup],
    name: str,
    identifier: str,
    token: str,
    step: float,
    about: str,
) -> str:
    """modelDescription.xml.

    Args:
        groups: The variables.
        name: Of the model.
        identifier: The same in C.
        token: By which the description and the binary know each other.
        step: Of the FMU, in s.
        about: What it is.
    """
    variables = [(each, group) for group in groups for each in group.variables]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(name)} '
        f"instantiationToken={quoteattr(token)} description={quoteattr(about)} "
        'generationTool="drake_dae" variableNamingConvention="flat">',
        f"  <CoSimulation modelIdentifier={quoteattr(identifier)} "
        'canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true" '
        'canSerializeFMUState="true" providesIntermediateUpdate="false" hasEventMode="false"'
        f' fixedInternalStepSize="{step!r}"/>',
        "  <UnitDefinitions>",
        *_units({each.signal.unit for each, _ in variables} | {"s"}),
        "  </UnitDefinitions>",
        '  <LogCategories><Category name="logStatusError"/></LogCategories>',
        f'  <DefaultExperiment stepSize="{step!r}"/>',
        "  <ModelVariables>",
        '    <Float64 name="time" valueReference="0" causality="independent" '
        'variability="continuous" unit="s"/>',
    ]
    outputs = []
    for reference, (each, group) in enumerate(variables, 1):
        initial = {"input": "", "output": ' initial="calculated"'}.get(
            each.causality, ' initial="exact"'
        )
        unit = f" unit={quoteattr(each.signal.unit)}" if each.signal.unit else ""
        text = f" description={quoteattr(each.text)}" if each.text else ""
        start = "" if each.start is None else f' start="{each.start!r}"'
        lines.append(
            f'    <{group.kind} name={quoteattr(each.signal.name)} valueReference="{reference}" '
            f'causality="{each.causality}" variability="{each.variability}"{initial}{unit}'
            f"{start}{text}/>"
        )
        if each.causality == "output":
            outputs.append(reference)
    lines += [
        "  </ModelVariables>",
        "  <ModelStructure>",
        *(f'    <Output valueReference="{reference}"/>' for reference in outputs),
        *(f'    <InitialUnknown valueReference="{reference}"/>' for reference in outputs),
        "  </ModelStructure>",
        "</fmiModelDescription>",
        "",
    ]
    return "\n".join(lines)


def exponents(unit: str) -> dict[str, int] | None:
    """A unit such as "N m/s^2" or "m/(N s)" in those of SI; None for what it does not know."""
    found = dict[str, int]()
    for index, side in enumerate(unit.split("/")):
        for word in side.strip("()").split():
            base, _, power = word.partition("^")
            if base not in BASES or (power and not re.fullmatch("[0-9]+", power)):
                return None
            for key, exponent in BASES[base].items():
                sign = -1 if index else 1
                found[key] = found.get(key, 0) + sign * exponent * int(power or 1)
    return {key: exponent for key, exponent in found.items() if exponent}


def _units(units: Iterable[str]) -> list[str]:
    lines = []
    for unit in sorted(set(units) - {""}):
        known = exponents(unit)
        base = "".join(f' {key}="{value}"' for key, value in (known or {}).items())
        inner = "" if known is None else f"<BaseUnit{base}/>"
        lines.append(f"    <Unit name={quoteattr(unit)}>{inner}</Unit>")
    return lines


def _at(member: str) -> str:
    return f"offsetof(Data, {member})"


def _named(vectors: Mapping[str, Sequence[Signal]]) -> list[Signal]:
    """The entries of vectors as `vector.entry`, in the order of C."""
    given = {name: tuple(signals) for name, signals in vectors.items()}
    return [
        Signal(f"{name}.{signal.name}", signal.unit)
        for name, signals in identifiers(given).items()
        for signal in signals
    ]


def _control(written: WrittenPart) -> Sequence[Signal]:
    return written.part.outputs["control"]


def _told() -> list[FmuVariable]:
    texts = {
        "status": "0 running, 1 holding, 2 stopped, 3 waiting for the first good inputs",
        "fault": "0 none, 1 no number, 2 stale, 3 late, 4 clock, 5 the law has no value",
        "bad_steps": "how many steps in a row were bad",
    }
    return [
        FmuVariable(Signal(name), "output", "discrete", None, text) for name, text in texts.items()
    ]


def _distinct(groups: Sequence[FmuVariableGroup]) -> list[FmuVariableGroup]:
    """The same groups, in which no name comes twice."""
    signals = [Signal("time"), *(each.signal for group in groups for each in group.variables)]
    names = iter(distinct(signals)[1:])
    return [
        replace(group, variables=[replace(each, signal=next(names)) for each in group.variables])
        for group in groups
    ]
