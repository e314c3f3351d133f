"""Each equation (1)-(83) of the paper has its line, or a reason why not, and its test."""

from equations import LAST, WITHOUT_LINE, lines, proofs, table

ALL = set(range(1, LAST + 1))


def test_each_equation_has_a_line_or_a_reason():
    places = set(lines())
    assert places | set(WITHOUT_LINE) == ALL
    assert not places & set(WITHOUT_LINE)


def test_each_equation_has_a_test():
    assert set(proofs()) == ALL


def test_the_table_has_a_row_for_each():
    assert table().count("\n") == LAST + 1
