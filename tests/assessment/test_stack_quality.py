"""Figures of merit of co-added images, on stars drawn here whose widths, ellipticities and places are known."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from legdistort.assessment import baselines, stack_quality
from legdistort.assessment.run_checks import image_check, stack_check
from legdistort.assessment.stack_quality import SINGLE, assess, compare_stacks
from legdistort.assessment.star_shapes import measure_shapes
from legdistort.exceptions import InputError
from legdistort.inputs.exposures import Exposure
from legdistort.plots import stack_plots
from legdistort.priors.prior import Prior
from legdistort.reporting import page as report
from legdistort.simulation.observations import simulate_gsaoi_matches
from legdistort.solving.estimation import solve

WIDTH = 2 * np.sqrt(2 * np.log(2))  # of a Gaussian, in its standard deviations
SIGMA, SKY, OFFSET = 1.9, 50.0, (-80, -90)
FWHM = WIDTH * SIGMA


def gaussians(shape, xy, flux, sx, sy=None, *, theta=0.0, sub=1):
    """Elliptical Gaussian stars, the mean over sub x sub points of every pixel."""
    sy = sx if sy is None else sy
    image = np.full(shape, SKY)
    points = (np.arange(sub) + 0.5) / sub - 0.5
    for (x, y), f in zip(xy, flux, strict=True):
        half = int(8 * max(sx, sy))
        columns = np.arange(max(round(x) - half, 0), min(round(x) + half + 1, shape[1]))
        rows = np.arange(max(round(y) - half, 0), min(round(y) + half + 1, shape[0]))
        if len(columns) == 0 or len(rows) == 0:
            continue
        dx = (columns[:, None] + points).ravel()[None, :] - x
        dy = (rows[:, None] + points).ravel()[:, None] - y
        u, v = dx * np.cos(theta) + dy * np.sin(theta), dy * np.cos(theta) - dx * np.sin(theta)
        fine = np.exp(-((u / sx) ** 2 + (v / sy) ** 2) / 2) * f / (2 * np.pi * sx * sy)
        image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += fine.reshape(
            len(rows), sub, len(columns), sub
        ).mean(axis=(1, 3))
    return image


@dataclass(frozen=True)
class Picture:
    """What of a mosaic is looked at."""

    data: np.ndarray
    offset: tuple | None = OFFSET

    @property
    def shape(self):
        return self.data.shape

    @property
    def flags(self):
        return np.zeros(self.shape, dtype=np.uint8)

    @property
    def footprint(self):
        return np.ones(self.shape, dtype=np.int32)


@pytest.fixture(scope="module")
def night():
    return simulate_gsaoi_matches(small=True, seed=4)


@pytest.fixture(scope="module")
def solution(night):
    return solve(night.matches, prior=Prior(night.truth.static))


@pytest.fixture(scope="module")
def exposures(night):
    truth = night.truth
    return [
        Exposure(name=name, data=gaussians(truth.shape, truth.distort(name, truth.positions), truth.flux, SIGMA))
        for name in truth.names
    ]


def stack(solution, *shape, shift=(0, 0), theta=0.0):
    """A mosaic with stars of this shape, drawn where the solution has them."""
    flux = np.asarray(solution.stars["flux"])
    image = gaussians((680, 700), solution.estimate.positions - OFFSET + shift, flux, *shape, theta=theta)
    return Picture(image.astype(np.float32))


# --- shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fwhm", "sub"), [(2.2, 9), (4.5, 1), (9.0, 1)])
@pytest.mark.parametrize("ellipticity", [0.0, 0.15, 0.4])
def test_known_shapes_are_found(fwhm, sub, ellipticity):
    rng = np.random.default_rng(2)
    sx = fwhm / WIDTH / np.sqrt(1 - ellipticity)
    sy = sx * (1 - ellipticity)
    step = int(12 * fwhm)
    xy = np.stack(np.meshgrid(*[np.arange(1, 5) * step] * 2), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (16, 2))
    image = gaussians((5 * step, 5 * step), xy, np.geomspace(1e3, 1e6, 16), sx, sy, theta=0.7, sub=sub)
    x, y, width, flat, peak, angle = measure_shapes(image, np.round(xy + 0.6), fwhm=fwhm).T
    assert np.abs(np.column_stack([x, y]) - xy).max() < 5e-3
    assert width == pytest.approx(fwhm, rel=0.02)
    assert flat == pytest.approx(ellipticity, abs=0.015)
    if ellipticity:
        assert angle == pytest.approx(np.degrees(0.7), abs=2)
    # what a fine grid holds within two FWHM
    t = np.linspace(-3 * fwhm, 3 * fwhm, 801)
    profile = np.exp(-((t[None] / sx) ** 2 + (t[:, None] / sy) ** 2) / 2) / (2 * np.pi * sx * sy)
    inside = profile[np.hypot(t[None], t[:, None]) < 2 * fwhm].sum() * (t[1] - t[0]) ** 2
    assert peak == pytest.approx(profile.max() / inside, rel=0.03)


def test_what_cannot_be_measured_is_nan():
    xy = np.array([[30.0, 30], [90, 30], [150, 30], [30, 90], [90, 90], [150, 90], [3, 150], [np.nan, 60], [900, 900]])
    image = gaussians((180, 180), xy[:7], np.full(7, 1e5), SIGMA)
    bad = np.zeros(image.shape, dtype=bool)
    bad[30, 90] = True  # its centre
    bad[80:90, 25:40] = True  # much of its surroundings
    image[30, 145] = np.nan  # one pixel of the wing
    image[90, 90] = 1e5
    image[75:105, 135:165] = SKY
    found = np.isfinite(measure_shapes(image, xy, fwhm=FWHM, bad=bad, saturation=5e4)).all(axis=1)
    assert found.tolist() == [True, False, True, False, False, False, False, False, False]
    assert measure_shapes(image, xy[2:3], fwhm=FWHM)[0, 2] == pytest.approx(FWHM, rel=0.02)
    assert measure_shapes(image, np.zeros((0, 2)), fwhm=FWHM).shape == (0, 6)


def test_a_doubled_star_counts_with_all_its_light():
    """No pixel is rejected: the second image of a star makes it wider, whatever a single profile says."""
    one, two = np.array([[60.0, 60]]), np.array([[58.0, 60], [62.0, 60]])
    single = measure_shapes(gaussians((120, 120), one, [1e5], SIGMA), one, fwhm=FWHM)[0]
    double = measure_shapes(gaussians((120, 120), two, [5e4, 5e4], SIGMA), one, fwhm=FWHM)[0]
    assert double[:2] == pytest.approx([60, 60], abs=0.02)
    assert double[2] > 1.2 * single[2]
    assert double[3] > 0.3
    assert double[4] < 0.7 * single[4]


# --- mosaics -----------------------------------------------------------------------------------------------------


def test_perfect_stack(night, solution, exposures):
    found = assess(stack(solution, SIGMA), solution, exposures=exposures, fwhm=FWHM)
    assert found.fwhm == pytest.approx(FWHM, rel=0.02)  # the Moffat profile nearest to a Gaussian
    assert (found.fwhm_ratio, found.peak_ratio) == pytest.approx((1, 1), abs=0.01)
    assert found.ellipticity < 0.01
    assert found.position < 2e-3
    assert found.n_stars >= 10
    assert str(found).startswith(f"{found.n_stars} stars: FWHM 4.4")


@pytest.mark.parametrize(
    "blur", [pytest.param(0.5, marks=pytest.mark.slow), pytest.param(1.0, marks=pytest.mark.slow), 2.0]
)
def test_blur_shows(night, solution, exposures, blur):
    """Gaussians convolved: squares of widths add, peaks go with the area."""
    wide = np.hypot(SIGMA, blur)
    found = assess(stack(solution, wide), solution, exposures=exposures, fwhm=FWHM)
    assert found.fwhm_ratio == pytest.approx(wide / SIGMA, rel=0.01)
    cut = [1 - np.exp(-((2 * FWHM / s) ** 2) / 2) for s in (SIGMA, wide)]  # of the flux, within the aperture
    assert found.peak_ratio == pytest.approx((SIGMA / wide) ** 2 * cut[0] / cut[1], rel=0.02)
    assert found.ellipticity < 0.01


def test_blur_in_one_direction_shows_as_ellipticity(night, solution, exposures):
    wide = np.hypot(SIGMA, 1.5)
    found = assess(stack(solution, wide, SIGMA, theta=1.1), solution, exposures=exposures, fwhm=FWHM)
    assert found.ellipticity == pytest.approx(1 - SIGMA / wide, abs=0.01)
    assert found.fwhm_ratio == pytest.approx(np.sqrt(wide / SIGMA), rel=0.01)


@pytest.mark.slow
def test_positions_are_those_of_the_mosaic(night, solution):
    shifted = assess(stack(solution, SIGMA, shift=(0.3, -0.4)), solution, fwhm=FWHM)
    assert shifted.position == pytest.approx(0.5 / np.sqrt(2 * np.log(2)), rel=0.01)
    rng = np.random.default_rng(5)
    scattered = stack(solution, SIGMA, shift=0.2 * rng.normal(size=solution.estimate.positions.shape))
    found = assess(scattered, solution, fwhm=FWHM)
    assert found.position == pytest.approx(0.2, rel=0.35)  # two dozen stars
    jump = np.zeros_like(solution.estimate.positions)
    jump[np.argsort(solution.stars["flux"])[-2:]] = 2.5  # two blends do not count
    assert assess(stack(solution, SIGMA, shift=jump), solution, fwhm=FWHM).position < 2e-3
    assert np.isnan(found.fwhm_ratio)


def test_offsets_of_single_exposures(night, solution, exposures, monkeypatch):
    """Stars drawn off their places in every exposure: corrected positions scatter as much."""
    rng = np.random.default_rng(6)
    truth, moved = night.truth, []
    for exposure in exposures:
        xy = truth.distort(exposure.name, truth.positions) + 0.1 * rng.normal(size=truth.positions.shape)
        moved.append(Exposure(name=exposure.name, data=gaussians(truth.shape, xy, truth.flux, SIGMA)))
    comparison = {"copy": replace(solution), baselines.METHOD: solution}
    perfect = stack(solution, SIGMA)
    monkeypatch.setattr(stack_quality, "coadd", lambda *args, **kwargs: perfect)
    found = compare_stacks(moved, comparison, mosaic=perfect, fwhm=FWHM).qualities
    assert found[SINGLE].position == pytest.approx(0.1, rel=0.2)
    assert found["copy"].position < 2e-3


def test_stars_lost_anywhere_are_lost_everywhere(night, solution, exposures, monkeypatch):
    whole = stack(solution, SIGMA)
    n = assess(whole, solution, exposures=exposures, fwhm=FWHM).n_stars
    holed = stack(solution, 2 * SIGMA)
    star = np.argmax(solution.stars["flux"])
    x, y = np.round(solution.estimate.positions[star] - OFFSET).astype(int)
    holed.data[y - 3 : y + 4, x - 3 : x + 4] = np.nan
    monkeypatch.setattr(stack_quality, "coadd", lambda frames, made, **options: holed)
    comparison = {"other": replace(solution), baselines.METHOD: solution}
    made = compare_stacks(exposures, comparison, mosaic=whole, fwhm=FWHM)
    assert {q.n_stars for q in made.qualities.values()} == {n - 1}
    assert list(made.qualities) == [SINGLE, "other", baselines.METHOD]
    assert made.qualities["other"].fwhm_ratio == pytest.approx(2, rel=0.02)
    assert made.qualities[SINGLE].fwhm_ratio == made.qualities[SINGLE].peak_ratio == 1
    assert json.loads(json.dumps(made.figures(), allow_nan=False))["other"]["n_stars"] == n - 1
    assert repr(made) == f"<Stacks: 2 corrections, {n - 1} stars, 3 zooms>"


def test_saturated_stars_are_left_out(night, solution, exposures):
    whole = stack(solution, SIGMA)
    n = assess(whole, solution, exposures=exposures, fwhm=FWHM).n_stars
    level = np.sort(solution.stars["flux"])[-3:].mean() / (2 * np.pi * SIGMA**2)
    clipped = [replace(exposure, saturation=float(level)) for exposure in exposures]
    assert n - 5 < assess(whole, solution, exposures=clipped, fwhm=FWHM).n_stars < n


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mosaic": {"offset": None}}, "not on the reference plane"),
        ({"mosaic": {"data": np.full((680, 700), np.nan, dtype=np.float32)}}, "no star could be measured"),
        ({"fwhm": None}, "without a column fwhm: give fwhm="),
        ({"fwhm": np.nan}, "between 0.5 and 200 pixels, got nan"),
        ({"fwhm": 1000.0}, "between 0.5 and 200 pixels, got 1000"),
        ({"max_stars": 0}, "max_stars must be at least 1, got 0"),
        (
            {"exposures": [Exposure(name="stranger", data=np.ones((20, 20)))]},
            "none of the exposures is in the solution",
        ),
    ],
)
def test_bad_input(night, solution, exposures, change, message):
    given = {"exposures": exposures, "fwhm": FWHM} | {k: v for k, v in change.items() if k != "mosaic"}
    mosaic = replace(stack(solution, SIGMA), **change.get("mosaic", {}))
    with pytest.raises(InputError, match=message):
        assess(mosaic, solution, **given)


def test_comparison_needs_the_method(night, solution, exposures):
    with pytest.raises(InputError, match="comparison must hold 'all distortions solved', got shift"):
        compare_stacks(exposures, {"shift": solution}, mosaic=stack(solution, SIGMA), fwhm=FWHM)


# --- the same night with other corrections, really co-added ------------------------------------------------------


@pytest.fixture(scope="module")
def stacks(night, solution, exposures):
    from legdistort.coaddition.mosaicking import coadd

    comparison = baselines.compare(night.matches, solution, prior=Prior(night.truth.static))
    mosaic = coadd(exposures, solution)
    return compare_stacks(exposures, comparison, mosaic=mosaic, fwhm=FWHM), comparison


@pytest.mark.slow
def test_corrections_sharpen_in_turn(stacks):
    made, _ = stacks
    shift, static, _, method = list(made.qualities.values())[1:]
    assert list(made.qualities)[1:] == ["shift", "static + shift", "relative polynomial", baselines.METHOD]
    assert shift.fwhm > static.fwhm > method.fwhm
    assert shift.peak_ratio < static.peak_ratio < method.peak_ratio
    assert shift.position > static.position > 3 * method.position
    assert method.fwhm_ratio < 1.03
    assert method.position < 0.01


@pytest.mark.slow
def test_zooms_have_their_star_in_the_middle(stacks, solution):
    made, comparison = stacks
    assert len(made.zooms) == 3
    places = np.array([zoom.place for zoom in made.zooms])
    middle = np.median(solution.estimate.positions, axis=0)
    assert len({tuple(p > middle) for p in places}) == 3  # one a corner
    for zoom in made.zooms:
        assert list(zoom.cuts) == list(comparison)
        image, (left, right, bottom, top) = zoom.cuts[baselines.METHOD]
        peak = np.unravel_index(np.argmax(image), image.shape)
        assert np.hypot(left + 0.5 + peak[1], bottom + 0.5 + peak[0]) < 1
        assert (right - left, top - bottom) == image.shape[::-1]
        assert zoom.place == pytest.approx(
            solution.estimate.positions[list(solution.estimate.star_names).index(zoom.star)]
        )
        assert repr(zoom) == f"<Zoom: star {zoom.star} in 4 stacks>"


def test_zooms_are_drawn_in_one_stretch(stacks):
    made, comparison = stacks
    axes = stack_plots.plot_zooms(made.zooms, fig=Figure(layout="constrained"))
    assert axes.shape == (3, 4)
    assert [ax.get_title(loc="left") for ax in axes[0]] == list(comparison)
    for row, zoom in zip(axes, made.zooms, strict=True):
        assert len({ax.images[0].get_clim() for ax in row}) == 1
        assert [ax.texts[0].get_text() for ax in row] == [f"FWHM {w:.2f} px" for w in zoom.fwhm.values()]
    assert "[px]" in axes[-1, 0].get_xlabel()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_report_has_the_stacks(stacks, solution, monkeypatch):
    monkeypatch.setattr(report, "_pictures", lambda *args: {"steps": None, "pairs": []})
    made, _ = stacks
    page = report.render(solution, stacks=made, summary={"quality": made.figures()[baselines.METHOD]})
    assert page.count(">Stacks compared</h2>") == 1
    for name, q in made.qualities.items():
        assert f"<tr><td>{name}</td><td>{q.fwhm:.3f}</td><td>{q.fwhm_ratio:.3f}</td>" in page
    assert f"Stars in the mosaic</th><td>{made.qualities[SINGLE].n_stars} stars: FWHM" in page
    assert "a common map of degree" in page or "a common similarity" in page
    assert "Stacks compared" not in report.render(solution)


def test_without_a_mosaic_the_option_that_makes_one_is_named():
    """Also where it is repeated from an earlier run, by the word that leaves it out."""
    checks = [stack_check(None, stacked=False), image_check(None, stacked=False)]
    assert [check.state for check in checks] == 2 * ["unknown"]
    assert all(check.cure.endswith("--forget no-mosaic") and "without --no-mosaic" in check.cure for check in checks)
