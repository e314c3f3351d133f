"""The variables of an FMU, and its modelDescription.xml."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

from drake_dae.dae.system.signals import Signal
from drake_dae.running.export.steps.cuts import CONTROL
from drake_dae.running.export.steps.parts import CONTROLLER, WrittenPart
from drake_dae.running.export.steps.words import distinct, identifiers

NEVER, AT_FIRST, ALWAYS = "NEVER", "AT_FIRST", "ALWAYS"
"""The times at which a variable may be set, as constants of fmi3.c."""

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
"""Unit of a signal -> exponents of SI base units."""


@dataclass(frozen=True)
class FmuVariable:
    """A variable of an FMU.

    Attributes:
        signal: Name and unit.
        causality, variability: The attributes of FMI 3.0.
        start: The start value; None for computed variables.
        text: A description; empty if the name suffices.
    """

    signal: Signal
    causality: str
    variability: str
    start: float | int | None = None
    text: str = ""


@dataclass(frozen=True)
class FmuVariableGroup:
    """Variables that are adjacent in the memory of an FMU.

    Attributes:
        variables: The variables, in memory order.
        place: The C expression of the first variable's offset in the struct Data of fmi3.c.
        when: NEVER, AT_FIRST or ALWAYS: when they may be set.
        kind: "Float64" or "Int32".
    """

    variables: list[FmuVariable]
    place: str
    when: str
    kind: str = "Float64"


def groups_of(written: WrittenPart) -> list[FmuVariableGroup]:
    """The variables of a controller or a plant."""
    own, is_controller = f"own.{written.kind}", written.kind == CONTROLLER
    starts = zip(_named(written.part.inputs), written.inputs.tolist(), strict=True)
    inputs = [FmuVariable(signal, "input", "continuous", start) for signal, start in starts]
    variability = "discrete" if is_controller else "continuous"
    outputs = [FmuVariable(s, "output", variability) for s in _named(written.part.outputs)]
    parameters = _tunable(written.parameters, written.values.tolist())
    groups = [FmuVariableGroup(parameters, _at(f"{own}.parameters"), ALWAYS)]
    if is_controller:
        controls = _named({CONTROL: written.part.outputs[CONTROL]})
        stop = _tunable([Signal(f"stop_{s.name}", s.unit) for s in controls], [0.0] * len(controls))
        stop_time = _tunable([Signal("stop_time", "s")], [0.1])
        max_age = _tunable([Signal("max_age", "s")], [1.5 * written.part.ticks.period])
        age = FmuVariable(Signal("measurement_age", "s"), "input", "continuous", 0.0)
        text = "bad steps until it stops"
        patience = FmuVariable(Signal("patience"), "parameter", "tunable", 10, text)
        groups += [
            FmuVariableGroup(stop, _at(f"{own}.stop_control"), ALWAYS),
            FmuVariableGroup(stop_time, _at(f"{own}.stop_time"), ALWAYS),
            FmuVariableGroup(max_age, _at(f"{own}.max_age"), ALWAYS),
            FmuVariableGroup(inputs, f"{_at('own.in.measured_at')} + sizeof(double)", ALWAYS),
            FmuVariableGroup([age], _at("own.age"), ALWAYS),
            FmuVariableGroup(outputs, _at("own.out"), NEVER),
            FmuVariableGroup([patience], _at(f"{own}.patience"), ALWAYS, "Int32"),
            FmuVariableGroup(_reports(), _at("own.out.status"), NEVER, "Int32"),
        ]
    else:
        states = zip(written.states, written.start.tolist(), strict=True)
        start = [
            FmuVariable(Signal(f"start.{s.name}", s.unit), "parameter", "fixed", value)
            for s, value in states
        ]
        behind = f"{_at(f'{own}.parameters')} + sizeof(double) * {len(parameters)}"
        step = _tunable([Signal("step", "s")], [written.longest])
        groups += [
            FmuVariableGroup(inputs, behind, ALWAYS),
            FmuVariableGroup(start, _at("own.start"), AT_FIRST),
            FmuVariableGroup(step, _at(f"{own}.longest"), ALWAYS),
            FmuVariableGroup(outputs, _at(f"{own}.row"), NEVER),
        ]
    return _distinct([group for group in groups if group.variables])


def _tunable(signals: Iterable[Signal], values: Iterable[float]) -> list[FmuVariable]:
    pairs = zip(signals, values, strict=True)
    return [FmuVariable(signal, "parameter", "tunable", value) for signal, value in pairs]


def ranges(groups: Sequence[FmuVariableGroup], kind: str) -> str:
    """C code of a table of fmi3.c. Value references number all variables; 0 is the time."""
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
    """Returns the text of modelDescription.xml.

    Args:
        groups: The variables.
        name: The name of the model.
        identifier: The name of the model as a C identifier.
        token: The instantiation token, equal in the description and in the binary.
        step: The internal step of the FMU, in s.
        about: A description of the model.
    """
    variables = [(variable, group) for group in groups for variable in group.variables]
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
        *_units({variable.signal.unit for variable, _ in variables} | {"s"}),
        "  </UnitDefinitions>",
        '  <LogCategories><Category name="logStatusError"/></LogCategories>',
        f'  <DefaultExperiment stepSize="{step!r}"/>',
        "  <ModelVariables>",
        '    <Float64 name="time" valueReference="0" causality="independent" '
        'variability="continuous" unit="s"/>',
    ]
    outputs = []
    for reference, (variable, group) in enumerate(variables, 1):
        signal, causality = variable.signal, variable.causality
        initial = {"input": "", "output": ' initial="calculated"'}.get(
            causality, ' initial="exact"'
        )
        unit = f" unit={quoteattr(signal.unit)}" if signal.unit else ""
        text = f" description={quoteattr(variable.text)}" if variable.text else ""
        start = "" if variable.start is None else f' start="{variable.start!r}"'
        lines.append(
            f'    <{group.kind} name={quoteattr(signal.name)} valueReference="{reference}" '
            f'causality="{causality}" variability="{variable.variability}"{initial}{unit}'
            f"{start}{text}/>"
        )
        if causality == "output":
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
    """The SI exponents of a unit such as "N m/s^2" or "m/(N s)"; None for an unknown unit."""
    total = dict[str, int]()
    for index, side in enumerate(unit.split("/")):
        for word in side.strip("()").split():
            base, _, power = word.partition("^")
            if base not in BASES or (power and not re.fullmatch("[0-9]+", power)):
                return None
            for key, exponent in BASES[base].items():
                sign = -1 if index else 1
                total[key] = total.get(key, 0) + sign * exponent * int(power or 1)
    return {key: exponent for key, exponent in total.items() if exponent}


def _units(units: Iterable[str]) -> list[str]:
    lines = []
    for unit in sorted(set(units) - {""}):
        powers = exponents(unit)
        base = "".join(f' {key}="{value}"' for key, value in (powers or {}).items())
        inner = "" if powers is None else f"<BaseUnit{base}/>"
        lines.append(f"    <Unit name={quoteattr(unit)}>{inner}</Unit>")
    return lines


def _at(member: str) -> str:
    return f"offsetof(Data, {member})"


def _named(vectors: Mapping[str, Sequence[Signal]]) -> list[Signal]:
    """The entries of vectors with the names "vector.entry", in memory order."""
    tuples = {name: tuple(signals) for name, signals in vectors.items()}
    return [
        Signal(f"{name}.{signal.name}", signal.unit)
        for name, signals in identifiers(tuples).items()
        for signal in signals
    ]


def _reports() -> list[FmuVariable]:
    """The outputs of a controller about its inputs."""
    texts = {
        "status": "0 running, 1 holding, 2 stopped, 3 waiting for the first good inputs",
        "fault": "0 none, 1 no number, 2 stale, 3 late, 4 clock, 5 the law has no value",
        "bad_steps": "how many steps in a row were bad",
    }
    return [
        FmuVariable(Signal(name), "output", "discrete", None, text) for name, text in texts.items()
    ]


def _distinct(groups: Sequence[FmuVariableGroup]) -> list[FmuVariableGroup]:
    """Returns the groups with unique names of variables."""
    signals = [variable.signal for group in groups for variable in group.variables]
    names = iter(distinct([Signal("time"), *signals])[1:])
    return [
        replace(group, variables=[replace(old, signal=next(names)) for old in group.variables])
        for group in groups
    ]
