"""Checks of a robot for Drake's own contact, and changed parameters."""

from collections.abc import Mapping, Sequence

from numpy.typing import ArrayLike
from pydrake.geometry import HalfSpace, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody, SpatialInertia, UnitInertia
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.errors import ModelError
from drake_dae.robots import Constraint, PosedShape, RobotModel, own_values
from drake_dae.systems.plants.contact.contact_material import ContactMaterial


def check_model(model: RobotModel, material: ContactMaterial) -> None:
    """Refuses a model or a material that Drake's contact cannot represent.

    Raises:
        ModelError: It cannot; the message has the reason.
    """
    if model.links.plant is None:
        raise ModelError("Drake's contact needs a robot that a MultibodyPlant has read")
    if model.dae.exogenous or model.known_forces:
        raise ModelError(
            "Drake's contact as the plant takes no exogenous signals and no robot.known_forces; "
            "forces that the law does not know are disturbance forces (plant.disturbances). Use "
            "`plant: !CompliantContact`, which has the same equations of contact, or a rollout"
        )
    if model.stages:
        raise ModelError(
            f"{model.name} has springs, motors or valves at its joints, which Drake's contact does "
            "not step: take a CompliantPlant (`plant: !CompliantContact`)"
        )
    if not model.constraints:
        raise ModelError("the robot has no constraints, so there is nothing to touch")
    for constraint in model.constraints:
        values = own_values(constraint, model.dae, model.dae.parameter_values)
        surface = constraint.surface_at(values)
        if surface is None or constraint.touch(model.links) is None:
            raise ModelError(
                f"'{constraint.name}' is no contact with a surface: use an ideal plant"
            )
        if material.contact_model != "hydroelastic" and not surface.solids():
            raise ModelError(
                f"'{constraint.name}' has no solid for Drake's point contact, as a "
                "PointOnSurface has on a Plane, or on the outside of a Sphere or a "
                "Cylinder. Use hydroelastic contact (contact_model: hydroelastic), which meshes "
                "any smooth surface, or `plant: !CompliantContact`"
            )


def solids_of(
    constraint: Constraint, values: FloatArray, point: FloatArray, material: ContactMaterial
) -> tuple[PosedShape, ...]:
    """The solids of a constraint in the world.

    Args:
        constraint: The contact.
        values: The values of its parameters.
        point: Its nominal contact point in the world, m, shape (3,).
        material: The contact material.

    Raises:
        ModelError: There are none.
    """
    surface, pose = constraint.surface_at(values), constraint.placement(values)
    assert surface is not None  # `check_model` refuses others.
    solids = surface.solids()
    exact = solids and all(isinstance(solid.form, HalfSpace | Sphere) for solid in solids)
    # Drake's own mesh of a long cylinder is too coarse: 2 N of ripple in a force of 20 N.
    if material.contact_model != "point" and not exact:
        try:
            near = pose.inverse() @ point
            solids = (surface.layer(near, material.piece, material.thickness),)
        except ModelError as error:
            raise ModelError(f"{constraint.name}: {error}") from None
    return tuple(solid.moved(pose) for solid in solids)


def changed_parameters(model: RobotModel, parameters: Mapping[str, ArrayLike]) -> FloatArray:
    """The values of all parameters, some of them changed for a plant.

    Args:
        model: The robot.
        parameters: Name -> value: of surfaces, masses and stages.

    Raises:
        ModelError: There is no such parameter, or a value does not fit.
    """
    values = model.dae.parameter_values
    changeable = [p for constraint in model.constraints for p in constraint.parameters]
    changeable += [
        *model.links.parameters,
        *(p for stage in model.stages for p in stage.parameters),
        *(p for load in model.known_forces for p in load.parameters),
    ]
    known = {parameter.name: parameter for parameter in changeable}
    for name, value in parameters.items():
        if name not in known:
            raise ModelError(
                f"of Drake's contact as the plant {unknown_name('parameter', name, known)}; give "
                "the law's model others instead"
            )
        given = numbers(f"parameter '{name}'", value)
        if given.shape not in ((), known[name].value.shape):
            raise ModelError(
                f"parameter '{name}' has {known[name].value.size} entries, got {value!r}"
            )
        values[model.dae.parameter_slice(name)] = given
        known[name].check(values[model.dae.parameter_slice(name)])
    return values


def check_same(plant: MultibodyPlant, model: RobotModel) -> None:
    """Refuses a robot other than that of the model.

    Raises:
        ModelError: It is another robot.
    """
    model_plant = model.links.plant
    assert model_plant is not None  # check_model.
    names, model_names = (
        (robot.GetPositionNames(), robot.GetVelocityNames(), robot.GetActuatorNames())
        for robot in (plant, model_plant)
    )
    if names != model_names:
        raise ModelError(
            f"add_robot must add the robot of the model, with positions "
            f"{', '.join(model_names[0])}; it has {', '.join(names[0]) or 'none'}"
        )


def point_mass(mass: float, center: FloatArray) -> SpatialInertia:
    """The inertia of a point mass in kg at a place in m, shape (3,)."""
    squares = center @ center - center**2
    unit = UnitInertia(*squares, *(-center[[0, 0, 1]] * center[[1, 2, 2]]))
    return SpatialInertia(mass, center, unit)


OtherMass = tuple[RigidBody, float, FloatArray | None]
"""A body, its mass in kg, and its place in m if it is a point mass."""


def other_masses(
    model: RobotModel, plant: MultibodyPlant, values: FloatArray
) -> tuple[OtherMass, ...]:
    """The bodies of a plant whose mass or place is not that of the robot's file.

    Args:
        model: The robot, made from a MultibodyPlant.
        plant: Another plant of the same robot.
        values: The values of all parameters of the model.
    """
    drawn = model.links.plant
    assert drawn is not None  # check_same.
    bodies = (drawn.get_body(BodyIndex(i)) for i in range(drawn.num_bodies()))
    with_mass = (body for body in bodies if body.default_mass() > 0.0)
    known = {p.name: values[model.dae.parameter_slice(p.name)] for p in model.links.parameters}
    masses = [name for name in known if name.endswith(".mass")]
    changed = list[OtherMass]()
    for body, name in zip(with_mass, masses, strict=True):
        mass, center = known[name].item(), known.get(f"{name.removesuffix('mass')}center")
        if mass != body.default_mass() or (center is not None and center.any()):
            changed.append((plant.get_body(body.index()), mass, center))
    return tuple(changed)


def set_masses(context: Context, masses: Sequence[OtherMass]) -> None:
    """Sets the masses of `other_masses` in a context of their plant."""
    for body, mass, center in masses:
        if center is None:
            body.SetMass(context, mass)
        else:
            body.SetSpatialInertiaInBodyFrame(context, point_mass(mass, center))
