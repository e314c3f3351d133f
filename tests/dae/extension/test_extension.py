import casadi as ca
import numpy as np
import pytest
from arms import touching
from problems import (
    PROBLEMS,
    changed,
    double_integrator,
    early_control,
    hidden_normal_form,
    integrated,
)
from runs import some

from drake_dae.dae.extension.dynamic_extension import dynamic_extension
from drake_dae.dae.extension.extension import Extension, extend
from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import poles
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.trace.functions import TracedFunction

GRAVITY = 9.81


def unicycle(**changes) -> DaeSystem:
    """A wheel that rolls and turns: x' = v cos, y' = v sin, heading' = w (Isidori 1995, 5.4)."""
    fields = {
        "f": lambda x: [0, 0, 0],
        "h": lambda x: [[ca.cos(x[2]), 0], [ca.sin(x[2]), 0], [0, 1]],
        "l": lambda x: [x[0], x[1]],
        "control_signals": [Signal("v", "m/s"), Signal("w", "rad/s")],
        "name": "unicycle",
    }
    return DaeSystem.from_functions(["x", "y", "heading"], **{**fields, **changes})


def wheels() -> DaeSystem:
    """The same on two wheels of radius 0.5, 0.5 apart: v = (left + right)/4, w = right - left."""
    return unicycle(
        h=lambda x: [
            [0.25 * ca.cos(x[2]), 0.25 * ca.cos(x[2])],
            [0.25 * ca.sin(x[2]), 0.25 * ca.sin(x[2])],
            [-1, 1],
        ],
        control_signals=["left", "right"],
    )


def vtol() -> DaeSystem:
    """A planar aircraft without the coupling of roll to lift (Hauser, Sastry and Meyer 1992)."""
    return DaeSystem.from_functions(
        ["x", "y", "roll", "vx", "vy", "rate"],
        f=lambda x: [x[3], x[4], x[5], 0, -GRAVITY, 0],
        h=lambda x: [*[[0, 0]] * 3, [-ca.sin(x[2]), 0], [ca.cos(x[2]), 0], [0, 1]],
        l=lambda x: [x[0], x[1]],
        control_signals=[Signal("thrust", "m/s^2"), "torque"],
        name="vtol",
    )


def quadrotor() -> DaeSystem:
    """A quadrotor of four thrusts, with z = (position, yaw)."""

    def thrust_axis(a: ca.SX) -> list[ca.SX]:
        roll, pitch, yaw = a[0], a[1], a[2]
        forward, side = ca.sin(pitch) * ca.cos(roll), ca.sin(roll)
        return [
            ca.cos(yaw) * forward + ca.sin(yaw) * side,
            ca.sin(yaw) * forward - ca.cos(yaw) * side,
            ca.cos(pitch) * ca.cos(roll),
        ]

    def f(x: ca.SX) -> list:
        roll, pitch, (p, q, r) = x[3], x[4], ca.vertsplit(x[9:])
        turn = ca.sin(roll) * q + ca.cos(roll) * r
        angles = [p + ca.tan(pitch) * turn, ca.cos(roll) * q - ca.sin(roll) * r]
        rates = [-0.6 * q * r, 0.5 * p * r, 0.1 * p * q]
        return [*ca.vertsplit(x[6:9]), *angles, turn / ca.cos(pitch), 0, 0, -GRAVITY, *rates]

    arms = [[0, 5, 0, -5], [-5, 0, 5, 0], [0.4, -0.4, 0.4, -0.4]]
    return DaeSystem.from_functions(
        ["x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "p", "q", "r"],
        f=f,
        h=lambda x: [*[[0] * 4] * 6, *[[axis] * 4 for axis in thrust_axis(x[3:6])], *arms],
        l=lambda x: [x[0], x[1], x[2], x[5]],
        control_signals=["front", "left", "back", "right"],
        output_signals=["x", "y", "z", "yaw"],
        name="quadrotor",
    )


CRANE = np.array([3.0, 0.5, 1.0])
"""Masses of the trolley, of the winch and of the load, in kg."""


def crane(**changes) -> DaeSystem:
    """A load on a rope from a winch on a trolley, z = load (Fliess et al. 1995: it is flat).

    k = ((X - s)^2 + Y^2 - l^2)/2 keeps the rope tight, v is its tension over its length.
    """
    fields = {
        "f": lambda x: [*ca.vertsplit(x[4:]), 0, 0, 0, -GRAVITY],
        "g": lambda x: [
            *[0] * 4,
            -(x[2] - x[0]) / CRANE[0],
            -x[1] / CRANE[1],
            (x[2] - x[0]) / CRANE[2],
            x[3] / CRANE[2],
        ],
        "h": lambda x: [*[[0, 0]] * 4, [1 / CRANE[0], 0], [0, 1 / CRANE[1]], [0, 0], [0, 0]],
        "k": lambda x: ((x[2] - x[0]) ** 2 + x[3] ** 2 - x[1] ** 2) / 2,
        "l": lambda x: [x[2], x[3]],
        "m": lambda x: [0, 0],
        "control_signals": [Signal("trolley", "N"), Signal("winch", "N")],
        "output_signals": ["X", "Y"],
        "nominal_state": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0],
        "name": "crane",
    }
    names = ["s", "l", "X", "Y", "s'", "l'", "X'", "Y'"]
    return DaeSystem.from_functions(names, **{**fields, **changes})


def sleigh() -> DaeSystem:
    """The knife edge of the problems, steered by where it is."""
    system = PROBLEMS["knife_edge"]().system
    return changed(system, l=system.state[:2], output_signals=("x", "y"))


def evaluated(system: DaeSystem, state, **expressions: ca.SX) -> list[np.ndarray]:
    """As matrices."""
    function = TracedFunction(
        "values", {"x": system.state, "p": system.parameter_symbol}, expressions
    )
    found = function(state, system.parameter_values)
    return [
        value.reshape(e.shape) if value.ndim == 1 else value
        for value, e in zip(found, expressions.values(), strict=True)
    ]


# ---- integrators that are asked for


def test_an_integrator_is_a_state_and_its_rate_the_control():
    system = extend(unicycle(), ["v"], {"v": 0.7})
    assert [s.name for s in system.state_signals] == ["x", "y", "heading", "v"]
    assert system.state_signals[3].unit == "m/s"
    assert [s.name for s in system.control_signals] == ["v'", "w"]
    np.testing.assert_array_equal(system.nominal_state, [0.0, 0.0, 0.0, 0.7])
    f, h = evaluated(system, [1.0, 2.0, 0.3, 0.9], f=system.f, h=system.h)
    np.testing.assert_allclose(f[:, 0], [0.9 * np.cos(0.3), 0.9 * np.sin(0.3), 0, 0], rtol=1e-15)
    np.testing.assert_array_equal(h, [[0, 0], [0, 0], [0, 1], [1, 0]])


def test_several_integrators_before_several_controls():
    """(x, u1, u2, u2', u2''): rounds of integrators, one before each control that still needs one.

    The units are those of derivatives of the control.
    """
    system = changed(unicycle(), control_signals=("drive", Signal("steer", "rad")))
    extended = extend(system, {"steer": 3, "drive": 1})
    names = ["x", "y", "heading", "drive", "steer", "steer'", "steer''"]
    assert [s.name for s in extended.state_signals] == names
    assert extended.state_signals[6].unit == "rad/s^2"
    assert extended.control_signals == (Signal("drive'", "1/s"), Signal("steer'''", "rad/s^3"))
    f, h = evaluated(extended, [0, 0, 0, 2, 3, 4, 5], f=extended.f, h=extended.h)
    np.testing.assert_array_equal(f[:, 0], [2, 0, 3, 0, 4, 5, 0])
    np.testing.assert_array_equal(np.argwhere(h), [[3, 0], [6, 1]])
    assert find_structure(extend(double_integrator(), {"u0": 2})).output_degrees == (4,)


def test_all_else_stays():
    """Constraints, outputs, parameters, and mass matrix: B(x) with them and without."""
    plain = crane(nominal_state=[0.0, 1.0, 0.6, -0.8, 0.0, 0.0, 0.0, 0.0])
    mass = ca.diag(ca.SX([1, 1, 1, 1, *CRANE, CRANE[2]]))
    heavy = changed(
        plain,
        **{key: ca.mtimes(mass, getattr(plain, key)) for key in "fgh"},
        mass_matrix=mass,
    )
    one, two = (
        changed(e, l=e.state[[1, 0]], output_signals=("l", "s"))
        for e in (
            extend(system, ["trolley", "winch"], {"trolley": 2.0}) for system in (plain, heavy)
        )
    )
    first, second = find_structure(one), find_structure(two)
    assert first.output_degrees == second.output_degrees == (3, 3)
    assert one.parameters == plain.parameters
    assert one.constraint_output_signals == plain.constraint_output_signals
    for state in first.states:
        # Twenty operations on numbers of order 10.
        np.testing.assert_allclose(
            evaluated(one, state, b=first.control_matrix)[0],
            evaluated(two, state, b=second.control_matrix)[0],
            rtol=1e-12,
            atol=1e-12,
        )


@pytest.mark.parametrize("wrong", ["u0", 3, None])
def test_integrators_are_named_in_a_list(wrong):
    with pytest.raises(ModelError, match="integrators must be a dictionary or a list, got"):
        extend(double_integrator(), wrong)


def test_no_integrators_change_nothing():
    system = crane()
    assert extend(system, []) is system


@pytest.mark.parametrize(
    ("integrators", "nominal", "message"),
    [
        (["v", "speed"], None, "integrators names speed, but the controls are v, w"),
        ({"v": 0}, None, "integrators must be whole numbers from 1, got {'v': 0}"),
        ({"v": 1.5}, None, r"integrators\['v'\] must be a whole number, got 1\.5"),
        ({"v": True}, None, r"integrators\['v'\] must be a whole number, got True"),
        (["v"], {"speed": 1.0}, "nominal_control names speed, but the controls are v, w"),
        (["v"], {"v": np.nan}, r"nominal_control\['v'\] must be a finite number, got nan"),
    ],
)
def test_wrong_arguments_are_refused(integrators, nominal, message):
    with pytest.raises(ModelError, match=f"(unicycle|extend): .*{message}"):
        extend(unicycle(), integrators, nominal)


# ---- integrators that are found

REGULAR = {
    "unicycle": (unicycle, {"v": 0.8}, {"v": 1}, (2, 2)),
    "wheels": (wheels, {"left": 1.0, "right": 2.0}, {"left": 1}, (2, 2)),
    "vtol": (vtol, {"thrust": GRAVITY}, {"thrust": 2}, (4, 4)),
    "quadrotor": (
        quadrotor,
        dict.fromkeys(("front", "left", "back", "right"), GRAVITY / 4),
        {"front": 2},
        (4, 4, 4, 2),
    ),
    "crane": (crane, {"winch": -GRAVITY}, {"winch": 2}, (4, 4)),
    "sleigh": (sleigh, {}, {"u0": 1}, (3, 3)),
}


def extension_of(name: str) -> Extension:
    make, nominal, _, _ = REGULAR[name]
    return dynamic_extension(make(), nominal_control=nominal)


@pytest.mark.slow
@pytest.mark.parametrize("name", REGULAR)
def test_degrees_are_those_of_the_literature(name):
    """Unicycle: Isidori 1995, 5.4; the others are flat by their outputs (Fliess et al. 1995).

    All of them have trivial zero dynamics after it: n + integrators = sum r_i + sum mu_i.
    """
    make, _, integrators, degrees = REGULAR[name]
    with pytest.raises(AssumptionError):
        find_structure(make())
    extension = extension_of(name)
    assert extension.integrators == integrators
    assert extension.structure.output_degrees == degrees
    assert extension.structure.zero_dynamics_dimension == 0
    assert extension.structure.system is extension.system
    assert extension.system.num_states == make().num_states + sum(integrators.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", REGULAR)
def test_the_extension_moves_the_original_states_as_the_original_does(name):
    """f_e + h_e w, in the rows of x, is f + h u with the u that `original_control` recovers."""
    extension, random = extension_of(name), np.random.default_rng(0)
    original, extended = extension.original, extension.system
    n = original.num_states
    for _ in range(5):
        state = extended.nominal_state + 0.3 * random.standard_normal(extended.num_states)
        w = random.standard_normal(extended.num_controls)
        u = extension.original_control(state, w)
        f, h, g = evaluated(original, state[:n], f=original.f, h=original.h, g=original.g)
        fe, he, ge = evaluated(extended, state, f=extended.f, h=extended.h, g=extended.g)
        # A few operations on numbers of order 10.
        np.testing.assert_allclose((fe[:, 0] + he @ w)[:n], f[:, 0] + h @ u, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(ge[:n], g)
        np.testing.assert_array_equal(ge[n:], 0.0)


def test_recovered_controls_are_integrals():
    """u of the aircraft is its state thrust and the torque, whatever the thrust's derivatives."""
    extension = extension_of("vtol")
    state = np.array([0, 0, 0.1, 0, 0, 0, 9.0, -2.0])
    np.testing.assert_array_equal(extension.original_control(state, [5.0, 0.3]), [9.0, 0.3])


def test_mixed_controls_by_hand():
    """left* = left + right is 4 v: both wheels share its integral, and left = left* - right."""
    extension = extension_of("wheels")
    assert [s.name for s in extension.system.state_signals] == ["x", "y", "heading", "left*"]
    assert [s.name for s in extension.system.control_signals] == ["left*'", "right"]
    # Also where one coordinate alone does not tell the mixture.
    for heading in (0.0, np.pi / 2, 0.7, -2.0):
        u = extension.original_control([1.0, 2.0, heading, 3.0], [7.0, 0.5])
        np.testing.assert_allclose(u, [2.5, 0.5], rtol=1e-15)
    assert extension.system.nominal_state[3] == pytest.approx(3.0, rel=1e-15)


def test_the_control_matrix_of_the_aircraft_by_hand():
    """x'' = -sin(roll) T and y'' = cos(roll) T - g differentiated twice, w the rate of the roll:

    x^(4) = -s T'' - c T u2 + s w^2 T - 2 c w T',   y^(4) = c T'' - s T u2 - c w^2 T - 2 s w T'.
    """
    extension, random = extension_of("vtol"), np.random.default_rng(1)
    for _ in range(5):
        state = extension.system.nominal_state + 0.5 * random.standard_normal(8)
        s, c, w, (thrust, rate) = np.sin(state[2]), np.cos(state[2]), state[5], state[6:]
        structure = extension.structure
        b, a = evaluated(extension.system, state, b=structure.control_matrix, a=structure.drift)
        drift = [s * w**2 * thrust - 2 * c * w * rate, -c * w**2 * thrust - 2 * s * w * rate]
        # Ten operations on numbers of order 10.
        np.testing.assert_allclose(b, [[-s, -c * thrust], [c, -s * thrust]], rtol=0, atol=1e-13)
        np.testing.assert_allclose(a[:, 0], drift, rtol=0, atol=1e-13)


def test_found_and_asked_for_are_the_same():
    extension = extension_of("vtol")
    asked = extend(vtol(), {"thrust": 2}, {"thrust": GRAVITY})
    assert asked.state_signals == extension.system.state_signals
    assert asked.control_signals == extension.system.control_signals
    np.testing.assert_array_equal(asked.nominal_state, extension.system.nominal_state)
    one, two = (
        evaluated(system, np.arange(8.0), f=system.f, h=system.h, l=system.l)
        for system in (asked, extension.system)
    )
    for left, right in zip(one, two, strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(12)))
def test_hidden_integrators_are_found(seed):
    """Integrators before some controls of a random system, behind a feedback, want the others too.

    B(x) is regular and dense without them, so that all outputs then have one degree more.
    """
    random = np.random.default_rng(seed)
    while True:
        hidden = hidden_normal_form(int(random.integers(1000)))
        small = hidden.system.num_states <= 5 and max(hidden.output_degrees) <= 2
        if hidden.system.num_controls >= 2 and small:  # Larger ones take seconds.
            break
    p = hidden.system.num_controls
    count = int(random.integers(1, p))
    system = extend(hidden.system, [f"u{i}" for i in range(count)])
    # The controls in another basis: each moves all.
    system = changed(system, h=ca.mtimes(system.h, np.eye(p) + 0.4 * random.normal(size=(p, p))))
    extension = dynamic_extension(system)
    assert extension.structure.constraint_degrees == hidden.constraint_degrees
    assert extension.structure.output_degrees == tuple(d + 1 for d in hidden.output_degrees)
    assert sum(extension.integrators.values()) == p - count
    assert extension.structure.zero_dynamics_dimension == hidden.zero_dynamics


def test_a_regular_system_needs_none():
    system = PROBLEMS["two_link_arm"]().system
    extension = dynamic_extension(system)
    assert extension.system is system
    assert extension.integrators == {}
    np.testing.assert_array_equal(extension.original_control(np.ones(4), [3.0, 5.0]), [3.0, 5.0])


def test_round_off_is_no_control():
    """Entries of 1e-17, as a change of basis leaves behind, do not make B(x) regular."""
    system = unicycle(
        h=lambda x: [[ca.cos(x[2]), 1e-17], [ca.sin(x[2]), 2e-17], [0, 1]],
        nominal_state=[0.0, 0.0, 0.4],
    )
    extension = dynamic_extension(system, nominal_control={"v": 1.0})
    assert extension.integrators == {"v": 1}
    assert extension.structure.output_degrees == (2, 2)


def test_units_do_not_matter():
    """The aircraft in micrometres and with thrust in millions of its unit."""
    system = vtol()
    scale = ca.SX([1e-6, 1e-6, 1, 1e-6, 1e-6, 1])
    moved = {
        key: ca.substitute(getattr(system, key), system.state, scale * system.state)
        for key in "fhl"
    }
    other = changed(
        system,
        f=moved["f"] / scale,
        h=ca.mtimes(moved["h"] / ca.repmat(scale, 1, 2), ca.diag(ca.SX([1e6, 1]))),
        l=moved["l"] * 1e3,
    )
    extension = dynamic_extension(
        other,
        nominal_control={"thrust": GRAVITY * 1e-6},
        spread=[1e5, 1e5, 0.1, 1e5, 1e5, 0.1],
    )
    assert extension.integrators == {"thrust": 2}
    assert extension.structure.output_degrees == (4, 4)


def test_a_constraint_that_a_control_meets_too_early_gets_integrators():
    """x0' = x1 + u, x1' = v violates Assumption (3): u acts on k', v on k''. As a state u may."""
    system = early_control()
    with pytest.raises(AssumptionError) as caught:
        find_structure(system)
    assert caught.value.assumption == 3
    by_hand = find_structure(extend(system, ["u0"]))
    extension = dynamic_extension(system)
    assert extension.integrators == {"u0": 1}
    for structure in (by_hand, extension.structure):
        assert (structure.constraint_degrees, structure.output_degrees) == ((2,), (2,))
        # x1 + u = 0 binds u: N* is {x0 = 0, x1 = -u}.
        for state in structure.states:
            np.testing.assert_allclose([state[0], state[1] + state[3]], 0.0, atol=1e-15)


def test_controls_that_act_together_with_the_force_need_none():
    """Beside that constraint x2'' = v1 + u1, where u1 acts as early as Assumption (3) allows."""
    system = DaeSystem.from_functions(
        5,
        f=lambda x: [x[1], 0, x[3], 0, 0],
        g=lambda x: [[0, 0], [1, 0], [0, 0], [0, 1], [0, 0]],
        h=lambda x: [[1, 0], [0, 0], [0, 0], [0, 1], [1, 0]],
        k=lambda x: [x[0], x[2]],
        l=lambda x: [x[4], 0],
        m=lambda x: [[0, 0], [0, 1]],
    )
    extension = dynamic_extension(system)
    assert extension.integrators == {"u0": 1}
    assert extension.structure.output_degrees == (2, 0)


# ---- closed loops


def rope_force(x: np.ndarray, free: np.ndarray) -> float:
    """v that keeps k'' of the crane at 0, where the free motion would not."""
    gap, rate = x[2] - x[0], x[6] - x[4]
    bend = rate**2 + x[7] ** 2 - x[5] ** 2
    pull = gap * (free[6] - free[4]) + x[3] * free[7] - x[1] * free[5]
    inverse = gap**2 * (1 / CRANE[0] + 1 / CRANE[2]) + x[3] ** 2 / CRANE[2] + x[1] ** 2 / CRANE[1]
    return -(bend + pull) / inverse


def original_loop(extension: Extension, law: TrackingLaw, start, reference, times) -> np.ndarray:
    """Outputs of the original system under the law as a dynamic state feedback.

    The original's states follow (1) with `original_control`; from the extended system come only
    the integrators. By SciPy's DOP853 with tolerances of 1e-11.
    """
    original, extended = extension.original, extension.system
    n = original.num_states
    fields = ca.Function("fields", [original.state], [original.f, original.g, original.h])
    output = ca.Function("output", [original.state], [original.l])
    rows = slice(n, None)
    integrators = ca.Function(
        "integrators", [extended.state], [extended.f[rows], extended.h[rows, :]]
    )

    def rate(t: float, state: np.ndarray) -> np.ndarray:
        w = law.control(state, reference(t))
        f, g, h = (np.array(e) for e in fields(state[:n]))
        moving = f[:, 0] + h @ extension.original_control(state, w)
        if original.num_constraints:
            moving = moving + g[:, 0] * rope_force(state, moving)
        held, following = (np.array(e) for e in integrators(state))
        return np.concatenate([moving, held[:, 0] + following @ w])

    states = integrated(rate, start, times)
    return np.array([np.array(output(state[:n]))[:, 0] for state in states])


def wave(center: float, size: float, rate: float, degree: int, phase: float = 0.0):
    """center + size sin(rate t + phase) and its derivatives."""

    def at(t: float) -> list[float]:
        values = [
            size * rate**j * np.sin(rate * t + phase + j * np.pi / 2) for j in range(degree + 1)
        ]
        return [center + values[0], *values[1:]]

    return at


@pytest.mark.slow
@pytest.mark.parametrize(("make", "speed"), [(unicycle, {"v": 2.5}), (wheels, {"left": 10.0})])
def test_a_figure_of_eight(make, speed):
    """x = 2 sin t, y = sin 2t from beside it: the error is the closed form, over both lobes."""
    extension = dynamic_extension(make(), nominal_control=speed)
    law = TrackingLaw(extension.system, poles(-2.0), structure=extension.structure)
    across, along = wave(0.0, 2.0, 1.0, 2), wave(0.0, 1.0, 2.0, 2)

    def reference(t: float) -> np.ndarray:
        return np.concatenate([across(t), along(t)])

    start = np.array([0.2, -0.1, 0.6, *speed.values()])
    times = np.linspace(0.0, 2 * np.pi, 30)
    outputs = original_loop(extension, law, start, reference, times)
    wanted = np.array([reference(t)[[0, 3]] for t in times])
    predicted = law.predicted_error(times, start, reference(0.0))
    np.testing.assert_allclose(predicted[0], [0.2, -0.1], rtol=1e-15)
    # The integrator keeps 1e-11 a step of numbers of order 1.
    np.testing.assert_allclose(outputs - wanted, predicted, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_load_on_a_crane():
    """The load moves on an ellipse with the predicted error, by trolley and winch."""
    extension = extension_of("crane")
    law = TrackingLaw(extension.system, poles(-3.0), structure=extension.structure)
    across, up = wave(0.0, 0.3, 1.5, 4), wave(-1.0, 0.1, 1.5, 4, np.pi / 2)

    def reference(t: float) -> np.ndarray:
        return np.concatenate([across(t), up(t)])

    start = extension.structure.manifold.project(extension.system.nominal_state)
    times = np.linspace(0.0, 3.0, 10)
    outputs = original_loop(extension, law, start, reference, times)
    wanted = np.array([reference(t)[[0, 5]] for t in times])
    predicted = law.predicted_error(times, start, reference(0.0))
    assert np.abs(predicted[1:]).max() > 0.05
    # The integrator keeps 1e-11 a step; the law of order 4 amplifies it.
    np.testing.assert_allclose(outputs - wanted, predicted, rtol=0, atol=1e-8)


# ---- systems that no integrators help


def violation(system: DaeSystem, **options) -> AssumptionError:
    with pytest.raises(AssumptionError) as caught:
        dynamic_extension(system, **options)
    return caught.value


def pair(outputs) -> DaeSystem:
    """Two nonlinear double integrators."""
    return DaeSystem.from_functions(
        4,
        f=lambda x: [x[1], ca.sin(x[0]), x[3], x[0] * x[1]],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 1]],
        l=outputs,
        output_signals=["a", "b"],
        name="pair",
    )


@pytest.mark.parametrize(
    "outputs",
    [
        lambda x: [x[0], 2 * x[0] + 1],
        lambda x: [x[0], ca.sin(x[0])],
        lambda x: [x[0], x[1]],
        lambda x: [x[1], x[0] + x[1]],
        lambda x: [x[0], x[0] * x[1] + x[1]],
    ],
)
def test_outputs_that_depend_on_each_other(outputs):
    """One is a function of the other, of its derivative, or of both."""
    error = violation(pair(outputs))
    assert error.assumption == 5
    assert "the outputs a, b and their derivatives depend on each other" in str(error)


def test_outputs_that_depend_on_each_other_through_the_motion():
    """b' = a + b, found when the chains meet."""
    system = DaeSystem.from_functions(
        5,
        f=lambda x: [x[1], 0, x[0] + x[2], x[4], 0],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 0], [0, 1]],
        l=lambda x: [x[0], x[2]],
    )
    error = violation(system)
    assert error.assumption == 5
    assert "not right-invertible" in str(error)


def test_outputs_that_depend_on_each_other_are_found_before_integrators_are_added():
    """Beside states that are free, which could feed some rounds."""
    system = DaeSystem.from_functions(
        8,
        f=lambda x: [x[1], ca.sin(x[0]), x[3], x[0], x[5], x[6], x[7], -x[4]],
        h=lambda x: [[0, 0], [1, 0], [0, 0], [0, 1], *[[0, 1]] * 4],
        l=lambda x: [x[0], ca.exp(x[0])],
    )
    assert "not right-invertible" in str(violation(system, max_integrators=0))


def test_an_output_that_repeats_the_constraint():
    def rope(x: ca.SX) -> ca.SX:
        return (x[2] - x[0]) ** 2 + x[3] ** 2 - x[1] ** 2

    error = violation(crane(l=lambda x: [x[2], x[2] + rope(x)]))
    assert error.assumption == 5
    assert "the outputs X, Y and their derivatives depend on each other or on the" in str(error)
    error = violation(crane(l=lambda x: [x[2], rope(x)]))
    assert error.assumption == 5
    assert "the control never acts on output 'Y'" in str(error)


def test_isolated_singularities_are_not_mended():
    """Ball and beam (Hauser, Sastry and Kokotovic 1992): 2 x1 x4 u in x1''' vanishes at rest."""
    system = DaeSystem.from_functions(
        ["ball", "ball'", "beam", "beam'"],
        f=lambda x: [x[1], 0.7143 * (x[0] * x[3] ** 2 - GRAVITY * ca.sin(x[2])), x[3], 0],
        h=lambda x: [0, 0, 0, 1],
        l=lambda x: x[0],
        name="ball and beam",
    )
    error = violation(system)
    assert error.assumption == 4
    assert "singular at isolated states, which more integrators do not mend" in str(error)
    np.testing.assert_array_equal(error.state, np.zeros(4))
    assert dynamic_extension(changed(system, nominal_state=[1, 0, 0, 1])).integrators == {}


@pytest.mark.parametrize(("make", "count"), [(unicycle, "1 before v"), (vtol, "2 before thrust")])
def test_at_rest_another_nominal_control_is_asked_for(make, count):
    error = violation(make())
    name = count.split()[-1]
    assert f'give another nominal_control, for example nominal_control={{"{name}": 1.0}}; ' in str(
        error
    )
    assert str(error).endswith(f"integrators: {count}")
    assert error.state[make().num_states] == 0.0


def test_more_integrators_than_allowed():
    hovering = {"nominal_control": {"thrust": GRAVITY}}
    assert dynamic_extension(vtol(), max_integrators=2, **hovering).integrators == {"thrust": 2}
    error = violation(vtol(), max_integrators=1, **hovering)
    assert error.assumption == 5
    assert "more than max_integrators = 1 are needed" in str(error)
    assert "for a regular B(x) of (16), so far 2 before thrust" in str(error)


def test_a_constraint_that_binds_the_control_forever():
    """No constraint input ever acts on x0' = u, whatever stands before u."""
    system = DaeSystem.from_functions(
        2,
        f=lambda x: [0, 0],
        g=lambda x: [0, 1],
        h=lambda x: [1, 0],
        k=lambda x: x[0],
        l=lambda x: x[1],
        m=lambda x: 0,
    )
    error = violation(system)
    assert error.assumption == 2
    assert "no constraint input ever acts on constraint 'y0'" in str(error)


def test_a_rank_that_changes_from_state_to_state():
    """B = [[1, 0, 0], [1, 0, 0], [1, x3^60, 0]] has rank 2 or, to the eye, 1 around x3 = 1."""
    system = DaeSystem.from_functions(
        4,
        f=lambda x: [0, 0, 0, 0],
        h=lambda x: [[1, 0, 0], [1, 0, 0], [1, x[3] ** 60, 0], [0, 0, 1]],
        l=lambda x: x[:3],
        nominal_state=[0, 0, 0, 1],
    )
    error = violation(system, spread=0.1)
    assert "the rank of B(x) of (16) falls from 2 to 1" in str(error)
    assert 0.5 < error.state[3] < 1.0


def test_a_spread_of_a_wrong_shape_is_refused():
    with pytest.raises(ModelError, match=r"spread must be a number or have shape \(3,\)"):
        dynamic_extension(unicycle(), spread=[0.1, 0.2])


def test_a_robot_keeps_its_mass_matrix():
    """Torques that are set by their rates: force and height of the arm have one degree more.

    And B(x) is the same: what the torque did to z^(mu), its rate does to z^(mu + 1).
    """
    arm = touching("two_link").dae
    names = [signal.name for signal in arm.control_signals]
    plain, slow = find_structure(arm), find_structure(extend(arm, names))
    assert slow.constraint_degrees == plain.constraint_degrees
    assert slow.output_degrees == tuple(degree + 1 for degree in plain.output_degrees)
    for state in slow.states:
        one = evaluated(arm, state[:4], b=plain.control_matrix)[0]
        two = evaluated(slow.system, state, b=slow.control_matrix)[0]
        # A hundred operations on numbers of order 1.
        np.testing.assert_allclose(one, two, rtol=1e-11, atol=1e-12)
