"""Stars of two solutions compared; lists and their truth are made by numpy alone."""

import json

import four_detectors
import numpy as np
import pytest
from night_sets import SIZE, Nights
from numpy.polynomial.polynomial import polyvander2d
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.cli import main


def solved(table, **options):
    table = table.copy()
    del table["block"]
    return ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)), **options)


def halves(nights, moved=None, **options):
    """Solutions of every other night, which have no exposure in common; of the second a star is somewhere else.

    Without motions no times are stated either.
    """
    table = nights.table.copy()
    if "motion" not in options:
        del table["epoch"]
    second = table["block"] % 2 == 1
    if moved is not None:
        table["x"][second & (table["star"] == moved)] += 0.3
    return [solved(table[mine], **options) for mine in (~second, second)]


def without_maps(d, xy, error, degree=3):
    """Differences (n, 2) without a map in plain powers, by weighted least squares."""
    powers = polyvander2d(*(xy / SIZE - 0.5).T, [degree, degree])
    powers = powers[:, np.add.outer(range(degree + 1), range(degree + 1)).ravel() <= degree] / error[:, None]
    return (d / error[:, None] - powers @ np.linalg.lstsq(powers, d / error[:, None], rcond=None)[0]) * error[:, None]


def columns(table, *names):
    return np.column_stack([table[name].value for name in names])


@pytest.mark.slow
def test_with_and_without_a_night_nothing_is_significant(tmp_path, capsys):
    nights = Nights(5, nights=6, per=3, odd=0.5, roll=0.7, n_stars=100, motion=0.05)
    whole, part = (solved(each, motion="proper") for each in (nights.table, nights.table[nights.table["block"] != 3]))
    found = ld.difference(whole, part)
    assert found.shared == part.names
    assert found.agrees is None
    assert np.isnan([found.p, found.chi2, found.stars.places.p, found.stars.motions.p]).all()
    assert "n0e0, n0e1, n0e2 and 12 more are in both, so that their errors are not independent" in found.sentence
    one, two, year = whole.stars, part.stars, whole.stars.meta["epoch"]
    assert two.meta["epoch"] != year == found.stars.epoch
    order = np.argsort(found.stars.table["star"])
    kept = np.isin(one["star"], found.stars.table["star"])
    one, two = one[kept], two[np.isin(two["star"], one["star"][kept])]
    later = columns(two, "x", "y") + columns(two, "vx", "vy") * (year - two.meta["epoch"])
    error = np.sqrt(np.mean(columns(one, "x_err", "y_err") ** 2, axis=1))
    then = part.stars_at(year)
    then = then[np.isin(then["star"], one["star"])]
    error = np.maximum(error, np.sqrt(np.mean(columns(then, "x_err", "y_err") ** 2, axis=1)))
    left = without_maps(later - columns(one, "x", "y"), columns(one, "x", "y"), error)
    assert_allclose(columns(found.stars.table[order], "dx", "dy"), left, atol=2e-5)  # less a turn of 1e-4
    assert_allclose(found.stars.places.rms, np.sqrt(np.mean(left**2)), rtol=0.01)
    assert found.stars.places.ratio < 1  # what is lost with a sixth of the data is less than the errors
    assert found.stars.places.rms_similarity > found.stars.places.rms

    paths = [str(each.write(tmp_path / f"{name}.asdf")) for name, each in (("all", whole), ("part", part))]
    assert main(["difference", *paths, "--strict"]) == 0
    text = capsys.readouterr().out
    assert f"{len(one)} stars in both, of {len(whole.stars)} and {len(part.stars)}: places at {year:.4f} differ" in text
    assert "Motions differ by" in text
    assert main(["difference", *paths, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["shared_exposures"] == list(part.names)
    assert figures["p"] is figures["stars"]["places_px"]["p"] is None
    assert figures["stars"]["places_px"]["rms"] == pytest.approx(found.stars.places.rms)
    assert len(figures["stars"]["largest"]) == 5


@pytest.mark.slow
def test_differences_in_mas_where_the_pixel_scale_is_stated():
    one, two = halves(Nights(5, nights=4, per=3, n_stars=100, motion=0.05), motion="proper", pixel_scale=0.02)
    found = ld.difference(one, two).stars
    assert "At 0.02 arcsec a pixel: places " in "\n".join(found.lines())
    assert found.to_dict()["angles"] == pytest.approx(
        {
            "places_similarity_mas": 20 * found.places.rms_similarity,
            "places_mas": 20 * found.places.rms,
            "motions_similarity_mas_yr": 20 * found.motions.rms_similarity,
            "motions_mas_yr": 20 * found.motions.rms,
        }
    )
    assert one.stars.meta["pixel_scale"] == 0.02
    assert one.stars["x"].unit == "pix"
    assert ld.difference(*halves(Nights(2, n_stars=100))).stars.to_dict()["angles"] is None


def test_a_star_that_is_somewhere_else_is_named():
    right, wrong = (ld.difference(*halves(Nights(2, n_stars=120), moved)) for moved in (None, 17))
    assert right.shared == wrong.shared == ()
    assert right.agrees
    assert right.stars.places.p > 1e-3
    assert right.stars.places.ratio == pytest.approx(1, abs=0.15)
    assert right.stars.motions is None
    assert wrong.stars.places.p < 1e-6
    assert wrong.stars.table["star"][0] == 17
    assert wrong.stars.table["dx"][0].value == pytest.approx(0.3, abs=0.06)


def test_names_that_were_exchanged_are_of_other_stars():
    """They are left out, in place of a difference of hundreds of pixels that all others show too."""
    first, second = halves(Nights(11, nights=4, n_stars=80, roll=0.0))
    usual = ld.difference(first, second).stars
    table = second.residuals["exposure", "star", "x", "y", "x_err", "y_err"]
    a, b = usual.table["star"][:2]
    table["star"][...] = np.where(table["star"] == a, b, np.where(table["star"] == b, a, table["star"]))
    found = ld.difference(first, ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)))).stars
    assert len(found.table) == len(usual.table) - 2
    assert not {a, b} & set(found.table["star"])
    assert found.places.rms < 1.5 * usual.places.rms


def test_years_without_motions_have_no_chance():
    """They are the motions of the stars, which no error of the two has; and without years there is one."""
    nights = Nights(2, nights=4, per=3, n_stars=120, motion=0.05)
    table = nights.table.copy()
    years = np.asarray(table["epoch"])
    early = years < np.median(years)
    pair = [solved(table[mine]) for mine in (early, ~early)]
    gap = np.mean(years[~early]) - np.mean(years[early])
    for one, two, word in ((*pair, "later"), (*pair[::-1], "earlier")):
        found = ld.difference(one, two).stars
        assert np.isnan(found.places.p)
        assert abs(found.to_dict()["unmoved_yr"]) == pytest.approx(gap, rel=0.05)
        assert f"years {word}, and neither has motions: the stars moved by these years of them" in str(found.lines())
    table["epoch"] = 2020.0
    found = ld.difference(*(solved(table[mine]) for mine in (early, ~early))).stars
    assert found.years == 0
    assert found.places.p < 1e-6


@pytest.mark.slow
def test_stars_of_other_names_are_found_by_their_places():
    nights = Nights(3, nights=4, per=3, n_stars=120, roll=0.0)
    other = nights.table.copy()
    other["star"] = np.random.default_rng(0).permutation(120)[other["star"]]
    second = other["block"] % 2 == 1
    first = solved(nights.table[~second])
    named, anew = (ld.difference(first, solved(each[second])).stars for each in (nights.table, other))
    assert_allclose(anew.places.rms, named.places.rms, rtol=0.02)
    assert len(anew.table) == len(named.table)
    assert ld.difference(first, solved(Nights(4, nights=2, per=3, n_stars=120).table)).stars is None  # another field


@pytest.mark.slow
def test_frames_that_were_measured_anew_are_the_same():
    nights = Nights(3, nights=2, per=3, n_stars=100, roll=0.0)
    again = nights.table.copy()
    again["x"] += np.random.default_rng(0).normal(0, 0.01, len(again))
    first, second = solved(nights.table), solved(again)
    assert ld.difference(first, second).shared == first.names
    again["epoch"] += 1.0  # a year later at the same place: other exposures, of the same names
    assert ld.difference(first, solved(again)).shared == ()


@pytest.mark.slow
def test_a_camera_of_nights_knows_which_it_has(tmp_path):
    table = Nights(6, nights=4, per=4, n_stars=100).table
    nights = [solved(table[table["block"] == k]) for k in range(4)]
    camera = ld.combine_nights(nights[:3])
    camera.write(tmp_path / "camera.asdf")
    for given in (camera, tmp_path / "camera.asdf"):
        inside, outside = (ld.difference(given, nights[k]) for k in (1, 3))
        assert inside.shared == nights[1].names
        assert inside.agrees is None
        assert outside.shared == ()
        assert outside.agrees


def test_stars_are_compared_where_maps_cannot_be():
    """Of a camera whose static distortions were held, nothing is known of these."""
    first, second = (ld.solve(four_detectors.matches("layout", 1), layout="fit", degree=d) for d in (1, 2))
    found = ld.difference(first, second)
    assert "are not compared: the first map was solved with the static distortions of camera FOUR" in str(found)
    assert found.agrees is None
    assert len(found.stars.table) > 100
    assert found.to_dict()["modes"] == []
    with pytest.raises(ld.exceptions.InputError, match="no picture of maps that are not compared"):
        found.plot()


@pytest.mark.sets
def test_chances_of_stars_are_even():
    """Halves of eight nights, with motions: squares over those of the errors, and p, which is anything."""
    sets = (Nights(seed, n_stars=120, motion=0.05) for seed in range(8))
    found = [ld.difference(*halves(nights, motion="proper")).stars for nights in sets]
    for each in ("places", "motions"):
        ratios, chances = (np.array([getattr(getattr(f, each), name) for f in found]) for name in ("ratio", "p"))
        assert np.mean(ratios**2) == pytest.approx(1, abs=0.12)
        assert chances.min() > 1e-4
        assert 0.2 < chances.mean() < 0.85
    assert np.mean([f.places.ratio_similarity**2 for f in found]) == pytest.approx(1, abs=0.9)
