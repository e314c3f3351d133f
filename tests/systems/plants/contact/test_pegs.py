"""Pegs and plates in Drake's contact: forces of many balls, edges, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.systems.analysis import Simulator
from runs import run_scenario, scenario

from drake_dae import CompliantPlant, PointMaterial, build_scenario
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.systems.plants.contact.contact_material import ContactMaterial, Peg

PRESSES = (
    "constraint_damping=!Poles {all: [-50.0]}",
    "gains.all=[-25.0]",
    "references={tool.z: 0.3, wall.force: 20}",
    "start.errors={}",
    "duration=0.6",
)
PEG = "{constraint: wall, radius: 0.01, length: 0.05, balls: 6}"


def pressing(material: str):
    return scenario("two_link_wall", *PRESSES, f"plant=!MultibodyPlant {{{material}}}")


@pytest.mark.slow
def test_a_peg_that_stands_flat_is_as_stiff_as_its_balls():
    """Six balls share 20 N: phi = -20 / (6 k). A ball alone goes six times as deep."""
    still = (
        "references={tool.y: 0, tool.z: 0.6, tool.z_axis: 0, joint3: 0, joint7: 0, wall.force: 20}"
    )
    depths = []
    for pegs in ("[]", f"[{PEG}]"):
        plant = f"plant=!MultibodyPlant {{stiffness: 1.0e5, radius: 1.0e-3, pegs: {pegs}}}"
        chosen = scenario("wall_point_contact", *PRESSES[:2], still, "duration=0.3", plant)
        _, _, record = run_scenario(chosen)
        assert_allclose(record["constraint_force"][-1], 20.0, rtol=1e-3)
        depths.append(-record["constraint_residual"][-1, 0])
    assert_allclose(depths, [20.0 / 1e5, 20.0 / 6e5], rtol=0.01)


def test_the_balls_of_a_peg_are_within_it():
    """Its hull: rings from its end to its length, as wide as its radius."""
    centers = Peg("wall", 0.01, 0.05, rings=4, balls=6).centers(0.002)
    assert centers.shape == (24, 3)
    assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 0.008)
    assert_allclose(np.unique(centers[:, 2].round(12)), [-0.048, -0.098 / 3, -0.052 / 3, -0.002])
    turned = Peg("wall", 0.01, 0.05, (2.0, 0.0, 0.0), 4, 6).centers(0.002)
    assert_allclose(np.unique(turned[:, 0].round(12)), np.unique(centers[:, 2].round(12)))


@pytest.mark.parametrize(
    ("peg", "problem"),
    [
        ("{constraint: hole, radius: 0.01, length: 0.05}", "pegs: .*'hole'.*wall"),
        ("{constraint: wall, radius: 0.0009, length: 0.05}", "no room for balls with a radius"),
        ("{constraint: wall, radius: 0.01, length: 0.05, balls: 2}", "3 or more balls"),
        ("{constraint: wall, radius: -0.01, length: 0.05}", "peg: radius must be positive"),
    ],
)
def test_a_peg_that_makes_no_sense_is_refused(peg, problem):
    with pytest.raises(DrakeDaeError, match=problem):
        build_scenario(pressing(f"radius: 1.0e-3, pegs: [{peg}]"))


def test_pegs_need_room_in_python_too():
    with pytest.raises(ModelError, match="no room"):
        ContactMaterial(radius=0.01, pegs=[Peg("wall", 0.005, 0.05)])


def test_a_plate_has_no_hydroelastic_contact():
    """Its pieces would press with seams between them."""
    surface = "constraints.0.surface=!Plate {point: [1.2, 0, 0.3], normal: [-1, 0, 0]}"
    plant = "plant=!MultibodyPlant {contact_model: hydroelastic}"
    with pytest.raises(DrakeDaeError, match="hydroelastic contact has no edges"):
        build_scenario(scenario("two_link_wall", *PRESSES, surface, plant))


SLIDES = (
    "constraints.0.surface=!Plate {point: [1.2, 0, 0.3], normal: [-1, 0, 0], "
    "half_widths: [1, 0.05]}",
    "constraint_damping=!Poles {all: [-20.0]}",
    "gains.all=[-25.0]",
    "references={tool.z: !PointToPoint {start: [0.3], end: [0.42], end_time: 0.6}, wall.force: 20}",
    "plant=!MultibodyPlant {stiffness: 1.0e5, radius: 0.002}",
    "start.errors={}",
    "duration=0.65",
    "may_diverge=true",
)


@pytest.mark.slow
def test_a_tool_leaves_the_edge_of_a_plate_alike_on_both_compliant_plants():
    """Drake with convex pieces, and this library with the closed form of their distance.

    Drake's solver stops at 1e-6 of the forces, here 20 N, and errors grow while the ball rolls
    over the edge, by less than a factor of 100.
    """
    sliding = scenario("two_link_wall", *SLIDES)
    _, _, by_drake = run_scenario(sliding)
    contact = "plant=!CompliantContact {stiffness: 1.0e5, radius: 0.002}"
    completed, loop = build_completed(scenario("two_link_wall", *SLIDES, contact))
    rolled = roll_scenario(
        completed.scenario, loop, start_scenario(completed.scenario, loop)
    ).record
    forces = by_drake["constraint_force"][:, 0]
    edge = np.argmax(by_drake["controlled_output"][:, 0] > 0.3525)
    assert 200 < edge < 500
    assert forces[edge - 50] > 15.0  # It has pressed,
    assert not forces[edge:].any()  # and beyond the edge there is nothing.
    assert by_drake["constraint_residual"][-1, 0] < -0.001
    assert_allclose(rolled["constraint_force"][:, 0], forces, atol=2e-3)
    assert_allclose(rolled["state"], by_drake["state"], atol=1e-5)


EIGHT = "[{constraint: wall, radius: 0.005, length: 0.02, rings: 2, balls: 4}]"
"""Eight balls press with more forces than the robot has joints."""


@pytest.fixture(scope="module")
def plants():
    """Drake's plant and the traced one, on a plane."""
    plant = f"plant=!MultibodyPlant {{radius: 0.001, friction: 0.3, pegs: {EIGHT}}}"
    loop = build_completed(scenario("wall_point_contact", plant))[1]
    pegs = [Peg("wall", 0.005, 0.02, rings=2, balls=4)]
    material = PointMaterial(radius=0.001, friction=0.3, pegs=pegs)
    return loop.plant, CompliantPlant(loop.plant.robot("peg"), material)


def stepped(plant, state, control):
    context = plant.CreateDefaultContext()
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, control)
    Simulator(plant, context).AdvanceTo(0.5e-3)
    return plant.state(context), plant.GetOutputPort("contact_force").Eval(context)


@pytest.mark.slow
def test_a_step_of_a_peg_is_that_of_drakes_contact(plants):
    """Drake's solver stops at a relative residual of 1e-6; ours solves 24 equations as seven."""
    drakes, traced = plants
    random, size = np.random.default_rng(4), 7
    at_rest = traced.structure.manifold.project(traced.dae.nominal_state)
    pressed = 0
    for _ in range(30):
        speed = random.choice([1e-3, 0.1])
        state = at_rest + np.concatenate([random.normal(0, 2e-4, 7), random.normal(0, speed, 7)])
        control = random.normal(0.0, 20.0, 7)
        (found, force), (wanted, theirs) = (
            stepped(plant, state, control) for plant in (traced, drakes)
        )
        moved = np.abs(wanted[size:] - state[size:]).max()
        assert_allclose(found[size:], wanted[size:], rtol=0.0, atol=1e-5 * moved)
        assert_allclose(force, theirs, rtol=0.0, atol=1e-4 * max(1.0, np.abs(theirs).max()))
        pressed += bool(force.any())
    assert 8 < pressed < 30


def test_a_traced_peg_needs_its_constraint(plants):
    with pytest.raises(ModelError, match=r"pegs: .*'hole'.*wall"):
        CompliantPlant(plants[0].robot("peg"), PointMaterial(pegs=[Peg("hole", 0.02, 0.1)]))
