"""A figure that is laid out once looks as matplotlib renders it."""

import io

import cv2
import numpy as np

from armsight.app.show.plotting import DPI, drawing, new_figure, png, svg


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
