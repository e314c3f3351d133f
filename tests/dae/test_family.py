"""Relative degrees belong to all numbers that a system may have, not to its defaults alone."""

import pytest
from runs import some

from drake_dae import analyze
from drake_dae.analysis import Finding
from drake_dae.dae import DaeSystem, ViolationKind, find_constraint_structure, find_structure
from drake_dae.errors import AssumptionError


def integrators(count, output, parameters, **more):
    """x_0' = x_1, ..., x_(n-1)' = u."""
    return DaeSystem.from_functions(
        count,
        f=lambda x, p: [*[x[i + 1] for i in range(count - 1)], 0],
        h=lambda x, p: [*[0] * (count - 1), 1],
        l=output,
        parameters=parameters,
        **more,
    )


def chain_that_moves(exogenous, drift=0, **more):
    """0 = s_0 with s_0' = s_1 + w a, s_1' = s_2 - w b, and a' = b.

    Then s_0'' = s_2 + w' a, and its derivative is c + w'' a + w' b with c = s_2'. In b' = -a + v
    and c' = d + drift v and d' = -s_1 + v the input acts on the fourth derivative by drift, and by
    w' in any case: without drift the degree is 5 at rest.
    """
    return DaeSystem.from_functions(
        ["s0", "s1", "s2", "a", "b", "c", "d"],
        f=lambda x, p: [x[1] + p.w * x[3], x[2] - p.w * x[4], x[5], x[4], -x[3], x[6], -x[1]],
        g=lambda x, p: [0, 0, 0, 0, 1, drift, 1],
        k=lambda x, p: x[0],
        parameters={"w": 0.0},
        exogenous=exogenous,
        **more,
    )


def test_parameters_and_their_derivatives_have_the_names_of_their_symbols():
    system = chain_that_moves(["w"])
    names = [signal.name for signal in system.parameter_signals]
    assert names == [str(symbol) for symbol in system.parameter_symbol.elements()]
    assert names[:3] == ["w", "w'", "w''"]


def coupled(gain):
    """Two inputs that an output each has, coupled by numbers."""
    return DaeSystem.from_functions(
        2,
        f=lambda x, p: [-x[0], -x[1]],
        h=lambda x, p: gain(p),
        l=lambda x, p: [x[0], x[1]],
        parameters={"a": 1.0, "b": 1.0},
    )


OUTPUTS = {
    "sum": (lambda x, p: x[0] + p.w * x[1], {"w": 0.0}, 2, ("w",)),
    "one of a vector": (lambda x, p: x[0] + p.w[1] * x[1], {"w": [1.0, 0.0]}, 2, ("w[1]",)),
    "difference": (lambda x, p: x[0] + (p.a - p.b) * x[2], {"a": 2.0, "b": 2.0}, 1, ("a", "b")),
    "both": (lambda x, p: x[0] + p.a * p.b * x[2], {"a": 0.0, "b": 0.0, "c": 3.0}, 1, ("a", "b")),
}
"""Outputs of three integrators, parameters, the degree elsewhere, and what decides. At the defaults
the degree is 3."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(OUTPUTS))
@pytest.mark.parametrize("moves", [False, True])
def test_an_output_whose_degree_depends_on_numbers_is_refused(name, moves):
    output, parameters, degree, deciding = OUTPUTS[name]
    signal = [deciding[0].removesuffix("[1]")] if moves else []
    system = integrators(3, output, parameters, exogenous=signal)
    with pytest.raises(AssumptionError) as caught:
        find_structure(system)
    violation = caught.value.violation
    assert (violation.assumption, violation.cause) == (4, ViolationKind.NUMBERS)
    assert violation.order == degree
    assert violation.deciding.names == deciding
    # `analyze` reports it instead of raising it.
    found = analyze(system).assumptions[3]
    assert found.finding is Finding.VIOLATED
    assert found.violation.deciding.names == deciding


def test_a_constraint_whose_degree_depends_on_the_rate_of_a_signal():
    """A derivative of it holds w' v, so that r is one less while w moves."""
    moves = chain_that_moves(["w"])
    with pytest.raises(AssumptionError) as caught:
        find_constraint_structure(moves)
    violation = caught.value.violation
    assert (violation.assumption, violation.cause, violation.order) == (1, ViolationKind.NUMBERS, 4)
    assert violation.deciding.names == ("w'",)
    assert violation.names == ("y0",)
    for still in (chain_that_moves([]), moves.with_bounds({"w": (0.0, 0.0)})):
        assert find_constraint_structure(still).constraint_degrees == (5,)
    # Where v acts on the fourth derivative anyway, w may move.
    assert find_constraint_structure(chain_that_moves(["w"], drift=1)).constraint_degrees == (4,)


def test_a_rank_of_b_that_depends_on_numbers():
    with pytest.raises(AssumptionError, match="'a'") as caught:
        find_structure(coupled(lambda p: [[1, p.a], [p.b, 1]]))
    assert caught.value.assumption == 5
    assert set(caught.value.violation.deciding.names) == {"a", "b"}
    # det = 1 - a b / 2 is lost at a = 2.
    regular = coupled(lambda p: [[1, 0.5 * p.a], [p.b, 1]])
    assert find_structure(regular).output_degrees == (1, 1)
    found = analyze(regular.with_bounds({"a": (0.1, 3.0)})).assumptions[4]
    assert found.finding is Finding.VIOLATED
    assert found.violation.cause is ViolationKind.BOUNDS


@pytest.mark.parametrize(
    ("entry", "ranges", "names"),
    [
        (lambda p: (p.a - 1.5) ** 2 + (p.b - 1.6) ** 2, {"a": (0, 2), "b": (0, 2)}, {"a", "b"}),
        (lambda p: (p.a - 2) ** 2, {"a": (0.1, 3.5)}, {"a"}),  # Without a change of sign.
        (lambda p: (p.a - 1.7) * (p.a - 1.9), {"a": (0.1, 3.0)}, {"a"}),
        (lambda p: 3.5 - p.a - p.b, {"a": (0.1, 2.0), "b": (0.1, 2.0)}, {"a", "b"}),  # At a corner.
    ],
)
def test_a_rank_that_is_lost_inside_a_box_of_parameters(entry, ranges, names):
    regular = coupled(lambda p: [[entry(p), 0], [0, 1]])
    assert find_structure(regular).output_degrees == (1, 1)
    with pytest.raises(AssumptionError) as caught:
        find_structure(regular.with_bounds(ranges))
    assert caught.value.violation.cause is ViolationKind.BOUNDS
    assert set(caught.value.violation.deciding.names) == names
    narrow = {name: (low, 1.2) for name, (low, _) in ranges.items()}
    assert find_structure(regular.with_bounds(narrow)).output_degrees == (1, 1)


def test_a_rank_of_a_within_bounds():
    """A = 1 + w: lost at w = -1, which bounds may hold."""
    system = DaeSystem.from_functions(
        2,
        f=lambda x, p: [x[1], 0],
        g=lambda x, p: [0, 1 + p.w],
        k=lambda x, p: x[0],
        parameters={"w": 0.0},
    )
    narrow = system.with_bounds({"w": (-0.9, 5)})
    assert find_constraint_structure(narrow).constraint_degrees == (2,)
    for low in (-1.0, -2.0):
        with pytest.raises(AssumptionError, match="'w'"):
            find_constraint_structure(system.with_bounds({"w": (low, 5.0)}))
