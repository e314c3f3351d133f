"""Pictures of a run: what they show, and how they say it."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from drake_dae import Record
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Recorded
from drake_dae.pictures.plots import (
    PLOTS,
    plot_controls,
    plot_errors,
    plot_outputs,
    plot_paths,
    plot_residual,
    save_plots,
)
from drake_dae.pictures.run_motion import ContactPath
from drake_dae.running.phases import phase_spans, phases_at

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
        },
    ), errors


def texts(figure):
    return [axis.get_title() for axis in figure.axes]


def legend(figure):
    (found,) = figure.legends
    return [text.get_text() for text in found.get_texts()]


def curves(axis):
    return {line.get_label(): line for line in axis.get_lines()}


def words(figure):
    """What stands below the axes, on one line."""
    return " ".join(" ".join(text.get_text() for text in figure.texts).split())


def test_outputs_with_their_references():
    """The one that is held at a constant is a line of text, not a panel of noise."""
    run, predicted = record()
    figure = plot_outputs(run, predicted)
    assert texts(figure) == ["z0", "z1 [m]"]
    assert figure.get_supxlabel() == "time [s]"
    assert legend(figure) == ["actual", "reference"]
    assert "held: z2 = 15 m (within 1e-9)" in words(figure)
    for i, axis in enumerate(figure.axes):
        lines = curves(axis)
        for label, name in (("actual", "controlled_output"), ("reference", "desired_output")):
            np.testing.assert_array_equal(lines[label].get_xdata(), TIME)
            np.testing.assert_array_equal(lines[label].get_ydata(), run[name][:, i])
        assert lines["reference"].get_linestyle() == "--"


def test_a_constant_that_is_not_held_has_its_panel():
    run, predicted = record()
    run["controlled_output"][:, 2] += 0.01
    assert texts(plot_outputs(run, predicted)) == ["z0", "z1 [m]", "z2 [m]"]


def test_outputs_that_are_all_held_are_text_alone():
    run, predicted = record(1)
    figure = plot_outputs(run, predicted)
    assert (texts(figure), figure.legends) == ([], [])
    # A pure number; what is off by less than round-off is not told.
    assert words(figure) == "held: z0 = 15 (within 1e-9)"


def test_errors_below_the_accuracy_are_grey_and_none_is_drawn_alone():
    """z0 and z1 decay through it; z2 stays below 1e-6 of its 15 m all the time."""
    run, predicted = record()
    figure = plot_errors(run, predicted, accuracy=1e-6)
    assert texts(figure) == ["|error of z0|", "|error of z1| [m]"]
    assert legend(figure) == ["predicted", "actual", "below the integrator's accuracy"]
    assert "below the integrator's accuracy of 1e-6 all the time: z2 (1e-9 m)" in words(figure)
    # Beside numbers of size one, and beside the largest of those in metres.
    for axis, top in zip(figure.axes, (1e-6, 15e-6), strict=True):
        (band,) = axis.patches
        corners = band.get_extents().transformed(axis.transData.inverted())
        assert corners.y1 == pytest.approx(top, rel=1e-6)


def test_paths_are_drawn_to_scale():
    turn = np.linspace(0.0, 2.0 * np.pi, 50)
    eight = np.column_stack([0.15 * np.sin(turn), 0.6 + 0.08 * np.sin(2.0 * turn)])
    line = np.column_stack([np.zeros(50), 0.3 * turn])
    paths = [ContactPath("wall", eight + 0.01, eight), ContactPath("line", line, line[:20])]
    figure = plot_paths(paths)
    assert texts(figure) == ["path on wall", "path on line"]
    assert legend(figure) == ["desired", "actual", "start"]
    figure.draw_without_rendering()
    for axis, path in zip(figure.axes, paths, strict=True):
        drawn = curves(axis)
        np.testing.assert_array_equal(drawn["actual"].get_xydata(), path.actual)
        np.testing.assert_array_equal(drawn["desired"].get_xydata(), path.desired)
        np.testing.assert_array_equal(drawn["start"].get_xydata(), path.actual[:1])
        assert axis.get_xlabel().endswith("[m]")
        box = axis.get_window_extent()
        scale = np.ptp(axis.get_xlim()) / box.width, np.ptp(axis.get_ylim()) / box.height
        assert scale[0] == pytest.approx(scale[1], rel=1e-6)


def test_errors_over_the_predicted_ones():
    run, predicted = record()
    figure = plot_errors(run, 2.0 * predicted)
    assert texts(figure) == ["|error of z0|", "|error of z1| [m]", "|error of z2| [m]"]
    assert legend(figure) == ["predicted", "actual", "round-off"]
    for i, axis in enumerate(figure.axes):
        assert axis.get_yscale() == "log"
        lines = curves(axis)
        for label, factor in (("actual", 1.0), ("predicted", 2.0)):
            shown = lines[label].get_ydata()
            truth = factor * np.abs(predicted[:, i])
            # Differences of numbers of order 15 carry round-off of 2e-15, and below 3e-15 all is
            # drawn at the floor.
            np.testing.assert_allclose(shown, truth, rtol=1e-12, atol=5e-15)
            low, high = axis.get_ylim()
            assert low < np.min(shown)
            assert np.max(shown) < high
        # The narrow curve stands out from the wide one below it.
        assert lines["predicted"].get_linewidth() > lines["actual"].get_linewidth()
        assert to_hex(lines["predicted"].get_color()) != to_hex(lines["actual"].get_color())


def test_no_error_at_all_is_drawn_at_round_off():
    run, predicted = record()
    run["controlled_output"][:] = run["desired_output"]
    figure = plot_errors(run, 0.0 * predicted)
    for axis, size in zip(figure.axes, (1.0, 1.0, 15.0), strict=True):
        shown = curves(axis)["actual"].get_ydata()
        np.testing.assert_allclose(shown, np.finfo(float).eps * size, rtol=0.01)
        low, high = axis.get_ylim()
        assert high / low > 1e3  # Ticks at whole decades.


def test_residual():
    figure = plot_residual(record(contacts=2)[0])
    (axis,) = figure.axes
    assert axis.get_yscale() == "log"
    assert legend(figure) == ["y0 [m]", "y1 [m]", "y2 [m]", "y3 [m]", "round-off"]
    np.testing.assert_allclose(curves(axis)["y1 [m]"].get_ydata()[1:], 1e-8 * np.sin(TIME[1:]))
    assert "constraint residual" in axis.get_title()
    assert figure.get_supxlabel() == "time [s]"


@pytest.mark.slow
def test_a_legend_of_many_residuals_is_all_in_the_picture():
    figure = plot_residual(record(contacts=7)[0])
    figure.draw_without_rendering()
    box, axes = figure.legends[0].get_tightbbox(), figure.axes[0].get_tightbbox()
    assert len(legend(figure)) == 15
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1
    assert axes.y1 <= box.y0
    assert box.y1 <= figure.bbox.y1


def test_residual_without_constraints():
    assert legend(plot_residual(record(contacts=0)[0])) == ["round-off"]


def test_controls_with_limits_that_are_in_sight():
    figure = plot_controls(record()[0], np.array([1.1, 40.0, np.inf]))
    assert texts(figure) == ["u0 [N m], limit ±1.1", "u1 [N m], limit ±40", "u2 [N m]"]
    lines = [[line.get_ydata() for line in axis.get_lines()[1:]] for axis in figure.axes]
    assert [[data[0] for data in drawn] for drawn in lines] == [[-1.1, 1.1], [], []]
    assert texts(plot_controls(record()[0])) == ["u0 [N m]", "u1 [N m]", "u2 [N m]"]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3, 6, 7])
def test_no_cell_is_empty_and_nothing_overlaps(count):
    figure = plot_errors(*record(count))
    figure.draw_without_rendering()
    assert len(figure.axes) == count
    boxes = [axis.get_tightbbox() for axis in figure.axes] + [figure.legends[0].get_tightbbox()]
    for i, one in enumerate(boxes):
        for other in boxes[i + 1 :]:
            overlap = (
                min(one.x1, other.x1) - max(one.x0, other.x0),
                min(one.y1, other.y1) - max(one.y0, other.y0),
            )
            assert min(overlap) <= 1.0  # Pixels.
    width = figure.bbox.width
    if count in (1, 2, 3, 7):
        assert figure.axes[-1].get_window_extent().width > 0.8 * width
    if count > 2:
        assert figure.axes[0].get_window_extent().width < 0.5 * width


@pytest.mark.slow
def test_saved_as_png(tmp_path):
    run, predicted = record()
    line = np.column_stack([TIME, TIME])
    paths = save_plots(run, predicted, None, tmp_path, [ContactPath("wall", line, line)], 1e-8)
    assert [path.name for path in paths] == list(PLOTS)
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 10_000


@pytest.mark.slow
def test_a_single_moment_can_be_drawn(tmp_path):
    """As a run leaves it that failed in its first step."""
    run, predicted = record()
    start = Record(
        run.time[:1], {k: Recorded(r.values[:1], r.signals) for k, r in run.signals.items()}
    )
    line = np.zeros((1, 2))
    save_plots(start, predicted[:1], None, tmp_path, [ContactPath("wall", line, line)], 1e-8)


def test_the_moment_of_a_change_shows_the_phase_before_it():
    """As a sample there does: the phase that begins is known from the next one on."""
    names = ("0 Approach", "1 Press", "2 Release")
    run = Record(
        np.arange(6.0),
        {"phase": Recorded(np.eye(3)[[0, 0, 0, 1, 1, 2]], tuple(Signal(n, "") for n in names))},
    )
    spans = [(span.name, span.begin, span.end) for span in phase_spans(run)]
    assert spans == [("Approach", 0.0, 2.0), ("Press", 2.0, 4.0), ("Release", 4.0, 5.0)]
    times = np.array([0.0, 1.9, 2.0, 2.1, 4.0, 4.1, 5.0])
    wanted = ["Approach"] * 3 + ["Press"] * 2 + ["Release"] * 2
    assert phases_at(run, times) == wanted
