"""Image pairs that cannot be matched: each is reported with its reason."""

import cv2
import numpy as np
import pytest
from dense_scenes import layers

from armsight.vision.dense import METHODS, open_method
from armsight.vision.dense.method import Search
from armsight.vision.dense.rectified import match_pair
from asserts import one_line

SEARCH = Search(0, 32)


def pair():
    return layers(height=240, width=320, seed=4)[:2]


def rejected(left, right, *texts, search=SEARCH):
    with one_line(*texts):
        match_pair(open_method("block"), left, right, search)


@pytest.mark.opencv
def test_a_good_pair_passes_without_a_remark():
    said = []
    assert match_pair(open_method("block"), *pair(), SEARCH, said.append).problem is None
    assert said == []


def test_rows_that_are_apart_are_reported():
    left, right = pair()
    rejected(left, np.roll(right, 5, axis=0), "not rectified", "5.0 px")
    rotation = cv2.getRotationMatrix2D((160, 120), 3, 1)
    rejected(left, cv2.warpAffine(right, rotation, (320, 240)), "not rectified")


def test_rows_that_are_a_little_apart_are_a_remark():
    left, right = pair()
    said = []
    match_pair(open_method("block"), left, np.roll(right, 2, axis=0), SEARCH, said.append)
    assert len(said) == 1
    assert "2.0 px apart" in said[0]


@pytest.mark.opencv
def test_exchanged_images_are_reported():
    left, right = pair()
    rejected(right, left, "exchanged")


def test_sizes_and_searches_that_do_not_fit_are_reported():
    left, right = pair()
    rejected(left, right[:-1], "320x240", "320x239")
    rejected(left, right, "outside an image 320 px wide", search=Search(0, 321))
    rejected(left, right, "outside", search=Search(319, 2))


def test_floats_are_taken_unless_they_are_none():
    left, right = pair()
    as_floats = match_pair(open_method("block"), left.astype(np.float32), right.astype(np.float64), SEARCH)
    np.testing.assert_array_equal(as_floats.disparity, match_pair(open_method("block"), left, right, SEARCH).disparity)
    bad = left.astype(np.float32)
    bad[3, 4] = np.nan
    rejected(bad, right, "left image", "1 values are NaN")
    rejected(left, np.full(right.shape, np.inf), "right image", "NaN or infinite")
    rejected(left / 255.0 * 1000, right, "0 to 255")


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_an_image_without_texture_is_an_empty_result_with_the_reason(name, noise):
    rng = np.random.default_rng(0)
    left, right = (np.rint(90 + noise * rng.normal(size=(120, 200))).astype(np.uint8) for _ in "lr")
    result = match_pair(open_method(name), left, right, SEARCH)
    assert "no texture" in result.problem
    assert not result.measured.any()
    assert np.isnan(result.disparity).all()
