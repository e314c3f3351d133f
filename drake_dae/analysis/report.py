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
    """What the theory says about one system; made by `analyze`, printed by `print`."""

    def __repr__(self) -> str:
        problems = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Analysis('{self.system.name}': {problems})"

    def __str__(self) -> str:
        return to_text([*self.parts(), *([problem] for problem in self.problems)])

    def to_markdown(self) -> str:
        """The report with Markdown tables."""
        return to_markdown([*self.parts(), *([problem] for problem in self.problems)])

    def _repr_markdown_(self) -> str:
        """The display in notebooks."""
        return self.to_markdown()

    def to_dict(self) -> dict[str, Any]:
        """The report as plain numbers, lists and texts, with the states of the margins."""
        return as_dict(self)

    def parts(self) -> list[Part]:
        """The report's paragraphs and tables, without the problems."""
        return parts_of(self)
