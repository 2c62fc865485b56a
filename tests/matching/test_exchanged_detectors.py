"""Headers with two detectors in each other's places, or all far from their own, where the camera is turned by 90 deg.

Then no detector by itself ties the exposures before and after the turn to each other.
"""

from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.table import QTable
from astropy.wcs import WCS

import legdistort as ld
from legdistort.cameras.exchanged import check_places
from legdistort.exceptions import AssumptionWarning, InputError


def night_of(seed, rolls, **options):
    return header_layouts.Night(seed, n=len(rolls), n_stars=250, dither=30.0, rolls=rolls, **options)


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_detectors_that_are_far_off_are_not_taken_for_exchanged_ones(seed):
    """By 12 px each; it ended with an exposure that shares no star with the others, after all had been matched."""
    night = night_of(seed, (0.0, 0.0, 0.0, 90.0, 90.0), off=12.0)
    table = QTable(night.table)
    table["star"] = table["true"]
    check_places(ld.Matches.from_table(table, camera=ld.Camera.of_frames(night.exposures)))


def with_two_exchanged(exposures):
    """Every exposure with the header of detector 2 at detector 3, and the other way round."""
    headers = {each.name: each.header for each in exposures}
    swapped = {"2": "3", "3": "2"}
    out = []
    for each in exposures:
        header = headers[f"{each.exposure}-{swapped.get(each.detector, each.detector)}"]
        out.append(replace(each, header=header, wcs=WCS(header)))
    return out


def test_exchanged_headers_are_set_right():
    """Stars of exposures that are turned do not prove the wrong places which they were matched in."""
    night = night_of(3, (0.0, 0.0, 0.0, 0.0, 0.0, 30.0, 90.0, 90.0), off=1.0)
    right, wrong = night.exposures, with_two_exchanged(night.exposures)
    with pytest.warns(AssumptionWarning, match="the headers have detectors 2 and 3 in each other's places: with the"):
        matches = ld.match(night.table, exposures=wrong)
    assert len(night.found(matches)) > 0.95 * len(night.crossing())
    places = {key: each.layout for key, each in ld.Camera.of_frames(right).detectors.items()}
    for key, layout in places.items():
        np.testing.assert_allclose(matches.camera[key].layout, layout, atol=1e-6)


def test_a_camera_with_two_exchanged_is_refused():
    night = night_of(3, (0.0, 0.0, 0.0, 0.0, 0.0, 30.0, 90.0, 90.0), off=1.0)
    wrong = with_two_exchanged(night.exposures)
    words = r"detectors 2 and 3 of camera \w+ seem to be exchanged: .* camera in which they are where they belong"
    with pytest.raises(InputError, match=words):
        ld.match(night.table, exposures=wrong, camera=ld.Camera.of_frames(wrong))
