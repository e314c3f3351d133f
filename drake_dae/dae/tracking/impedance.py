"""Gains from the stiffness and damping that are felt at outputs."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, positive, unknown_name
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import DerivativeLayout, Indices
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.errors import GainError
from drake_dae.trace.factorization import nonzeros


@checked(GainError)
def impedance_gains(
    structure: Structure,
    stiffness: Mapping[str, float],
    damping_ratio: float = 1.0,
    rest: GainDesign | None = None,
) -> GainDesign:
    """Designs gains by which some outputs yield to forces as springs and dampers.

    The law (28) assigns the accelerations of the outputs, so an external force does not change with
    its gains but meets the inertia of the robot. Let z be the chosen outputs, with z' = P v, and f
    the forces that do the work f^T z' on them, so that they act on the links as P^T f. Then the
    errors obey

        e'' + K_2 e' + K_1 e = W f,    W = P (M^-1 - M^-1 G A^-1 J M^-1) P^T,

    with the mass matrix M, and G, J and A = J M^-1 G of the closed constraints. W^-1 is the
    apparent inertia at the outputs. It is not diagonal: with poles alone, a push along one output
    moves the others as well, on some robots far more than on others. With

        K_1 = W S,    K_2 = 2 d (W S)^(1/2),    S = diag(s_1, ..., s_k)

    it becomes the spring and damper W^-1 e'' + D e' + S e = f with a symmetric positive definite D.
    A steady force moves each output by f_i / s_i on any robot, and no other one. All modes have the
    damping ratio d: their frequencies are the roots of the eigenvalues of W S.

    W is evaluated at the state near which the structure was found, `structure.states[0]`, with the
    default parameters. The gains are constant, so that elsewhere the stiffness is W(x)^-1 W S.

    Args:
        structure: The structure of the law's system.
        stiffness: Output name -> s_i, positive: in N/m for an output in m, in N m/rad for one in
            rad, in N m for a component of an axis. These outputs have degree 2, as with rigid
            joints.
        damping_ratio: d, positive; 1 for the fastest motion that does not oscillate.
        rest: The gains of all other outputs, as by `poles`; None if there are none.

    Raises:
        GainError: An output does not exist, has another degree, or cannot be moved by forces of its
            own; a number is not positive; or other outputs have no gains.
    """
    names = [signal.name for signal in structure.system.output_signals]
    if not stiffness:
        raise GainError("stiffness: give one for at least one output, such as {tool.y: 200.0}")
    for name, value in stiffness.items():
        if name not in names:
            raise GainError(f"stiffness: {unknown_name('output', name, names)}")
        positive(f"stiffness of {name}", value, GainError)
        if (degree := structure.output_degrees[names.index(name)]) != 2:
            raise GainError(
                f"stiffness: '{name}' has degree {degree}; only an output of degree 2 yields as a "
                "spring, a position with rigid joints"
            )
    positive("damping_ratio", damping_ratio, GainError)
    chosen = np.array(sorted(map(names.index, stiffness)))
    mobility = _mobility(structure, chosen)
    # W S and its root by the symmetric matrix S^1/2 W S^1/2.
    roots = np.sqrt([stiffness[names[i]] for i in chosen])
    squares, modes = np.linalg.eigh(roots[:, None] * mobility * roots)
    if not squares[0] > structure.system.least_margin**2 * squares[-1]:
        raise GainError(
            f"stiffness: forces at {listed(names[i] for i in chosen)} do not move all of them; "
            "leave one out"
        )
    frequencies = (modes * np.sqrt(squares)) @ modes.T * roots / roots[:, None]
    blocks = frequencies @ frequencies, 2.0 * damping_ratio * frequencies

    def design(names: Sequence[str], degrees: Sequence[int]) -> FeedbackGains:
        starts = DerivativeLayout(tuple(degrees)).starts
        for i in chosen:
            if degrees[i] != 2:
                raise GainError(
                    f"stiffness: the error of '{names[i]}' is integrated, and the integral would "
                    "cancel each force that the spring shall yield to; take it out of `integral`"
                )
        others = np.setdiff1d(np.arange(len(names)), chosen)
        matrix = np.zeros((len(names), sum(degrees)))
        for order, block in enumerate(blocks):
            matrix[np.ix_(chosen, starts[chosen] + order)] = block
        if any(degrees[i] for i in others):
            if rest is None:
                needed = listed(names[i] for i in others if degrees[i])
                raise GainError(f"the other outputs need gains, such as poles: {needed}")
            own = rest([names[i] for i in others], [degrees[i] for i in others])
            columns = np.concatenate([starts[i] + np.arange(degrees[i]) for i in others])
            matrix[np.ix_(others, columns.astype(int))] = own.matrix
        return FeedbackGains(tuple(names), tuple(degrees), matrix)

    return design


def _mobility(structure: Structure, outputs: Indices) -> FloatArray:
    """W of `impedance_gains` for some outputs of degree 2, shape (k, k)."""
    system, residual = structure.system, structure.manifold
    moving = _moving(system)
    rows, columns = moving.tolist(), system.state[moving.tolist()]
    rates = ca.vertcat(*(structure.output_chains[i][1] for i in outputs))
    ends = DerivativeLayout(structure.constraint_degrees).ends
    constraints = residual.residual_expression[ends.tolist(), :]
    function = system.trace(
        "mobility of outputs",
        {
            "mass": ca.densify(system.mass_matrix[rows, rows]),
            "outputs": ca.densify(ca.jacobian(rates, columns)),
            "constraints": ca.densify(ca.jacobian(constraints, columns)),
            "forces": ca.densify(system.frictional_contacts.without_friction(system.g)[rows, :]),
        },
        often=False,
    )
    values = function(structure.states[0], system.parameter_values)
    sizes = [(moving.size, moving.size), (outputs.size, moving.size)]
    sizes += [(system.num_constraints, moving.size), (moving.size, system.num_constraints)]
    mass, P, J, G = (value.reshape(size) for value, size in zip(values, sizes, strict=True))
    moved = np.linalg.solve(mass, np.hstack([P.T, G]))
    by_outputs, by_forces = moved[:, : outputs.size], moved[:, outputs.size :]
    held = by_forces @ np.linalg.solve(J @ by_forces, J @ by_outputs)
    mobility: FloatArray = P @ (by_outputs - held)
    return 0.5 * (mobility + mobility.T)


def _moving(system: DaeSystem) -> Indices:
    """The states on whose rates controls or constraint forces act, also by way of inertia."""
    acts = nonzeros(ca.horzcat(system.g, system.h).sparsity()).any(axis=1)
    mass = nonzeros(system.mass_matrix.sparsity())
    while True:
        both = acts | mass[:, acts].any(axis=1)
        if np.array_equal(both, acts):
            return np.flatnonzero(acts)
        acts = both
