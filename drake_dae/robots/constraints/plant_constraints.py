"""Constraints of a MultibodyPlant itself: mimic joints, couplers, rods."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydrake.multibody.inverse_kinematics import AddMultibodyPlantConstraints
from pydrake.multibody.plant import MultibodyPlant
from pydrake.solvers import LinearEqualityConstraint, MathematicalProgram

from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.constraints.couplers import JointCoupler
from drake_dae.robots.constraints.points import FixedDistance
from drake_dae.robots.links.frames import frame_name, joint_names
from drake_dae.robots.links.links import Links
from drake_dae.robots.surfaces.surface import triple


def plant_constraints(links: Links) -> tuple[Constraint, ...]:
    """The constraints of the plant of the links; none without a plant.

    Couplers, which mimic joints are, become a `JointCoupler` "<follower>_coupler", and rods of
    AddDistanceConstraint a `FixedDistance` "rod0", "rod1", ... Drake enforces them only in discrete
    plants; here they hold in continuous time as well.

    Raises:
        ModelError: The plant has other constraints, or a rod with a stiffness.
    """
    plant = links.plant
    if plant is None or plant.num_constraints() == 0:
        return ()
    constraints = (*_couplers(plant, links), *_rods(plant))
    others = plant.num_constraints() - len(constraints)
    if others:
        raise ModelError(
            f"the plant has {others} constraint(s) that cannot be read back from it; take them out "
            "of the plant or of its file, and give them as `constraints`: a ball constraint is "
            "CoincidentPoints, a weld constraint WeldedFrames"
        )
    return constraints


@dataclass(frozen=True)
class Coupling:
    """Two joints of a plant with q_follower = ratio q_leader + offset, by their names."""

    follower: str
    leader: str
    ratio: float
    offset: float


def couplings_of(plant: MultibodyPlant) -> list[Coupling]:
    """The couplings of a finalized plant, read from a mathematical program of Drake.

    Raises:
        ModelError: The plant has a constraint that Drake does not describe.
    """
    program = MathematicalProgram()
    q = program.NewContinuousVariables(plant.num_positions(), "q")
    try:
        AddMultibodyPlantConstraints(plant, q, program, plant.CreateDefaultContext())
    except RuntimeError as error:
        raise ModelError(
            f"the plant has a constraint that is not supported ({error}); leave it out of the plant"
        ) from None
    couplings: list[Coupling] = []
    followers: set[str] = set()
    joints = {joint.position_start(): name for name, joint in joint_names(plant).items()}
    index = {variable.get_id(): i for i, variable in enumerate(q)}
    for binding in program.GetAllConstraints():
        row = binding.evaluator()
        if not isinstance(row, LinearEqualityConstraint) or binding.variables().size != 2:
            continue
        names = [joints[index[variable.get_id()]] for variable in binding.variables()]
        factors = [float(factor) for factor in np.reshape(row.GetDenseA(), 2)]
        # The follower has the factor 1. If both have it, either may be; no joint follows twice.
        able = [i for i in (1, 0) if factors[i] == 1.0] or [0]
        place = next((i for i in able if names[i] not in followers), able[0])
        followers.add(names[place])
        ratio = -factors[1 - place] / factors[place]
        offset = float(row.lower_bound()[0]) / factors[place]
        couplings.append(Coupling(names[place], names[1 - place], ratio, offset))
    return couplings


def _couplers(plant: MultibodyPlant, links: Links) -> Iterator[JointCoupler]:
    units = {signal.name: signal.unit for signal in links.position_signals}
    for coupling in couplings_of(plant):
        unit: Literal["rad", "m"] = "m" if units[coupling.follower] == "m" else "rad"
        yield JointCoupler(**vars(coupling), unit=unit, name=f"{coupling.follower}_coupler")


def _rods(plant: MultibodyPlant) -> Iterator[FixedDistance]:
    rods = plant.GetDefaultDistanceConstraintParams()
    for number, key in enumerate(sorted(rods, key=lambda key: key.get_value())):
        rod = rods[key]
        bodies = [plant.get_body(index) for index in (rod.bodyA(), rod.bodyB())]
        start, end = (frame_name(plant, body.body_frame()) for body in bodies)
        if np.isfinite(rod.stiffness()):
            raise ModelError(
                f"the distance constraint between '{start}' and '{end}' has a stiffness of "
                f"{rod.stiffness():g} N/m: that is a spring and no rod; add a LinearSpringDamper"
            )
        point_a, point_b = (triple("a point", point) for point in (rod.p_AP(), rod.p_BQ()))
        yield FixedDistance(start, point_a, end, point_b, rod.distance(), f"rod{number}")
