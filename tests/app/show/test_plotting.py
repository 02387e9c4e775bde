"""A figure that is laid out once looks as matplotlib renders it."""

import csv
import io

import cv2
import numpy as np

from armsight.app.show.plotting import DPI, data_csv, drawing, new_figure, png, svg


def figure():
    """One with all that takes room: labels, titles, a legend, an annotation, axes in space."""
    made = new_figure(3.0)
    x = np.linspace(0, 20, 300)
    flat = made.add_subplot(1, 2, 1)
    flat.plot(x, 1e4 * np.sin(x), label="a line")
    flat.set(title="a title", xlabel="along, s", ylabel="across, mm")
    flat.annotate("a word", (4.0, 0.0), (3, -8), textcoords="offset points")
    flat.legend()
    space = made.add_subplot(1, 2, 2, projection="3d")
    space.plot(np.cos(x), np.sin(x), x)
    space.set_xlabel("x, mm")
    return made


def saved(made, **how):
    data = io.BytesIO()
    made.savefig(data, **how)
    return data.getvalue()


def test_a_figure_has_the_pixels_and_the_lines_that_matplotlib_gives_it():
    with drawing():
        plain, ours = figure(), figure()
        expected = saved(plain, format="png", dpi=DPI)
        plain.set_layout_engine("none")  # lines where the pixels are
        lines = saved(plain, format="svg", metadata={"Date": None, "Creator": None})
        data = png(ours)
        assert svg(ours) == lines
    decoded = [cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_UNCHANGED) for each in (data, expected)]
    np.testing.assert_array_equal(*decoded)


def test_the_data_of_a_figure_are_its_points_bars_arrows_and_cells():
    with drawing():
        made = new_figure(3.0)
        ax, other = made.subplots(1, 2)
        ax.plot([1.0, 2.0], [3.0, np.nan], label="a line")
        ax.axhline(7.0)  # lies at no data
        ax.scatter([4.0, 5.0], [6.0, 7.0], c=[8.0, 9.0])
        ax.quiver([1.0], [2.0], [3.0], [4.0])
        ax.set(title="of a test", xlabel="along, s", ylabel="across, mm")
        other.bar([1, 3], [2.0, 5.0], width=0.5)
        made.colorbar(other.imshow([[1.0, 2.0], [3.0, 4.0]], extent=(0, 4, 0, 2), aspect="auto"))
        head, *rows = csv.reader(io.StringIO(data_csv(made).decode()))
    cells = [dict(zip(head, row, strict=True)) for row in rows]
    points = [tuple(row[name] for name in ("panel", "series", "x", "y", "value", "u", "v")) for row in cells]
    assert points == [
        ("1", "a line", "1", "3", "", "", ""),
        ("1", "a line", "2", "", "", "", ""),
        ("1", "", "4", "6", "8", "", ""),
        ("1", "", "5", "7", "9", "", ""),
        ("1", "", "1", "2", "", "3", "4"),
        ("2", "", "1", "2", "", "", ""),
        ("2", "", "3", "5", "", "", ""),
        *(
            ("2", "", x, y, v, "", "")
            for x, y, v in (("1", "1.5", "1"), ("3", "1.5", "2"), ("1", "0.5", "3"), ("3", "0.5", "4"))
        ),
    ]
    assert (cells[0]["title"], cells[0]["x axis"], cells[0]["y axis"]) == ("of a test", "along, s", "across, mm")


def test_names_along_an_axis_are_numbers_in_the_data():
    with drawing():
        made = new_figure(2.0)
        made.subplots().plot(["a", "b"], [1.0, 2.0])
        _, *rows = csv.reader(io.StringIO(data_csv(made).decode()))
    assert [row[3:5] for row in rows] == [["0", "1"], ["1", "2"]]
