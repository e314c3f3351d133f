"""Drake's own contact as the plant, against the ideal constraint and Drake's own numbers."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake import geometry
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from runs import run_scenario, scenario
from two_arms import NOMINAL, add_two_arms, two_arms_plant

import drake_dae as dd
from drake_dae.dae import find_constraint_structure
from drake_dae.errors import ScenarioError, WiringError
from drake_dae.scenario.scenario import Scenario
from drake_dae.systems.contact_plant import proximity

# Without damping a compliant contact swings for ever. A ball without extension does not roll.
CONTACT = (
    "plant=!MultibodyPlant {time_step: 1.0e-3, stiffness: 1.0e5, radius: 1.0e-5}",
    "law.constraint_damping=!Poles {all: [-50.0]}",
    "law.gains.all=[-25.0]",
)


def pressing(*settings: str) -> Scenario:
    """The two-link arm that holds still on its wall and presses."""
    still = "references={tool.z: 0.3, wall.force: 20}"
    return two_link(still, *settings)


def two_link(*settings: str) -> Scenario:
    """The two-link arm on its wall in Drake's contact, at rest where its reference begins."""
    found = scenario("two_link_wall", *CONTACT, "duration=1.0", *settings)
    found.start.errors.clear()
    return found


@pytest.mark.slow
def test_robot_at_rest_is_pressed_in_by_force_over_stiffness():
    """phi = -lambda / k = -0.2 mm, less what a ball of 10 um rolls by.

    The law's model has the robot where it is not pressed in.
    """
    _, _, record = run_scenario(pressing())
    assert_allclose(record["constraint_force"][-1], 20.0, rtol=2e-4)
    assert_allclose(record["constraint_residual"][-1, 0], -20.0 / 1e5, atol=1e-6)
    assert_allclose(record["controlled_output"][-1, 1], record["constraint_force"][-1, 0])


@pytest.mark.parametrize(
    ("name", "tolerance"), [("wall_point_contact", 1e-9), ("wall_hydroelastic", 0.02)]
)
def test_contact_force_from_generalized_forces_is_that_of_drakes_results(name, tolerance):
    """While the tool slides: of a point to round-off; a patch has a torque as well."""
    loop, context, record = run_scenario(scenario(name, "duration=0.05"))
    own = loop.plant.GetMyContextFromRoot(context)
    assert record["state"][-1, 7:] @ record["state"][-1, 7:] > 1e-3
    found = loop.plant.GetOutputPort("contact_force").Eval(own)
    results = loop.plant.GetOutputPort("contact_results").Eval(own)
    points, patches = results.num_point_pair_contacts(), results.num_hydroelastic_contacts()
    forces = [results.point_pair_contact_info(i).contact_force() for i in range(points)]
    forces += [
        results.hydroelastic_contact_info(i).F_Ac_W().translational() for i in range(patches)
    ]
    (total,) = forces  # Of one contact, on one of the two bodies.
    total = total * np.sign(total @ found)
    assert np.linalg.norm(total) > 1.0
    assert_allclose(found, total, rtol=0.0, atol=tolerance)


def test_contact_forces_of_several_model_instances_are_those_of_drakes_results():
    """Of two arms that fall onto two tables: to round-off of 100 N, on one of the two bodies."""
    links = two_arms_plant()
    at = links.CreateDefaultContext()
    links.SetPositions(at, NOMINAL)
    tables = []
    for side in ("left", "right"):
        tool = links.GetFrameByName("tool", links.GetModelInstanceByName(side))
        table = dd.Plane(point=tool.CalcPoseInWorld(at).translation(), normal=(0, 0, 1))
        tables.append(dd.PointOnSurface(f"{side}::tool", table, name=side, friction=0.3))
    model = dd.RobotModel.from_multibody(links, tables, nominal_positions=NOMINAL)
    structure = find_constraint_structure(model.dae)
    material = dd.ContactMaterial(time_step=1e-3, stiffness=1e5)
    plant = dd.ContactPlant(model, add_two_arms, material, structure=structure)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, 3.0 * np.sin(np.arange(14)))
    plant.set_consistent_state(context, model.dae.nominal_state)
    Simulator(plant, context).AdvanceTo(0.02)
    results = plant.GetOutputPort("contact_results").Eval(context)
    found = plant.GetOutputPort("contact_force").Eval(context).reshape(2, 3)
    infos = map(results.point_pair_contact_info, range(results.num_point_pair_contacts()))
    wanted = np.array([info.contact_force() for info in infos])
    assert_allclose(np.abs(found), np.abs(wanted), rtol=0.0, atol=1e-9)
    assert found[:, 2].min() > 5.0


@pytest.mark.slow
def test_force_tends_to_that_of_the_ideal_constraint():
    """First order in 1/k: twice the stiffness and half the step leave half of the difference.

    Measured ratios are 2.05 and 1.93. Another such pair gives 1.98, and over a longer run, up to
    4e5 N/m and 25 us, a fourfold stiffness gives 4.32 and 4.05, and less than 2e-3 N is left.
    """
    differences = []
    for stiffness, step in ((1.25e4, 8e-4), (2.5e4, 4e-4), (5e4, 2e-4)):
        settings = f"plant.stiffness={stiffness}", f"plant.time_step={step}", "duration=0.4"
        _, _, record = run_scenario(two_link(*settings))
        late = record.time > 0.3
        error = record["constraint_force"][late, 0] - record["desired_output"][late, 1]
        differences.append(np.sqrt(np.mean(error**2)))
    ratios = [coarse / fine for coarse, fine in pairwise(differences)]
    assert_allclose(ratios, 2.0, rtol=0.06)
    assert differences[-1] < 0.04


@pytest.mark.slow
def test_shipped_wall_is_tracked_by_a_law_that_does_not_know_its_friction():
    """The circle at 0.1 m/s with 20 + 5 sin 2t N: 0.02 mm and 0.03 N rms after 2 s, at 1 kHz.

    Measured 0.007 mm and 0.017 N; what is left is for other versions of Drake.
    """
    loop, _, record = run_scenario(scenario("wall_point_contact", "duration=3.0"))
    late = record["tracking_error"][record.time > 2.0]
    assert np.sqrt(np.mean(np.sum(late[:, :2] ** 2, axis=1))) < 2e-5
    assert np.sqrt(np.mean(late[:, -1] ** 2)) < 0.03
    # Nothing but the ball and the wall touches.
    assert record["constraint_force"].min() >= 0.0
    assert loop.plant.time_step == 1e-3
    assert_allclose(record["friction"][[0, -1], 0], [0.0, 0.3], atol=1e-3)
    assert "disturbance" in record.signals


@pytest.mark.parametrize("sphere", [None, 0.05])
def test_the_stiffness_of_a_hydroelastic_contact_is_drakes(sphere):
    """k = dF/dd = 2 F / d of a ball at rest in Drake's plane or sphere, for a force like d^2.

    A mesh with edges of 3 mm: the forces are 8 % off those of the round bodies at most.
    """
    material = dd.ContactMaterial(1e-3, contact_model="hydroelastic", modulus=1e6, radius=0.02)
    depth = 1e-3
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.02))
    round_form = geometry.Sphere(material.radius)
    own, other = proximity(material, 0.0), geometry.ProximityProperties()
    if sphere is None:
        other = proximity(material, 0.0, geometry.HalfSpace())
    else:
        geometry.AddCompliantHydroelasticProperties(sphere / 16.0, material.modulus, other)
        geometry.AddContactMaterial(1.0, None, CoulombFriction(0.0, 0.0), other)
    plant.RegisterCollisionGeometry(ball, RigidTransform(), round_form, "ball", own)
    form = geometry.HalfSpace() if sphere is None else geometry.Sphere(sphere)
    at = RigidTransform([0.0, 0.0, 0.0 if sphere is None else -sphere])
    plant.RegisterCollisionGeometry(plant.world_body(), at, form, "surface", other)
    plant.Finalize()
    diagram = builder.Build()
    whole = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(whole)
    height = RigidTransform([0.0, 0.0, material.radius - depth])
    plant.SetFreeBodyPose(context, ball, height)
    results = plant.get_contact_results_output_port().Eval(context)
    force = abs(results.hydroelastic_contact_info(0).F_Ac_W().translational()[2])
    assert material.stiffness_at(force, sphere) == pytest.approx(2.0 * force / depth, rel=0.08)


NEAR = (
    "references={tool.z: !Sinusoids {offset: 0.4, amplitudes: [0.1], frequencies: [1.0]}, "
    "wall.force: 20}"
)


@pytest.mark.slow
def test_a_curved_surface_is_a_mesh_in_hydroelastic_contact():
    """Within 0.2 mm and 1 N of 20 N, by a law without integrals whose ball rolls by 10 mm.

    In point contact of `CompliantPlant` it is 0.1 mm and 0.5 N.
    """
    surface = '!ImplicitSurface {function: "1.2 + 0.01*sin(20*z) - x"}'
    settings = ("plant.contact_model=hydroelastic", "plant.modulus=1.0e8", "plant.radius=0.01")
    _, _, record = run_scenario(
        two_link(f"constraints.0.surface={surface}", *settings, "plant.piece=0.6", NEAR)
    )
    late = record["tracking_error"][record.time > 0.8]
    assert np.abs(late[:, 0]).max() < 1e-3
    assert np.abs(late[:, 1]).max() < 1.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["plant.stiffness=-1.0"], "stiffness"),
        (["plant.friction=-0.1"], "friction"),
        (
            [
                "actuation=[!FlexibleJoints {stiffness: 8000, inertia: 0.5}]",
                "law.gains={all: [-4]}",
            ],
            "CompliantPlant",
        ),
        (["robot.known_forces=[{frame: tool}]"], r"robot.known_forces.*plant.disturbances"),
        (["plant.parameters={link1.mas: [1.0]}"], r"'link1\.mas'"),
        (["constraints.0.surface=!Sphere {center: [0, 0, 0], radius: 1.3, inside: true}"], "wall"),
        (
            [
                "constraints.0.surface=!Cylinder {point: [1, 0, 0], axis: [0, 0, 1], radius: 0.2}",
                "plant.contact_model=hydroelastic",
                "plant.piece=0.02",
            ],
            r"wall: .*0.02.*0.01",
        ),
        (["plant.contact_model=hydroelastic", "plant.piece=-1"], "piece"),
    ],
)
def test_what_drakes_contact_cannot_be_is_refused(settings, message):
    with pytest.raises(ScenarioError, match=message):
        dd.build_scenario(two_link(*settings))


def test_delay_below_a_step_of_the_plant_is_refused():
    with pytest.raises((ScenarioError, WiringError), match=r"delay.*0\.001"):
        dd.build_scenario(two_link("sampling={period: 1.0e-3}"))
