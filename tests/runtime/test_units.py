"""What has a unit is converted, or refused by name; never is a unit dropped."""

import inspect

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Column, QTable, Table
from astropy.time import Time, TimeDelta

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.runtime.guards.units import UNITS, plain, plain_numbers

#: Read by themselves, with a unit of their own each.
OWN = {"reference_error", "data", "mask", "uncertainty"}
#: Methods for places: what these take is tested beside `View`.
OTHERS = {"Catalogue", "CombinedNights", "EffectivePSF", "Mosaic", "Solution", "Term"}


def _public():
    """Name, function and parameters of everything public that is called with arguments."""
    for name in ld.__all__:
        thing = getattr(ld, name)
        if not inspect.isclass(thing):
            yield name, thing
        elif not issubclass(thing, Exception):
            if name not in OTHERS:
                yield name, thing
            for word, method in vars(thing).items():
                method = getattr(method, "__func__", method)  # of a class method
                if word[0] != "_" and hasattr(method, "__wrapped__"):
                    yield f"{name}.{word}", method


#: Without numbers among their arguments.
PLAIN = {"Matches", "open_exposures", "read_exposures", "read_wcs", "refine"}
FUNCTIONS = {name: function for name, function in _public() if name not in PLAIN}


def _parameters(function):
    """Names of the parameters of a function or class that may be given a number."""
    skipped = {"self", "cls", *OWN}
    parameters = inspect.signature(function).parameters.values()
    return [p.name for p in parameters if p.name not in skipped and p.kind is not p.VAR_KEYWORD]


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_no_unit_is_dropped(function):
    assert _parameters(function)
    for name in _parameters(function):
        values = [3 * u.kg, [3 * u.kg], {"a": 3 * u.kg}, Column([3.0], unit="kg")]
        if UNITS.get(name, (u.kg,))[0].physical_type != "time":
            values += [TimeDelta(3, format="jd")]
        for value in values:
            with pytest.raises(InputError, match=rf"^{name} "):
                function(
                    *[None] * (next(iter(inspect.signature(function).parameters)) in ("self", "cls")), **{name: value}
                )


@pytest.mark.parametrize(
    ("name", "value", "number"),
    [
        ("fwhm", 4.3 * u.pix, 4.3),
        ("fwhm", u.Quantity(4.3), 4.3),
        ("box", 17 * u.pix, 17),
        ("dithers", [(1 * u.pix, 2 * u.pix)], [(1.0, 2.0)]),
        ("spectrum", {2: 4 * u.pix, 3: 1.0}, {2: 4.0, 3: 1.0}),
        ("read_noise", 9 * u.electron, 9.0),
        ("gain", 2 * u.electron / u.ct, 2.0),
        ("gain", 2 * u.electron / u.adu, 2.0),
        ("saturation", 5e4 * u.adu, 5e4),
        ("exposure_time", 2 * u.min, 120.0),
        ("exposure_time", TimeDelta(30, format="sec"), 30.0),
        ("rotations", [0.5 * np.pi * u.rad], [90.0]),
        ("epoch", Time(2013.25, format="jyear"), 2013.25),
        ("epoch", 2013.25 * u.yr, 2013.25),
        ("motion_sigma", "evidence", "evidence"),
        ("sigma", Column([0.1, 0.2], unit="pix"), [0.1, 0.2]),
    ],
)
def test_numbers_of_a_unit(name, value, number):
    found = plain(value, name)
    if isinstance(number, (dict, str)):
        assert found == number
    else:
        np.testing.assert_allclose(found, number, rtol=1e-12)


def test_angles_are_lengths_by_the_pixel_scale():
    # 0.02 arcsec a pixel: 0.4 mas are 0.02 px, 1 mas/yr 0.05 px/yr
    assert plain(0.4 * u.mas, "sigma", 0.02) == pytest.approx(0.02, rel=1e-12)
    assert plain(1 * u.mas / u.yr, "motion_sigma", 0.02) == pytest.approx(0.05, rel=1e-12)
    with pytest.raises(InputError, match="error_floor must be in pix, or give pixel_scale"):
        ld.solve(None, error_floor=1 * u.mas)

    @plain_numbers
    def of(sigma, pixel_scale=None):
        return sigma, pixel_scale

    assert of(0.4 * u.mas, pixel_scale=20 * u.mas / u.pix) == pytest.approx((0.02, 0.02), rel=1e-12)
    assert of(0.4) == (0.4, None)


def test_predict_in_angles_is_predict_in_pixels():
    plain_words = {"n_exposures": 5, "n_stars": 40, "seed": 2, "degree": 2}
    pixels = ld.predict(**plain_words, sigma=0.02, dithers=150.0, spectrum={1: 0.2, 2: 0.1, 3: 0.05})
    angles = ld.predict(
        **plain_words, sigma=0.4 * u.mas, dithers=3 * u.arcsec, pixel_scale=0.02,
        spectrum={1: 4 * u.mas, 2: 2 * u.mas, 3: 1 * u.mas},
    )  # fmt: skip
    assert angles.b == pytest.approx(pixels.b, rel=1e-9)
    assert angles.b_alias == pytest.approx(pixels.b_alias, rel=1e-9)
    row = next(line for line in str(angles).splitlines() if line.startswith("b, star positions"))
    assert float(row.split()[4]) == pytest.approx(20 * pixels.b, rel=1e-2)
    assert "[mas]" in str(angles)


def test_solve_takes_angles_by_the_sky_of_the_matches():
    sim = ld.simulate_matches(n_stars=30, n_exposures=5, sigma=0.02, degree=1, seed=1)
    from legdistort.geometry.tangent_plane import TangentPlane

    scale = 0.05 / 3600
    table = sim.matches.table
    matches = ld.Matches.from_table(
        table, shape=(2048, 2048), poses=sim.matches.poses, sky=TangentPlane(10.0, 20.0, scale * np.eye(2, 3))
    )
    with_angle = ld.solve(matches, degree=1, error_floor=1 * u.mas)
    assert with_angle.diagnostics.error_floor == pytest.approx(0.02, rel=1e-6)


def test_magnitudes_under_the_name_of_fluxes_are_magnitudes():
    table = Table({"exposure": ["a", "a"], "x": [1.0, 2.0], "y": [1.0, 2.0], "x_err": [0.1, 0.1], "y_err": [0.1, 0.1]})
    table["flux"] = Column([15.0, 17.5], unit="mag")
    table["flux_err"] = Column([0.01, 0.1], unit="mag")
    from legdistort.inputs import column_contract

    kept = column_contract.check(table, column_contract.DETECTED, "table")
    assert kept["flux"][0] / kept["flux"][1] == pytest.approx(10.0)
    np.testing.assert_allclose(kept["flux_err"] / kept["flux"], [0.00921034, 0.0921034], rtol=1e-6)
    assert table["flux"][0] == 15.0


def test_the_unit_of_an_image_is_kept():
    rng = np.random.default_rng(1)
    data = rng.normal(100, 5, (30, 30)) * u.electron / u.s
    exposure = ld.Exposure("a", data, uncertainty=np.full((30, 30), 5e3) * u.electron / u.ks, exposure_time=1 * u.min)
    assert u.Unit(exposure.header["BUNIT"]) == u.electron / u.s
    assert exposure.uncertainty[0, 0] == pytest.approx(5.0)
    assert exposure.exposure_time == 60.0
    with pytest.raises(InputError, match="the uncertainty is in kg, the data in"):
        ld.Exposure("a", data, uncertainty=np.ones((30, 30)) * u.kg)


def test_names_of_units_are_those_of_arguments():
    used = {name for function in FUNCTIONS.values() for name in _parameters(function)}
    of_poses = {"shift", "rotation"}
    assert set(UNITS) <= used | of_poses, set(UNITS) - used - of_poses


def test_tables_with_units_are_not_touched():
    stars = QTable({"x": np.linspace(100, 900, 12) * u.pix, "y": np.linspace(900, 50, 12) ** 1.01 * u.pix})
    plan = ld.predict(n_exposures=4, stars=stars, sigma=0.02, degree=1, shape=(1000, 1000))
    assert plan.n_stars == 12
