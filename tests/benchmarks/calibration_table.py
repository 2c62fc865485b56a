"""Reported absolute errors against true ones, over many simulated sets.

``python tests/benchmarks/calibration_table.py``. The truth is made of Chebyshev polynomials in pixels
(``numpy.polynomial.chebyshev``), none of it by the package. Every set has a static distortion of its own, drawn with
the width that the prior states, or 3 px rms where there is none, and exposures that depart from it independently.
Errors are those of the star positions once a similarity of the plane and the unknown directions that the solution
names are taken off.
"""

import argparse
import logging
import warnings

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.polynomial import chebyshev

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

SIZE = 2048
#: Rms per axis over the detector, pixels: of the static distortion, and of what changes from exposure to exposure.
STATIC, DYNAMIC = 3.0, 0.4
DEGREE = 3


def similarity_fields(xy, *, centre=None):
    """Displacements (2 n, 4), x first, by which a similarity about a centre (their mean) moves positions (n, 2)."""
    x, y = (xy - (xy.mean(axis=0) if centre is None else centre)).T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    return np.stack([np.r_[one, zero], np.r_[zero, one], np.r_[x, y], np.r_[-y, x]], axis=1)


def without(vector, columns):
    """What is left of a vector once a combination of columns is fitted and taken off."""
    return vector - columns @ np.linalg.lstsq(columns, vector, rcond=None)[0]


def random_field(rng, rms):
    """Chebyshev coefficients (2, 4, 4) of a cubic displacement of so many pixels, rms per axis, no similarity in it."""
    i, j = np.indices((DEGREE + 1, DEGREE + 1))
    c = rng.normal(size=(2, *i.shape)) * (i + j <= DEGREE) / (1 + i + j)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 25)] * 2))
    field = np.concatenate([chebyshev.chebval2d(x, y, each) for each in c])
    similar = similarity_fields(np.column_stack([x, y]))
    shift_x, shift_y, scale, turn = np.linalg.lstsq(similar, field, rcond=None)[0]
    c[0, 0, 0] -= shift_x
    c[1, 0, 0] -= shift_y
    c[0, 1, 0] -= scale
    c[1, 0, 1] -= scale
    c[0, 0, 1] += turn
    c[1, 1, 0] -= turn
    return c * rms / np.sqrt(np.mean(without(field, similar) ** 2))


def displacement(c, q):
    """Displacement (n, 2) at undistorted pixels (n, 2)."""
    x, y = (2 * (q + 0.5) / SIZE - 1).T
    return np.column_stack([chebyshev.chebval2d(x, y, each) for each in c])


def simulated(
    seed, *, n_exposures=11, n_stars=70, dither=150.0, rolls=False, sigma=0.02, static=STATIC, dynamic=DYNAMIC
):
    """Matches, true positions by star, and the Chebyshev coefficients of the static distortion."""
    rng = np.random.default_rng(seed)
    common = random_field(rng, static)
    margin = 2 * dither
    sky = rng.uniform(-margin, SIZE + margin, (round(n_stars * (1 + 2 * margin / SIZE) ** 2), 2))
    middle, rows, poses = np.full(2, SIZE / 2 - 0.5), [], {}
    for i in range(n_exposures):
        angle = np.radians(33.0 * i if rolls else rng.normal(0, 0.1))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift = middle + rng.normal(0, dither, 2) - turn @ middle
        q = sky @ turn.T + shift
        x = q + displacement(common + (random_field(rng, dynamic) if dynamic else 0), q)
        inside = ((x > 0) & (x < SIZE - 1) & (q > -0.5) & (q < SIZE - 0.5)).all(axis=1)
        x += rng.normal(0, sigma, x.shape)
        poses[f"e{i:02d}"] = np.column_stack([turn, shift])
        rows += [(f"e{i:02d}", k, *x[k], sigma, sigma) for k in np.flatnonzero(inside)]
    table = QTable(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"])
    for name in ("x", "y", "x_err", "y_err"):
        table[name] *= u.pix
    table = table[np.bincount(table["star"])[table["star"]] >= min(3, n_exposures)]
    return ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses), sky, common


def as_prior(common, rng, static_sigma=None):
    """The static distortion as a `Prior`, off by a draw of `static_sigma` (2, n_modes) if that is given."""
    from astropy.modeling import models

    domain = {f"{axis}_domain": (-0.5, SIZE - 0.5) for axis in "xy"}
    parts = [models.Chebyshev2D(DEGREE, DEGREE, **domain) for _ in range(2)]
    for part, c in zip(parts, common, strict=True):
        for (i, j), value in np.ndenumerate(c):
            setattr(part, f"c{i}_{j}", value)
    model = models.Identity(2) + (models.Mapping((0, 1, 0, 1)) | parts[0] & parts[1])
    prior = ld.Prior.from_model(model, shape=(SIZE, SIZE), degree=DEGREE, direction="reference_to_detector")
    if static_sigma is None:
        return prior
    mean = prior.mean + rng.normal(size=prior.mean.shape) * static_sigma
    return ld.Prior(mean, static_sigma=np.broadcast_to(static_sigma, mean.shape))


def catalogue(sky, solution_stars, n, rng, sigma=0.005):
    """A reference of n stars with errors."""
    chosen = rng.permutation(np.unique(solution_stars))[:n]
    xy = sky[chosen] + rng.normal(0, sigma, (len(chosen), 2))
    table = QTable({"star": chosen, "x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix})
    table["x_err"] = table["y_err"] = np.full(len(chosen), sigma) * u.pix
    return table


WIDTHS = np.concatenate([np.zeros(3), np.full(7, 0.3)])  # of the prior mean, by mode, pixels


def settings():
    """``{name: (arguments of simulated, function (matches, sky, common, rng) -> arguments of solve)}``."""
    none = lambda *_: {}  # noqa: E731
    exact = lambda m, s, c, r: {"prior": as_prior(c, r)}  # noqa: E731
    stated = lambda m, s, c, r: {"prior": as_prior(c, r, WIDTHS)}  # noqa: E731
    sized = lambda *_: {"prior": ld.Prior(None, static_sigma=STATIC)}  # noqa: E731
    fit = lambda *_: {"static": "fit"}  # noqa: E731
    auto = lambda *_: {"degree": "auto"}  # noqa: E731

    def tied(n, also=none):
        def arguments(matches, sky, common, rng):
            return also(matches, sky, common, rng) | {"reference": catalogue(sky, matches.table["star"], n, rng)}

        return arguments

    out = {
        "no prior": ({}, none),
        "no prior, 400 px dithers": ({"dither": 400.0}, none),
        "no prior, rolls": ({"rolls": True}, none),
        "no prior, no dithers": ({"dither": 0.0}, none),
        "prior, exact": ({}, exact),
        "prior with static_sigma": ({}, stated),
        "size declared": ({}, sized),
        "static='fit', no rolls": ({"dynamic": 0.0, "dither": 300.0}, fit),
        "static='fit', rolls": ({"dynamic": 0.0, "dither": 300.0, "rolls": True}, fit),
        "degree='auto'": ({}, auto),
    }
    for n in (5, 12, 20, 40, 200):
        many = {"n_stars": 250} if n == 200 else {}
        out[f"{n} reference stars"] = (many, tied(n))
        out[f"{n} reference stars, prior"] = (many, tied(n, exact))
    return out


def one(seed, simulating, solving):
    """True and reported mean square error, and what is unknown, of one set."""
    matches, sky, common = simulated(seed, **simulating)
    rng = np.random.default_rng(1_000_000 + seed)
    solution = ld.solve(matches, **solving(matches, sky, common, rng))
    good = np.isfinite(solution.positions[:, 0])
    true, got = sky[np.asarray(solution.stars["star"])[good]], solution.positions[good]
    unknown = solution.gauge.unknown
    columns = [np.zeros((2 * len(got), 0)), *(each.stars[good].T.reshape(-1, 1) for each in unknown)]
    if solution.gauge.tie is None:
        columns.append(similarity_fields(true))
    left = without((got - true).T.ravel(), np.hstack(columns))
    reported = solution.absolute_covariance(without_unknown=True)[good]
    return np.mean(left**2), np.mean(np.einsum("nkk->nk", reported)), tuple(each.name for each in unknown)


def row(name, n_sets, **changed):
    """The figures of a setting over many sets."""
    simulating, solving = settings()[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        results = [one(seed, simulating | changed, solving) for seed in range(n_sets)]
    true, reported = np.mean([r[:2] for r in results], axis=0)
    named = [r[2] for r in results]
    return true, reported, max(set(named), key=named.count)


def command_line(description):
    """What was asked for; the package keeps silent."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--exposures", type=int, nargs="+", default=[11, 6, 4])
    parser.add_argument("--only", default="", help="settings whose names contain this")
    logging.getLogger("legdistort").setLevel(logging.ERROR)
    return parser.parse_args()


def main():
    arguments = command_line(__doc__)
    print(f"{'setting':32s} {'exposures':>9s} {'true rms':>9s} {'reported':>9s} {'ratio^2':>8s}  unknown")
    for name in settings():
        for n in arguments.exposures if arguments.only in name else []:
            true, reported, unknown = row(name, arguments.sets, n_exposures=n)
            words = ", ".join(dict.fromkeys(unknown)) or "-"
            print(
                f"{name:32s} {n:9d} {true**0.5:9.4f} {reported**0.5:9.4f} {true / reported:8.2f}  {words}", flush=True
            )


if __name__ == "__main__":
    main()
