"""What is not determined, in words."""

import pytest

from legdistort.results.gauge import in_words


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["shear", "shear"], "shear"),
        (["z^2", "i z^2"], "change of scale over the field (z^2, i z^2 with z = x + iy)"),
        (["z^3", "degree 2"], "change of scale over the field (z^3 with z = x + iy) and maps of degree 2"),
        (["degree 2", "shear", "degree 3"], "shear and maps of degree 2, 3"),
    ],
)  # fmt: skip
def test_names_for_a_reader(names, words):
    assert in_words(iter(names)) == words
