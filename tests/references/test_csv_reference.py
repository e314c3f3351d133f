"""A motion from a CSV file: what smoothing costs, and what is wrong with files."""

from pathlib import Path

import numpy as np
import pytest

from drake_dae import CsvReference
from drake_dae.errors import ReferenceSignalError


def wave(folder: Path, delimiter: str = ",") -> Path:
    """y = 0.1 sin(2 t), z = 0.3 t, each 10 ms for 5 s, from t = 2 s on."""
    rows = [("t", "y", "z")]
    for t in np.arange(0.0, 5.0 + 1e-9, 0.01):
        rows.append((f"{t + 2.0}", f"{0.1 * np.sin(2 * t)}", f"{0.3 * t}"))
    file = folder / "wave.csv"
    file.write_text("".join(delimiter.join(row) + "\n" for row in rows))
    return file


@pytest.mark.parametrize("order", [2, 4])
def test_the_error_of_smoothing_is_the_reported_one(order, tmp_path):
    """(order + 2) / 24 smoothing^2 times the acceleration, 0.4, away from the ends; 2 % beside."""
    path = CsvReference(str(wave(tmp_path)), ["y"], "t", smoothing=0.05, order=order)
    function = path.derivatives([2])
    times = np.linspace(1.0, 4.0, 400)
    found = np.array([function(t) for t in times])
    off = found[:, 0] - 0.1 * np.sin(2 * times)
    assert np.abs(off).max() == pytest.approx((order + 2) / 24 * 0.05**2 * 0.4, rel=0.02)
    np.testing.assert_allclose(found[:, 1], 0.2 * np.cos(2 * times), atol=1e-3)
    np.testing.assert_allclose(found[:, 2], -0.4 * np.sin(2 * times), atol=5e-3)


def raster(folder: Path, strokes: int, length: float, times: tuple[float, float]) -> Path:
    """Strokes to and fro along y, each begun beside the last one, with rows at their ends alone."""
    rows, time = ["time,y,z"], 0.0
    for stroke in range(strokes):
        for place, lasting in zip((stroke % 2, 1 - stroke % 2), times, strict=True):
            rows.append(f"{time},{length * place},{0.02 * stroke}")
            time += lasting
    file = folder / "raster.csv"
    file.write_text("\n".join(rows))
    return file


@pytest.mark.parametrize("order", [2, 4, 6])
@pytest.mark.parametrize(
    ("strokes", "length", "times"),
    [(6, 0.16, (2.0, 0.5)), (3, 16.0, (1.0, 1.0)), (2, 1e-3, (9, 1))],
)
def test_few_rows_are_met_within_the_tolerance(strokes, length, times, order, tmp_path):
    """The reference itself is asked at the times of the rows, by the function that the law gets."""
    file = str(raster(tmp_path, strokes, length, times))
    for share in (0.02, 0.001):
        path = CsvReference(file, ["y", "z"], order=order, tolerance=share)
        function = path.derivatives([0, 0])
        off = np.array([np.abs(function(row[0]) - row[1:]) for row in path.table])
        assert np.all(off.max(axis=0) <= share * np.ptp(path.table[:, 1:], axis=0))


def test_smoothing_that_loses_the_rows_is_refused_with_what_is_lost(tmp_path):
    """With 2 s between points, as rows have along strokes, half of each stroke is lost."""
    file = str(raster(tmp_path, 6, 0.16, (2.0, 0.5)))
    wide = CsvReference(file, ["z", "y"], smoothing=2.0, tolerance=1.0)
    function = wide.derivatives([0, 0])
    off = max(abs(function(row[0])[1] - row[2]) for row in wide.table)
    assert off > 0.03
    with pytest.raises(ReferenceSignalError, match=rf"{off:.3g}.*'y'"):
        CsvReference(file, ["z", "y"], smoothing=2.0).derivatives([2, 2])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_columns_are_found_by_name_and_held_at_the_ends(delimiter, tmp_path):
    path = CsvReference(str(wave(tmp_path, delimiter)), ["z", "y"], "t", start_time=1.0)
    function = path.derivatives([2, 1])
    np.testing.assert_allclose(function(0.0), np.zeros(5), atol=1e-15)
    np.testing.assert_allclose(function(9.0), [1.5, 0, 0, 0.1 * np.sin(10.0), 0], atol=1e-15)
    np.testing.assert_allclose(function(3.0)[:3], [0.6, 0.3, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"wave\.csv"),
        ("", "'t'"),
        ("t,x\n0,1\n1,2\n", "'y'"),
        ("t,y\n0,1\n", r"wave\.csv"),
        ("t,y\n0,1\n1,two\n", r"row 3, y: .*'two'"),
        ("t,y\n0,1\n1\n", r"row 3, y: .*''"),
        ("t,y\n0,1\n1,inf\n", r"row 3, y: .*'inf'"),
        ("t,y\n0,1\n1_0,2\n", r"row 3, t: .*'1_0'"),
        ("t;y\n0;1,5\n1;2,5\n", r"row 2, y: .*'1,5'"),
        ("t,y\n0,1\n1,1e300\n", r"row 3, y: .* at most 1e\+15, got '1e300'"),
        ("t,y,y\n0,1,2\n1,2,3\n", r"2 columns .*'y'"),
        ("t, t ,y\n0,0,1\n1,1,2\n", r"2 columns .*'t'"),
        ("t,y\n0,1\n1,2\n1,3\n", r"t .*row 4"),
        (b"\xff\xfe\x00", r"wave\.csv"),
    ],
)
def test_what_is_wrong_with_a_file(text, message, tmp_path):
    file = tmp_path / "wave.csv"
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ReferenceSignalError, match=message):
        CsvReference(str(file), ["y"], "t").derivatives([0])
