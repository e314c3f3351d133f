"""Plots of runs: what they show, of records made by hand, and the command that draws them."""

from dataclasses import replace
from itertools import pairwise
from shutil import copytree

import numpy as np
import pytest
from matplotlib.figure import Figure
from runs import run_scenario, scenario, some

from drake_dae import Record, plot_runs
from drake_dae.cli import main
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Recorded
from drake_dae.errors import ModelError
from drake_dae.pictures import PLOTS
from drake_dae.pictures.motion import ContactPath, contact_paths, follow
from drake_dae.pictures.plots import figures_of_run, plot_paths, save_plots

TIME = np.linspace(0.0, 2.0, 41)


def record(outputs=3, contacts=1):
    """Output i is sin((i + 1) t), off its reference by 0.1^i exp(-4 t); the last is constant."""
    desired = np.array([np.sin((i + 1) * TIME) for i in range(outputs)]).T
    desired[:, -1] = 15.0
    errors = np.array([0.1**i * np.exp(-4.0 * TIME) for i in range(outputs)]).T
    errors[:, -1] = 1e-9 * np.sin(TIME)
    signals = tuple(Signal(f"z{i}", "m" if i else "") for i in range(outputs))
    controls = np.array([(i + 1) * np.cos(TIME) for i in range(outputs)]).T
    residual = np.abs(np.sin(TIME))[:, None] * 10.0 ** np.arange(-9.0, -9.0 + 2 * contacts)
    return Record(
        TIME,
        {
            "controlled_output": Recorded(desired + errors, signals),
            "desired_output": Recorded(desired, signals),
            "constraint_residual": Recorded(
                residual, tuple(Signal(f"y{i}", "m") for i in range(2 * contacts))
            ),
            "control": Recorded(controls, tuple(Signal(f"u{i}", "N m") for i in range(outputs))),
            "constraint_force": Recorded(desired[:, -1:] + 3.0, signals[-1:]),
        },
    ), errors


def titles(figure):
    return [axis.get_title() for axis in figure.axes]


def legend(figure):
    (found,) = figure.legends
    return [text.get_text() for text in found.get_texts()]


def curves(axis):
    """The drawn lines, without the empty ones that only name a style in the legend."""
    return [line for line in axis.get_lines() if len(line.get_xdata()) > 2]


def test_outputs_with_their_references_and_one_that_does_not_vary_is_a_flat_line():
    run, predicted = record()
    figure = figures_of_run(run, predicted)["outputs.png"]
    assert titles(figure) == ["z0", "z1 [m]", "z2 [m]"]
    assert legend(figure) == ["actual", "reference"]
    for i, axis in enumerate(figure.axes):
        actual, desired = curves(axis)
        np.testing.assert_array_equal(actual.get_ydata(), run["controlled_output"][:, i])
        np.testing.assert_array_equal(desired.get_ydata(), run["desired_output"][:, i])
        assert (actual.get_linestyle(), desired.get_linestyle()) == ("-", "--")
    assert np.ptp(figure.axes[2].get_ylim()) > 1e6 * np.ptp(run["controlled_output"][:, 2])
    assert [axis.get_xlabel() for axis in figure.axes] == ["", "time [s]", "time [s]"]


def test_errors_over_the_predicted_ones():
    run, predicted = record()
    figure = figures_of_run(run, 2.0 * predicted)["errors.png"]
    assert titles(figure) == ["|error of z0|", "|error of z1| [m]", "|error of z2| [m]"]
    assert legend(figure)[:2] == ["actual", "predicted"]
    for i, axis in enumerate(figure.axes):
        assert axis.get_yscale() == "log"
        wide, narrow = curves(axis)
        for line, factor in ((narrow, 1.0), (wide, 2.0)):
            # Differences of numbers of order 15 carry round-off of 2e-15, and below 3e-15 all is
            # drawn at the floor.
            truth = factor * np.abs(predicted[:, i])
            np.testing.assert_allclose(line.get_ydata(), truth, rtol=1e-12, atol=5e-15)
            low, high = axis.get_ylim()
            assert low < np.min(line.get_ydata())
            assert np.max(line.get_ydata()) < high
        assert wide.get_linewidth() > narrow.get_linewidth()
    run["controlled_output"][:] = run["desired_output"]
    figure = figures_of_run(run, 0.0 * predicted)["errors.png"]
    for axis, size in zip(figure.axes, (1.0, 15.0, 15.0), strict=True):
        assert curves(axis)[1].get_ydata().max() <= np.finfo(float).eps * size
        low, high = axis.get_ylim()
        assert high / low > 1e3  # Ticks at whole decades.


def test_residual_and_controls_with_limits_that_are_in_sight():
    run, predicted = record(contacts=2)
    figures = figures_of_run(run, predicted, np.array([1.1, 40.0, np.inf]))
    (axis,) = figures["residual.png"].axes
    assert axis.get_yscale() == "log"
    assert legend(figures["residual.png"]) == ["y0 [m]", "y1 [m]", "y2 [m]", "y3 [m]", "round-off"]
    np.testing.assert_allclose(curves(axis)[1].get_ydata()[1:], 1e-8 * np.sin(TIME[1:]))
    figure = figures["controls.png"]
    assert titles(figure) == ["u0 [N m], limit ±1.1", "u1 [N m], limit ±40", "u2 [N m]"]
    lines = [[line.get_ydata() for line in axis.get_lines()[1:]] for axis in figure.axes]
    assert [[data[0] for data in drawn] for drawn in lines] == [[-1.1, 1.1], [], []]
    assert legend(figures_of_run(*record(contacts=0))["residual.png"]) == ["round-off"]


def test_paths_are_drawn_to_scale():
    turn = np.linspace(0.0, 2.0 * np.pi, 50)
    eight = np.column_stack([0.15 * np.sin(turn), 0.6 + 0.08 * np.sin(2.0 * turn)])
    line = np.column_stack([np.zeros(50), 0.3 * turn])
    paths = [ContactPath("wall", eight + 0.01, eight), ContactPath("line", line, line[:20])]
    figure = plot_paths(paths)
    assert titles(figure) == ["path on wall", "path on line"]
    assert legend(figure) == ["desired", "actual", "start"]
    figure.draw_without_rendering()
    for axis, path in zip(figure.axes, paths, strict=True):
        desired, actual = curves(axis)
        np.testing.assert_array_equal(actual.get_xydata(), path.actual)
        np.testing.assert_array_equal(desired.get_xydata(), path.desired)
        box = axis.get_window_extent()
        scale = np.ptp(axis.get_xlim()) / box.width, np.ptp(axis.get_ylim()) / box.height
        assert scale[0] == pytest.approx(scale[1], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["cart_wall", "seven_joint_wall"]))
def test_paths_are_seen_from_the_free_side(name):
    """Who looks against the normal n, with e up, has e x n to the right."""
    loop, context, run = run_scenario(scenario(name, "duration=0.5"))
    motion = follow(loop, run, context, 8.0)
    path = contact_paths(motion)[0]
    row = next(i for i, c in enumerate(motion.acting.constraints) if c.name == path.name)
    normal = np.array(motion.acting.constraints[row].surface.normal)
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = (motion.points[:, row] - motion.points[0, row]) @ np.cross(up, normal)
    to_pixels = plot_paths([path]).axes[0].transData.transform(path.actual)[:, 0]
    assert np.sign(to_pixels[-1] - to_pixels[0]) == np.sign(across[-1])


@pytest.mark.slow
@pytest.mark.parametrize("count", some([7, 1]))
def test_nothing_overlaps_or_is_cut_off(count):
    for figure in figures_of_run(*record(count, contacts=count)).values():
        figure.draw_without_rendering()
        boxes = [axis.get_tightbbox() for axis in figure.axes] + [figure.legends[0].get_tightbbox()]
        for i, one in enumerate(boxes):
            assert figure.bbox.x0 <= one.x0 <= one.x1 <= figure.bbox.x1
            assert figure.bbox.y0 <= one.y0 <= one.y1 <= figure.bbox.y1
            for other in boxes[i + 1 :]:
                across = min(one.x1, other.x1) - max(one.x0, other.x0)
                assert min(across, min(one.y1, other.y1) - max(one.y0, other.y0)) <= 1.0  # Pixels.


def test_several_runs_over_each_other():
    (one, _), (other, _) = record(), record()
    other["controlled_output"][:] += 0.1
    figure = plot_runs({"one": one, "other": other})
    assert legend(figure) == ["one", "other", "reference"]
    expected = [
        run[name][:, 0] for run in (one, other) for name in ("controlled_output", "desired_output")
    ]
    for line, values in zip(curves(figure.axes[0]), expected, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.column_stack([TIME, values]))
    assert len(curves(plot_runs({"a": one}, ["z0"], errors=True).axes[0])) == 1  # No prediction.


def test_a_signal_and_its_entries():
    """A name alone is the output of that name; a signal before it chooses another."""
    run, _ = record()
    found = [titles(plot_runs({"one": run}, names)) for names in (["control"], ["u2"])]
    assert found == [["u0 [N m]", "u1 [N m]", "u2 [N m]"], ["u2 [N m]"]]
    both = plot_runs({"one": run}, ["z2", "constraint_force/z2"]).axes
    np.testing.assert_allclose([curves(axis)[0].get_ydata()[0] for axis in both], [15.0, 18.0])


def test_dollars_in_names_are_no_mathematics():
    values = Recorded(np.zeros((41, 1)), (Signal("$x^$", "m"),))
    assert titles(plot_runs({"a": Record(TIME, {"own": values})}, ["own"])) == [r"\$x^\$ [m]"]


def without(run, name):
    return replace(run, signals={k: v for k, v in run.signals.items() if k != name})


@pytest.mark.parametrize(
    ("records", "names", "errors", "message"),
    [
        ({}, [], False, r"\brun\b"),
        ({"a": record()[0]}, ["motor9"], False, "'motor9'"),
        ({"a": record()[0]}, ["control/y"], False, r"control.*'y'"),
        ({"a": record()[0]}, ["u1"], True, "u1"),
        ({"a": record()[0], "b": without(record()[0], "control")}, ["u1"], False, r"'b'.*'u1'"),
    ],
)
def test_what_cannot_be_drawn(records, names, errors, message):
    with pytest.raises(ModelError, match=message):
        plot_runs(records, names, errors)


@pytest.mark.slow
def test_a_run_is_drawn_also_if_it_failed_in_its_first_step(tmp_path):
    loop, context, run = run_scenario(scenario("two_link_wall", "duration=0.5"))
    start = {name: Recorded(r.values[:1], r.signals) for name, r in run.signals.items()}
    save_plots(loop, Record(run.time[:1], start), context, tmp_path)
    for name in PLOTS[:-1]:  # A point has no path.
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert plot_runs({"one": run})._repr_png_().startswith(b"\x89PNG")  # As a notebook shows it.


@pytest.mark.slow
def test_the_command(tmp_path, monkeypatch, capsys):
    folders = [str(tmp_path / name) for name in ("one", "other")]
    settings = ("--set=duration=0.2", "--set=write.animation=false", f"--out={folders[0]}")
    assert main(["simulate", "two_link_wall", *settings]) == 0
    copytree(*folders)
    monkeypatch.chdir(tmp_path)
    assert main(["plot", *folders, "--errors"]) == 0
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "plot.png").unlink()
    assert main(["plot", folders[0], "--all"]) == 0
    assert "one/: outputs.png, errors.png, residual.png, controls.png, path.png" in (
        capsys.readouterr().out
    )
    record = str(tmp_path / "one" / "record.npz")
    assert main(["plot", record, "--signals=wall.force,control", "--out=a.svg"]) == 0
    assert "<svg" in (tmp_path / "a.svg").read_text()
    capsys.readouterr()
    for arguments, said in (
        ([folders[0], "--out=a.txt"], "'a.txt'"),
        ([folders[0], folders[0]], folders[0]),
        ([*folders, "--all", "--errors"], "--all"),
        ([record, "--all"], "scenario.yaml"),
        ([str(tmp_path)], "record.npz"),
        (["nothing"], "nothing"),
        ([folders[0], "--signals=tool.x"], "'tool.x'"),
    ):
        assert main(["plot", *arguments]) == 1
        assert said in capsys.readouterr().err

    def fill(*_arguments, **_options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", fill)
    assert main(["plot", "--all", "--force", folders[0]]) == 1
    assert capsys.readouterr().err.startswith(f"error: {folders[0]}/outputs.png: ")


def test_names_of_short_phases_stand_apart():
    times, phase = np.linspace(0.0, 10.0, 101), np.zeros((101, 4))
    for k, begin in enumerate((0, 50, 52, 54)):
        phase[begin:, k], phase[begin:, :k] = 1.0, 0.0
    signals = {
        "control": Recorded(np.zeros((101, 1)), [Signal("u", "N m")]),
        "phase": Recorded(phase, [Signal(f"{k} Move", "") for k in range(4)]),
    }
    figure = plot_runs({"one": Record(times, signals)}, ["control"])
    (axis,) = figure.axes
    assert legend(figure) == ["one"]
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axis.texts]
    assert len(boxes) == 4
    assert all(a.x1 <= b.x0 for a, b in pairwise(boxes))
