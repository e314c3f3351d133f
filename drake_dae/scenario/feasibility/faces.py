"""How near a face of several points is to tipping, before its task runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, sin
from typing import Protocol

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.feasibility.touches import angle_between, normals_at, plant_values
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.records.record import Record
from drake_dae.systems.task.controller import TaskController

_SMALL = 1e-6
"""A tilt in rad, or a difference of friction, that does not count."""

_STATES = 30
"""The number of states of a phase at which a tipping force is computed."""


@dataclass(frozen=True)
class FaceNeeds:
    """How near a face is to tipping in a phase.

    Attributes:
        eccentricity: Its largest eccentricity in the law's model; see `PhaseGuard`.
        tips: The smallest force along the face, in N, that would tip it if the law does not know
            it, as of friction.
    """

    eccentricity: float
    tips: float


class PhaseWithFace(Protocol):
    """A phase with its largest force in N."""

    @property
    def name(self) -> str: ...

    @property
    def force(self) -> float: ...

    @property
    def face(self) -> FaceNeeds | None: ...


class FaceTips:
    """The forces along a face of several points that tip it.

    A force f along the face at the middle of its points, which the law does not know, changes the
    forces of the points at once, by

        A dlambda = -J M^-1 T^T f,

    with A(x), the Jacobian J of their distances and that of the middle along the face, T: the law
    keeps its control, and the distances stay. A point loses its force at lambda_i / |row i of A^-1
    J M^-1 T^T|. If f lasts, the gains of the outputs balance it.

    Args:
        model: The robot.
        controller: Its task.
        points: The constraints of the face.
    """

    def __init__(
        self, model: RobotModel, controller: TaskController, points: Sequence[Constraint]
    ) -> None:
        links, forces = model.links, list(controller.contact.forces)
        touches = [touch for point in points if (touch := point.touch(links)) is not None]
        middle = sum(links.position(touch.frame, touch.point) for touch in touches) / len(touches)
        normal = touches[0].normal
        along = ca.SX.eye(3) - ca.mtimes(normal, normal.T)
        q, rates = links.q, links.velocity_map
        terms = {
            "face": ca.mtimes(ca.jacobian(model.dae.k[forces], q), rates),
            "along": ca.mtimes([along, ca.jacobian(middle, q), rates]),
            "mass": links.mass_matrix,
        }
        self._terms = model.dae.trace("face", terms)
        self._forces, self._values = forces, model.dae.parameter_values
        self._structure = controller.law.structure
        self._model, self._points = model, tuple(points)

    def needs(self, record: Record, rows: Indices) -> FaceNeeds | None:
        """The needs of a phase; None while it builds up its force, or begins open.

        Args:
            record: A run of the law's model.
            rows: Its rows in the phase.
        """
        forces = record["constraint_force"][rows][:, self._forces]
        total = forces.sum(axis=1)
        if not (forces[:2] > 0.0).all() or total[:2].min() < total.max() / 2.0:
            return None
        closed = forces.min(axis=1) > 0.0
        rows, forces = rows[closed], forces[closed]
        chosen = np.unique(np.linspace(0, len(rows) - 1, _STATES).astype(int))
        tips = min(
            float(np.min(forces[i] / np.linalg.norm(self.shift(record["state"][rows[i]]), axis=1)))
            for i in chosen
        )
        off = 1.0 - forces.shape[1] * forces.min(axis=1) / forces.sum(axis=1)
        return FaceNeeds(float(off.max()), tips)

    def shift(self, state: FloatArray) -> FloatArray:
        """dlambda per unit of f, along each axis of the world, shape (k, 3).

        Args:
            state: x.
        """
        face, along, mass = self._terms(state, self._values)
        matrix = self._structure.constraint_matrix(state)[np.ix_(self._forces, self._forces)]
        pushed = face @ np.linalg.solve(mass, along.T)
        return -np.linalg.solve(matrix, pushed).astype(np.float64)

    def nearest(
        self, scenario: Scenario, phases: Sequence["PhaseWithFace"], state: FloatArray
    ) -> str:
        """A sentence on the phase in which the smallest force tips the face.

        Beside it stands the force along the face that the plant of the scenario has, and the law
        does not know: F sin a of a tilt by a, and the difference of friction times F.

        Args:
            scenario: The completed scenario.
            phases: The needs of the phases.
            state: x.
        """
        pressing = [(phase.face.tips, phase) for phase in phases if phase.face is not None]
        if not pressing:
            return ""
        tips, phase = min(pressing, key=lambda each: each[0])
        tilt = max(
            angle_between(*normals_at(scenario, self._model, point, state))
            for point in self._points
        )
        apart = max(self._friction_apart(scenario, point) for point in self._points)
        by_tilt, by_friction = phase.force * sin(tilt), phase.force * apart
        causes = [
            (tilt, f"{by_tilt:.2g} N by its tilt of {degrees(tilt):.2g} degrees"),
            (apart, f"{by_friction:.2g} N by its friction"),
        ]
        known = [cause for size, cause in causes if size > _SMALL]
        text = (
            f"The face is nearest to tipping in {phase.name}: a force of {tips:.2g} N along it, of "
            "which the law does not know, tips it"
        )
        differs = f". The plant differs from the law's model by {' and '.join(known)}"
        return text + differs * bool(known)

    def _friction_apart(self, scenario: Scenario, point: Constraint) -> float:
        """How far the coefficients of friction of plant and law are apart."""
        name, material = point.friction_parameter, scenario.plant.material
        if name is None:
            return 0.0 if material is None else material.friction or 0.0
        place = self._model.dae.parameter_slice(name)
        own = plant_values(scenario, self._model, point)[place]
        if material is not None and material.friction is not None:
            own = np.array([material.friction])
        return float(np.max(np.abs(own - self._values[place])))
