"""Runs side by side against the same runs one after the other, and their arithmetic alone."""

import ctypes
import shutil
import signal
import threading
import warnings

import casadi as ca
import numpy as np
import pytest
from runs import close_records, scenario, some

from drake_dae import build_scenario, rollout
from drake_dae.blocks import machine
from drake_dae.blocks.emitter import emitted
from drake_dae.diagrams.parts import encoder_seed
from drake_dae.errors import MachineCodeWarning, ModelError
from drake_dae.running import rollout as module
from drake_dae.running import start_values
from drake_dae.running.rollout_program import program_of
from drake_dae.trace.compiled import library

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
ONE_AFTER_THE_OTHER = 10**9
COUNT = 11
"""More than a register has, and no multiple of it."""


def problem(name, *settings):
    """A closed loop, its integrator, and random starts and link masses for some runs."""
    chosen = scenario(name, *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    random, size = np.random.default_rng(0), loop.plant.dae.num_states
    manifold, mass = loop.plant.structure.manifold, loop.plant.dae.parameter_slice("link1.mass")
    starts, rows = [], []
    for _ in range(COUNT):
        near = manifold.settle(start[:size] + 0.02 * random.normal(size=size))
        starts.append(np.concatenate([near, start[size:]]))
        rows.append(parameters.copy())
        rows[-1][mass] *= random.uniform(0.9, 1.1)
    return loop, chosen, np.array(starts), np.array(rows)


def both_ways(monkeypatch, *arguments, **settings):
    """The runs side by side, and one after the other."""
    found = []
    for several in (1, ONE_AFTER_THE_OTHER):
        monkeypatch.setattr(module, "SEVERAL", several)
        found.append(rollout(*arguments, compiled=True, **settings))
    return found


def assert_same(ours, theirs, tolerance, slack=0):
    for one, other in zip(ours, theirs, strict=True):
        assert one.failure is None
        assert abs(one.steps - other.steps) <= slack
        close_records(one.record, other.record, tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "seeds"),
    [
        ("two_link_wall", [], ()),
        pytest.param(
            "two_link_wall",
            [
                "sampling={period: 0.002, delay: 0.001}",
                "sensors.encoders={position_noise: 1e-5, velocity_noise: 1e-3, seed: 3}",
            ],
            ("encoder_noise",),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "two_link_measured_force",
            ["sensors.force={sample_period: 0.003, noise_deviation: 0.1}", "law.force_gain=0.5"],
            ("force_noise",),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_fixed_steps_are_equal(monkeypatch, name, settings, seeds):
    """To 1e-13 of the largest value, after 100 steps: products and sums are rounded once."""
    loop, chosen, starts, rows = problem(name, *settings, *FIXED)
    given = [dict.fromkeys(seeds, encoder_seed(number)) for number in range(COUNT)]
    times = [0.0, 0.0125, 0.05, 0.1]
    config = chosen.integrator
    found = both_ways(monkeypatch, loop, starts, rows, times, config=config, seeds=given)
    assert_same(*found, 1e-13)


def test_error_control_with_equal_steps_is_equal(monkeypatch):
    """To 1e-13 of the largest value: the longest step is what all take, rows lie between."""
    settings = ["integrator.accuracy=1e-6", "integrator.max_step_size=0.01"]
    loop, chosen, starts, rows = problem("two_link_wall", *settings)
    times = np.linspace(0.0, 0.3, 71)
    assert_same(*both_ways(monkeypatch, loop, starts, rows, times, config=chosen.integrator), 1e-13)


@pytest.mark.parametrize(
    "settings", some([[], pytest.param(["sampling={period: 0.05}"], marks=pytest.mark.slow)])
)
def test_each_run_has_steps_of_its_own(monkeypatch, settings):
    """To 1e-9, as accurate as steps are: round-off in the estimate of an error shifts them."""
    loop, chosen, starts, rows = problem("two_link_wall", "integrator.accuracy=1e-6", *settings)
    # Steps differ where speeds do.
    fast = loop.plant.structure.manifold
    starts[:, :4] = [
        fast.settle(each[:4] * np.r_[1.0, 1.0, 10.0 * k, 10.0 * k]) for k, each in enumerate(starts)
    ]
    times = np.linspace(0.0, 1.0, 31)
    ours, theirs = both_ways(monkeypatch, loop, starts, rows, times, config=chosen.integrator)
    assert_same(ours, theirs, 1e-9, slack=1)
    if not settings:
        assert len({each.steps for each in ours}) > 2


@pytest.mark.parametrize("config", [FIXED, ["integrator.accuracy=1e-6"]])
def test_a_run_does_not_depend_on_those_beside_it(monkeypatch, config):
    """To the last bit, in another order and among fewer."""
    loop, chosen, starts, rows = problem("two_link_wall", *config)
    monkeypatch.setattr(module, "SEVERAL", 1)
    settings = {"config": chosen.integrator, "compiled": True}
    times = np.linspace(0.0, 0.2, 5)
    whole = rollout(loop, starts, rows, times, **settings)
    backward = rollout(loop, starts[::-1], rows[::-1], times, **settings)[::-1]
    (alone,) = rollout(loop, starts[3], rows[3], times, **settings)
    for one, other in zip(whole, backward, strict=True):
        np.testing.assert_array_equal(one.record["state"], other.record["state"])
    np.testing.assert_array_equal(whole[3].record["state"], alone.record["state"])


def assert_same_failures(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        assert type(one.failure) is type(other.failure)
        assert one.record.time.size == other.record.time.size
        if one.failure is not None:
            assert one.failure.time == pytest.approx(other.failure.time, abs=1e-9)
            assert str(one.failure)[:20] == str(other.failure)[:20]


def test_a_run_that_fails_ends_no_other(monkeypatch):
    """Every third run has gains that no step of this length follows; the others reach the end."""
    euler = ["integrator.integration_scheme=explicit_euler", FIXED[1]]
    settings = [*euler, "integrator.max_step_size=0.01"]
    loop, chosen, starts, rows = problem("two_link_wall", *settings)
    rows[::3] = start_values(*build_scenario(scenario("two_link_wall", "law.gains.all=[-4000]")))[1]
    times = np.linspace(0.0, 2.0, 21)
    ours, theirs = both_ways(monkeypatch, loop, starts, rows, times, config=chosen.integrator)
    assert [each.failure is None for each in ours] == [k % 3 > 0 for k in range(COUNT)]
    assert_same_failures(ours, theirs)
    going = [k for k in range(COUNT) if k % 3]
    assert_same([ours[k] for k in going], [theirs[k] for k in going], 1e-12)


X, P = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
a, b, c = ca.vertsplit(X)
OPERATIONS = ca.vertcat(
    *(-a, ca.exp(a), ca.log(b), ca.sqrt(b), a**2, a + a, a**3, ca.fabs(a), ca.sin(a), ca.cos(a)),
    *(ca.tan(a), ca.asin(c), ca.acos(c), ca.atan(a), ca.sinh(c), ca.cosh(c), ca.tanh(c)),
    *(ca.sign(a), ca.sign(0.0 * a), 1 / b, a / b, c / b, ca.floor(a), ca.ceil(a), b**a, P[0]),
    *(a - b, a * b, ca.fmin(a, b), ca.fmax(a, b), ca.fmin(ca.log(a), b), ca.fmax(b, ca.log(a))),
    *(a < b, a <= b, ca.eq(a, b), ca.ne(a, b), ca.atan2(a, b), ca.copysign(b, a)),
    ca.if_else(ca.logic_and(a > 0, ca.logic_or(b > 1, ca.logic_not(c > 0))), P[0] * b, P[1]),
    ca.if_else(a > 0, ca.sqrt(a), 0),
    *(ca.sin(1e4 * a), ca.cos(1e4 * a), ca.sin(1e7 * a), ca.cos(1e7 * a), 3.0),
    *(ca.sin(2e8 * a), ca.cos(2e8 * a), a / ca.sqrt(b + 1), ca.sqrt(b + 1), 1 / ca.sqrt(b + 3)),
    *(b / ca.sqrt(ca.fmax(a, 0)), ca.sqrt(ca.fmax(a, 0)), b / ca.sqrt(b / ca.fmax(a, 0))),
    *(b / ca.sqrt(1e300 * b), b / ca.sqrt(1e-320 * b)),
)
ENTRY = """
__attribute__((visibility("default"))) int evaluate(
    const double *c, const double *x, const double *p, double *r) {
  real own[3], shared[2], found[ROWS];
  int i, lane;
  for (lane = 0; lane < LANES; lane++) {
    for (i = 0; i < 3; i++) AT(own[i], lane) = x[3 * lane + i];
    for (i = 0; i < 2; i++) AT(shared[i], lane) = p[i];
  }
  const mask far = operations(c, own, shared, found);
  for (lane = 0; lane < LANES; lane++) r[ROWS * LANES + lane] = AT(far, lane) ? 1.0 : 0.0;
  for (lane = 0; lane < LANES; lane++) {
    for (i = 0; i < ROWS; i++) r[ROWS * lane + i] = AT(found[i], lane);
  }
  return LANES;
}
"""


@pytest.mark.slow
def test_angles_that_are_too_large_for_the_lanes_are_no_less_accurate(monkeypatch):
    """A reference of 1e18 rad/s, whose acceleration of 1 m/s^2 the torques have.

    Runs side by side take angles up to 5e8 rad, and are continued alone from 5e-10 s on.
    """
    settings = ["references.tool.z.amplitudes=[1.0e-36]", "references.tool.z.frequencies=[1.0e+18]"]
    loop, chosen, starts, rows = problem("two_link_wall", *FIXED, *settings)
    found = both_ways(
        monkeypatch, loop, starts, rows, np.linspace(0.0, 0.02, 5), config=chosen.integrator
    )
    assert np.ptp(found[0][0].record["desired_output"]) > 0.0
    assert_same(*found, 1e-13)


def given_of(*arrays):
    return [each.ctypes.data_as(ctypes.c_void_p) for each in arrays]


@pytest.mark.slow
@pytest.mark.parametrize("options", some(["-O2", "-mno-avx512f", "-march=x86-64"]))
def test_operations_are_those_of_casadi(options):
    """To two units in the last place; sine and cosine have a series of their own."""
    function = ca.Function("operations", [X, P], [OPERATIONS], {"cse": False})
    rows, constants = function.numel_out(0), list[float]()
    header = (machine.FOLDER / "real.h").read_text()
    text = [header, emitted(function, "operations", constants), f"enum {{ ROWS = {rows} }};", ENTRY]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MachineCodeWarning)
        path = library("\n".join(text), 100, True, True, (*machine.LANES_OPTIONS, options))
    if path is None:
        pytest.skip(f"the C compiler does not know {options}")
    code = ctypes.CDLL(str(path))
    random = np.random.default_rng(0)
    shared, table = np.array([1.5, -0.5]), np.array(constants)
    for _ in range(20):
        points = random.uniform([-2.0, 0.1, -0.9], [2.0, 2.0, 0.9], (8, 3))
        points[0, 0] = 0.0
        found = np.zeros((9, rows))
        lanes = code.evaluate(*given_of(table, points, shared, found))
        for point, values in zip(points[:lanes], found, strict=False):
            wanted = function(point, shared).full()[:, 0]
            np.testing.assert_allclose(values, wanted, rtol=5e-16, atol=2e-16)
        assert not found.ravel()[lanes * rows : lanes * (rows + 1)].any()
    # Angles are up to 2e8 a.
    points[:, 0] = [0.0, 3.0, 1e3, -3.0, -1e20, 2.0, np.nan, 2.4]
    code.evaluate(*given_of(table, points, shared, found))
    far = found.ravel()[lanes * rows : lanes * (rows + 1)]
    np.testing.assert_array_equal(far, np.abs(points[:lanes, 0]) > 2.5)


def test_diagrams_that_differ_in_constants_share_their_code(monkeypatch):
    """Sampled laws with other references and gains: one C source, and each has its own runs."""
    settings = ["sampling={period: 0.002, delay: 0.001}", *FIXED]
    others = ["references.tool.z.offset=0.25", "law.gains.all=[-3.0]"]
    found, texts, tables = [], [], []
    for more in ((), others):
        loop, chosen, starts, rows = problem("two_link_wall", *settings, *more)
        tables.append([])
        texts.append(machine.source(program_of(loop).functions, tables[-1], several=True))
        times = np.linspace(0.0, 0.1, 6)
        found.append(both_ways(monkeypatch, loop, starts, rows, times, config=chosen.integrator))
        assert_same(*found[-1], 1e-13)
    assert texts[0] == texts[1]
    assert tables[0] != tables[1]
    assert np.abs(found[0][0][0].record["control"] - found[1][0][0].record["control"]).max() > 0.1


def test_what_lanes_do_not_know_is_refused():
    function = ca.Function("odd", [X], [ca.erf(X)])
    with pytest.raises(ModelError, match="odd"):
        emitted(function, "odd", [])


@pytest.mark.slow
@pytest.mark.parametrize("config", [FIXED, ["integrator.max_step_size=1e-3"]])
@pytest.mark.usefixtures("signals_of_a_shell")
def test_an_interrupt_ends_all_runs(config):
    """Within a step of each: they would take half a minute."""
    loop, chosen, starts, rows = problem("two_link_wall", *config)
    settings = {"config": chosen.integrator, "compiled": True}
    rollout(loop, starts, rows, [0.0, 0.1], **settings)
    main = threading.main_thread().ident
    timer = threading.Timer(0.3, lambda: signal.pthread_kill(main, signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        rollout(loop, starts, rows, [0.0, 3e4], **settings)
    timer.join()
