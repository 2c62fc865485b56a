"""Steps between amplifiers: found, whichever way they run, and nothing else is taken for one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from star_images import GAIN, READ_NOISE, errors, image, observe, positions, scattered, usable

from legdistort.inputs.exposures import Exposure
from legdistort.measurement.detection import prepare
from legdistort.measurement.positions import measure
from legdistort.measurement.sky.amplifiers import amplifier_levels

SIZE = 320
XY = scattered(np.random.default_rng(1), 64, SIZE) + np.random.default_rng(2).uniform(-9, 9, (64, 2))
FLUX = np.random.default_rng(3).permutation(np.geomspace(1e3, 2e4, 64))


def frame(seed=1, curved=0.0):
    """Stars on a sky that may be curved; the noise is 8."""
    y, x = np.indices((SIZE, SIZE)) / SIZE
    return observe(image((SIZE, SIZE), XY, FLUX, 3.0) + curved * (x**2 + x * y), np.random.default_rng(seed))


def levels(kind):
    out = np.zeros((SIZE, SIZE), dtype=np.float32)
    if kind == "stripes":
        out += np.repeat([0, 25, -20, 30], SIZE // 4)
    elif kind == "rows":
        out += np.repeat([0, 40, 5, -30], SIZE // 4)[:, None]
    elif kind == "quadrants":
        out[: SIZE // 2, SIZE // 2 :], out[SIZE // 2 :, : SIZE // 2], out[SIZE // 2 :, SIZE // 2 :] = 30, -25, 60
    return out


@pytest.mark.parametrize("kind", ["stripes", "rows", "quadrants"])
@pytest.mark.parametrize("masked", [False, True])
def test_levels_are_found(kind, masked):
    mask = np.zeros((SIZE, SIZE), dtype=bool)
    data = frame(curved=60.0) + levels(kind)
    data[:, 50] += 500  # a bad column is no amplifier
    if masked:
        mask[:, 140:144], mask[200:220, 30:90] = True, True
        data[mask] = 1e6
    found = amplifier_levels(data, mask)
    assert np.abs(found - levels(kind)).max() < 8  # the noise of a pixel


@pytest.mark.parametrize(
    "curved", [0.0, pytest.param(100.0, marks=pytest.mark.slow), pytest.param(600.0, marks=pytest.mark.slow)]
)
def test_no_levels_where_there_are_none(curved):
    for seed in range(12):
        assert amplifier_levels(frame(seed, curved), np.zeros((SIZE, SIZE), dtype=bool)) is None


@pytest.mark.parametrize("shape", [(20, 20), (12, 400), (400, 12), (40, 40_000)])
def test_strips_and_masked_frames_have_none(shape):
    data = np.random.default_rng(1).normal(100, 5, shape).astype(np.float32)
    assert amplifier_levels(data, np.zeros(shape, dtype=bool)) is None
    assert amplifier_levels(data, np.ones(shape, dtype=bool)) is None


def test_stars_on_steps_are_measured_as_without():
    """Across two steps of three times the noise: positions of stars that lie on them, too."""
    pulls = []
    for extra in (0.0, levels("stripes")):
        table = usable(measure(Exposure("e", frame(3) + extra, gain=GAIN, read_noise=READ_NOISE), psf="moffat"))
        off = np.linalg.norm(positions(table)[:, None] - XY, axis=2)
        table, star = table[off.min(axis=1) < 1], off.argmin(axis=1)[off.min(axis=1) < 1]
        assert len(table) > 60
        pulls.append(((positions(table) - XY[star]) / errors(table)).std())
    assert_allclose(pulls, 1.0, atol=0.25)


def test_what_was_taken_off_is_in_the_sky():
    data = frame() + levels("quadrants")
    made = prepare(Exposure("e", data, gain=GAIN))
    assert_allclose(made.signal + made.sky, data, atol=0.02)
    assert abs(np.median(made.signal[:, :160]) - np.median(made.signal[:, 160:])) < 1


def test_a_frame_prepared_again_has_the_same_levels():
    """As where stars turn out to be wide: a step is not looked for twice."""
    exposure = Exposure("e", frame() + levels("stripes"), gain=GAIN)
    first = prepare(exposure)
    assert prepare(exposure, mesh=96, before=first).levels is first.levels
