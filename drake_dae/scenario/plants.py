"""The plants of a scenario: each member of this family makes a plant."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import ClassVar, cast

from numpy.typing import ArrayLike
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant as DrakePlant
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import brief, positive
from drake_dae.dae.structure.structure import Structure
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.forms.keys import at
from drake_dae.systems.plants.contact.compliant_plant import CompliantPlant
from drake_dae.systems.plants.contact.contact_material import ContactMaterial, Peg, PointMaterial
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.contact.disturbance_forces import DisturbanceForce
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.robot_plant import RobotPlant
from drake_dae.systems.plants.unilateral.contacts import coefficient
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant


@dataclass(frozen=True, eq=False)
class RobotToSimulate:
    """The robot for which a plant is made.

    Attributes:
        model, structure: The robot, and the structure of its system.
        opens: The contacts that a task opens and closes; empty without a task.
        add_robot: A function that adds the robot with its payloads to a MultibodyPlant.
        parameters: Parameter name -> the value in the plant, if it differs from the law's.
        disturbances: Disturbance forces on the plant.
    """

    model: RobotModel
    structure: Structure
    opens: Sequence[str]
    add_robot: Callable[[DrakePlant, SceneGraph], None]
    parameters: Mapping[str, ArrayLike]
    disturbances: Sequence[DisturbanceForce]


class ScenarioPlant(ABC):
    """The contract of the key `plant` of a scenario.

    1. `plant` makes the plant of a robot, which follows the contract of `Plant`.
    2. With `carries`, this plant includes payloads, disturbances and changed parameters. Otherwise
       the scenario makes a model with these payloads and disturbances, and sets the parameters in
       the context. A plant that `carries` has `pushes` of its own.
    3. `material` is the material of compliant contacts, and None for ideal contacts.
    4. `rolled` is the member that a rollout runs instead: this member, or one with a traced plant.
    5. With `adjusts`, the parameters of the plant can be set in a context. `in_context` are the
       keys of numbers that `begin` sets in a context, even if the plant was made with other
       numbers.
    6. With `has_sides` its contacts include the sides of a body that ends, as those of a hole in a
       `Plate`, and not only its face. `pegs` are the pegs that enter them.
    """

    carries: ClassVar[bool] = False
    adjusts: ClassVar[bool] = True
    pegs: Sequence[Peg] = ()
    in_context: ClassVar[frozenset[str]] = frozenset()

    @property
    def material(self) -> PointMaterial | None:
        """The material of compliant contacts; None for ideal ones."""
        return None

    @property
    def has_sides(self) -> bool:
        """Whether a body that ends has sides too, as those of a hole."""
        return True

    @property
    def rolled(self) -> "ScenarioPlant":
        """The plant that a rollout uses in place of this one; itself if it is traced."""
        return self

    def begin(self, plant: Plant, context: Context) -> None:  # noqa: B027 - Nothing by default.
        """Sets the numbers of `in_context` in a context of the plant.

        Raises:
            ModelError: They do not fit the plant.
        """

    @abstractmethod
    def plant(self, robot: RobotToSimulate) -> Plant:
        """Makes the plant.

        Raises:
            ScenarioError: The robot cannot be simulated so; the message names the key.
        """


@dataclass(frozen=True)
class IdealConstraints(ScenarioPlant):
    """The plant is a `RobotPlant`: its constraints hold exactly.

    In a task its contacts open, without bouncing: it is then a `UnilateralRobotPlant`.

    Attributes:
        pegs: The pegs with which a task enters holes, as for `!Unilateral`.
    """

    pegs: Sequence[Peg] = ()

    @property
    def has_sides(self) -> bool:
        return bool(self.pegs)

    def plant(self, robot: RobotToSimulate) -> Plant:
        if robot.opens:
            return Unilateral(dict.fromkeys(robot.opens, 0.0), pegs=self.pegs).plant(robot)
        if self.pegs:
            text = "a peg is for a contact that opens: give a task, or take !Unilateral"
            raise ScenarioError(("plant.pegs", text))
        return RobotPlant(robot.model, structure=robot.structure)


@checked(ModelError)
@dataclass(frozen=True)
class Unilateral(ScenarioPlant):
    """The plant is a `UnilateralRobotPlant`: contacts open instead of pulling, and impact.

    The law is that of closed contacts, also while a contact is open. Then phi'' = -A(x) lambda_d
    with the desired force lambda_d: the robot returns to the surface if lambda_d > 0, and leaves it
    if lambda_d < 0.

    Attributes:
        restitution: Constraint -> its coefficient of restitution, 0 (no bounce) to 1 (no loss), a
            pure number. Other constraints stay closed. If left out, all unilateral contacts open,
            without bouncing.
        settling_time: Bouncing that would end within this time, in s, is ended immediately.
        pegs: The pegs with which it enters holes, each at a contact that opens, with the friction
            of that contact. Here a peg is round and smooth, so its rings and balls do not count.

    Raises:
        ModelError: A number makes no sense.
    """

    restitution: dict[str, float] = field(default_factory=dict)
    settling_time: float = 1e-3
    pegs: Sequence[Peg] = ()

    @property
    def has_sides(self) -> bool:
        return bool(self.pegs)

    def __post_init__(self) -> None:
        positive("settling_time", self.settling_time)
        for name, value in self.restitution.items():
            coefficient(f"restitution.{name}", value)

    def plant(self, robot: RobotToSimulate) -> Plant:
        with at("plant or plant_parameters" if robot.opens else "plant.restitution"):
            pushing = [
                constraint.name
                for constraint in robot.model.constraints
                if any(constraint.is_unilateral)
            ]
            if not pushing:
                raise ModelError("the robot has no unilateral constraint, so no contact can open")
            return UnilateralRobotPlant(
                robot.model,
                self.restitution or dict.fromkeys(pushing, 0.0),
                settling_time=self.settling_time,
                structure=robot.structure,
                pegs=self.pegs,
            )


@dataclass(frozen=True)
class MultibodyPlant(ContactMaterial, ScenarioPlant):
    """The plant is a `ContactPlant`: Drake's own contact, in a discrete MultibodyPlant.

    A ball at the tool, or a peg of balls, touches the surfaces of the constraints. With point
    contact the force is stiffness times depth. With hydroelastic contact the ball is rigid, and the
    pressure of the surface is modulus times depth / thickness.

    If the robot tilts by an angle a from its nominal orientation, the ball rolls: it touches at a
    distance 2 radius sin(a / 2) from the point of the constraint, and that point is radius (1 - cos
    a) off the surface. A smaller radius reduces this deviation from ideal contact; a stiffer
    contact does not. A tool that stays normal to its surface does not roll.
    """

    carries: ClassVar[bool] = True

    @property
    def material(self) -> ContactMaterial:
        return self

    @property
    def rolled(self) -> ScenarioPlant:
        if self.contact_model != "point":
            return self
        return CompliantContact(**{f.name: getattr(self, f.name) for f in fields(PointMaterial)})

    def plant(self, robot: RobotToSimulate) -> Plant:
        with at("plant or plant_parameters"):
            return ContactPlant(
                robot.model,
                robot.add_robot,
                self,
                structure=robot.structure,
                parameters=robot.parameters,
                disturbances=robot.disturbances,
            )


@dataclass(frozen=True)
class CompliantContact(PointMaterial, ScenarioPlant):
    """The plant is a `CompliantPlant`: Drake's point contact as equations of this library.

    It contains no MultibodyPlant, so rollouts are hundreds of times as fast as Drake's plant. It
    supports what `!MultibodyPlant` does not: surfaces of any shape, moving surfaces, exogenous
    signals, exports. It has no stops at the limits of joints. With a time_step of 0 it is
    continuous.
    """

    in_context: ClassVar[frozenset[str]] = frozenset(
        {"stiffness", "dissipation", "friction", "radius"}
    )

    @property
    def material(self) -> PointMaterial:
        return self

    def begin(self, plant: Plant, context: Context) -> None:
        cast(CompliantPlant, plant).set_contact(context, self)

    def plant(self, robot: RobotToSimulate) -> Plant:
        with at("plant or plant_parameters"):  # Whose numbers are set in a context.
            return CompliantPlant(robot.model, self, structure=robot.structure)


@dataclass(frozen=True)
class OwnPlant(ScenarioPlant):
    """The plant is your own class that follows the contract of `drake_dae.Plant`.

    It is called with the robot and its structure, as `maker(model, structure)`. Running such a
    scenario imports the module, found by PYTHONPATH, also in the processes of a sweep: use only
    files from people whose code you trust.

    Attributes:
        maker: The module and the class in it, as "my_plants:SpringyPlant".

    Raises:
        ModelError: The text is not a module and class; or, when the plant is made, there is no such
            class.
    """

    maker: str
    adjusts: ClassVar[bool] = False

    def __post_init__(self) -> None:
        module, _, name = self.maker.partition(":")
        if not (module and name.isidentifier()):
            raise ModelError(
                "maker: a module and a class in it are needed, as my_plants:SpringyPlant, got "
                f"'{brief(self.maker)}'"
            )

    def plant(self, robot: RobotToSimulate) -> Plant:
        module, _, name = self.maker.partition(":")
        with at("plant.maker"):
            try:
                kind = getattr(import_module(module), name)
            except (ImportError, AttributeError) as error:
                raise ModelError(f"'{self.maker}' cannot be loaded: {error}") from error
            if not (isinstance(kind, type) and issubclass(kind, Plant)):
                raise ModelError(
                    f"'{self.maker}' is no class that keeps the contract of drake_dae.Plant"
                )
            return kind(robot.model, robot.structure)
