"""References: desired values over time with all derivatives that a law needs."""

from drake_dae.references.by_name import ReferenceRows, references_by_name
from drake_dae.references.csv_file import CsvReference
from drake_dae.references.formulas import (
    ConstantReference,
    ExpressionReference,
    PointToPointReference,
    SinusoidReference,
)
from drake_dae.references.paths import CircleReference, LineReference, PathLimits
from drake_dae.references.reference import Reference, stack_references
from drake_dae.references.splines import PolylineReference, WaypointsReference

__all__ = [
    "CircleReference",
    "ConstantReference",
    "CsvReference",
    "ExpressionReference",
    "LineReference",
    "PathLimits",
    "PointToPointReference",
    "PolylineReference",
    "Reference",
    "ReferenceRows",
    "SinusoidReference",
    "WaypointsReference",
    "references_by_name",
    "stack_references",
]
