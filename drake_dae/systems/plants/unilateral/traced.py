"""The computations of a plant with opening contacts, as traced functions of its mode."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import casadi as ca
import numpy as np

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
from drake_dae.systems.plants.pegs.opening import may_close
from drake_dae.systems.plants.robot_ports import RobotPorts
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts
from drake_dae.systems.plants.unilateral.log import MARGIN
from drake_dae.systems.plants.unilateral.modes import Closed, Mode, Modes, closed_of
from drake_dae.trace.functions import TracedFunction

MOST = 8
"""The largest number of modes, as of three contacts: each function contains all of them."""

BESIDE = 1e-3
"""The part of their usual spread by which states are off the nominal one, at which modes of pegs
are examined."""


class TracedContacts:
    """The functions of a plant, each with all of its modes.

    Args:
        contacts: The contacts.
        modes: Their modes.
        residual: The function of the constraint residual.
        latch_sets: The latches that are closed together, one flag for each.

    Raises:
        ModelError: There are too many contacts.
    """

    def __init__(
        self,
        contacts: UnilateralContacts,
        modes: Modes,
        residual: TracedFunction,
        latch_sets: Sequence[Closed],
    ) -> None:
        count = len(contacts.every)
        touching = product((False, True), repeat=len(contacts.names))
        fitting = [closed for closed in touching if may_close(contacts.openings, closed)]
        every = [(*closed, *latched) for closed, latched in product(fitting, latch_sets)]
        if len(every) > MOST:
            raise not_traced(f"a plant with {len(every)} modes of its contacts, more than {MOST},")
        dae = self._dae = contacts.dae
        self._contacts, self._modes, self._residual = contacts, modes, residual
        self._state = ca.SX.sym("state", dae.num_states)
        self._held = ca.SX.sym("mode", count + contacts.edges.size)
        self._numbers, self._on = ca.vertsplit(self._held, [0, count, self._held.numel()])
        self._control = ca.SX.sym("control", dae.num_controls)
        size = dae.parameter_symbol.numel()
        # The coefficients of restitution come last; no motion depends on them.
        self._all = ca.SX.sym("parameters", size + len(contacts.shown))
        self._parameters = self._all[:size]
        self._all_modes = [(closed, self._mode(closed)) for closed in every]

    def _mode(self, closed: Closed) -> Mode | None:
        """A mode; None if its contacts cannot be closed together."""
        dae, state = self._dae, self._dae.nominal_state
        if dae is not self._contacts.of_model:
            # A peg at the very axis of its hole has no direction to its side.
            random = np.random.default_rng(0).standard_normal(state.size)
            state = state + BESIDE * dae.usual_spread(state) * random
        try:
            return self._modes(closed, state)
        except (AssumptionError, ModelError):
            return None

    def _chosen(
        self, values: Callable[[Mode], Sequence[ca.SX]], none: Sequence[ca.SX]
    ) -> list[ca.SX]:
        """The columns of a function of the mode in the current mode.

        Args:
            values: The columns in a mode.
            none: The columns in a mode that is not possible.
        """
        columns = [ca.SX.zeros(value.numel()) for value in none]
        for closed, mode in self._all_modes:
            is_current = ca.SX(1)
            for i, shut in enumerate(closed):
                is_shut = self._held[i] > 0.5
                is_current = ca.logic_and(is_current, is_shut if shut else ca.logic_not(is_shut))
            in_mode = none if mode is None else values(mode)
            columns = [
                column + ca.if_else(is_current, ca.densify(value), 0)
                for column, value in zip(columns, in_mode, strict=True)
            ]
        return columns

    def _function(self, attribute: str, size: int, by_control: bool) -> TracedFunction:
        """A function of a `Mode` by its attribute, for all modes."""

        def values(mode: Mode) -> list[ca.SX]:
            function = getattr(mode, attribute)
            control = [self._control] if "control" in function.input_names else []
            value, pivot, *_ = function.function.call([self._state, *control, self._parameters])
            return [value, pivot]

        value, pivot = self._chosen(values, [ca.SX.nan(size, 1), ca.SX(1)])
        control = {"control": self._control} if by_control else {}
        return TracedFunction(
            f"{self._dae.name} {attribute}",
            {"state": self._state, "mode": self._held, **control, "parameters": self._all},
            {attribute: value},
            pivot,
            "A(x) of Assumption (2)",
            compiled=self._dae.compiled,
        )

    def computations(self, ports: RobotPorts) -> tuple[Computation, ...]:
        """All outputs, and the derivative of the state.

        Args:
            ports: The ports of the plant's robot.
        """
        dae, contacts = self._dae, self._contacts
        by_state, by_control = (STATE, HELD, PARAMETERS), (STATE, HELD, "control", PARAMETERS)
        motion = self._function("dynamics", dae.num_states, True)
        computations = [Computation.of(motion, by_control, (DERIVATIVE,))]
        modes = [mode for _, mode in self._all_modes if mode is not None]
        for name, size, port in (
            ("force", dae.num_constraints, "acting_force"),
            ("grip", dae.num_constraints, "grip"),
            ("output", dae.num_outputs, "controlled_output"),
        ):
            needs = any("control" in getattr(mode, name).input_names for mode in modes)
            function = self._function(name, size, needs)
            computations.append(
                Computation.of(function, by_control if needs else by_state, (port,))
            )
        acting = ca.SX.sym("force", dae.num_constraints)
        pushing = ca.SX(acting)
        pushing[contacts.normals] = ca.fmax(pushing[contacts.normals], 0)
        x, mode, inputs = self._state, self._held, (self._state, self._parameters)
        m, own = contacts.of_model.num_constraints, len(contacts.shown)
        pushed = ca.Function("pushing", [acting], _apart(pushing, m))
        forces = ("constraint_force", "hole_force")
        computations.append(Computation(pushed, ("acting_force",), forces))
        closed = _apart(ca.fmax(self._numbers, 0), own + len(contacts.latches))
        same = ca.Function(
            "shown", [x, mode], [x, *closed, *(x[part] for part in ports.parts.values())]
        )
        shown_state = ("state", "mode", "hole_mode", *ports.parts)
        computations.append(Computation(same, (STATE, HELD), shown_state))
        holds = {row: ca.fmax(mode[i], 0) for i, own in enumerate(contacts.rows()) for row in own}
        rows = [
            ca.repmat(ca.SX(holds.get(row, 1)), size, 1) for row, size in enumerate(contacts.sizes)
        ]
        residual = ca.vertcat(*rows) * self._residual.function.call(inputs)[0]
        gaps = _apart(contacts.gaps.function.call(inputs)[0], own)
        shown = ca.Function("shown", [x, mode, self._all], [residual, *gaps])
        outputs = ("constraint_residual", "gap", "hole_gap")
        computations.append(Computation(shown, by_state, outputs))
        wrenches = ca.Function(
            "wrenches",
            [x, acting, self._all],
            ports.wrench_function.function.call([x, acting[:m], self._parameters])[:1],
        )
        by_force = (STATE, "acting_force", PARAMETERS)
        computations.append(Computation(wrenches, by_force, ("constraint_wrenches",)))
        for name, of_joints in ports.joints.items():
            part = ca.Function("part", [x, self._all], of_joints.function.call(inputs)[:1])
            computations.append(Computation(part, (STATE, PARAMETERS), (name,)))
        return tuple(computations)

    def guard(self) -> Computation:
        """The margins of the plant: of contacts and their edges, and commands of latches."""
        grip, contacts = ca.SX.sym("grip", self._dae.num_constraints), self._contacts
        gaps, rates = contacts.gaps.function.call([self._state, self._parameters])[:2]
        clear = ca.if_else(gaps < -TOUCHING, gaps, ca.fmax(gaps, rates + MARGIN))
        is_closed, latched = ca.vertsplit(
            self._numbers > 0.5, [0, len(contacts.names), self._numbers.numel()]
        )
        beside = self._numbers[: len(contacts.names)] < -0.5
        clear = ca.if_else(beside, 1, clear)
        margins = ca.if_else(is_closed, grip[contacts.normals], clear)
        inputs, sources = (
            [self._state, self._held, grip, self._all],
            [STATE, HELD, "grip", PARAMETERS],
        )
        if contacts.latches:
            latch = ca.SX.sym("latch", len(contacts.latches))
            inputs, sources = [*inputs, latch], [*sources, "latch"]
            margins = ca.vertcat(margins, ca.if_else((latch > 0.5) == latched, 1, -1))
        away, speeds = contacts.edges.function.function.call([self._state, self._parameters])[:2]
        is_on = self._on > 0.5
        until = ca.if_else(is_on, away, TOUCHING - away)
        margins = ca.vertcat(margins, contacts.edges.traced_margins(beside, self._on, until, gaps))
        # The gap of a closed contact does not fall, and that of one that has just opened neither.
        is_still = ca.vertcat(ca.logic_or(is_closed, beside), ca.SX.zeros(until.numel()))
        rates = ca.vertcat(rates, ca.if_else(is_on, speeds, -speeds))
        falls = ca.if_else(ca.logic_or(is_still, ca.fabs(rates) < MARGIN), 0, rates)
        values = [ca.densify(value) for value in (margins, ca.vertcat(gaps, until), falls)]
        function = ca.Function("guard", inputs, values)
        return Computation(function, tuple(sources), (MARGINS, GAPS, RATES))

    def projection(self) -> Projection:
        """The projection of the state onto the manifold of its mode."""
        start = ca.SX.sym("start", self._dae.num_states)

        def values(mode: Mode) -> list[ca.SX]:
            function = mode.structure.manifold.newton_step.function
            (step, *_) = function.call([self._state, start, self._parameters])
            return [step * ca.DM(mode.structure.system.scale / self._dae.scale)]

        steps = self._chosen(values, [ca.SX.nan(self._dae.num_states, 1)])
        newton = ca.Function("newton", [self._state, start, self._all, self._held], steps)
        return Projection(newton, self._dae.scale, partial(_project, self._modes, self._contacts))


def _apart(values: ca.SX, count: int) -> list[ca.SX]:
    """The values of the contacts of the model, as many, and those of pegs in holes."""
    parts: list[ca.SX] = ca.vertsplit(ca.densify(values), [0, count, values.numel()])
    return parts


def _project(
    modes: Modes,
    contacts: UnilateralContacts,
    state: FloatArray,
    parameters: FloatArray,
    held: FloatArray,
) -> FloatArray:
    of_system = parameters[: parameters.size - len(contacts.shown)]
    closed = closed_of(held[: len(contacts.every)])
    return modes(closed, state).structure.manifold.project(state, of_system)
