"""Signals of runs, drawn over each other, and the command that does it."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from runs import scenario

from drake_dae import Record, build_scenario, simulate
from drake_dae.cli import main
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Recorded
from drake_dae.errors import ModelError
from drake_dae.pictures.runs import plot_runs

TIME = np.linspace(0.0, 2.0, 21)
OUTPUTS = (Signal("tool.y", "m"), Signal("wall.force", "N"))


def run(off=0.1):
    """An error of `off` e^-t in y, predicted as half of it; the same name for output and force."""
    desired = np.column_stack([np.sin(TIME), np.full(TIME.size, 20.0)])
    error = np.column_stack([off * np.exp(-TIME), 0.0 * TIME])
    return Record(
        TIME,
        {
            "controlled_output": Recorded(desired + error, OUTPUTS),
            "desired_output": Recorded(desired, OUTPUTS),
            "predicted_error": Recorded(error / 2.0, OUTPUTS),
            "constraint_force": Recorded(desired[:, 1:] + 3.0, OUTPUTS[1:]),
            "control": Recorded(desired, (Signal("motor1", "N m"), Signal("motor2", "N m"))),
        },
    )


def drawn(axis):
    return [np.column_stack(line.get_data()) for line in axis.get_lines() if len(line.get_xdata())]


def test_outputs_with_their_references():
    one, other = run(0.1), run(0.2)
    figure = plot_runs({"one": one, "other": other})
    assert [axis.get_title() for axis in figure.axes] == ["tool.y [m]", "wall.force [N]"]
    curves = drawn(figure.axes[0])
    expected = [
        record[name][:, 0]
        for record in (one, other)
        for name in ("controlled_output", "desired_output")
    ]
    assert len(curves) == 4
    for curve, values in zip(curves, expected, strict=True):
        np.testing.assert_array_equal(curve, np.column_stack([TIME, values]))
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "other", "reference"]


def test_errors_over_the_predicted_ones():
    figure = plot_runs({"one": run(0.1)}, ["tool.y"], errors=True)
    (axis,) = figure.axes
    assert axis.get_yscale() == "log"
    predicted, measured = drawn(axis)
    np.testing.assert_allclose(measured[:, 1], 0.1 * np.exp(-TIME), rtol=1e-14)
    np.testing.assert_allclose(predicted[:, 1], 0.05 * np.exp(-TIME), rtol=1e-14)


def test_a_signal_and_its_entries():
    """A name alone is the output of that name; a signal before it chooses another."""
    record = run()
    titles = [
        [axis.get_title() for axis in plot_runs({"one": record}, names).axes]
        for names in (["control"], ["motor2"], ["wall.force", "constraint_force/wall.force"])
    ]
    assert titles == [
        ["motor1 [N m]", "motor2 [N m]"],
        ["motor2 [N m]"],
        ["wall.force [N]", "wall.force [N]"],
    ]
    both = plot_runs({"one": record}, ["wall.force", "constraint_force/wall.force"]).axes
    assert [drawn(axis)[0][0, 1] for axis in both] == [20.0, 23.0]


def without(record, name):
    return replace(record, signals={k: v for k, v in record.signals.items() if k != name})


@pytest.mark.parametrize(
    ("records", "names", "errors", "message"),
    [
        ({}, [], False, r"\brun\b"),
        ({"a": run()}, ["motor9"], False, "'motor9'"),
        ({"a": run()}, ["control/y"], False, r"control.*'y'"),
        ({"a": run()}, ["motor1"], True, "motor1"),
        (
            {"a": run(), "b": without(run(), "control")},
            ["motor1"],
            False,
            r"'b'.*'motor1'",
        ),
    ],
)
def test_what_cannot_be_drawn(records, names, errors, message):
    with pytest.raises(ModelError, match=message):
        plot_runs(records, names, errors)


def test_a_record_without_prediction_has_its_error():
    figure = plot_runs({"a": without(run(), "predicted_error")}, ["tool.y"], errors=True)
    assert len(drawn(figure.axes[0])) == 1


@pytest.mark.slow
def test_the_command(tmp_path, monkeypatch, capsys):
    bare = ("--set=duration=0.2", "--set=write.plots=false", "--set=write.animation=false")
    folders = [str(tmp_path / name) for name in ("one", "other")]
    for folder in folders:
        assert main(["simulate", "two_link_wall", *bare, f"--out={folder}"]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["plot", *folders, "--errors"]) == 0
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "plot.png").unlink()
    assert main(["plot", *folders, "--all"]) == 0
    assert "one/: outputs.png, errors.png, residual.png, controls.png, path.png" in (
        capsys.readouterr().out
    )
    record = str(tmp_path / "one" / "record.npz")
    assert main(["plot", record, "--signals=wall.force,control", "--out=a.svg"]) == 0
    assert "<svg" in (tmp_path / "a.svg").read_text()
    capsys.readouterr()
    for arguments, said in (
        ([folders[0], "--out=a.txt"], "'a.txt'"),
        ([folders[0], folders[0]], "a run is named twice"),
        ([*folders, "--all", "--errors"], "--all"),
        ([record, "--all"], "scenario.yaml"),
        ([str(tmp_path)], "record.npz"),
        (["nothing"], "nothing"),
        ([folders[0], "--signals=tool.x"], "'tool.x'"),
    ):
        assert main(["plot", *arguments]) == 1
        assert said in capsys.readouterr().err


@pytest.mark.slow
def test_plots_of_a_run_are_the_same_later(tmp_path):
    """With the touch of its contact."""
    short = ["simulate", "wall_guarded", "--set=duration=1.2", "--set=write.animation=false"]
    folders = [tmp_path / name for name in ("at_once", "later")]
    for folder, plots in zip(folders, ("true", "false"), strict=True):
        assert main([*short, f"--set=write.plots={plots}", f"--out={folder}"]) == 0
    assert not [*folders[1].glob("*.png")]
    assert main(["plot", "--all", str(folders[1])]) == 0
    pictures = sorted(folders[0].glob("*.png"))
    assert len(pictures) >= 4
    for picture in pictures:
        assert (folders[1] / picture.name).read_bytes() == picture.read_bytes()


@pytest.mark.slow
def test_plots_that_cannot_be_written_are_told(tmp_path, monkeypatch, capsys):
    def fill(*_arguments, **_options):
        raise OSError(28, "No space left on device")

    bare = ("--set=duration=0.05", "--set=write.animation=false")
    assert main(["simulate", "two_link_wall", *bare, f"--out={tmp_path}"]) == 0
    monkeypatch.setattr(Figure, "savefig", fill)
    (tmp_path / "outputs.png").write_bytes(b"of an earlier time")
    capsys.readouterr()
    assert main(["plot", "--all", "--force", str(tmp_path)]) == 1
    said = f"error: {tmp_path}/outputs.png: No space left on device\n"
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", said)


def test_a_notebook_shows_figures():
    """As PNG, without Matplotlib's inline mode."""
    case = scenario("two_link_wall", "duration=0.05")
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    figure = plot_runs({"one": loop.record(context)})
    assert figure._repr_png_().startswith(b"\x89PNG")
