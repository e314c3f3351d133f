"""The printable results of the analysis of a system."""

from dataclasses import dataclass
from typing import Any

from drake_dae.analysis.findings import Findings
from drake_dae.analysis.presentation import as_dict, parts_of
from drake_dae.analysis.tables import Part, count_of, to_markdown, to_text
from drake_dae.arguments import checked
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Analysis(Findings):
    """The report of `analyze` on one system; `print` shows it as text."""

    def __repr__(self) -> str:
        problems = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Analysis('{self.system.name}': {problems})"

    def __str__(self) -> str:
        return to_text([*self.parts(), *([problem] for problem in self.problems)])

    def to_markdown(self) -> str:
        """Returns the report with Markdown tables."""
        return to_markdown([*self.parts(), *([problem] for problem in self.problems)])

    def _repr_markdown_(self) -> str:
        """Returns the text that notebooks display."""
        return self.to_markdown()

    def to_dict(self) -> dict[str, Any]:
        """Returns the report as plain numbers, lists and texts."""
        return as_dict(self)

    def parts(self) -> list[Part]:
        """Returns the paragraphs and tables of the report, without the problems."""
        return parts_of(self)
