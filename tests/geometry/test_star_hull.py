"""Where stars support a map."""

import numpy as np
import pytest

from legdistort.geometry.star_hull import supported_pixels


@pytest.mark.parametrize("turn", [0, 30, 90])
def test_supported_pixels_are_those_between_the_half_planes(turn):
    angle = np.radians(turn) + np.arange(4) * np.pi / 2
    a, b = np.cos(angle).round(12), np.sin(angle).round(12)
    planes = np.column_stack([a, b, -9.25 - 20 * a - 12 * b])  # a square around (20, 12)
    y, x = np.mgrid[:30, :50]
    expected = (a[:, None, None] * x + b[:, None, None] * y + planes[:, 2, None, None] <= 1e-9).all(axis=0)
    assert 300 < expected.sum() < 400
    np.testing.assert_array_equal(supported_pixels(planes, (30, 50)), expected)
    assert not supported_pixels([[0.0, 0.0, 1.0]], (3, 4)).any()
