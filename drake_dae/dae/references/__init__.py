"""What a system shall follow: values of time with all the derivatives that a law asks for."""

from drake_dae.dae.references.by_name import ReferenceRows, references_by_name
from drake_dae.dae.references.formulas import (
    ConstantReference,
    ExpressionReference,
    PointToPointReference,
    SinusoidReference,
)
from drake_dae.dae.references.reference import Reference, stack_references

__all__ = [
    "ConstantReference",
    "ExpressionReference",
    "PointToPointReference",
    "Reference",
    "ReferenceRows",
    "SinusoidReference",
    "references_by_name",
    "stack_references",
]
