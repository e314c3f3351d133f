"""Inputs and outputs that Python computed, and the part of the test program that compares them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.running.export.parts import LoopParts
from drake_dae.running.export.text import CFunction, braced
from drake_dae.running.export.whole import whole_values

SAMPLES = 10
"""The largest number of samples of each function in the test program."""


@dataclass(frozen=True, eq=False)
class FunctionSample:
    """A sample of a function, for the test program.

    Attributes:
        inputs, outputs: Name of an argument or result -> value.
        scales: Name of a result -> its scale for the comparison: its largest entry, or its change
            if all inputs change by their own size, whichever is larger. A residual near N*, for
            example, is a small difference of large numbers, and has their round-off.
    """

    inputs: Mapping[str, FloatArray]
    outputs: Mapping[str, FloatArray]
    scales: Mapping[str, float]


def samples(
    parts: LoopParts, context: Context, calls: Mapping[str, CFunction]
) -> dict[str, list[FunctionSample]]:
    """Evaluates all functions at the start and at states near and on N*.

    Raises:
        ModelError: A function has no finite value at any of these states.
    """
    plant, controller, manifold = parts.plant, parts.controller, parts.plant.structure.manifold
    reference, whole = parts.reference(context), parts.compiled
    random = np.random.default_rng(0)
    own = plant.GetMyContextFromRoot(context)
    start, parameters = plant.state(own), plant.current_parameters(own)
    model = controller.all_parameters(controller.GetMyContextFromRoot(context))
    states = [start, *plant.structure.states][:SAMPLES]
    by_name: dict[str, list[FunctionSample]] = {name: [] for name in (*calls, "project")}
    for index, state in enumerate(states):
        near = state + 1e-4 * random.normal(size=state.size) * np.maximum(1.0, np.abs(state))
        time = context.get_time() + 0.1 * index
        values = {
            "state": state,
            "link_state": state[: controller.law.system.num_states],
            "other": states[0],
            "reference": reference(time),
            "measured_force": random.normal(size=plant.dae.num_constraints),
            "integral": random.normal(size=len(controller.law.integral.outputs)),
            "parameters": parameters,
            "law_parameters": model,
            "control": np.zeros(plant.dae.num_controls),
            "time": np.array([time]),
        }
        if whole is not None:
            at_start, of_blocks = whole.start(context), whole.values(context)
            held = whole.initialized(context.get_time(), *at_start, of_blocks)
            values |= whole_values(whole, (at_start[0], held), state)
            values["loop_parameters"] = of_blocks
        for name, call in calls.items():
            # The residual on N* is only round-off.
            values["state"] = near if name == "residual" else state
            results = call.function(*(values[source] for source in call.inputs))
            if not call.function.is_valid:
                continue
            outputs = dict(zip(call.outputs, results, strict=True))
            inputs = {source: values[source] for source in call.inputs}
            by_name[name].append(FunctionSample(inputs, outputs, _scales(call, inputs, outputs)))
            if name == "law" and "control" in outputs:
                values["control"] = outputs["control"]
        try:
            projected = manifold.project(near, parameters)
        except InconsistentStateError:
            continue
        inputs, size = {"state": near, "parameters": parameters}, np.abs(projected).max(initial=0.0)
        by_name["project"].append(
            FunctionSample(inputs, {"projected": projected}, {"projected": size})
        )
    empty = [name for name, samples in by_name.items() if not samples]
    if empty:
        raise ModelError(
            f"{plant.dae.name}: nothing to compare: {', '.join(empty)} has no values at the start "
            "nor at any state where the structure was examined"
        )
    return by_name


def _scales(
    call: CFunction, inputs: Mapping[str, FloatArray], outputs: Mapping[str, FloatArray]
) -> dict[str, float]:
    """The scales of a sample, see `FunctionSample`."""
    random, step = np.random.default_rng(0), 1e-7
    scales = {name: float(np.max(np.abs(value), initial=0.0)) for name, value in outputs.items()}
    for _ in range(3):
        changed = [
            value * (1.0 + step * random.uniform(-1.0, 1.0, value.shape))
            for value in inputs.values()
        ]
        results = call.function(*changed)
        if not call.function.is_valid:
            continue
        for name, result in zip(call.outputs, results, strict=True):
            change = float(np.max(np.abs(result - outputs[name]), initial=0.0)) / step
            scales[name] = max(scales[name], change)
    return scales


def tests(
    prefix: str, calls: Mapping[str, CFunction], samples: Mapping[str, Sequence[FunctionSample]]
) -> dict[str, str]:
    """The data and the comparisons of the test program, for its template."""
    data, checks = [], list[str]()

    def table(name: str, rows: Sequence[FloatArray]) -> str:
        width = max(1, rows[0].size)
        lines = ",\n".join(braced([*map(repr, row.tolist())] or ["0.0"]) for row in rows)
        data.append(f"static const double {name}[{len(rows)}][{width}] = {{\n{lines}}};\n")
        return f"{name}[k]"

    def check(name: str, own: Sequence[FunctionSample], before: list[str], arguments: str) -> None:
        """Appends a loop over the samples of a function that calls it and compares its results."""
        results = {key: [sample.outputs[key] for sample in own] for key in own[0].outputs}
        checks.extend(
            [
                f"  for (k = 0; k < {len(own)}; k++) {{",
                *(
                    f"    double found_{key}[{max(1, rows[0].size)}];"
                    for key, rows in results.items()
                ),
                *before,
                f'    if (refused("{name}", k, {prefix}_{name}({arguments}))) {{',
                "      failures++;",
                "    } else {",
            ]
        )
        for key, rows in results.items():
            expected = table(f"{name}_expected_{key}", rows)
            scale = float(max(sample.scales[key] for sample in own))
            pair = f"k, {rows[0].size}, found_{key}, {expected}, {scale!r}"
            checks.append(f'      failures += differs("{key}", {pair});')
        checks.extend(["    }", "  }"])

    for name, call in calls.items():
        if name == "newton_step":  # A static function, which `project` calls.
            continue
        own = samples[name]
        inputs = [table(f"{name}_{key}", [s.inputs[key] for s in own]) for key in call.inputs]
        check(name, own, [], ", ".join([*inputs, *(f"found_{key}" for key in call.outputs)]))
    own = samples["project"]
    near = table("project_state", [s.inputs["state"] for s in own])
    parameters = table("project_parameters", [s.inputs["parameters"] for s in own])
    copy = f"    memcpy(found_projected, {near}, sizeof(found_projected));"
    check("project", own, [copy], f"found_projected, {parameters}")
    count = sum(len(rows) for name, rows in samples.items() if name != "newton_step")
    return {"data": "".join(data), "checks": "\n".join(checks), "count": str(count)}
