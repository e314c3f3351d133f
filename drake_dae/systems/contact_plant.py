"""Drake's own contact as the plant: a discrete MultibodyPlant in place of the ideal constraint."""

import logging
from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddCompliantHydroelasticPropertiesForHalfSpace,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Role,
    SceneGraph,
    Shape,
    Sphere,
    TriangleSurfaceMesh,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    BodyIndex,
    ModelInstanceIndex,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import MatrixGain, Multiplexer

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import ConstraintStructure, Signal
from drake_dae.errors import ModelError
from drake_dae.robots import Constraint, PosedShape, RobotModel, frame_named, own_values
from drake_dae.systems.contact_forces import (
    AppliedDisturbances,
    ContactForces,
    DisturbanceForce,
    contact_block,
)
from drake_dae.systems.contact_laws import (
    ContactMaterial,
    ball_normals,
    contact_force_signals,
    touching,
)
from drake_dae.systems.plant import Plant, changed_parameters


def _is_relevant(record: logging.LogRecord) -> bool:
    """Filters Drake's message on half spaces in deformable contact, which is not used here."""
    return "half spaces are not currently supported for deformable" not in record.getMessage()


@checked(ModelError)
class ContactPlant(Diagram, Plant):
    """A robot in Drake's own contact: a discrete MultibodyPlant with the ports of a `RobotPlant`.

    Compliant contact with friction satisfies the constraints approximately, and may open. For each
    constraint there is a ball on the robot at its point, and its surface in the world; nothing else
    of the robot collides.

    The plant steps at t_n = n time_step: its ports then have x(t_n), before the step to t_(n+1),
    which uses the control at t_n. The force is that of the step to t_n. After
    `set_consistent_state` the robot touches without force, and penetrates when the run starts.

    Input port:
        control: u, shape (p,): the torques and forces of the actuators, N m (N).

    Output ports:
        state, link_state: x = (q, v), shape (n,).
        contact_force: F of each contact on the robot, with friction, in the world, N, shape (3 m,).
        constraint_force: lambda = n . F along the normal of the surface, N, shape (m,).
        constraint_residual: phi and phi', as for `DaePlant`; not zero in compliant contact.
        controlled_output: z = l(x) + m(x) lambda.
        contact_results: Drake's.

    Args:
        model: The robot, with rigid joints: each constraint a `PointOnSurface` at rest, on a
            surface with `solids`, or on any smooth one in hydroelastic contact.
        add_robot: Adds the robot to a plant, as it was added to the plant of the model.
        material: The contact material.
        structure: The structure of the model's system.
        parameters: Parameter name -> the plant's value if it differs from the model: positions and
            friction of surfaces, and masses of bodies.
        disturbances: Forces on the robot that its law does not know.

    Attributes:
        multibody: Drake's plant.

    Raises:
        ModelError: The robot has stages of actuation, or contacts that cannot be represented.
    """

    __slots__ = SHARED_DICTIONARY
    is_ideal = False

    def __init__(
        self,
        model: RobotModel,
        add_robot: Callable[[MultibodyPlant, SceneGraph], None],
        material: ContactMaterial,
        *,
        structure: ConstraintStructure,
        parameters: Mapping[str, ArrayLike] | None = None,
        disturbances: Sequence[DisturbanceForce] = (),
    ) -> None:
        super().__init__()
        check_model(model, material)
        self.model: RobotModel = model
        self.dae, self.structure = model.dae, structure
        self.time_step, self._friction = material.time_step, material.friction
        self._values = changed_parameters(model, parameters or {})
        logging.getLogger("drake").addFilter(_is_relevant)
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=material.time_step,
            contact_model=material.contact_model,
            stiction_tolerance=material.stiction_tolerance,
        )
        plant, scene_graph = AddMultibodyPlant(config, builder)
        self.multibody = plant
        add_robot(plant, scene_graph)
        pairs = self._add_contacts(plant, scene_graph, material)
        plant.Finalize()
        drawn = model.links.plant
        assert drawn is not None  # check_model.
        if _names(plant) != _names(drawn):
            raise ModelError(
                f"add_robot must add the robot of the model, with positions "
                f"{listed(drawn.GetPositionNames())}; it has {listed(plant.GetPositionNames())}"
            )
        self._masses = other_masses(model, plant, self._values)
        if disturbances:
            frames = [frame_named(plant, disturbance.frame) for disturbance in disturbances]
            applied = builder.AddSystem(AppliedDisturbances(disturbances, frames))
            builder.Connect(applied.get_output_port(), plant.get_applied_spatial_force_input_port())
        block = contact_block(model, structure, self._values, material)
        signals = builder.AddSystem(TracedSystem(block, compiled=model.dae.compiled))
        results, state = plant.get_contact_results_output_port(), plant.get_state_output_port()
        builder.Connect(state, signals.GetInputPort("state"))
        if "generalized_contact_force" in block.inputs:
            force, name = _generalized_forces(builder, plant), "generalized_contact_force"
        else:
            sums, name = builder.AddSystem(ContactForces(pairs)), "contact_force"
            builder.Connect(results, sums.GetInputPort("contact_results"))
            force = sums.get_output_port()
        builder.Connect(force, signals.GetInputPort(name))
        builder.ExportInput(plant.get_actuation_input_port(), "control")
        shown = {name: signals.GetOutputPort(name) for name in block.outputs}
        shown |= {"state": state, "link_state": state, "contact_results": results}
        for name, port in shown.items():
            builder.ExportOutput(port, name)
        builder.BuildInto(self)
        self.set_name(model.dae.name)

    def _add_contacts(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, material: ContactMaterial
    ) -> list[tuple[list[GeometryId], list[GeometryId]]]:
        """Balls on the robot and solids in the world for each constraint, and nothing else."""
        model, pairs = self.model, []
        touches = touching(model)
        at = [model.links.position(touch.frame, touch.point) for _, touch in touches]
        outputs = {"normals": ball_normals(model), "points": ca.vertcat(*at)}
        nominal = self.structure.manifold.project(self.dae.nominal_state, self._values)
        placed = self.dae.trace("balls", outputs, often=False)(nominal, self._values)
        rows = (np.reshape(each, (-1, 3)) for each in placed)
        for (constraint, touch), normal, point in zip(touches, *rows, strict=True):
            frame = GetScopedFrameByName(plant, touch.frame)
            center = touch.point + material.radius * normal
            values = own_values(constraint, self.dae, self._values)
            solids = solids_of(constraint, values, point, material)
            friction, name = material.friction or 0.0, constraint.friction_parameter
            if material.friction is None and name is not None:
                friction = self._values[self.dae.parameter_slice(name)].item()
            ball = plant.RegisterCollisionGeometry(
                frame.body(),
                RigidTransform(frame.GetFixedPoseInBodyFrame() @ center),
                Sphere(material.radius),
                f"{constraint.name}_ball",
                proximity(material, friction),
            )
            touched = [
                plant.RegisterCollisionGeometry(
                    plant.world_body(),
                    solid.pose,
                    solid.form,
                    f"{constraint.name}_surface{number or ''}",
                    proximity(material, friction, solid.form),
                )
                for number, solid in enumerate(solids)
            ]
            pairs.append(([ball], touched))
        # The robot's own shapes do not collide, and a ball collides only with its own surface.
        every = scene_graph.model_inspector().GetAllGeometryIds(Role.kProximity)
        manager = scene_graph.collision_filter_manager()
        manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(every)))
        for pair in pairs:
            manager.Apply(CollisionFilterDeclaration().AllowBetween(*map(GeometrySet, pair)))
        return pairs

    def parameters(self, context: Context) -> FloatArray:
        return self._values.copy()

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return {"contact_force": contact_force_signals(self.model)}

    def friction(self, context: Context) -> dict[str, float]:
        if self._friction is None:
            return super().friction(context)
        return {constraint.name: self._friction for constraint in self.model.constraints}

    def state(self, context: Context) -> FloatArray:
        multibody_context = self.GetSubsystemContext(self.multibody, context)
        return np.array(self.multibody.GetPositionsAndVelocities(multibody_context))

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x, shape (n,), and the plant's changed masses, which Drake keeps in its context."""
        multibody_context = self.GetMutableSubsystemContext(self.multibody, context)
        values = self.dae.state_vector(state)
        self.multibody.SetPositionsAndVelocities(multibody_context, values)
        for body, mass, center in self._masses:
            if center is None:
                body.SetMass(multibody_context, mass)
            else:
                inertia = SpatialInertia(mass, center, UnitInertia.PointMass(center))
                body.SetSpatialInertiaInBodyFrame(multibody_context, inertia)


def proximity(
    material: ContactMaterial, friction: float, surface: Shape | TriangleSurfaceMesh | None = None
) -> ProximityProperties:
    """The properties of a surface, or of the robot's ball."""
    properties, frictional = ProximityProperties(), CoulombFriction(friction, friction)
    # Two equal springs in series have half their stiffness.
    AddContactMaterial(material.dissipation, 2.0 * material.stiffness, frictional, properties)
    if material.contact_model == "point":
        return properties
    if surface is None:
        AddRigidHydroelasticProperties(material.radius / 8.0, properties)
    elif isinstance(surface, HalfSpace):
        layer = material.thickness, material.modulus
        AddCompliantHydroelasticPropertiesForHalfSpace(*layer, properties)
    else:
        AddCompliantHydroelasticProperties(material.radius, material.modulus, properties)
    return properties


def _names(plant: MultibodyPlant) -> tuple[list[str], ...]:
    return plant.GetPositionNames(), plant.GetVelocityNames(), plant.GetActuatorNames()


def check_model(model: RobotModel, material: ContactMaterial) -> None:
    """Refuses a model or a material that Drake's contact cannot represent."""
    compliant = "take a CompliantPlant (`plant: !CompliantContact`)"
    if model.links.plant is None:
        raise ModelError("Drake's contact needs a robot that a MultibodyPlant has read")
    if model.dae.exogenous or model.known_forces:
        raise ModelError(
            "Drake's contact as the plant takes no exogenous signals and no robot.known_forces: "
            f"{compliant}; forces that the law does not know are plant.disturbances"
        )
    if model.stages:
        raise ModelError(
            f"{model.name} has springs, motors or valves at its joints, which Drake's contact does "
            f"not step: {compliant}"
        )
    for constraint, _ in touching(model):
        values = own_values(constraint, model.dae, model.dae.parameter_values)
        surface = constraint.surface_at(values)
        if surface is None or (material.contact_model == "point" and not surface.solids()):
            raise ModelError(
                f"'{constraint.name}' has no solid for Drake's point contact, as a PointOnSurface "
                "has on a Plane, or on the outside of a Sphere or a Cylinder: take hydroelastic "
                f"contact (contact_model: hydroelastic) on any smooth surface, or {compliant}"
            )


def solids_of(
    constraint: Constraint, values: FloatArray, point: FloatArray, material: ContactMaterial
) -> tuple[PosedShape, ...]:
    """The solids of a constraint in the world; `point` is its nominal contact point there."""
    surface, pose = constraint.surface_at(values), constraint.placement(values)
    assert surface is not None  # `check_model` refuses others.
    solids = surface.solids()
    exact = solids and all(isinstance(solid.form, HalfSpace | Sphere) for solid in solids)
    # Drake's own mesh of a long cylinder is too coarse: 2 N of ripple in a force of 20 N.
    if material.contact_model != "point" and not exact:
        near = pose.inverse() @ point
        try:
            solids = (surface.layer(near, material.piece, material.thickness),)
        except ModelError as error:
            raise ModelError(f"{constraint.name}: {error}") from None
    return tuple(solid.moved(pose) for solid in solids)


def _generalized_forces(builder: DiagramBuilder, plant: MultibodyPlant) -> OutputPort:
    """Drake's generalized contact forces of all joints, in the order of the velocities."""
    instances = map(ModelInstanceIndex, range(plant.num_model_instances()))
    moving = [instance for instance in instances if plant.num_velocities(instance)]
    ports = [plant.get_generalized_contact_forces_output_port(each) for each in moving]
    if len(ports) == 1:
        return ports[0]
    places = np.arange(plant.num_velocities())
    order = np.concatenate([plant.GetVelocitiesFromArray(each, places) for each in moving])
    stacked = builder.AddSystem(Multiplexer([port.size() for port in ports]))
    for i, port in enumerate(ports):
        builder.Connect(port, stacked.get_input_port(i))
    sorted_ = builder.AddSystem(MatrixGain(np.eye(order.size)[np.argsort(order)]))
    builder.Connect(stacked.get_output_port(), sorted_.get_input_port())
    return sorted_.get_output_port()


def other_masses(
    model: RobotModel, plant: MultibodyPlant, values: FloatArray
) -> list[tuple[RigidBody, float, FloatArray | None]]:
    """Each body with another mass, or place as a point mass, than in the robot's file."""
    drawn = model.links.plant
    assert drawn is not None  # check_model.
    bodies = (drawn.get_body(BodyIndex(i)) for i in range(drawn.num_bodies()))
    with_mass = (body for body in bodies if body.default_mass() > 0.0)
    known = {p.name: values[model.dae.parameter_slice(p.name)] for p in model.links.parameters}
    masses = [name for name in known if name.endswith(".mass")]
    changed = list[tuple[RigidBody, float, FloatArray | None]]()
    for body, name in zip(with_mass, masses, strict=True):
        mass, center = known[name].item(), known.get(f"{name.removesuffix('mass')}center")
        if mass != body.default_mass() or (center is not None and center.any()):
            changed.append((plant.get_body(body.index()), mass, center))
    return changed
