"""A block as computations, for the compiler."""

from collections.abc import Mapping

import casadi as ca
from pydrake.systems.framework import System

from drake_dae.blocks.block import TIME, Block, BlockFunction, stacked
from drake_dae.blocks.computations import (
    DERIVATIVE,
    HELD,
    PARAMETERS,
    STATE,
    Computation,
    Computations,
    Update,
)
from drake_dae.blocks.computations import TIME as TIME_SOURCE
from drake_dae.blocks.computations import Projection as Projected


def computations_of(system: System, block: Block) -> Computations:
    """The computations of a block: one for all outputs of the same sources."""
    held = stacked([each.symbol for each in block.held.values()])
    columns = {
        TIME_SOURCE: TIME,
        STATE: block.state,
        HELD: held,
        **block.inputs,
        PARAMETERS: block.parameters,
    }
    columns = {name: column for name, column in columns.items() if column.numel()}

    def computed(what: str, values: Mapping[str, ca.SX]) -> Computation:
        function = BlockFunction(block, what, values, columns=columns)
        return Computation.of(function, function.sources, tuple(values))

    grouped: dict[tuple[str, ...], dict[str, ca.SX]] = {}
    derivative = {DERIVATIVE: block.derivative} if block.state.numel() else {}
    for name, value in {**derivative, **block.outputs}.items():
        sources = tuple(n for n, column in columns.items() if ca.depends_on(value, column))
        grouped.setdefault(sources, {})[name] = value
    updates = []
    for rate, names in block.rates().items():
        after = [each.next if name in names else each.symbol for name, each in block.held.items()]
        updates.append(Update(computed("update", {HELD: stacked(after)}), *rate))
    initial = None
    if any(each.begin is not None for each in block.held.values()):
        start = [
            ca.SX(each.start) if each.begin is None else each.begin for each in block.held.values()
        ]
        initial = computed("start", {HELD: stacked(start)})
    projection = None
    if block.projection is not None:
        assert block.scale is not None
        projection = Projected(block.projection.newton, block.scale, block.projection.project)
    return Computations(
        system,
        tuple(computed(" and ".join(values), values) for values in grouped.values()),
        tuple(updates),
        initial=initial,
        projection=projection,
        scale=block.scale,
        unwired={name: computed(name, {name: value}) for name, value in block.defaults.items()},
        signals=block.signals,
        ports={name: tuple(s) for name, s in block.signals.items() if name in block.outputs},
    )
