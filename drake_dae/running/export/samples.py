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
"""How many inputs the test program has for each function."""


@dataclass(frozen=True, eq=False)
class FunctionSample:
    """Inputs and outputs of a function, by the names of its arguments.

    Attributes:
        inputs, outputs: Their values.
        scales: How large each output is, in its unit: its largest entry, or what it changes by for
            a change of all inputs by their own size, where that is more. A residual near N*, for
            example, is a small difference of large numbers, and has their round-off.
    """

    inputs: Mapping[str, FloatArray]
    outputs: Mapping[str, FloatArray]
    scales: Mapping[str, float]


def samples(
    parts: LoopParts, context: Context, calls: Mapping[str, CFunction]
) -> dict[str, list[FunctionSample]]:
    """Inputs and outputs of all functions: at the start, and at states near and on N*.

    Raises:
        ModelError: No sample of a function has values.
    """
    plant, controller, manifold = parts.plant, parts.controller, parts.plant.structure.manifold
    reference, whole = parts.reference(context), parts.compiled
    random = np.random.default_rng(0)
    own = plant.GetMyContextFromRoot(context)
    start, given = plant.state(own), plant.current_parameters(own)
    model = controller.all_parameters(controller.GetMyContextFromRoot(context))
    states = [start, *plant.structure.states][:SAMPLES]
    found: dict[str, list[FunctionSample]] = {name: [] for name in (*calls, "project")}
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
            "parameters": given,
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
            found[name].append(FunctionSample(inputs, outputs, _scales(call, inputs, outputs)))
            if name == "law" and "control" in outputs:
                values["control"] = outputs["control"]
        try:
            projected = manifold.project(near, given)
        except InconsistentStateError:
            continue
        inputs, size = {"state": near, "parameters": given}, np.max(np.abs(projected), initial=0.0)
        found["project"].append(
            FunctionSample(inputs, {"projected": projected}, {"projected": size})
        )
    empty = [name for name, samples in found.items() if not samples]
    if empty:
        raise ModelError(
            f"{plant.dae.name}: nothing to compare: {', '.join(empty)} has no values at the start "
            "nor at any state where the structure was examined"
        )
    return found


def _scales(
    call: CFunction, inputs: Mapping[str, FloatArray], outputs: Mapping[str, FloatArray]
) -> dict[str, float]:
    """The scales of a sample."""
    random, share = np.random.default_rng(0), 1e-7
    found = {name: float(np.max(np.abs(value), initial=0.0)) for name, value in outputs.items()}
    for _ in range(3):
        changed = [
            value * (1.0 + share * random.uniform(-1.0, 1.0, value.shape))
            for value in inputs.values()
        ]
        results = call.function(*changed)
        if not call.function.is_valid:
            continue
        for name, result in zip(call.outputs, results, strict=True):
            change = float(np.max(np.abs(result - outputs[name]), initial=0.0)) / share
            found[name] = max(found[name], change)
    return found


def tests(
    prefix: str, calls: Mapping[str, CFunction], samples: Mapping[str, Sequence[FunctionSample]]
) -> dict[str, str]:
    """The data of the test program, and its comparisons."""
    data, checks = [], []

    def table(name: str, rows: Sequence[FloatArray]) -> str:
        width = max(1, rows[0].size)
        lines = ",\n".join(braced([*map(repr, row.tolist())] or ["0.0"]) for row in rows)
        data.append(f"static const double {name}[{len(rows)}][{width}] = {{\n{lines}}};\n")
        return f"{name}[k]"

    def compare(
        what: str, wanted: str, rows: Sequence[FloatArray], own: Sequence[FunctionSample]
    ) -> str:
        scale = float(max(sample.scales[what] for sample in own))
        place = f"k, {rows[0].size}, found_{what}, {wanted}, {scale!r}"
        return f'      failures += differs("{what}", {place});'

    for name, call in calls.items():
        if name == "newton_step":  # Static; what calls it is compared.
            continue
        own = samples[name]
        inputs = [table(f"{name}_{key}", [s.inputs[key] for s in own]) for key in call.inputs]
        sizes = {key: max(1, own[0].outputs[key].size) for key in call.outputs}
        arguments = ", ".join([*inputs, *(f"found_{key}" for key in call.outputs)])
        checks += [
            f"  for (k = 0; k < {len(own)}; k++) {{",
            *(f"    double found_{key}[{size}];" for key, size in sizes.items()),
            f'    if (refused("{name}", k, {prefix}_{name}({arguments}))) {{',
            "      failures++;",
            "    } else {",
        ]
        for key in call.outputs:
            rows = [s.outputs[key] for s in own]
            checks.append(compare(key, table(f"{name}_wanted_{key}", rows), rows, own))
        checks += ["    }", "  }"]
    own = samples["project"]
    near = table("project_state", [s.inputs["state"] for s in own])
    given = table("project_parameters", [s.inputs["parameters"] for s in own])
    rows = [s.outputs["projected"] for s in own]
    checks += [
        f"  for (k = 0; k < {len(own)}; k++) {{",
        f"    double found_projected[{rows[0].size}];",
        f"    memcpy(found_projected, {near}, sizeof(found_projected));",
        f'    if (refused("project", k, {prefix}_project(found_projected, {given}))) {{',
        "      failures++;",
        "    } else {",
        compare("projected", table("project_wanted", rows), rows, own),
        "    }",
        "  }",
    ]
    count = sum(len(rows) for name, rows in samples.items() if name != "newton_step")
    return {"data": "".join(data), "checks": "\n".join(checks), "count": str(count)}
