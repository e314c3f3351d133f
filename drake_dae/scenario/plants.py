"""The plants of a scenario: each member of this family makes a plant."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from importlib import import_module
from typing import Annotated, ClassVar, cast

from pydantic import Field
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant as DrakePlant
from pydrake.systems.framework import Context

from drake_dae.dae import ConstraintStructure
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.robots import RobotModel
from drake_dae.scenario.form import at, expected
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Payload, Robot
from drake_dae.systems.compliant_plant import CompliantPlant
from drake_dae.systems.contact_forces import DisturbanceForce
from drake_dae.systems.contact_material import ContactMaterial, PointMaterial
from drake_dae.systems.contact_plant import ContactPlant
from drake_dae.systems.ideal_plants import RobotPlant
from drake_dae.systems.plant import Plant


@dataclass(frozen=True, kw_only=True)
class ScenarioPlant(ABC):
    """What a scenario simulates.

    Attributes:
        parameters: Parameter name -> the plant's value, unknown to the law's model; one number for
            all entries, or a list. A surface can be tilted if it has the key `rpy`.
        payloads: Additional masses on the plant, unknown to the law's model.
        disturbances: Disturbance forces on the plant, unknown to the law.
    """

    parameters: dict[str, float | list[float]] = field(default_factory=dict)
    payloads: list[Payload] = field(default_factory=list)
    disturbances: list[DisturbanceForce] = field(default_factory=list)

    carries: ClassVar[bool] = False
    """Whether the plant has these itself. Else a model has the payloads and disturbances, and
    numbers are set in a context, or, if it does not adjust, the plant is made anew for each."""
    adjusts: ClassVar[bool] = True
    in_context: ClassVar[frozenset[str]] = frozenset()
    """The keys of numbers that `begin` sets in a context."""

    @property
    def material(self) -> PointMaterial | None:
        """The material of contacts that give way."""
        return None

    @property
    def rolled(self) -> "ScenarioPlant":
        """What a rollout runs: this, or what has a traced plant."""
        return self

    def begin(self, plant: Plant, context: Context) -> None:  # noqa: B027 - Nothing by default.
        """Sets the numbers of `in_context` in a context of the plant."""

    @abstractmethod
    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        """The plant of a robot, with the structure of its system."""


@dataclass(frozen=True)
class IdealConstraints(ScenarioPlant):
    """The plant is a `RobotPlant`: its constraints hold exactly, and pull where they must."""

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        return RobotPlant(model, structure=structure)


@dataclass(frozen=True)
class MultibodyPlant(ContactMaterial, ScenarioPlant):
    """The plant is a `ContactPlant`: Drake's own contact, in a discrete MultibodyPlant.

    A ball at the tool touches the surfaces of the constraints. With point contact the force is
    stiffness times depth. With hydroelastic contact the ball is rigid, and the pressure of the
    surface is modulus times depth / thickness. Where the tool tilts, the ball rolls, the farther
    off ideal contact the larger its radius.
    """

    carries: ClassVar[bool] = True

    @property
    def material(self) -> ContactMaterial:
        return self

    @property
    def rolled(self) -> ScenarioPlant:
        if self.contact_model != "point":
            return self
        names = [f.name for f in (*fields(PointMaterial), *fields(ScenarioPlant))]
        return CompliantContact(**{name: getattr(self, name) for name in names})

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        def add(plant: DrakePlant, scene_graph: SceneGraph) -> None:
            read_robot(robot, plant, scene_graph, self.payloads)

        with at("plant or plant.parameters"):
            return ContactPlant(
                model,
                add,
                self,
                structure=structure,
                parameters=self.parameters,
                disturbances=self.disturbances,
            )


@dataclass(frozen=True)
class CompliantContact(PointMaterial, ScenarioPlant):
    """The plant is a `CompliantPlant`: Drake's point contact as equations of this library.

    It contains no MultibodyPlant, so rollouts are hundreds of times as fast as Drake's plant. It
    supports what `!MultibodyPlant` does not: surfaces of any shape, moving surfaces, exogenous
    signals, exports. It has no stops at the limits of joints. With a time_step of 0 it is
    continuous.
    """

    in_context: ClassVar = frozenset({"stiffness", "dissipation", "friction", "radius"})

    @property
    def material(self) -> PointMaterial:
        return self

    def begin(self, plant: Plant, context: Context) -> None:
        cast(CompliantPlant, plant).set_contact(context, self)

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        with at("plant or plant.parameters"):  # Whose numbers are set in a context.
            return CompliantPlant(model, self, structure=structure)


@dataclass(frozen=True)
class OwnPlant(ScenarioPlant):
    """The plant is your own class that follows the contract of `drake_dae.Plant`.

    It is called with the robot and its structure, as `maker(model, structure)`. Running such a
    scenario imports the module, found by PYTHONPATH, also in the processes of a sweep: use only
    files from people whose code you trust.

    Attributes:
        maker: The module and the class in it, as "my_plants:SpringyPlant".
    """

    maker: Annotated[
        str,
        Field(pattern=r"^[^:]+:[^\W\d]\w*$"),
        expected("a module and a class in it, as my_plants:SpringyPlant"),
    ]
    adjusts: ClassVar[bool] = False

    def plant(self, model: RobotModel, structure: ConstraintStructure, robot: Robot) -> Plant:
        module, _, name = self.maker.partition(":")
        with at("plant.maker"):
            try:
                plant = getattr(import_module(module), name)(model, structure)
            except DrakeDaeError:
                raise
            except Exception as error:
                what = f"{type(error).__name__}: {error}"
                raise ModelError(f"'{self.maker}' cannot be loaded and made: {what}") from error
            if not isinstance(plant, Plant):
                raise ModelError(
                    f"'{self.maker}' makes no plant that keeps the contract of drake_dae.Plant"
                )
            return plant
