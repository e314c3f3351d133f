"""The runs whose records are kept: inputs that no later advice changes."""

from dataclasses import dataclass
from pathlib import Path

FIXTURE = Path(__file__).parents[2] / "golden" / "records.npz"

STEPS = 50
"""A run is advanced so many times; every second of these moments is kept."""

GAINS = (  # As they were computed for wall_point_contact at 77bdd245, with twice the rates.
    "law.gains=!Coefficients {outputs: {tool.y: [33000, 2060, 64.1], tool.z: [33000, 2060, 64.1], "
    "tool.z_axis.y: [1030, 45.4], tool.z_axis.z: [1030, 45.4], joint3: [1030, 45.4], "
    "joint7: [1030, 45.4], wall.force: [19.7]}}",
    "law.integral=[tool.y, tool.z, wall.force]",
    "law.constraint_damping=!Poles {all: [-49.2]}",
    "estimator={rate: 42.8, friction_rate: 10.7, force_rate: 21.4, parameters: [wall.friction]}",
    "sensors.force={sample_period: 0.001}",
)
"""Of the seven joints on a wall that gives way, at 1 kHz."""

SOFT = "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.3}"


@dataclass(frozen=True)
class Case:
    """A run: a shipped scenario, what is changed in it, its fixed step and its duration, in s.

    `contact`: Drake's contact solver makes its steps. `amplifies`: it amplifies round-off, since a
    contact opens and closes. `rolls`: a rollout makes the same run. `is_slow`: `make check` leaves
    it out.
    """

    scenario: str
    settings: tuple[str, ...] = ()
    step: float = 1e-3
    duration: float = 0.5
    contact: bool = False
    amplifies: bool = False
    rolls: bool = False
    is_slow: bool = True

    @property
    def all_settings(self) -> list[str]:
        return [
            "integrator.integration_scheme=runge_kutta3",
            "integrator.use_error_control=false",
            f"integrator.max_step_size={self.step}",
            f"duration={self.duration}",
            "compiled=false",
            *self.settings,
        ]


IDEAL = (
    *("boom", "cart_wall", "conveyor", "crank_turning", "five_bar", "four_bar", "planar_3rrr"),
    *("planar_4rrr", "seven_joint_dome", "seven_joint_flexible", "seven_joint_flexible_motors"),
    *("seven_joint_moving_plate", "seven_joint_pipe", "seven_joint_wall", "slider_crank"),
    *("slider_crank_flexible", "stewart_platform", "three_fingers", "biped", "two_arms"),
    *("two_arms_free_box", "two_link_wall", "two_link_flexible", "two_link_flexible_motors"),
    *("two_link_hydraulics", "two_link_measured_force", "two_link_motors"),
)

QUICK = {"two_link_wall", "seven_joint_wall", "slider_crank", "two_link_flexible_motors"}

PUSHED = (
    "plant.disturbances=[{frame: tool, force: [0, 5, 5], start_time: 0.1003, end_time: 0.3998}]",
    "sampling={period: 0.001, delay: 0.001}",
    "estimator={rate: 20.0}",
    "sensors.force={sample_period: 0.001}",
    "law.gains={all: [-10]}",
)

SEEN = (
    "bounds={wall.position: [[0.69, -0.01, -0.01], [0.71, 0.01, 0.01]], wall.rpy: [-0.15, 0.15]}",
    "constraints.0.rpy=[0, 0, 0]",
    "estimator.parameters=[wall.friction, wall.position, wall.rpy]",
    "plant.parameters={wall.position: [0.701, 0, 0], wall.rpy: [0, 0.02, -0.01]}",
)

CASES = {
    **{
        name: Case(name, step=0.5e-3 if name == "biped" else 1e-3, is_slow=name not in QUICK)
        for name in IDEAL
    },
    "wall_point_contact": Case("wall_point_contact", GAINS, contact=True, is_slow=False),
    "wall_hydroelastic": Case("wall_hydroelastic", GAINS, contact=True),
    "polish_unknown_part": Case("polish_unknown_part", duration=2.0, contact=True),
    # Tasks, completed with the gains of their day.
    **{
        name: Case(str(FIXTURE.with_name(f"{name}.yaml")), duration=3.5, amplifies=True)
        for name in ("wall_polish", "wall_guarded")
    },
    "wall_flexible_contact": Case("wall_flexible_contact", rolls=True),
    # What no scenario covers, on contact that is traced.
    "compliant": Case("wall_point_contact", (*GAINS, SOFT), rolls=True, is_slow=False),
    "encoders": Case(
        "wall_point_contact",
        (
            *GAINS[:3],
            "estimator={rate: 30.0, friction_rate: 7.0, force_rate: 15.0, state_rate: 300.0, "
            "parameters: [wall.friction]}",
            GAINS[4],
            SOFT,
            "sensors.encoders={resolution: 1.0e-5}",
        ),
        rolls=True,
    ),
    "parameters estimated": Case("wall_point_contact", (*GAINS, SOFT, *SEEN), rolls=True),
    "saturation": Case(
        "seven_joint_wall",
        ("saturation=true", "start.errors={tool.y: 0.2}", "law.gains={all: [-30]}"),
        rolls=True,
    ),
    # Rows at samples: Drake's ports then have the control before them, a rollout that after them.
    "disturbance force": Case("seven_joint_wall", PUSHED),
    "stages on compliant contact": Case(
        "two_link_flexible",
        ("plant=!CompliantContact {time_step: 0, stiffness: 1.0e5, friction: 0.1}",),
        step=2e-4,
        rolls=True,
    ),
    "moving surface on compliant contact": Case(
        "seven_joint_moving_plate",
        ("plant=!CompliantContact {time_step: 0, stiffness: 1.0e5, friction: 0}",),
        step=2e-4,
        rolls=True,
    ),
    "a lost contact": Case(
        "wall_point_contact",
        (
            *GAINS,
            SOFT,
            "plant.disturbances=[{frame: tool, force: [-60, 0, 0], start_time: 0.1003, "
            "end_time: 0.2003}]",
        ),
        amplifies=True,
        rolls=True,
    ),
    "a measured surface": Case(
        "seven_joint_wall",
        (
            "constraints.0.surface=!MeasuredSurface {size: [0.8, 0.8], heights: [[0, 0, 0, 0], "
            "[0, 0.01, 0.02, 0], [0, 0.02, 0.01, 0], [0, 0, 0, 0]], point: [0.7, 0, 0.6], "
            "normal: [-1, 0, 0]}",
        ),
        rolls=True,
    ),
}
