"""Rollouts against Drake's Simulator on the same closed loop."""

import re
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from runs import MANY_PIECES, both, close_records, mostly_compiled, run, scenario, some

from drake_dae import DaePlant, DaeSystem, build_scenario, rollout, simulate
from drake_dae.blocks import machine
from drake_dae.diagrams.parts import encoder_seed
from drake_dae.errors import InconsistentStateError, MachineCodeWarning, ModelError, SimulationError
from drake_dae.references.splines import UNROLLED
from drake_dae.running import start_values
from drake_dae.running.rollout import run_loop
from drake_dae.running.rollout_program import program_of
from drake_dae.scenario.build import roll_scenario

SAMPLED = "sampling={period: 0.03125}"


def fixed(scheme: str = "runge_kutta3", step: float = 1e-3) -> list[str]:
    return [
        f"integrator.integration_scheme={scheme}",
        "integrator.use_error_control=false",
        f"integrator.max_step_size={step}",
        "compiled=false",
    ]


def grid(duration: float, step: float) -> np.ndarray:
    return np.linspace(0.0, duration, round(duration / step) + 1)


def assert_equal_records(found, wanted, tolerance) -> None:
    """Drake adds its steps up, and so may take one of 1e-13 s more at the end."""
    assert list(found.signals) == list(wanted.signals)
    for name, recorded in wanted.signals.items():
        assert found.signals[name].signals == recorded.signals
    close_records(found, wanted, tolerance, [*range(found.time.size - 2), -1])


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        ("two_link_wall", "runge_kutta3"),
        ("two_link_wall", "runge_kutta5"),
        ("two_link_wall", "runge_kutta2"),
        ("two_link_wall", "bogacki_shampine3"),
        ("two_link_wall", "explicit_euler"),
        ("two_link_motors", "runge_kutta3"),
        ("two_link_measured_force", "runge_kutta3"),
    ],
)
def test_equal_fixed_steps_are_equal(name, scheme, compiled):
    """To 1e-12 of the largest value: both do the same, in another order of additions.

    The states of both are rounded 200 times; forces and controls of some 1e3 are cancelled.
    """
    chosen = scenario(name, "duration=0.2", *fixed(scheme))
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, 0.2, chosen.integrator)
    seeds = [chosen.sensors.force.seed] if chosen.sensors.force else None
    (found,) = rollout(
        loop,
        start,
        parameters,
        grid(0.2, 1e-3),
        config=chosen.integrator,
        compiled=compiled,
        seeds=seeds,
    )
    assert found.failure is None
    assert found.steps == 200
    assert_equal_records(found.record, wanted, 1e-12)


@pytest.mark.slow
@mostly_compiled
def test_a_reference_of_many_polynomials_is_the_same(compiled):
    """To 1e-12 of the largest value, in steps that are powers of 2: Drake's times are exact."""
    step, duration = 2.0**-10, 0.5
    chosen = scenario("two_link_wall", MANY_PIECES, f"duration={duration}", *fixed(step=step))
    loop, context = build_scenario(chosen)
    assert len(loop.generator.references[0].pieces([0]).breaks) > UNROLLED + 1
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, duration, chosen.integrator)
    assert np.ptp(wanted["desired_output"][:, 0]) > 0.005
    moments = grid(duration, step)
    (found,) = rollout(
        loop, start, parameters, moments, config=chosen.integrator, compiled=compiled
    )
    assert_equal_records(found.record, wanted, 1e-12)
    # Several runs: they do not go side by side, and are the same.
    many = rollout(
        loop, [start] * 9, parameters, moments, config=chosen.integrator, compiled=compiled
    )
    np.testing.assert_array_equal(many[8].record["state"], found.record["state"])


@mostly_compiled
@pytest.mark.parametrize(
    "name", ["two_link_wall", pytest.param("seven_joint_wall", marks=pytest.mark.slow)]
)
def test_error_control_agrees(name, compiled):
    """To 1e-9: Drake at an accuracy of 1e-12 is the truth, and the rollout at 1e-8 is held to it.

    Its steps are long, so that this holds between them, too.
    """
    chosen = scenario(name, "duration=1", "integrator.accuracy=1e-12", "compiled=false")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, 1.0, chosen.integrator)
    config = SimulatorConfig()
    config.accuracy = 1e-8
    (found,) = rollout(loop, start, parameters, wanted.time, config=config, compiled=compiled)
    assert found.failure is None
    assert found.steps < 40
    for signal in ("state", "controlled_output", "constraint_force"):
        np.testing.assert_allclose(found.record[signal], wanted[signal], rtol=1e-9, atol=1e-9)
    assert np.max(np.abs(found.record["constraint_residual"])) < 1e-13


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize(("mass", "sampling"), [(None, []), (11.0, [SAMPLED])])
def test_error_control_takes_the_same_steps_with_machine_code_and_without(mass, sampling):
    """To 1e-9, as long as the steps do; also where the plant is not what the law takes it for.

    At a sample the control jumps: the rate at the end of a step is not that of the next one.
    """
    chosen = scenario("two_link_wall", "integrator.accuracy=1e-6", "compiled=false", *sampling)
    loop, context = build_scenario(chosen)
    if mass is not None:
        loop.plant.set_parameter(
            loop.plant.GetMyMutableContextFromRoot(context), "link1.mass", mass
        )
    start, parameters = start_values(loop, context)
    times = [0.0, 0.05, 0.051, 0.4, 1.0]
    one, other = (
        rollout(loop, start, parameters, times, config=chosen.integrator, compiled=compiled)[0]
        for compiled in (False, True)
    )
    assert one.steps == other.steps
    for name, recorded in one.record.signals.items():
        np.testing.assert_allclose(other.record[name], recorded.values, rtol=1e-9, atol=1e-9)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize(
    "settings",
    [
        ["integrator.accuracy=1e-9"],
        [SAMPLED, "integrator.max_step_size=0.01"],
        [SAMPLED, *fixed(step=0.01)[:3]],
    ],
)
def test_a_run_that_pauses_is_the_same_run(monkeypatch, settings):
    """Bit by bit: Python looks at it between steps, to see Ctrl-C and divergence."""
    chosen = scenario("two_link_wall", *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    found = []
    for first in (10**9, 3):
        monkeypatch.setattr(machine, "FIRST", first)
        monkeypatch.setattr(machine, "PAUSE", 0.0)
        given = loop, start, parameters, grid(0.5, 0.02)
        found += rollout(*given, config=chosen.integrator, compiled=True)
    assert found[0].steps == found[1].steps > 5
    for name, recorded in found[0].record.signals.items():
        np.testing.assert_array_equal(found[1].record[name], recorded.values)


def test_a_newton_step_has_the_sizes_of_the_states():
    """Of a pendulum of 1000 mm: one step from a millionth off N* leaves the square of that."""
    system = DaeSystem.from_functions(
        ["a", "b", "a_rate", "b_rate"],
        f=lambda x: [x[2], x[3], 0.0, -9810.0],
        g=lambda x: [0.0, 0.0, x[0] / 1e3, x[1] / 1e3],
        k=lambda x: x[0] ** 2 + x[1] ** 2 - 1e6,
        nominal_state=[600.0, -800.0, 0.0, 0.0],
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(system))
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    program = program_of(builder.Build())
    state, held, parameters = program.values_in(program.context)
    off = state * (1.0 + 1e-6)
    moved, left = program.functions.newton(0.0, off, held, parameters)
    assert 1e-7 < float(left) < 1e-5
    before, after = (np.hypot(*x[:2]) - 1e3 for x in (off, moved.full()[:, 0]))
    assert abs(after) < 1e-5 * abs(before)


@pytest.mark.slow
@both
@pytest.mark.parametrize(
    "settings",
    [
        # The tool leaves what the arm can reach.
        ("references.tool.z.amplitudes=[3.0]", "integrator.accuracy=1e-6"),
        ("references.tool.z.amplitudes=[3.0]", *fixed(step=0.01)[:3]),
        # Gains that no step of this length follows.
        ("law.gains.all=[-4000]", *fixed("explicit_euler", 0.01)[:3]),
    ],
)
def test_a_failure_is_that_of_the_simulation(settings, compiled):
    """Its kind, its time, and its words up to the numbers: round-off grows before it."""
    chosen = scenario("two_link_wall", *settings, "compiled=false", "duration=10")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    with pytest.raises(SimulationError) as raised:
        simulate(loop.diagram, context, chosen.duration, chosen.integrator, may_diverge=True)
    wanted = raised.value
    (found,) = rollout(
        loop, start, parameters, grid(10.0, 0.01), config=chosen.integrator, compiled=compiled
    )
    assert type(found.failure) is type(wanted)
    tolerance = 1e-3 if chosen.integrator.use_error_control else 1e-9
    assert found.failure.time == pytest.approx(wanted.time, abs=tolerance)
    assert found.failure.state.shape == wanted.state.shape
    assert re.search(rf"t = {found.failure.time:.6g} s, state (\[|grown to )", str(found.failure))
    assert str(found.failure)[:20] == str(wanted)[:20]
    assert found.record.time[-1] <= found.failure.time < found.record.time[-1] + 0.02
    assert np.isfinite(found.record["state"]).all()


@both
def test_many_runs_are_those_of_one_each(compiled):
    """Exactly: each is computed alone. Parameters and starts are their own, as in Drake."""
    chosen = scenario("two_link_wall", "duration=0.1", *fixed())
    loop, context = build_scenario(chosen)
    own = loop.plant.GetMyMutableContextFromRoot(context)
    times = grid(0.1, 1e-3)
    values, records = [], []
    for mass in (1.0, 2.0, 3.0):
        loop.plant.set_parameter(own, "link1.mass", mass)
        loop.plant.set_consistent_state(own, loop.plant.state(own) + 0.01)
        values.append(start_values(loop, context))
        other = context.Clone()
        simulate(loop.diagram, other, 0.1, chosen.integrator)
        records.append(loop.record(other))
    starts, parameters = (np.array(column) for column in zip(*values, strict=True))
    settings = {"config": chosen.integrator, "compiled": compiled}
    found = rollout(loop, starts, parameters, times, **settings)
    for one, wanted, (start, row) in zip(found, records, values, strict=True):
        assert_equal_records(one.record, wanted, 1e-12)
        (alone,) = rollout(loop, start, row, times, **settings)
        np.testing.assert_array_equal(alone.record["state"], one.record["state"])
    # One row of parameters serves all starts.
    same = rollout(loop, starts, parameters[1], times, **settings)
    np.testing.assert_array_equal(same[1].record["state"], found[1].record["state"])


def test_one_start_is_that_of_all_rows_of_parameters_or_seeds():
    noisy = ["sampling={period: 0.01}", "sensors.encoders={position_noise: 1.0e-4}"]
    loop, context = build_scenario(scenario("two_link_wall", *fixed(step=0.01), *noisy))
    start, parameters = start_values(loop, context)
    rows, seeds, times = np.array([parameters, 1.01 * parameters]), [3, 4], grid(0.1, 0.01)
    place = loop.plant.dae.parameter_slice("wall.position")
    rows[1, place] = parameters[place]  # The start is on this wall.
    config = SimulatorConfig(max_step_size=0.01, use_error_control=False)
    for given in ({"parameters": rows}, {"parameters": parameters, "seeds": seeds}):
        wanted = rollout(loop, [start, start], times=times, config=config, **given)
        found = rollout(loop, start, times=times, config=config, **given)
        assert len(found) == 2
        assert np.any(found[0].record["state"] != found[1].record["state"])
        for one, other in zip(found, wanted, strict=True):
            assert_equal_records(one.record, other.record, 0.0)


def test_what_cannot_be_rolled_out_is_refused():
    chosen = scenario("two_link_wall", *fixed())
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    with pytest.raises(InconsistentStateError) as caught:
        rollout(loop, start + 0.1, parameters, [0.0, 0.1])
    assert np.abs(caught.value.residual).max() > 0.01
    for arguments, told in (
        ((start[:-1], parameters, [0.0, 0.1]), r"starts.*\(4,\)"),
        ((start, parameters[:-1], [0.0, 0.1]), "parameters"),
        ((start, parameters, [0.0]), "times"),
        ((start, parameters, [0.0, 0.0]), "times"),
        (([start] * 3, [parameters] * 2, [0.0, 0.1]), r"2 .*3 "),
        (([start] * 2, np.zeros((0, len(parameters))), [0.0, 0.1]), "0 rows .*2 starts"),
    ):
        with pytest.raises(ModelError, match=told):
            rollout(loop, *arguments)
    for seed in (-1, 2**32, {"any": -1}):  # Also where nothing is random.
        with pytest.raises(ModelError, match=r"seed .*(-1|4294967296)$"):
            rollout(loop, start, parameters, [0.0, 0.1], seeds=[seed])
    implicit = SimulatorConfig()
    implicit.integration_scheme, implicit.use_error_control = "implicit_euler", False
    with pytest.raises(ModelError, match="implicit_euler"):
        rollout(loop, start, parameters, [0.0, 0.1], config=implicit)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_study_decides_on_machine_code_by_its_length_alone():
    """So that a run has the same numbers in each process, whatever the cache has by then."""
    chosen = scenario("two_link_wall", "duration=0.1")
    loop, context = build_scenario(chosen)
    for lasting in (1.0, 1000.0):
        assert roll_scenario(chosen, loop, context, lasting).failure is None
        code = program_of(loop).made["shared"].made.get("code")
        assert (code is not None) == (lasting > 1.0)


def test_without_a_compiler_it_warns_and_goes_on(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    chosen = scenario("two_link_wall", *fixed())
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    with pytest.warns(MachineCodeWarning, match="no-such-compiler"):
        (found,) = rollout(loop, start, parameters, [0.0, 0.01], compiled=True)
    assert found.failure is None


@pytest.mark.slow
@both
def test_a_rollout_that_is_stopped_has_its_record_up_to_there(compiled):
    """Fixed steps of 1e-4 s; machine code looks after 500 steps first, CasADi's after each call."""
    fixed = ["use_error_control=false", "integration_scheme=runge_kutta3", "max_step_size=1e-4"]
    chosen = scenario("two_link_wall", "duration=3", *(f"integrator.{each}" for each in fixed))
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    times, looks = np.linspace(0.0, 3.0, 301), iter([False] * (1 if compiled else 40))
    settings = {"config": chosen.integrator, "compiled": compiled}
    (whole,) = run_loop(loop, start, parameters, times, **settings)
    (part,) = run_loop(
        loop, start, parameters, times, look=lambda record: next(looks, True), **settings
    )
    assert part.failure is None
    assert 1 < part.record.time.size < 301
    for name in whole.record.signals:
        np.testing.assert_array_equal(
            part.record[name], whole.record[name][: part.record.time.size]
        )


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(["two_link_wall", "seven_joint_dome"]))
def test_states_that_leave_the_constraints_are_brought_back_as_drake_does(name, compiled):
    """Steps of 10 ms by Euler leave them by 1e-5: after one Newton step alone it would be 1e-9."""
    fixed = ["use_error_control=false", "integration_scheme=explicit_euler", "max_step_size=1e-2"]
    words = (f"integrator.{each}" for each in fixed)
    chosen = scenario(name, "duration=1", "compiled=false", *words)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    simulate(loop.diagram, context, chosen.duration, chosen.integrator)
    expected = loop.record(context)
    times, settings = expected.time, {"config": chosen.integrator, "compiled": compiled}
    (found,) = rollout(loop, start, parameters, times, **settings)
    # The last row of Drake's log is projected, as that of the rollout.
    assert np.abs(expected["constraint_residual"]).max() > 1e-6
    np.testing.assert_allclose(found.record["state"], expected["state"], rtol=0.0, atol=1e-13)


PARTS = {
    "a sensor with a lag and noise": (
        "sensors.force={time_constant: 0.02, bias: 0.5, noise_deviation: 0.1}",
        "law.integral=[wall.force]",
    ),
    "limits and integral": (
        "law.gains.all=[-40]",
        "law.integral=[tool.z]",
        "start.errors.tool.z=0.05",
        "saturation=true",
    ),
    "longer delay": ("sampling={period: 0.002, delay: 0.005}",),
    "noise of encoders": (
        "sampling={period: 0.002, delay: 0.001}",
        "sensors.encoders={position_noise: 1e-5, velocity_noise: 1e-3, seed: 3, "
        "position_bias: 1e-4}",
    ),
    "estimator of friction": (
        "sampling={period: 0.002}",
        "sensors.force={sample_period: 0.002}",
        "estimator={rate: 20.0, parameters: [wall.friction]}",
        "constraints.0.friction=0.0",
    ),
}
"""Those that `test_combinations` has not; there nothing is machine code."""


@pytest.mark.slow
@mostly_compiled
@pytest.mark.parametrize("name", some(PARTS))
def test_loops_with_these_parts_are_those_of_drake(name, compiled):
    """To 1e-11 of the largest value: controls of samples jump, and forces with them.

    The plant is not what the law takes it for, so that all that is estimated moves.
    """
    settings = PARTS[name]
    chosen = scenario("two_link_wall", "duration=0.2", *settings, *fixed())
    loop, context = build_scenario(chosen)
    own = loop.plant.GetMyMutableContextFromRoot(context)
    if "integral" in name or "estimator" in name:
        loop.plant.set_parameter(own, "link1.mass", 13.0)
    if "friction" in loop.signals:
        loop.plant.set_parameter(own, "wall.friction", 0.3)
    seeds = {"force_noise": chosen.sensors.force.seed} if chosen.sensors.force else {}
    if chosen.sensors.encoders is not None:
        seeds["encoder_noise"] = encoder_seed(chosen.sensors.encoders.seed)
    start, parameters = start_values(loop, context)
    wanted = run(loop, context, chosen.duration, chosen.integrator)
    settings = {"config": chosen.integrator, "compiled": compiled, "seeds": [seeds]}
    (found,) = rollout(loop, start, parameters, wanted.time, **settings)
    assert found.failure is None
    assert_equal_records(found.record, wanted, 1e-11)
    if name == "limits and integral":  # It stands still while a drive is at its limit.
        limited = np.abs(wanted["excess"]).max(axis=1) > 0.0
        assert 10 < np.count_nonzero(limited) < 190
        assert np.ptp(wanted["integral"][limited]) < np.ptp(wanted["integral"])
    if "disturbance" in wanted:
        assert np.ptp(wanted["disturbance"], axis=0).max() > 1.0


@pytest.mark.parametrize("is_compiled", [False, True])
@pytest.mark.parametrize("name", ["two_link_wall", "wall_point_contact"])
def test_threads_do_not_disturb_each_other(name, is_compiled):
    """Rollouts of one loop with different parameters from four threads at once."""
    if is_compiled and shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    loop, context = build_scenario(scenario(name, "duration=0.05", *fixed()))
    state, parameters = start_values(loop, context)
    times = grid(0.05, 0.01)
    changed = [parameters * (1.0 + 1e-3 * i * (parameters == 9.81)) for i in range(4)]
    changed = [parameters if i == 0 else other for i, other in enumerate(changed)]

    def values(number: int) -> list[np.ndarray]:
        (made,) = rollout(loop, state, changed[number], times, compiled=is_compiled)
        assert made.failure is None
        return [*(each.values for each in made.record.signals.values())]

    one_by_one = [values(number) for number in range(4)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(values, [0, 1, 2, 3] * 3))
    for number, found in enumerate(together):
        for value, wanted in zip(found, one_by_one[number % 4], strict=True):
            np.testing.assert_array_equal(value, wanted)
