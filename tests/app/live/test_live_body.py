"""The board in view: used where nobody named one, offered where one was named."""

import numpy as np
import pytest

from armsight.app.live import body
from armsight.app.live.body import BoardStep
from armsight.app.live.capture import LiveShot
from armsight.app.live.step import SessionOptions, Shared
from armsight.data import Shot


def chessboard(columns, rows):
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    image = np.full((360, 480), 200, np.uint8)
    drawn = np.kron(40 + 160 * squares, np.ones((30, 30))).astype(np.uint8)
    image[40 : 40 + drawn.shape[0], 60 : 60 + drawn.shape[1]] = drawn
    return image


@pytest.mark.parametrize("named", [None, "chessboard:9x6:25mm"])
def test_the_board_in_view_is_used_unless_one_was_named(named, tmp_path):
    said = []
    shared = Shared(SessionOptions(tmp_path, calibration_board=named), tmp_path, lambda level, text: said.append(text))
    step = BoardStep(shared, named or "chessboard:9x6:20mm", lambda rig, path: None)
    other, empty = chessboard(8, 5), np.full((360, 480), 200, np.uint8)
    looks = iter(np.arange(20) * (body._LOOK_S + 1e9))

    def look(left, right):
        for _ in range(2):  # one look alone may catch a board that is being moved
            step.look(LiveShot(Shot("1", left, right), 1, next(looks)))

    look(other, empty)
    assert (step.state.seen, step.state.used) == ("", False)
    look(other, other)
    assert step.state.seen == "chessboard:8x5:20mm"
    assert step.state.spec == (named or "chessboard:8x5:20mm")
    assert step.state.used is (named is None)
    assert [text.startswith("chessboard:8x5:20mm is in view and used") for text in said] == [True] * (named is None)
    step.use_board("chessboard:8x5:24mm")
    look(other, other)
    assert (step.state.spec, step.state.used) == ("chessboard:8x5:24mm", True)  # its lengths are a person's
    step.close()
