"""Each code of an error is that of its example, raised here, and of no other entry's."""

import shlex

import numpy as np
import pytest

import drake_dae
from drake_dae import errors
from drake_dae.cli import main
from drake_dae.errors import DrakeDaeError
from drake_dae.scenario.manual.remedies import code_of, remedies, remedies_page


@pytest.mark.slow
@pytest.mark.parametrize("code", remedies())
def test_example_of_a_code_ends_with_it(code, tmp_path, monkeypatch, capsys):
    remedy = remedies()[code]
    monkeypatch.chdir(tmp_path)
    for name, value in remedy.environment.items():
        monkeypatch.setenv(name, value)
    for name, text in remedy.files.items():
        (tmp_path / name).write_text(text, "utf-8")
    if remedy.python:
        with pytest.raises(DrakeDaeError) as raised:
            exec(remedy.python, {"dd": drake_dae, "np": np})
        assert code_of(str(raised.value), raised.type) == code, raised.value
        return
    assert main(shlex.split(remedy.command)) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert lines
    assert all(line.endswith(f" [{code}]") for line in lines), lines


def test_every_exception_has_a_code():
    for name in dir(errors):
        kind = getattr(errors, name)
        if isinstance(kind, type) and issubclass(kind, DrakeDaeError) and kind is not DrakeDaeError:
            assert code_of("", kind), name
    assert code_of("", ZeroDivisionError) == ""


def test_code_of_a_class_is_given_where_no_words_fit():
    assert code_of("something else", errors.ModelError) == "E20"
    assert code_of("something else", errors.PainleveError) != code_of("", errors.SimulationError)


def test_explain_prints_an_entry_all_titles_or_which_codes_there_are(capsys):
    assert main(["explain", "e12"]) == 0
    assert "## E12: A key that does not exist" in capsys.readouterr().out
    assert main(["explain"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == list(remedies())
    assert main(["explain", "E999"]) == 1
    assert "no code 'E999'" in capsys.readouterr().err


def test_page_has_an_entry_for_each_code():
    page = remedies_page()
    for code, remedy in remedies().items():
        assert f"## {code}: {remedy.title}\n" in page
        assert bool(remedy.words) != bool(remedy.kind)
