"""Pictures of a study: what they show of runs whose figures are known."""

import numpy as np
import pytest

from drake_dae.studies.study_plots import plot_histograms, plot_map

FIGURES = {
    "margin of wall.force [N]": ([5.0, 2.0, 7.0, 4.0, 9.0, 8.0], [2.0, 4.0, 8.0]),
    "least wall.force [N]": ([-5.0, 2.0, 7.0, 4.0, -9.0, 8.0], [-5.0, 4.0, -9.0]),
    "largest error of tool.z [m]": ([1.0, 3.0, 2.0, 6.0, 5.0, 4.0], [3.0, 6.0, 5.0]),
    "final error of tool.z [m]": ([-3.0, 1.0, -2.0, -6.0, 5.0, -4.0], [-3.0, -6.0, 5.0]),
}
"""Of six runs, two for each of three places, and the worst of each two."""


@pytest.mark.parametrize("name", FIGURES)
def test_a_map_over_two_keys_shows_the_worst_run_of_each_cell(name):
    """The least margin or force, the largest error; the fourth place has no run."""
    values, worst = FIGURES[name]
    x, y = np.repeat([[0.0, 1.0, 0.0], [5.0, 5.0, 6.0]], 2, axis=1)
    figure = plot_map({"a": x, "b": y}, {name: np.array(values)}, np.ones(6, dtype=bool))
    (cells,) = figure.axes[0].collections
    shown = cells.get_array().reshape(2, 2)
    assert [shown[0, 0], shown[0, 1], shown[1, 0]] == worst
    assert shown.mask.tolist() == [[False, False], [False, True]]


@pytest.mark.parametrize("name", FIGURES)
def test_a_map_over_one_key_draws_the_worst_on_top_and_crosses_what_did_not_finish(name):
    values, worst = FIGURES[name]
    places = np.repeat([0.0, 1.0, 2.0], 2)
    is_finished = np.array([True, True, False, True, True, True])
    figure = plot_map({"a": places}, {name: np.array(values)}, is_finished)
    runs, crosses = figure.axes[0].lines
    drawn = list(zip(runs.get_xdata(), runs.get_ydata(), strict=True))
    assert sorted(drawn) == sorted(zip(places, values, strict=True))
    assert [dict(drawn)[place] for place in (0.0, 1.0, 2.0)] == worst  # The last one of each.
    assert (crosses.get_xdata().tolist(), crosses.get_ydata().tolist()) == ([1.0], [values[2]])


def test_the_dashed_line_of_a_histogram_is_the_median_of_the_runs_that_have_the_figure():
    figure = plot_histograms({"end [s]": np.array([1.0, np.nan, 4.0, 2.0])})
    (line,) = figure.axes[0].lines
    assert line.get_xdata() == [2.0, 2.0]
    assert sum(bar.get_height() for bar in figure.axes[0].patches) == 3.0
