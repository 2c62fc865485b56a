"""Headers with two detectors in each other's places, or all far from their own, where the camera is turned by 90 deg.

Then no detector by itself ties the exposures before and after the turn to each other.
"""

from dataclasses import replace

import header_layouts
import pytest
from astropy.table import QTable
from astropy.wcs import WCS

import legdistort as ld
from legdistort.cameras.exchanged import check_places
from legdistort.exceptions import InputError


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


def test_exchanged_detectors_are_named():
    """Stars of exposures that are turned do not prove the wrong places which they were matched in."""
    night = night_of(3, (0.0, 0.0, 0.0, 0.0, 0.0, 30.0, 90.0, 90.0), off=1.0)
    words = r"detectors 2 and 3 of camera \w+ seem to be exchanged: .* camera in which they are where they belong"
    with pytest.raises(InputError, match=words):
        ld.match(night.table, exposures=with_two_exchanged(night.exposures))
