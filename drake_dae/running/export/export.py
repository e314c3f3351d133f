"""Export of a closed loop's law, plant and projection as plain C99, for real-time programs."""

from pathlib import Path

import casadi as ca
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.dae import ConstraintStructure, Signal, TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.parts import parts_of
from drake_dae.running.export.samples import samples, tests
from drake_dae.running.export.steps.words import common_words, file_of, parameter_names, prefix_of
from drake_dae.running.export.text import (
    CFunction,
    Vector,
    braced,
    comment,
    entry_lines,
    generated,
    string,
    written,
)
from drake_dae.running.export.whole import whole_calls, whole_vectors
from drake_dae.trace.functions import TracedFunction

TEMPLATES = Path(__file__).parent / "c99"


@checked(ModelError)
def export_code(
    loop: ClosedLoop | Diagram, context: Context, name: str, folder: str | Path
) -> list[Path]:
    """Writes the law, the plant and the projection of a closed loop as C99 without dependencies.

    If all blocks can be traced, see `compile_diagram`, it also writes functions of the whole loop:
    the derivative of all continuous states, all outputs, and the updates of all discrete states.

    The files are name.h with sizes, names and units; name.c; test_name.c, which compares the
    functions with values that Python computed; a Makefile, which compiles and runs the test; and
    LICENSE.txt. Existing files are overwritten.

    Args:
        loop: The closed loop, or any diagram with one plant and one law.
        context: Its context at the start time; the test uses its state and parameters.
        name: The name of the files, and, as a C identifier, the prefix of the functions.
        folder: The folder to write to; created if it does not exist.

    Returns:
        The paths of the files.

    Raises:
        ModelError: A function has no finite values to compare, the diagram does not have exactly
            one plant and one law, or it cannot be traced.
        OSError: A file cannot be written.
    """
    parts = parts_of(loop)
    plant, controller, whole = parts.plant, parts.controller, parts.compiled
    law, structure = controller.law, plant.structure
    plant_parameters = plant.current_parameters(context_in(plant, context))
    law_parameters = controller.all_parameters(context_in(controller, context))
    prefix, file = prefix_of(name), file_of(name)
    vectors = _vectors(law, structure, plant_parameters, law_parameters)
    calls = _calls(law, structure)
    if whole is not None:
        vectors |= whole_vectors(whole, whole.values(context))
        calls |= whole_calls(whole)
    words = common_words(name) | {
        "title": comment(f"{structure.system.name} ({name})"),
        "vectors": "".join(_declared(prefix, *item) for item in vectors.items()),
        "names": "".join(_defined(prefix, *item) for item in vectors.items()),
        "law": calls["law"].signature,
        "plant": calls["plant"].signature,
        "generated": generated(
            {f"{prefix}_traced_{key}": call.function.function for key, call in calls.items()}
        ),
        "calls": "".join(_called(prefix, *item) for item in calls.items()),
        "residual": calls["residual"].signature,
        "residuals": str(max(1, len(structure.manifold.residual_signals))),
        "whole": "".join(
            f"int {prefix}_{key}({call.signature});\n"
            for key, call in calls.items()
            if key.startswith("loop_")
        ),
        **tests(prefix, calls, samples(parts, context, calls)),
    }
    names = {
        "system.h": f"{file}.h",
        "system.c": f"{file}.c",
        "test.c": f"test_{file}.c",
        "Makefile": "Makefile",
        "LICENSE.txt": "LICENSE.txt",
    }
    return written(TEMPLATES, folder, names, words)


def _vectors(
    law: TrackingLaw,
    structure: ConstraintStructure,
    plant_parameters: FloatArray,
    law_parameters: FloatArray,
) -> dict[str, Vector]:
    """The vectors of the C code, by their C names."""
    system = structure.system
    moves = "; what moves comes here, too, with its derivatives" if system.exogenous else ""
    vectors = {
        "state": Vector("x, the state", system.state_signals),
        "control": Vector("u, the control", system.control_signals),
        "reference": Vector("R, the references with their derivatives", law.reference_signals),
        "measured_force": Vector("v as it is measured", system.constraint_input_signals),
        "tracking_error": Vector("e = z - r (29)", system.output_signals),
        "constraint_force": Vector("v, the constraint inputs", system.constraint_input_signals),
        "constraint_residual": Vector("zero on N*", structure.manifold.residual_signals),
        "controlled_output": Vector("z, the controlled outputs", system.output_signals),
        "parameters": Vector(f"of the plant{moves}", parameter_names(system), plant_parameters),
        "law_parameters": Vector(
            "of the law's model, and then the gains",
            parameter_names(law.system, law),
            law_parameters,
        ),
    }
    if is_of_links(law, structure):
        own = law.system
        vectors["link_state"] = Vector("(q, v), the state of the links", own.state_signals)
        vectors["wanted_torque"] = Vector("of the springs, by the law", own.control_signals)
    if not law.measured_force:
        del vectors["measured_force"]
    if law.integral.outputs:
        vectors["integral"] = Vector("the integrals of errors", law.integral.signals)
        rates = [Signal(f"d/dt {s.name}", s.unit.removesuffix(" s")) for s in law.integral.signals]
        vectors["integral_rate"] = Vector("their derivatives by the time", rates)
    return vectors


def _calls(law: TrackingLaw, structure: ConstraintStructure) -> dict[str, CFunction]:
    """The functions of the C code, by their C names."""
    system, derivatives = structure.system, structure.derivatives
    force = derivatives.expand(derivatives.constraint_input)
    plant = system.trace(
        "plant",
        {
            "rate": derivatives.expand(derivatives.rate),
            "constraint_force": force,
            "controlled_output": system.outputs(force),
        },
        {"control": derivatives.control},
        structure.elimination.pivot,
    )
    residual = system.trace(
        "residual", {"constraint_residual": structure.manifold.residual_expression}
    )
    newton = structure.manifold.newton_step
    inputs = {name: newton.function.sx_in(i) for i, name in enumerate(newton.input_names)}
    change = ca.SX(system.scale) * newton.function(*inputs.values())[0]
    step = TracedFunction("step to the manifold", inputs, {"step": change}, often=False)
    c_names = {"parameters": "law_parameters"}
    if is_of_links(law, structure):
        c_names |= {"state": "link_state", "control": "wanted_torque"}
    arguments, results = (
        [c_names.get(name, name) for name in names]
        for names in (law.function.input_names, law.function.output_names)
    )
    others = {"plant": plant, "residual": residual, "newton_step": step}
    return {
        "law": CFunction(law.function, arguments, results),
        **{key: CFunction(f, f.input_names, f.output_names) for key, f in others.items()},
    }


def is_of_links(law: TrackingLaw, structure: ConstraintStructure) -> bool:
    """Whether the law controls only the links of a robot with elastic joints."""
    return law.system.num_states != structure.system.num_states


def _declared(prefix: str, name: str, vector: Vector) -> str:
    """The declarations of a vector in the header."""
    size = f"{prefix}_{name}_SIZE".upper()
    entries = (f"     {line}" for line in entry_lines(vector.signals))
    lines = [f"/* {name}: {vector.what}", *entries]
    lines[-1] += " */"
    lines.append(f"enum {{ {size} = {len(vector.signals)} }};")
    for what in ("names", "units"):
        lines.append(f"extern const char *const {prefix}_{name}_{what}[{size} + 1];")
    if vector.default is not None:
        lines.append(f"extern const double {prefix}_default_{name}[{size} + 1];")
    return "\n".join([*lines, "", ""])


def _defined(prefix: str, name: str, vector: Vector) -> str:
    """The names, units and defaults of a vector."""
    lines = []
    for what in ("name", "unit"):
        texts = [string(getattr(signal, what)) for signal in vector.signals]
        lines.append(f"const char *const {prefix}_{name}_{what}s[] = {braced([*texts, '0'])};")
    if vector.default is not None:
        values = braced([*map(repr, vector.default.tolist()), "0.0"])
        lines.append(f"const double {prefix}_default_{name}[] = {values};")
    return "\n".join([*lines, ""])


def _called(prefix: str, name: str, call: CFunction) -> str:
    """The C function that calls the code that CasADi generated."""
    traced = f"{prefix}_traced_{name}"
    function = call.function.function
    kind = f"static int {name}" if name == "newton_step" else f"int {prefix}_{name}"
    own, count = len(call.outputs), len(call.inputs)
    # If no matrix must be regular, there is no pivot to check, and it keeps the value 1.
    checks = ["&pivot", "&finite", "&valid"][: function.n_out() - own]
    lines = [
        f"{kind}({call.signature}) {{",
        "  double pivot = 1.0, finite = 0.0, valid = 0.0;",
        f"  const double *arg[{max(count, function.sz_arg())}] = {braced(call.inputs)};",
        f"  static const int sizes[{count}] = {braced(list(map(str, call.function.sizes)))};",
        f"  double *res[{function.sz_res()}] = {braced([*call.outputs, *checks])};",
        f"  {traced}(arg, res, 0, 0, 0);",
        "  (void)valid;",
        f"  return status(pivot, finite, {count}, arg, sizes);",
        "}",
        "",
        "",
    ]
    return "\n".join(lines)
