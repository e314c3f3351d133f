"""Derivatives of rollouts against a closed form, and against differences in more digits."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Integrator
from runs import scenario

from drake_dae import build_scenario, rollout, rollout_gradient, rollout_tangent, start_values
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError
from drake_dae.running.rollout.program import program_of
from drake_dae.running.rollout.run import FIXED as SCHEMES
from drake_dae.running.rollout.stepping.many import UFUNCS

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
    "compiled=false",
]


def problem(name, *settings):
    chosen = scenario(name, *settings, *FIXED)
    loop, context = build_scenario(chosen)
    return loop, *start_values(loop, context), chosen.integrator


def test_the_error_of_a_law_has_the_derivative_of_its_closed_form():
    """e' = (A - B K) e (30), so that e(T) = expm(T (A - B K)) e(0).

    By the start along N*, and by the gains, to 1e-7: 300 steps of third order are off by 1e-9.
    """
    loop, start, parameters, config = problem("two_link_wall", "start.errors.tool.z=0.05")
    law, end = loop.controller.law, 0.3
    times = np.array([0.0, end])
    weights = {"controlled_output": [[0.0, 0.0], [1.0, 0.0]]}
    found = rollout_gradient(loop, start, parameters, times, weights, config=config)
    first, second = (k for k in parameters[-2:])
    assert (first, second) == (16.0, 8.0)
    matrix = np.array([[0.0, 1.0], [-first, -second]])
    reference = loop.reference.reference(0.0)
    begin = law.error_coordinates(start, reference)
    for entry, gradient in enumerate(found.parameters[-2:]):
        change = np.array([[0.0, 0.0], [-1.0, 0.0] if entry == 0 else [0.0, -1.0]])
        wanted = scipy.linalg.expm_frechet(end * matrix, end * change, compute_expm=False) @ begin
        assert gradient == pytest.approx(wanted[0], abs=1e-7)
    slopes = loop.plant.structure.manifold.gradients(start)
    for along in scipy.linalg.null_space(slopes).T:
        step = 1e-4
        ends = [law.error_coordinates(start + h * along, reference) for h in (step, -step)]
        wanted = scipy.linalg.expm(end * matrix) @ ((ends[0] - ends[1]) / (2.0 * step))
        assert found.start @ along == pytest.approx(wanted[0], abs=1e-7)
    # What leaves N* is projected away at once.
    for across in slopes:
        assert abs(found.start @ across) < 1e-12 * np.linalg.norm(across)


def precise(function, *arguments):
    """The first result of a CasADi function in numbers of 64 bits, as NumPy has them on x86."""
    work = {}
    found = [np.zeros(function.numel_out(i), dtype=np.longdouble) for i in range(function.n_out())]
    for i in range(function.n_instructions()):
        code, given = function.instruction_id(i), function.instruction_input(i)
        into = function.instruction_output(i)
        if code == ca.OP_OUTPUT:
            found[into[0]][into[1]] = work[given[0]]
        elif code == ca.OP_CONST:
            work[into[0]] = np.longdouble(function.instruction_constant(i))
        elif code == ca.OP_INPUT:
            work[into[0]] = np.longdouble(np.atleast_1d(arguments[given[0]])[given[1]])
        else:
            result = np.zeros((), dtype=np.longdouble)
            UFUNCS[code](*(work[j] for j in given), result)
            work[into[0]] = result[()]
    return found[0]


def precise_outputs(program, start, parameters, times, step):
    """The last row of a run without samples, by steps of third order in more digits."""
    compiled, (a, b, c) = program.compiled, SCHEMES["runge_kutta3"]
    project, x, held = compiled.newton(2), np.array(start, dtype=np.longdouble), np.zeros(0)
    count = round((times[-1] - times[0]) / step)
    for k in range(count):
        time = np.longdouble(times[0] + (times[-1] - times[0]) * (k / count))
        x, rates = precise(project, time, x, held, parameters), []
        for row, part in zip(a, c, strict=True):
            stage = x + step * sum(w * r for w, r in zip(row, rates, strict=False))
            rates.append(precise(compiled.rate, time + part * step, stage, held, parameters))
        x = x + step * sum(w * r for w, r in zip(b, rates, strict=True))
    x = precise(project, times[-1], x, held, parameters)
    return precise(compiled.row, times[-1], x, held, parameters)


@pytest.mark.slow
@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="no numbers of more digits")
def test_it_is_the_limit_of_differences_in_more_digits():
    """To 1e-12 of the gradient: of fourth order, steps of 1e-4 leave 1e-15 and round-off 1e-14.

    Of forces and controls, too, by the start across N*, by masses of the plant and of the law's
    model, and by the gains.
    """
    loop, start, parameters, config = problem("two_link_wall", "start.errors.tool.z=0.05")
    program, times = program_of(loop), np.array([0.0, 0.005])
    random = np.random.default_rng(0)
    (run,) = rollout(loop, start, parameters, times, config=config)
    weights = {
        name: np.vstack([np.zeros(run.record[name].shape[1]), random.normal(size=(1, each))])
        for name, each in (("constraint_force", 1), ("control", 2), ("state", 4))
    }
    found = rollout_gradient(loop, start, parameters, times, weights, config=config)
    stops = np.cumsum([0, *map(len, program.signals.values())])
    places = dict(zip(program.signals, stops, strict=False))

    def cost(point, values):
        row = precise_outputs(program, point, values, times, np.longdouble(1e-3))
        return sum(each[1] @ row[places[name] :][: each.shape[1]] for name, each in weights.items())

    for size, gradient in ((start.size, found.start), (parameters.size, found.parameters)):
        along = random.normal(size=size) * (1.0 if size == start.size else 0.1 * parameters)
        differences = []
        for step in (1e-4, 2e-4):
            ends = [
                cost(start + h * along, parameters)
                if size == start.size
                else cost(start, parameters + h * along)
                for h in (np.longdouble(step), np.longdouble(-step))
            ]
            differences.append((ends[0] - ends[1]) / (2.0 * step))
        wanted = float((4.0 * differences[0] - differences[1]) / 3.0)
        assert gradient @ along == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("two_link_wall", ["sampling={period: 0.002, delay: 0.001}"]),
        pytest.param(
            "two_link_measured_force",
            ["force_feedback=!MeasuredForce {sample_period: 0.003, noise_deviation: 0.1}"],
            marks=pytest.mark.slow,
        ),
        pytest.param("seven_joint_wall", [], marks=pytest.mark.slow),
    ],
)
def test_backward_and_forward_agree(name, settings):
    """To 1e-11 of their value: they add the same products in another order."""
    loop, start, parameters, config = problem(name, *settings)
    times, random = np.linspace(0.0, 0.02, 5), np.random.default_rng(0)
    signals = program_of(loop).signals
    weights = {name: random.normal(size=(5, len(each))) for name, each in signals.items()}
    found = rollout_gradient(loop, start, parameters, times, weights, config=config, seed=3)
    assert found.run.failure is None
    changes = random.normal(size=start.size), random.normal(size=parameters.size) * parameters
    tangent = rollout_tangent(loop, start, parameters, times, *changes, config=config, seed=3)
    wanted = sum((weights[name] * tangent[name]).sum() for name in signals)
    assert found.start @ changes[0] + found.parameters @ changes[1] == pytest.approx(wanted, 1e-11)


def test_samples_are_part_of_it():
    """By differences of rollouts, to 1e-6: of second order, with steps of 1e-5."""
    settings = ["sampling={period: 0.01, delay: 0.005}", "start.errors.tool.z=0.05"]
    loop, start, parameters, config = problem("two_link_wall", *settings)
    times = np.linspace(0.0, 0.1, 3)
    change = np.zeros(parameters.size)
    change[-2:] = 3.0, -2.0
    tangent = rollout_tangent(
        loop, start, parameters, times, parameter_change=change, config=config
    )
    ends = [
        rollout(loop, start, parameters + h * change, times, config=config)[0].record
        for h in (1e-5, -1e-5)
    ]
    for name in ("state", "control"):
        wanted = (ends[0][name] - ends[1][name]) / 2e-5
        scale = np.abs(wanted).max()
        assert scale > 1e-3
        np.testing.assert_allclose(tangent[name], wanted, rtol=0.0, atol=1e-6 * scale)


def test_of_an_integral_it_is_the_time():
    """x(T) = x(0) + T u, exactly, where u is the parameter of a source of Drake's."""
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource([0.5, -1.0]))
    integrator = builder.AddSystem(Integrator(2))
    builder.Connect(source.get_output_port(), integrator.get_input_port())
    builder.ExportOutput(integrator.get_output_port(), "x")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    config = SimulatorConfig(integration_scheme="runge_kutta2", use_error_control=False)
    weights = {"x": [[0.0, 0.0], [1.0, 0.0]]}
    found = rollout_gradient(diagram, start, parameters, [0.0, 3.0], weights, config=config)
    np.testing.assert_allclose(found.start, [1.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(found.parameters, [3.0, 0.0], atol=1e-13)


@pytest.mark.slow
def test_what_has_no_gradient_is_refused():
    loop, start, parameters, config = problem("two_link_wall")
    given, weights = (loop, start, parameters, [0.0, 0.01]), {"state": np.zeros((2, 4))}
    accurate = scenario("two_link_wall").integrator
    for arguments, settings, told in (
        ((*given, weights), accurate, "a gradient is that of fixed steps: choose"),
        ((*given, {"sate": [1.0]}), config, "'sate'"),
        ((*given, {"state": [1.0]}), config, r"must have the shape \(2, 4\)"),
        ((loop, [start, start], *given[2:], weights), config, "one run, got 2 starts"),
    ):
        with pytest.raises(ModelError, match=told):
            rollout_gradient(*arguments, config=settings)
    with pytest.raises(ModelError, match=r"start_change must have shape \(4,\)"):
        rollout_tangent(*given, [1.0], config=config)
    with pytest.raises(InconsistentStateError):
        rollout_gradient(loop, start + 0.1, *given[2:], weights, config=config)
    opening, start, parameters, config = problem("two_link_wall", "plant=!Unilateral {}")
    with pytest.raises(ModelError, match="has no gradient: a block changes"):
        rollout_tangent(opening, start, parameters, [0.0, 0.01], config=config)
    stiff, start, parameters, config = problem("two_link_wall", "gains.all=[-4000]")
    config.max_step_size = 0.01
    with pytest.raises(SimulationError):
        rollout_tangent(stiff, start, parameters, [0.0, 3.0], config=config)
