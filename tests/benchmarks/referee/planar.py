"""Mechanisms in the plane x-y; gravity points along -y."""

from referee.description import PLANAR, Body, Closure, Mechanism, Spring

DOWN = (0.0, -9.81, 0.0)


def rod(name: str, length: float, mass: float, **where: object) -> Body:
    """A uniform thin rod along x from its origin; by default it turns about z."""
    about = round(mass * length**2 / 12, 6)
    return Body(name, mass=mass, center=(length / 2, 0.0, 0.0),
                inertia=(about / 100, about, about), **where)  # fmt: skip


def pin(name: str, a: str, point_a: tuple, b: str, point_b: tuple) -> Closure:
    """Two points that coincide in the plane."""
    return Closure(name, "point", a, (*point_a, 0.0), b, (*point_b, 0.0), axes="xy")


PENDULUM = Mechanism(
    "pendulum",
    (rod("rod", 0.8, 1.3, joints=PLANAR),),
    (pin("pivot", "world", (0.0, 0.0), "rod", (0.0, 0.0)),),
    q=(0.0, 0.0, -0.4),
    v={2: 2.5},
    free=(2,),
    gravity=DOWN,
)

TWO_RODS = Mechanism(
    "two_rods",
    (rod("upper", 0.8, 1.3, joints=PLANAR), rod("lower", 0.6, 0.9, joints=PLANAR)),
    (
        pin("pivot", "world", (0.0, 0.0), "upper", (0.0, 0.0)),
        pin("elbow", "upper", (0.8, 0.0), "lower", (0.0, 0.0)),
    ),
    q=(0.0, 0.0, -0.4, 0.75, -0.3, -1.1),
    v={2: 1.5, 5: -2.0},
    free=(2, 5),
    gravity=DOWN,
)

FOUR_BAR = Mechanism(
    "four_bar",
    (
        rod("crank", 0.12, 0.5),
        rod("coupler", 0.35, 0.8, parent="crank", at=(0.12, 0.0, 0.0)),
        rod("rocker", 0.3, 0.7, at=(0.4, 0.0, 0.0)),
    ),
    (pin("knee", "rocker", (0.3, 0.0), "coupler", (0.35, 0.0)),),
    q=(1.0, -0.35, 1.6),
    v={0: 6.0},
    free=(0,),
    gravity=DOWN,
    torques={0: 0.5},
)

# Andrews' squeezer: the numbers of the Test Set for IVP Solvers; without gravity.
A, B, C = (-0.06934, -0.00227, 0.0), (-0.03635, 0.03273, 0.0), (0.014, 0.072, 0.0)


def squeezer_body(name: str, mass: float, center: tuple, about: float, **where: object) -> Body:
    """A body of the squeezer, flat."""
    return Body(name, mass=mass, center=(*center, 0.0), inertia=(about, about, about), **where)


SQUEEZER = Mechanism(
    "squeezer",
    (
        squeezer_body("K1", 0.04325, (0.00092, 0.0), 2.194e-6),
        squeezer_body(
            "K2", 0.00365, (-0.0115, 0.0), 4.41e-7, parent="K1", at=(0.007, 0.0, 0.0)
        ),
        squeezer_body("K3", 0.02373, (0.01874, 0.01043), 5.255e-6, at=B),
        squeezer_body("K5", 0.0705, (0.02308, 0.00916), 1.169e-5, at=A),
        squeezer_body(
            "K4", 0.00706, (0.0, -0.00579), 5.667e-7, parent="K5", at=(0.04, 0.0, 0.0)
        ),
        squeezer_body("K7", 0.05498, (0.00449, -0.01228), 1.912e-5, at=A),
        squeezer_body(
            "K6", 0.00706, (0.00579, 0.0), 5.667e-7, parent="K7", at=(0.0, -0.04, 0.0)
        ),
    ),
    (
        pin("third", "K3", (0.0, -0.035), "K2", (-0.028, 0.0)),
        pin("fourth", "K4", (0.0, -0.02), "K2", (-0.028, 0.0)),
        pin("sixth", "K6", (0.02, 0.0), "K2", (-0.028, 0.0)),
    ),
    q=(
        -0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449,
        0.487364979543842550225598953530, 0.222668390165885884674473185609,
        1.23054744454982119249735015568, -0.222668390165885884674473185609,
    ),  # beta, theta, gamma, delta, phi, epsilon, omega
    free=(1,),
    gravity=(0.0, 0.0, 0.0),
    torques={0: 0.033},
    springs=(Spring("world", C, "K3", (0.02, -0.018, 0.0), 4530.0, 0.07785),),
)  # fmt: skip


SLIDING_ROD = Mechanism(
    "sliding_rod",
    (Body("rod", PLANAR, mass=1.2, center=(0.0, 0.0, 0.0), inertia=(0.001, 0.04, 0.04)),),
    (
        Closure("ground", "plane", "world", (0.0, 0.0, 0.0), "rod", (-0.35, 0.0, 0.0),
                direction=(0.0, 1.0, 0.0), friction=0.45),
    ),
    q=(0.0, 0.3, 0.9),
    v={0: 1.5, 2: -0.7},
    free=(0, 2),
    gravity=DOWN,
)  # fmt: skip

# The car axis of the Test Set for IVP Solvers, with other numbers: a road that moves up and down
# lifts the right end of a bar without mass. Springs carry the chassis; its left end slides along
# the bar's own y.
UP = ("slide", (0.0, 1.0, 0.0))

CAR_AXIS = Mechanism(
    "car_axis",
    (
        Body("bar", mass=0.0),
        Body("left", (UP,), "bar", mass=4.0),
        Body("right", PLANAR[:2], mass=6.0),
    ),
    (
        Closure("wheel", "plane", "world", (0.0, 0.05, 0.0), "bar", (1.0, 0.0, 0.0),
                direction=(0.0, 1.0, 0.0), road=(0.8, -5.0)),
        Closure("chassis", "distance", "left", (0.0, 0.0, 0.0), "right", (0.0, 0.0, 0.0), size=1.0),
    ),
    q=(0.05, 0.47, 1.0, 0.5),
    v={1: -0.3, 3: 0.6},
    free=(1, 3),
    gravity=DOWN,
    springs=(
        Spring("world", (0.0, 0.0, 0.0), "left", (0.0, 0.0, 0.0), 800.0, 0.5),
        Spring("bar", (1.0, 0.0, 0.0), "right", (0.0, 0.0, 0.0), 700.0, 0.5),
    ),
)  # fmt: skip

PLANAR_MECHANISMS = (PENDULUM, TWO_RODS, FOUR_BAR, SQUEEZER, SLIDING_ROD, CAR_AXIS)
