"""What a run says of what is approximate in it."""

import pytest

from drake_dae.cli import main

SHORT = ("--set", "duration=0.02", "--set", "write={plots: false, animation: false}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("wall_point_contact", (), True),
        ("two_link_wall", (), False),
        ("two_link_wall", ("--set", "plant=!MultibodyPlant {radius: 0.004}"), True),
    ],
)
def test_a_run_on_drakes_contact_says_that_its_ball_rolls(name, settings, told, tmp_path, capsys):
    assert main(["simulate", name, *SHORT, *settings, "--out", str(tmp_path / "run")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert ("Where the robot tilts by an angle a the ball rolls" in words) is told
    assert ("contact is that of a ball of 4 mm" in words) is bool(settings)
