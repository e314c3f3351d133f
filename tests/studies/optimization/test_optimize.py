"""Optima against closed forms, and derivatives against differences of runs."""

import signal
from itertools import count

import casadi as ca
import numpy as np
import pytest
from arms import arm, law
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator
from runs import scenario

from drake_dae import (
    DaePlant,
    DaeSystem,
    ExpressionReference,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    build_scenario,
    make_closed_loop,
    optimize,
    poles,
    rollout,
    simulate,
    start_values,
)
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.rollout.program import program_of
from drake_dae.studies.optimization.loop_runs import LoopRuns
from drake_dae.studies.optimization.variables import chosen_variables

FIXED = SimulatorConfig(
    integration_scheme="runge_kutta3", use_error_control=False, max_step_size=5e-3
)

GAINS = {"gains.tool.z": (1.0, 400.0)}


def two_link(*settings):
    chosen = scenario("two_link_wall", "start.errors.tool.z=0.05", "compiled=false", *settings)
    return build_scenario(chosen)


def error(run):
    return ca.sumsqr(run["tracking_error", "tool.z"])


def found(loop, context, end=0.1, **given):
    times = np.linspace(0.0, end, 21)
    asked = {"free": GAINS, "cost": error, "config": FIXED, **given}
    return optimize(loop, context, asked.pop("times", times), **asked)


def pressed_mass():
    """A mass of 1 kg on the plane y = 0, pushed along it and onto it, at 1 m with 0.5 m/s."""
    dae = DaeSystem.from_functions(
        ["x", "y", "vx", "vy"],
        f=lambda s: [s[2], s[3], 0.0, -9.81],
        g=lambda s: [0.0, 0.0, 0.0, 1.0],
        h=lambda s: [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
        k=lambda s: [s[1]],
        l=lambda s: [s[0], 0.0],
        m=lambda s: [[0.0], [1.0]],
        nominal_state=[1.0, 0.0, 0.5, 0.0],
    )
    tracking = TrackingLaw(dae, poles(-2.0))
    loop = make_closed_loop(
        DaePlant(dae),
        tracking,
        [SinusoidReference(0.0, 0.0, 1.0), SinusoidReference(9.0, 0.0, 1.0)],
    )
    context = loop.diagram.CreateDefaultContext()
    loop.set_state(context, dae.nominal_state)
    return loop, context


@pytest.mark.slow
def test_gains_of_least_quadratic_cost_are_those_of_the_riccati_equation():
    """Of x'' = u and the integral of x^2 + rho u^2 they are rho^(-1/2) and sqrt(2) rho^(-1/4).

    To 2e-4: the sum of rows 0.01 s apart, weighted by Simpson's rule, is off by 1e-8 of the
    integral, about whose least value the gains are flat.
    """
    loop, context = pressed_mass()
    rho, times = 0.25, np.linspace(0.0, 8.0, 801)
    weights = ca.DM([1.0, *(4.0 if k % 2 else 2.0 for k in range(1, 800)), 1.0])
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", use_error_control=False, max_step_size=1e-2
    )

    def cost(run):
        return ca.dot(weights, run["state", "x"] ** 2 + rho * run["control"][:, 0] ** 2)

    free = {"gains.z0": (0.1, 50.0)}
    result = optimize(loop, context, times, free, cost, config=config)
    assert result.converged
    assert result.active == ()
    assert not result.without_effect
    np.testing.assert_allclose(result.values, [rho**-0.5, 2.0**0.5 * rho**-0.25], rtol=2e-4)
    assert result.cost < result.cost_before


def test_of_a_drake_diagram():
    """x(3) = 3 u is 6 at u = 2, exactly, and at most 4.5 where u is at most 1.5."""
    builder = DiagramBuilder()
    source = builder.AddNamedSystem("source", ConstantVectorSource([0.5]))
    integrator = builder.AddSystem(Integrator(1))
    builder.Connect(source.get_output_port(), integrator.get_input_port())
    builder.ExportOutput(integrator.get_output_port(), "x")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()

    def best(high):
        return optimize(
            diagram,
            context,
            [0.0, 3.0],
            {"source": (0.0, high)},
            lambda run: (run["x"][-1, 0] - 6.0) ** 2,
            config=FIXED,
        )

    free, bounded = best(10.0), best(1.5)
    assert free["source"] == pytest.approx(2.0, abs=1e-5)
    assert free.active == ()
    assert bounded["source"] == pytest.approx(1.5, abs=1e-6)
    assert bounded.active == ("source",)


def test_derivatives_are_those_of_differences():
    """By the start off N*, a moved wall, masses, gains and parameters of references.

    To 1e-7 of the largest: differences of fourth order with steps of 1e-3 leave 1e-12, and
    round-off 1e-11.
    """
    chosen = arm("two_link")
    references = {
        "tool.z": ExpressionReference(lambda t, rise: 0.3 + rise * ca.sin(2 * t), {"rise": 0.2}),
        "wall.force": ExpressionReference(
            lambda t, push, rise: 20.0 + ca.dot(push, ca.vertcat(t, rise)),
            {"push": [3.0, 10.0], "rise": 0.2},
        ),
    }
    loop = make_closed_loop(
        RobotPlant(chosen.model, structure=chosen.structure), law("two_link"), references
    )
    context = loop.diagram.CreateDefaultContext()
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), chosen.model.dae.nominal_state
    )
    start, parameters = start_values(loop, context)
    free = dict.fromkeys(
        ("start.joint1", "link2.mass", "plant.link1.mass", "gains.tool.z", "wall.position[0]"),
        (None, None),
    ) | dict.fromkeys(("rise", "push"), (-20.0, 20.0))
    free["link2.mass"] = free["plant.link1.mass"] = (1.0, 20.0)
    variables = chosen_variables(program_of(loop).compiled, start, parameters, free)
    times = np.linspace(0.0, 0.05, 3)
    trials = LoopRuns(loop, start, parameters, variables, times, FIXED, None)
    begin = np.array([one.start for one in variables])
    names = ("state", "control", "constraint_force", "reference")
    derivatives = trials.changes(begin, names)
    assert [one.name for one in variables][-3:] == ["rise", "push[0]", "push[1]"]
    for i in range(begin.size):
        h = 1e-3 * max(1.0, abs(begin[i]))
        records = {
            k: trials.run(begin + k * h * np.eye(begin.size)[i]).record for k in (-2, -1, 1, 2)
        }
        for name in names:
            near, far = (records[k][name] - records[-k][name] for k in (1, 2))
            wanted = (8.0 * near - far) / (12.0 * h)
            scale = np.abs(derivatives[name]).max()
            np.testing.assert_allclose(derivatives[name][i], wanted, rtol=0.0, atol=1e-7 * scale)


def test_the_context_of_the_result_runs_as_it_says():
    """In Drake's Simulator, with parameters of references, to the round-off of the same steps."""
    chosen = arm("two_link")
    references = {
        "tool.z": 0.3,
        "wall.force": ExpressionReference(lambda t, push: 20.0 + push * t, {"push": 5.0}),
    }
    loop = make_closed_loop(
        RobotPlant(chosen.model, structure=chosen.structure, feedback=True),
        law("two_link"),
        references,
    )
    context = loop.diagram.CreateDefaultContext()
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), chosen.model.dae.nominal_state
    )
    result = found(
        loop,
        context,
        free={"push": (0.0, 100.0), "wall.position[0]": (1.1, 1.3)},
        cost=lambda run: (
            ca.sumsqr(run["constraint_force"][-1, 0] - 24.0)
            + ca.sumsqr(run["wall.position"] - 1.15)
        ),
    )
    assert result["push"] == pytest.approx(40.0, abs=1e-3)
    assert result["wall.position[0]"] == pytest.approx(1.15, abs=1e-5)
    simulate(loop.diagram, result.context, 0.1, FIXED)
    record = loop.record(result.context)
    np.testing.assert_allclose(record["constraint_force"][-1], 24.0, atol=1e-4)
    for name in ("state", "reference", "tracking_error", "control"):
        np.testing.assert_allclose(record[name][-1], result.run.record[name][-1], atol=1e-8)


def test_a_start_is_brought_to_the_manifold():
    loop, context = two_link()
    result = found(loop, context, free={"start.joint1": (0.0, 2.0)})
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(result.context))
    assert result["start.joint1"] == state[0]
    assert np.abs(loop.plant.structure.manifold.residual(state)).max() < 1e-12
    assert result.cost < 0.6 * result.cost_before


@pytest.mark.slow
def test_limits_hold_and_are_named():
    loop, context = two_link()
    result = found(
        loop,
        context,
        end=1.0,
        more={"peak": 200.0},
        cost=lambda run: run["peak"],
        limits=lambda run: {
            "torque": (None, ca.fabs(run["control"]) - run["peak"], 0.0),
            "error": (-2e-3, run["tracking_error", "tool.z"][15:], 2e-3),
            "force": (5.0, run["constraint_force"], None),
        },
    )
    record = result.run.record
    assert result.converged
    assert result.violated == ()
    assert np.abs(record["control"]).max() <= result["peak"] * (1.0 + 1e-5)
    assert np.abs(record["tracking_error"][15:, 0]).max() <= 2e-3 * (1.0 + 1e-5)
    assert result.active[:2] == ("torque", "error")
    assert "force" not in result.active
    # Not even a tenth less torque leaves as little error: gains on a grid about the optimum.
    start, parameters = start_values(loop, context)
    for first in np.linspace(20.0, 120.0, 6):
        for second in np.linspace(4.0, 20.0, 6):
            own = np.append(parameters[:-2], [first, second])
            (run,) = rollout(loop, start, own, result.run.record.time, config=FIXED)
            late = np.abs(run.record["tracking_error"][15:, 0]).max()
            assert late > 2e-3 or np.abs(run.record["control"]).max() > 0.999 * result["peak"]


def test_limits_that_cannot_be_met_are_said_with_the_nearest():
    loop, context = two_link()
    result = found(
        loop, context, limits=lambda run: {"torque": (-1.0, run["control"], 1.0)}, iterations=20
    )
    assert not result.converged
    assert result.violated == ("torque",)
    assert "Limit torque is not met: beyond it by" in result.text()
    before = np.abs(result.run.record["control"]).max() - 1.0
    assert result.limits[0].violation == pytest.approx(before)


def test_an_interrupted_search_has_the_best_so_far():
    class Seeds(dict):
        """Asks for the end at the fifth run."""

        runs = count()

        def values(self):
            if next(self.runs) == 8:
                signal.raise_signal(signal.SIGINT)
            return super().values()

    loop, context = two_link()
    result = found(loop, context, seed=Seeds())
    assert result.interrupted is signal.SIGINT
    assert not result.converged
    assert result.cost < result.cost_before
    assert result.runs < 10
    assert "The search was interrupted; this is the best so far." in result.text()


def test_what_changes_nothing_is_named_and_stays():
    loop, context = two_link()
    result = found(loop, context, free={**GAINS, "wall.position[1]": (-1.0, 1.0)})
    assert result.without_effect == ("wall.position[1]",)
    assert result["wall.position[1]"] == 0.0
    assert "Without effect on cost and limits, left as before: wall.position[1]" in result.text()


@pytest.fixture(scope="module")
def once():
    """The two links, for tests that change nothing."""
    return two_link()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"free": {"gain.tool.z": (1, 2)}}, "did you mean 'gains.tool.z'"),
        ({"free": {}}, "free must name a variable"),
        ({"free": {"link1.mass[2]": (1, 2)}}, "is one number"),
        ({"free": {"wall.position[3]": (1, 2)}}, "has 3 entries, counted from 0, and no entry 3"),
        ({"free": {"link1.mass": (0, 20)}}, "must be above 0"),
        ({"free": {"gains.tool.z": (-1, 20)}}, "must be at least 0"),
        ({"free": {"link1.mass": (1, 2)}}, "begins with 12, outside of its bounds 1 and 2"),
        ({"free": {"link1.mass": (20, 1)}}, "a lower and a larger number"),
        ({"free": {"link1.mass": (5, 20), "plant.link1.mass": (5, 20)}}, "names one number twice"),
        ({"cost": lambda run: 1.0}, "the cost does not depend on the run"),
        ({"cost": lambda run: run["control"]}, r"must be one number, got shape \(21, 2\)"),
        ({"cost": lambda run: run["contrl"]}, "did you mean 'control'"),
        ({"cost": lambda run: run["control", "elbow"]}, "no entry of control 'elbow'"),
        ({"cost": lambda run: run[3]}, "a run has the names of signals"),
        ({"cost": lambda run: 1 / 0}, "cost failed: ZeroDivisionError"),
        ({"cost": lambda run: "x"}, "must be a CasADi expression of the run"),
        ({"cost": lambda run: ca.sumsqr(run["reference"])}, "does not depend on what is free"),
        ({"cost": lambda run: ca.log(-error(run))}, "the cost is not finite at the initial guess"),
        (
            {"limits": lambda run: {"odd": (0, ca.log(-error(run)), None)}},
            "limit 'odd' is not finite at the initial guess",
        ),
        ({"cost": lambda run: ca.sqrt(run["peak"]), "more": {"peak": 0.0}}, "no finite derivative"),
        ({"limits": lambda run: 3}, "limits must return a mapping"),
        ({"limits": lambda run: {"a": (1, run["control"])}}, "must be .least value, expression"),
        ({"limits": lambda run: {"a": (1, run["control"], 0)}}, "above its largest 0"),
        ({"limits": lambda run: {"a": (None, run["control"], None)}}, "bounds nothing"),
        ({"limits": lambda run: {"a": ([1, 2, 3], run["control"], None)}}, "the shape"),
        ({"more": {"gains.tool.z[0]": 1.0}}, "is a number of the loop"),
        ({"config": scenario("two_link_wall").integrator}, "a gradient is that of fixed steps"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(given, told, once):
    loop, context = once
    with pytest.raises(ModelError, match=told):
        found(loop, context, **given)


def test_other_numbers_in_plant_and_law_need_a_name_for_one():
    loop, context = two_link("plant_parameters.link1.mass=13")
    with pytest.raises(ModelError, match="different values in the plant and in the law, 12 and 13"):
        found(loop, context, free={"link1.mass": (5.0, 20.0)})
    result = found(loop, context, free={"law.link1.mass": (5.0, 20.0)}, end=0.3)
    assert result["law.link1.mass"] == pytest.approx(13.0, abs=0.2)


def test_contacts_that_open_have_no_gradient():
    loop, context = two_link("plant=!Unilateral {}")
    with pytest.raises(ModelError, match="has no gradient: a block changes"):
        found(loop, context)


def test_a_run_that_fails_with_the_first_values_is_an_error():
    loop, context = two_link()
    own = loop.controller.GetMyMutableContextFromRoot(context)
    parameters = own.get_mutable_numeric_parameter(0)
    parameters.SetFromVector([*parameters.CopyToVector()[:-2], 4e6, 4e5])
    with pytest.raises(SimulationError, match="not finite"):
        found(loop, context, end=3.0, free={"gains.tool.z": (1.0, 1e7)})


@pytest.mark.slow
def test_runs_that_fail_on_the_way_are_avoided():
    """Gains beyond 2 / 5 ms make steps of 5 ms unstable; the search goes on with lower ones."""
    loop, context = two_link()
    result = found(loop, context, end=0.5, free={"gains.tool.z": (1.0, 1e6)}, iterations=15)
    assert result.cost < result.cost_before
    assert np.isfinite(result.cost)
    assert result.run.failure is None


@pytest.mark.slow
def test_of_compliant_contact_derivatives_are_those_of_differences():
    """Of Drake's discrete point contact, traced, with observer and force sensor, at 1 kHz.

    To 1e-6 of the largest: differences of second order, with steps of 1e-5, leave 1e-8.
    """
    chosen = scenario(
        "wall_point_contact",
        "plant=!CompliantContact {stiffness: 1.0e5, friction: 0.3}",
        "compiled=false",
    )
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    free = {"gains.tool.y": (0.0, None), "plant.friction": (0.0, 1.0), "tool.mass": (0.1, 3.0)}
    variables = chosen_variables(program_of(loop).compiled, start, parameters, free)
    times = np.linspace(0.0, 0.03, 4)
    trials = LoopRuns(loop, start, parameters, variables, times, FIXED, None)
    begin = np.array([one.start for one in variables])
    derivatives = trials.changes(begin, ["state", "control"])
    for i in range(begin.size):
        step = 1e-5 * max(1.0, abs(begin[i])) * np.eye(begin.size)[i]
        ends = [trials.run(begin + each).record for each in (step, -step)]
        for name, own in derivatives.items():
            wanted = (ends[0][name] - ends[1][name]) / (2.0 * step[i])
            scale = np.abs(wanted).max()
            np.testing.assert_allclose(own[i], wanted, rtol=0.0, atol=1e-6 * scale)


def test_what_is_raised_within_the_search_comes_out():
    """CasADi loses exceptions of the functions that it calls; neither kind of them is lost."""

    class Seeds(dict):
        """Fails at some run: of a value, or of derivatives."""

        def __init__(self, last):
            super().__init__()
            self.left = last

        def values(self):
            self.left -= 1
            if not self.left:
                raise ZeroDivisionError
            return super().values()

    loop, context = two_link()
    for last in (8, 9, 10, 11):
        with pytest.raises(ZeroDivisionError):
            found(loop, context, seed=Seeds(last))
