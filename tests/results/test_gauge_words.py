"""What is not determined, in words."""

from types import SimpleNamespace

import pytest

from legdistort.results.gauge import Gauge, in_words, warning_of


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


@pytest.mark.parametrize("of_camera", [False, True])
@pytest.mark.parametrize("tie", [None, "a tie"])
def test_a_reference_is_advised_where_there_is_none(tie, of_camera):
    known = {"unknown_names": ("shear",), "unknown_in_words": "shear", "static": "fitted", "tie": tie}
    gauge = SimpleNamespace(warning=Gauge.warning.fget(SimpleNamespace(**known)))
    camera, settings = SimpleNamespace(has_focal_plane=of_camera), SimpleNamespace(dynamic=None)
    words = warning_of(SimpleNamespace(gauge=gauge, camera=camera, settings=settings))
    assert ("or tie to a reference" in words) == (tie is None)
    assert words.endswith("or give more stars of the reference") == (tie is not None)
    assert ("match --camera RESULTS" in words) == of_camera
