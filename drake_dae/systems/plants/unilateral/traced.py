"""What a plant computes whose contacts open and close, as traced functions of its mode."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.systems.blocks.dips import TOUCHING
from drake_dae.systems.blocks.traced import (
    DERIVATIVE,
    GAPS,
    HELD,
    MARGINS,
    PARAMETERS,
    RATES,
    STATE,
    Computation,
    Projection,
    not_traced,
)
from drake_dae.systems.plants.robot_ports import RobotPorts
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts
from drake_dae.systems.plants.unilateral.log import MARGIN
from drake_dae.systems.plants.unilateral.modes import Closed, Mode, Modes, closed_of
from drake_dae.trace.functions import TracedFunction

MOST = 3
"""So many contacts have eight modes, all of which are in each function."""


class TracedContacts:
    """The functions of a plant, each with all modes in it.

    Args:
        contacts: The contacts.
        modes: Their modes.
        residual: The function of the constraint residual.

    Raises:
        ModelError: There are too many contacts.
    """

    def __init__(
        self, contacts: UnilateralContacts, modes: Modes, residual: TracedFunction
    ) -> None:
        count = len(contacts.names)
        if count > MOST:
            raise not_traced(f"a plant with more than {MOST} contacts that open and close")
        dae = self._dae = contacts.dae
        self._contacts, self._modes, self._residual = contacts, modes, residual
        self._state, self._held = ca.SX.sym("state", dae.num_states), ca.SX.sym("mode", count)
        self._control = ca.SX.sym("control", dae.num_controls)
        size = dae.parameter_symbol.numel()
        # The coefficients of restitution come last; no motion needs them.
        self._all = ca.SX.sym("parameters", size + count)
        self._parameters = self._all[:size]
        self._each = [
            (closed, self._mode(closed)) for closed in product((False, True), repeat=count)
        ]

    def _mode(self, closed: Closed) -> Mode | None:
        """A mode; None if its contacts cannot be closed together."""
        try:
            return self._modes(closed, self._dae.nominal_state)
        except (AssumptionError, ModelError):
            return None

    def _chosen(
        self, values: Callable[[Mode], Sequence[ca.SX]], none: Sequence[ca.SX]
    ) -> list[ca.SX]:
        """What a function of the mode gives in that which holds, column by column."""
        found = [ca.SX.zeros(value.numel()) for value in none]
        for closed, mode in self._each:
            shut = [self._held[i] > 0.5 for i in range(len(closed))]
            holds = ca.SX(1)
            for own, wanted in zip(shut, closed, strict=True):
                holds = ca.logic_and(holds, own if wanted else ca.logic_not(own))
            given = none if mode is None else values(mode)
            found = [
                old + ca.if_else(holds, ca.densify(value), 0)
                for old, value in zip(found, given, strict=True)
            ]
        return found

    def _function(
        self, name: str, parts: Sequence[str], sizes: Sequence[int], by_control: bool
    ) -> TracedFunction:
        """Some functions of all modes, as one."""

        def values(mode: Mode) -> list[ca.SX]:
            found, pivot = [], ca.SX(1)
            for part in parts:
                function = getattr(mode, part)
                given = [self._state, self._parameters]
                if len(function.input_names) == 3:
                    given.insert(1, self._control)
                value, pivot, *_ = function.function.call(given)
                found.append(value)
            return [*found, pivot]

        none = [*(ca.SX.nan(size, 1) for size in sizes), ca.SX(1)]
        *found, pivot = self._chosen(values, none)
        inputs = {"state": self._state, "mode": self._held, "control": self._control}
        if not by_control:
            del inputs["control"]
        return TracedFunction(
            f"{self._dae.name} {name}",
            {**inputs, "parameters": self._all},
            dict(zip(parts, found, strict=True)),
            pivot,
            "A(x) of Assumption (2)",
            compiled=self._dae.compiled,
        )

    @property
    def _known(self) -> list[Mode]:
        return [mode for _, mode in self._each if mode is not None]

    def computations(self, ports: RobotPorts) -> tuple[Computation, ...]:
        """All outputs, and the derivative of the state.

        Args:
            ports: What the plant shows of its robot.
        """
        dae, contacts = self._dae, self._contacts
        by_state, by_control = (STATE, HELD, PARAMETERS), (STATE, HELD, "control", PARAMETERS)
        motion = self._function("motion", ["dynamics"], [dae.num_states], True)
        found = [Computation.of(motion, by_control, (DERIVATIVE,))]
        force_needs, output_needs = (
            any(getattr(mode, f"{name}_needs_control") for mode in self._known)
            for name in ("force", "output")
        )
        for name, needs, size, port in (
            ("force", force_needs, dae.num_constraints, "acting_force"),
            ("output", output_needs, dae.num_outputs, "controlled_output"),
        ):
            function = self._function(name, [name], [size], needs)
            found.append(Computation.of(function, by_control if needs else by_state, (port,)))
        acting = ca.SX.sym("force", dae.num_constraints)
        pushing = ca.SX(acting)
        pushing[contacts.normals] = ca.fmax(pushing[contacts.normals], 0)
        pushed = ca.Function("pushing", [acting], [pushing])
        found.append(Computation(pushed, ("acting_force",), ("constraint_force",)))
        x, mode, given = self._state, self._held, (self._state, self._parameters)
        same = ca.Function(
            "shown", [x, mode], [x, mode, *(x[part] for part in ports.parts.values())]
        )
        found.append(Computation(same, (STATE, HELD), ("state", "mode", *ports.parts)))
        holds = {row: mode[i] for i, one in enumerate(contacts.touches) for row in one.rows}
        rows = [
            ca.repmat(ca.SX(holds.get(row, 1)), size, 1) for row, size in enumerate(contacts.sizes)
        ]
        residual = ca.vertcat(*rows) * self._residual.function.call(given)[0]
        gap = contacts.gaps.function.call(given)[0]
        shown = ca.Function("shown", [x, mode, self._all], [residual, gap])
        found.append(Computation(shown, by_state, ("constraint_residual", "gap")))
        wrenches = ca.Function(
            "wrenches",
            [x, acting, self._all],
            ports.wrench_function.function.call([x, acting, self._parameters])[:1],
        )
        sources = (STATE, "acting_force", PARAMETERS)
        found.append(Computation(wrenches, sources, ("constraint_wrenches",)))
        for name, known in (("loop_state", ports.loops), ("joint_torque", ports.joint_force)):
            if known is not None:
                values = known.function.call(given)[:1]
                function = ca.Function("part", [x, self._all], values)
                found.append(Computation(function, (STATE, PARAMETERS), (name,)))
        return tuple(found)

    def guard(self) -> Computation:
        """The margins of contacts, as those of the plant: force if closed, clearance if open."""
        acting = ca.SX.sym("force", self._dae.num_constraints)
        given = (self._state, self._parameters)
        gaps, rates = self._contacts.gaps.function.call(given)[:2]
        clear = ca.if_else(gaps < -TOUCHING, gaps, ca.fmax(gaps, rates + MARGIN))
        is_closed = self._held > 0.5
        margins = ca.if_else(is_closed, acting[self._contacts.normals], clear)
        # A contact that is closed does not fall.
        own = [ca.densify(value) for value in (margins, gaps, ca.if_else(is_closed, 0, rates))]
        function = ca.Function("guard", [self._state, self._held, acting, self._all], own)
        return Computation(
            function, (STATE, HELD, "acting_force", PARAMETERS), (MARGINS, GAPS, RATES)
        )

    def projection(self) -> Projection:
        """How the state stays on the manifold of its mode."""
        start = ca.SX.sym("start", self._dae.num_states)

        def values(mode: Mode) -> list[ca.SX]:
            own = mode.structure.manifold.newton_step.function
            (step, *_) = own.call([self._state, start, self._parameters])
            return [step * ca.DM(mode.structure.system.scale / self._dae.scale)]

        found = self._chosen(values, [ca.SX.nan(self._dae.num_states, 1)])
        newton = ca.Function("newton", [self._state, start, self._all, self._held], found)
        return Projection(newton, self._dae.scale, partial(_project, self._modes))


def _project(
    modes: Modes, state: FloatArray, parameters: FloatArray, held: FloatArray
) -> FloatArray:
    own = parameters[: parameters.size - held.size]
    return modes(closed_of(held), state).structure.manifold.project(state, own)
