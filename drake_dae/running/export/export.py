"""A closed loop's law, plant and projection as plain C99, for somebody's real-time loop."""

from importlib.metadata import version
from pathlib import Path

import casadi as ca
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.parts import parts_of
from drake_dae.running.export.samples import samples, tests
from drake_dae.running.export.steps.words import file_of, parameter_names, prefix_of
from drake_dae.running.export.text import (
    CFunction,
    Vector,
    braced,
    comment,
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

    Where all of its blocks can be traced, see `compile_diagram`, the loop as a whole as well: the
    derivative of all states, all outputs, and what blocks hold between their samples.

    In the folder stand then: name.h with sizes, names and units; name.c; test_name.c, which
    compares them with values that Python computed; a Makefile, whose `make` compiles and runs that;
    and LICENSE.txt. Files of these names are overwritten.

    Args:
        loop: The closed loop, or any diagram with one plant and one law.
        context: Its context at the start, whose state and parameters the test program has too.
        name: What the files are called, and, in letters that C takes, the functions.
        folder: Where to write; made if there is none.

    Returns:
        The files.

    Raises:
        ModelError: No sample has values, so that nothing could be compared; or a diagram has not
            one plant and one law, or cannot be traced.
        OSError: A file cannot be written.
    """
    parts = parts_of(loop)
    plant, controller, whole = parts.plant, parts.controller, parts.compiled
    law, structure = controller.law, plant.structure
    plant_parameters = plant.current_parameters(plant.GetMyContextFromRoot(context))
    law_parameters = controller.all_parameters(controller.GetMyContextFromRoot(context))
    prefix, file = prefix_of(name), file_of(name)
    vectors = _vectors(law, structure, plant_parameters, law_parameters)
    calls = _calls(law, structure)
    if whole is not None:
        vectors |= whole_vectors(whole, whole.values(context))
        calls |= whole_calls(whole)
    words = {
        "title": comment(f"{structure.system.name} ({name})"),
        "name": file,
        "prefix": prefix,
        "guard": prefix.upper(),
        "version": version("drake_dae"),
        "casadi": ca.__version__,
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
    """All vectors of the C code, by their names there."""
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
    """The functions of the C code, by their names there."""
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
    own = structure.manifold.newton_step
    inputs = {name: own.function.sx_in(i) for i, name in enumerate(own.input_names)}
    moved = ca.SX(system.scale) * own.function(*inputs.values())[0]
    step = TracedFunction("step to the manifold", inputs, {"step": moved}, often=False)
    named = {"parameters": "law_parameters"}
    if is_of_links(law, structure):
        named |= {"state": "link_state", "control": "wanted_torque"}
    read, shown = (
        [named.get(name, name) for name in names]
        for names in (law.function.input_names, law.function.output_names)
    )
    return {
        "law": CFunction(law.function, read, shown),
        "plant": CFunction(plant, plant.input_names, plant.output_names),
        "residual": CFunction(residual, residual.input_names, residual.output_names),
        "newton_step": CFunction(step, step.input_names, step.output_names),
    }


def is_of_links(law: TrackingLaw, structure: ConstraintStructure) -> bool:
    """Whether a law is that of the links of a robot with springs, by themselves."""
    return law.system.num_states != structure.system.num_states


def _declared(prefix: str, name: str, vector: Vector) -> str:
    """What the header says of a vector."""
    size = f"{prefix}_{name}_SIZE".upper()
    width = max([len(comment(signal.name)) for signal in vector.signals], default=0)
    lines = [f"/* {name}: {vector.what}"]
    for index, signal in enumerate(vector.signals):
        entry = f"     {index:3d}  {comment(signal.name).ljust(width)}  {comment(signal.unit)}"
        lines.append(entry.rstrip())
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
    """The C function that calls what CasADi generated."""
    traced = f"{prefix}_traced_{name}"
    function = call.function.function
    kind = f"static int {name}" if name == "newton_step" else f"int {prefix}_{name}"
    own, count = len(call.outputs), len(call.inputs)
    # Without a matrix that must be regular its pivot is 1, and there is no check of it.
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
