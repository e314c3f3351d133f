"""CasADi functions as C on `real`: a number, or several side by side; see real.h."""

from math import copysign, inf

import casadi as ca

from drake_dae.errors import ModelError

_OPERATIONS: dict[int, str] = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "K(1.0) / {0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_SQRT: "square_root({0})",
    ca.OP_FABS: "magnitude({0})",
    ca.OP_FMIN: "least({0}, {1})",
    ca.OP_FMAX: "most({0}, {1})",
    ca.OP_LT: "ONE_IF(LESS({0}, {1}))",
    ca.OP_LE: "ONE_IF(NOT_MORE({0}, {1}))",
    ca.OP_EQ: "ONE_IF(SAME({0}, {1}))",
    ca.OP_NE: "ONE_IF(~SAME({0}, {1}))",
    ca.OP_NOT: "ONE_IF(SAME({0}, K(0.0)))",
    ca.OP_AND: "ONE_IF(~SAME({0}, K(0.0)) & ~SAME({1}, K(0.0)))",
    ca.OP_OR: "ONE_IF(~SAME({0}, K(0.0)) | ~SAME({1}, K(0.0)))",
    ca.OP_IF_ELSE_ZERO: "CHOOSE(~SAME({0}, K(0.0)), {1}, K(0.0))",
    ca.OP_SIGN: "sign({0})",
    ca.OP_EXP: "each_exp({0})",
    ca.OP_LOG: "each_log({0})",
    ca.OP_TAN: "each_tan({0})",
    ca.OP_ASIN: "each_asin({0})",
    ca.OP_ACOS: "each_acos({0})",
    ca.OP_ATAN: "each_atan({0})",
    ca.OP_SINH: "each_sinh({0})",
    ca.OP_COSH: "each_cosh({0})",
    ca.OP_TANH: "each_tanh({0})",
    ca.OP_FLOOR: "each_floor({0})",
    ca.OP_CEIL: "each_ceil({0})",
    ca.OP_POW: "each_pow({0}, {1})",
    ca.OP_CONSTPOW: "each_pow({0}, {1})",
    ca.OP_ATAN2: "each_atan2({0}, {1})",
    ca.OP_COPYSIGN: "each_copysign({0}, {1})",
}
"""CasADi's operations, by the functions of real.h."""

_TURNS = (ca.OP_SIN, ca.OP_COS)
"""Both are computed together, since most angles need both."""


def can_be_emitted(function: ca.Function) -> bool:
    """Whether all operations of a function are supported."""
    supported = {*_OPERATIONS, *_TURNS, ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}
    codes = (function.instruction_id(i) for i in range(function.n_instructions()))
    return supported.issuperset(codes)


def emitted(function: ca.Function, name: str, constants: list[float]) -> str:
    """A function as C that reads its constants, appended to a list, from `c`: code is shared."""
    if not can_be_emitted(function):
        raise ModelError(f"{function.name()} has an operation that lanes do not support")
    places: dict[int, str | float] = {}

    def used(place: int, inverse: bool = False) -> str:
        value = places[place]
        if isinstance(value, str):
            return value
        if inverse:
            value = 1.0 / value if value else copysign(inf, value)
        constants.append(value)
        return f"K(c[{len(constants) - 1}])"

    turned, inverted = set[str](), set[str]()
    often, roots = _divisors(function)
    lines, count = list[str](), 0
    for i in range(function.n_instructions()):
        code = function.instruction_id(i)
        operands, results = function.instruction_input(i), function.instruction_output(i)
        if code == ca.OP_OUTPUT:
            lines.append(f"r{results[0]}[{results[1]}] = {used(operands[0])};")
            continue
        if code == ca.OP_CONST:
            places[results[0]] = function.instruction_constant(i)
            continue
        value, count = f"v{count}", count + 1
        if code == ca.OP_INPUT:
            text = f"a{operands[0]}[{operands[1]}]"
        elif code in _TURNS:
            angle = used(operands[0])
            if angle not in turned:
                turned.add(angle)
                lines.append(f"real sin_{angle}, cos_{angle};")
                lines.append(f"far |= turn({angle}, &sin_{angle}, &cos_{angle});")
            places[results[0]] = f"{'sin' if code == ca.OP_SIN else 'cos'}_{angle}"
            continue
        elif i in roots:
            inverted.add(value)
            lines.append(f"real {value}, over_{value};")
            lines.append(f"root({used(operands[0])}, &{value}, &over_{value});")
            places[results[0]] = value
            continue
        elif code == ca.OP_DIV and isinstance(places[operands[1]], float):
            text = f"{used(operands[0])} * {used(operands[1], inverse=True)}"
        elif code == ca.OP_DIV and i in often:
            divided, by = used(operands[0]), used(operands[1])
            if by not in inverted:
                inverted.add(by)
                lines.append(f"const real over_{by} = K(1.0) / {by};")
            text = f"{divided} * over_{by}"
        else:
            text = _OPERATIONS[code].format(*map(used, operands))
        lines.append(f"const real {value} = {text};")
        places[results[0]] = value
    arguments = ["const double *c", *(f"const real *a{i}" for i in range(function.n_in()))]
    arguments += [f"real *r{i}" for i in range(function.n_out())]
    unused = " ".join(
        f"(void){each};" for each in ("c", *(f"a{i}" for i in range(function.n_in())))
    )
    body = "\n  ".join(["mask far = none();", unused, *lines, "return far;"])
    return f"static APART mask {name}({', '.join(arguments)}) {{\n  {body}\n}}\n"


def _divisors(function: ca.Function) -> tuple[set[int], set[int]]:
    """Divisions with a common divisor or by a root, which become products; and these roots."""
    places, divisions = dict[int, int](), dict[int, list[int]]()
    roots = set[int]()
    for i in range(function.n_instructions()):
        code, operands = function.instruction_id(i), function.instruction_input(i)
        if code == ca.OP_DIV:
            divisions.setdefault(places[operands[1]], []).append(i)
        if code == ca.OP_SQRT:
            roots.add(i)
        if code != ca.OP_OUTPUT:
            places[function.instruction_output(i)[0]] = i
    roots &= divisions.keys()
    often = {i for by, same in divisions.items() if len(same) > 1 or by in roots for i in same}
    return often, roots
