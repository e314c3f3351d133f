"""Systems from pydrake.symbolic: the same numbers as Drake's expressions, the same systems."""

import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS
from pydrake import symbolic as sym

from drake_dae import find_structure
from drake_dae.blocks.symbolic import from_symbolic, to_casadi
from drake_dae.errors import ModelError

# With arguments kept inside their domains: |sin e| <= 1.
ONE = [
    lambda a: sym.log(1.0 + a * a),
    lambda a: sym.exp(sym.sin(a)),
    lambda a: sym.sqrt(2.0 + a * a),
    sym.sin,
    sym.cos,
    lambda a: sym.tan(sym.sin(a)),
    lambda a: sym.asin(0.9 * sym.sin(a)),
    lambda a: sym.acos(0.9 * sym.sin(a)),
    sym.atan,
    lambda a: sym.sinh(sym.sin(a)),
    lambda a: sym.cosh(sym.sin(a)),
    sym.tanh,
    lambda a: a**3,
    lambda a: (2.0 + sym.sin(a)) ** -2,
    lambda a: 2.0 - a,
]
TWO = [
    lambda a, b: a + b,
    lambda a, b: a - 3.0 * b + 0.5,
    lambda a, b: a * b,
    lambda a, b: a / (2.0 + sym.cos(b)),
    lambda a, b: (2.0 + sym.sin(a)) ** sym.sin(b),
    lambda a, b: sym.atan2(a, 2.0 + sym.sin(b)),
]


def tree(random, leaves, depth):
    """A random expression."""
    if depth == 0:
        return leaves[random.integers(len(leaves))] * random.uniform(0.5, 1.5)
    inner = [tree(random, leaves, depth - 1) for _ in range(2)]
    if random.random() < 0.5:
        return ONE[random.integers(len(ONE))](inner[0])
    return TWO[random.integers(len(TWO))](*inner)


def kinds(expression, found):
    found.add(expression.get_kind())
    for part in expression.Unapply()[1]:
        if isinstance(part, sym.Expression):
            kinds(part, found)


def test_random_expressions_have_the_numbers_of_drake():
    """80 trees at 3 points: some 30 operations, each to round-off, in another order."""
    random = np.random.default_rng(0)
    variables = [sym.Variable(name) for name in "xyz"]
    symbols = {v.get_id(): ca.SX.sym(v.get_name()) for v in variables}
    found = set()
    for _ in range(80):
        expression = tree(random, variables, 5)
        kinds(expression, found)
        function = ca.Function("f", list(symbols.values()), [to_casadi(expression, symbols)])
        for point in random.uniform(-2.0, 2.0, (3, 3)):
            expected = expression.Evaluate(dict(zip(variables, point, strict=True)))
            assert float(function(*point)) == pytest.approx(expected, rel=1e-11, abs=1e-12)
    smooth = {
        kind for kind in vars(sym.ExpressionKind).values() if isinstance(kind, sym.ExpressionKind)
    }
    refused = ("Abs", "Min", "Max", "Ceil", "Floor", "IfThenElse", "UninterpretedFunction", "NaN")
    assert found == smooth - {getattr(sym.ExpressionKind, name) for name in refused}


def pendulum(**changes):
    """PROBLEMS["pendulum"] once more."""
    x, y, vx, vy = state = [sym.Variable(name) for name in ("x", "y", "vx", "vy")]
    mass, length, gravity = (sym.Variable(name) for name in ("mass", "length", "gravity"))
    fields = {
        "f": [vx, vy, 0.0, -gravity],
        "g": [0.0, 0.0, x / mass, y / mass],
        "h": np.array([[0.0], [0.0], [1.0 / mass], [0.0]]),
        "k": (x**2 + y**2 - length**2) / 2.0,
        "l": [x],
        "m": [[0.0]],
        "parameters": {mass: 2.0, length: 0.8, gravity: 9.81},
        "output_signals": ("x",),
        "nominal_state": [0.4, -0.6, 0.1, 0.1],
        "name": "pendulum",
    }
    fields |= {key: change(x, gravity) for key, change in changes.items()}
    return from_symbolic(state, **fields)


def test_the_same_system_as_from_casadi():
    made, problem = pendulum(), PROBLEMS["pendulum"]()
    structure = find_structure(made)
    assert structure.constraint_degrees == problem.constraint_degrees
    assert structure.output_degrees == problem.output_degrees
    assert [s.name for s in made.state_signals] == ["x", "y", "vx", "vy"]
    assert [p.name for p in made.parameters] == ["mass", "length", "gravity"]
    random = np.random.default_rng(0)
    for letter in "fghklm":
        values = [
            ca.Function(letter, [s.state, s.parameter_symbol], [ca.densify(getattr(s, letter))])
            for s in (made, problem.system)
        ]
        point = random.uniform(0.5, 2.0, 4), random.uniform(0.5, 2.0, 3)
        # The same operations up to their order.
        np.testing.assert_allclose(*(value(*point).full() for value in values), rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda a: sym.abs(a), r"\bk\b.*abs\(x\)"),
        (lambda a: 1.0 + sym.min(a, 1.0), r"\bmin\b"),
        (lambda a: sym.max(a, 1.0), r"\bmax\b"),
        (lambda a: sym.ceil(a), "ceil"),
        (lambda a: sym.sin(sym.floor(a)), "floor"),
        (lambda a: sym.if_then_else(a > 0, a, 1.0), "if_then_else"),
        (lambda a: sym.uninterpreted_function("w", [a]), r"\bw\(x\)"),
        (lambda a: a + sym.Variable("w"), r"\bk\b.*\bw\b"),
        (lambda a: sym.Variable("b", sym.Variable.Type.BOOLEAN), r"\bb\b"),
        (lambda a: "x", r"\bk\b.*\bx\b.*str"),
        (lambda a: np.nan, "pendulum: k, "),
        (lambda a: [a, a], "pendulum: g "),
    ],
)
def test_refusals_name_the_function_and_the_expression(make, message):
    with pytest.raises(ModelError, match=message):
        pendulum(k=lambda x, gravity: make(x))


def test_refused_variables():
    x = sym.Variable("x")
    with pytest.raises(ModelError, match=r"state.*Variable"):
        from_symbolic(x, f=[x], h=[1.0], l=[x])
    for states, parameters, message in (
        ([x, x], {}, r"\bx\b"),
        ([x], {x: 1.0}, r"\bx\b"),
        (["x"], {}, r"state\[0\].*'x'"),
        ([sym.Variable("n", sym.Variable.Type.INTEGER)], {}, "state"),
        ([x, sym.Variable("x")], {}, r"\bx\b"),
        ([x], {sym.Variable("c"): [1.0, 2.0]}, "parameters"),
    ):
        with pytest.raises(ModelError, match=message):
            from_symbolic(
                states, f=[0.0] * len(states), h=[1.0] * len(states), l=x, parameters=parameters
            )
