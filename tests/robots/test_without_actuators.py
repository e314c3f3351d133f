"""A robot without actuators is simulated; nothing of it is steered."""

import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from vendors import joint, link, robot

from drake_dae import Cylinder, JointPositions, Plane, PointOnSurface, RobotModel
from drake_dae.errors import ModelError
from drake_dae.systems.ideal_plants import RobotPlant

SURFACES = Plane((0, 0, 0.3), (0, 0, 1)), Cylinder((0, 0, 0), (0, 0, 1), 0.2)


def swinging() -> MultibodyPlant:
    links = [link(name, 1.0) for name in ("base", "one", "two", "three")]
    axes = ("0 1 0", "1 0 0", "0 1 0")
    joints = [
        joint(f"j{k}", name, child, axis)
        for k, (name, child, axis) in enumerate(
            zip(("base", "one", "two"), ("one", "two", "three"), axes, strict=True)
        )
    ]
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(robot("swing", *links, *joints), ".urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant


def test_it_needs_no_word_about_forces():
    """It falls from rest, and its energy stays: contacts do no work. The steps leave 1e-6 J."""
    touching = [PointOnSurface("three", one, name=f"c{k}") for k, one in enumerate(SURFACES)]
    drakes = swinging()
    model = RobotModel.from_multibody(drakes, touching, [], [0.6, 0.3, 0.4])
    assert model.dae.num_outputs == 0
    assert model.forces == ()
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    q = model.configuration(None, [0.6, 0.3, 0.4])
    plant.set_consistent_state(context, model.rest_state(q, []))
    simulator = Simulator(plant, context)
    simulator.get_mutable_integrator().set_target_accuracy(1e-8)
    energies = []
    for time in (0.0, 0.2):
        simulator.AdvanceTo(time)
        own = drakes.CreateDefaultContext()
        drakes.SetPositionsAndVelocities(own, plant.state(context))
        kinetic, potential = drakes.CalcKineticEnergy(own), drakes.CalcPotentialEnergy(own)
        energies.append(kinetic + potential)
    assert kinetic > 1e-3
    assert energies[1] == pytest.approx(energies[0], abs=1e-6)


@pytest.mark.parametrize(
    ("outputs", "forces"), [(["j0"], None), (["j0", "j1"], []), ([], ["c.force"])]
)
def test_what_it_cannot_steer_is_refused_in_words_that_fit(outputs, forces):
    touching = [PointOnSurface("three", SURFACES[0], name="c")]
    positions = [JointPositions(outputs)] if outputs else []
    with pytest.raises(ModelError, match="positions"):
        RobotModel.from_multibody(swinging(), touching, positions, forces=forces)
