"""Reported absolute errors against true ones, over many simulated sets.

``python tests/benchmarks/calibration_table.py`` makes all rows, ``--only`` some, ``--ties`` asks
whether ties to references settle. The truth is made of Chebyshev
polynomials in pixels (``numpy.polynomial.chebyshev``), none of it by the package. Every set has a static distortion of
its own, drawn with the width that the prior states, or 3 px rms where there is none, and exposures that depart from it
independently. Errors are those of the star positions once a similarity of the plane and the unknown directions that the
solution names are taken off, to second order (`legdistort.results.accuracy.known_offsets`); the noise that goes with
them is taken off the reported errors too.

Where nothing is known of the static distortion, the last column has the true error over the ideal one: that of the
posterior of a linear model in numpy, which knows the width of what changes from exposure to exposure.
"""

import argparse
import logging
import warnings
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from astropy import units as u
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.polynomial import chebyshev, legendre

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results import accuracy

SIZE = 2048
#: Rms per axis over the detector, pixels: of the static distortion, and of what changes from exposure to exposure.
STATIC, DYNAMIC = 3.0, 0.4
DEGREE = 3
#: Standard deviation of every coefficient of a static distortion whose size is declared, pixels: 2.8 px rms per axis.
DECLARED = 2.0
#: Sets in which an exposure has fewer stars are drawn again: wide dithers may leave four of them hardly an overlap.
FEWEST = 30


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
    c = without_similarity(rng.normal(size=(2, *i.shape)) * (i + j <= DEGREE) / (1 + i + j))
    return c * rms / np.sqrt(np.mean(chebyshev.chebval2d(*grid(), c.transpose(1, 2, 0)) ** 2))


def declared_field(rng, sigma):
    """The same where every orthonormal Legendre coefficient is drawn with a standard deviation of `sigma` pixels."""
    i, j = np.indices((DEGREE + 1, DEGREE + 1))
    norm = np.sqrt((2 * i + 1) * (2 * j + 1)) / 2  # mean square 1/4 over the detector
    c = rng.normal(scale=sigma, size=(2, *i.shape)) * (i + j <= DEGREE) * norm
    to_chebyshev = np.zeros((DEGREE + 1, DEGREE + 1))
    for n in range(DEGREE + 1):
        to_chebyshev[: n + 1, n] = chebyshev.poly2cheb(legendre.leg2poly(np.eye(DEGREE + 1)[n]))[: n + 1]
    return without_similarity(to_chebyshev @ c @ to_chebyshev.T)


def grid():
    """Points x, y on [-1, 1]."""
    middles = (np.arange(40) + 0.5) / 20 - 1
    return tuple(a.ravel() for a in np.meshgrid(middles, middles))


def without_similarity(c):
    """Chebyshev coefficients (2, n, n) of a displacement without its shift, rotation and scale over the detector."""
    x, y = grid()
    field = np.concatenate([chebyshev.chebval2d(x, y, each) for each in c])
    similar = similarity_fields(np.column_stack([x, y]))
    shift_x, shift_y, scale, turn = np.linalg.lstsq(similar, field, rcond=None)[0]
    c = c.copy()
    c[0, 0, 0] -= shift_x
    c[1, 0, 0] -= shift_y
    c[0, 1, 0] -= scale
    c[1, 0, 1] -= scale
    c[0, 0, 1] += turn
    c[1, 1, 0] -= turn
    return c


def displacement(c, q):
    """Displacement (n, 2) at undistorted pixels (n, 2)."""
    x, y = (2 * (q + 0.5) / SIZE - 1).T
    return np.column_stack([chebyshev.chebval2d(x, y, each) for each in c])


def simulated(seed, **setting):
    """Matches, true positions by star, and the Chebyshev coefficients of the static distortion."""
    rng = np.random.default_rng(seed)
    while True:
        matches, sky, common = drawn(rng, **setting)
        if len(matches.names) == setting.get("n_exposures", 11) and np.bincount(
            matches.observations.exposure
        ).min() >= min(FEWEST, setting.get("n_stars", 70) // 2):
            return matches, sky, common


def drawn(
    rng,
    *,
    n_exposures=11,
    n_stars=70,
    dither=150.0,
    rolls=False,
    sigma=0.02,
    static=STATIC,
    dynamic=DYNAMIC,
    declared=None,
    n_detectors=1,
):
    """One draw of what `simulated` gives; exposures are of the detectors in turn, and `common` is that of the first."""
    each = [
        random_field(rng, static) if declared is None else declared_field(rng, declared) for _ in range(n_detectors)
    ]
    common = each[0]
    margin = 2 * dither
    sky = rng.uniform(-margin, SIZE + margin, (round(n_stars * (1 + 2 * margin / SIZE) ** 2), 2))
    middle, rows, poses = np.full(2, SIZE / 2 - 0.5), [], {}
    for i in range(n_exposures):
        angle = np.radians(33.0 * i if rolls else rng.normal(0, 0.1))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift = middle + rng.normal(0, dither, 2) - turn @ middle
        q = sky @ turn.T + shift
        x = q + displacement(each[i % n_detectors] + (random_field(rng, dynamic) if dynamic else 0), q)
        inside = ((x > 0) & (x < SIZE - 1) & (q > -0.5) & (q < SIZE - 0.5)).all(axis=1)
        x += rng.normal(0, sigma, x.shape)
        poses[f"e{i:02d}"] = np.column_stack([turn, shift])
        rows += [(f"e{i:02d}", k, *x[k], sigma, sigma) for k in np.flatnonzero(inside)]
    table = QTable(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"])
    for name in ("x", "y", "x_err", "y_err"):
        table[name] *= u.pix
    if n_detectors > 1:
        table["detector"] = [f"d{int(name[1:]) % n_detectors}" for name in table["exposure"]]
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


def catalogue(sky, solution_stars, n, rng, sigma=0.005, *, celestial=False):
    """A reference of n stars with errors [pixels], in pixels or on the sky at `PIXEL` mas each."""
    chosen = rng.permutation(np.unique(solution_stars))[:n]
    xy = sky[chosen] + rng.normal(0, sigma, (len(chosen), 2))
    if celestial:
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [84.9, -69.1], [SIZE / 2, SIZE / 2]
        wcs.wcs.cdelt = np.array([-PIXEL, PIXEL]) / 3.6e6
        table = QTable(dict(zip(("ra", "dec"), wcs.all_pix2world(xy, 0).T * u.deg, strict=True)) | {"star": chosen})
        table["ra_error"] = table["dec_error"] = np.full(len(chosen), sigma * PIXEL) * u.mas
        return table
    table = QTable({"star": chosen, "x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix})
    table["x_err"] = table["y_err"] = np.full(len(chosen), sigma) * u.pix
    return table


PIXEL = 20.0  # mas
WIDTHS = np.concatenate([np.zeros(3), np.full(7, 0.3)])  # of the prior mean, by mode, pixels


def ties():
    """Say of 32 references whether and how fast the tie settles: stars, errors, prior, kind, nominal poses."""
    print(f"{'stars':>5s} {'error':>6s} {'prior':6s} {'kind':7s} {'poses':7s} {'true/reported':>13s}  status")
    cases = list(product((5, 12, 40, 200), (1.0, 50.0), (None, "exact"), ("sky", "pixels")))
    settled = 0
    for seed, (n, error, given, kind) in enumerate(cases):
        matches, sky, common = simulated(seed, n_stars=max(70, n + 50), dither=[50.0, 100.0, 150.0][seed % 3])
        rng = np.random.default_rng(1_000_000 + seed)
        prior = as_prior(common, rng) if given else None
        celestial, wrong = kind == "sky", seed // 3 % 2 == 1
        reference = catalogue(sky, matches.table["star"], n, rng, error / PIXEL, celestial=celestial)
        if wrong:  # nominal scale 1 % and rotation 1 degree off
            turn = 1.01 * np.array([[np.cos(0.0175), -np.sin(0.0175)], [np.sin(0.0175), np.cos(0.0175)]])
            poses = {name: np.column_stack([pose[:, :2] @ turn, pose[:, 2]]) for name, pose in matches.poses.items()}
            matches = ld.Matches.from_table(matches.table, shape=(SIZE, SIZE), poses=poses)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LegdistortWarning)
            solution = ld.solve(matches, prior=prior, reference=reference, epoch=2020.0 if celestial else None)
        settled += "not settled" not in solution.status
        pull = np.nan
        if not celestial:
            left = accuracy.known_offsets(solution, sky[solution.estimate.star_names])
            reported = np.einsum("nkk->n", solution.absolute_covariance(without_unknown=True)) / 2
            pull = np.sqrt(np.mean(left**2) / np.mean(reported))
        words = (
            f"{n:5d} {error:3.0f} mas {given or 'none':6s} {kind:7s} {'wrong' if wrong else 'right':7s} {pull:13.2f}"
        )
        print(f"{words}  {solution.status}", flush=True)
    print(f"{settled} of {len(cases)} settled")


def settings():
    """``{name: (arguments of simulated, function (matches, sky, common, rng) -> arguments of solve)}``."""
    none = lambda *_: {}  # noqa: E731
    exact = lambda m, s, c, r: {"prior": as_prior(c, r)}  # noqa: E731
    stated = lambda m, s, c, r: {"prior": as_prior(c, r, WIDTHS)}  # noqa: E731
    alike = lambda *a: {"prior": replace(stated(*a)["prior"], sigma="evidence")}  # noqa: E731
    sized = lambda *_: {"prior": ld.Prior(None, static_sigma=DECLARED)}  # noqa: E731
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
        "no prior, two detectors": ({"n_detectors": 2}, none),
        "prior, exact": ({}, exact),
        "prior with static_sigma": ({}, stated),
        "prior with static_sigma, exposures alike": ({"dynamic": 0.0}, alike),
        "size declared": ({"declared": DECLARED}, sized),
        "static='fit', no rolls": ({"dynamic": 0.0, "dither": 300.0}, fit),
        "static='fit', rolls": ({"dynamic": 0.0, "dither": 300.0, "rolls": True}, fit),
        "degree='auto'": ({}, auto),
    }
    for n in (5, 12, 20, 40, 200):
        many = {"n_stars": 250} if n == 200 else {}
        out[f"{n} reference stars"] = (many, tied(n))
        out[f"{n} reference stars, prior"] = (many, tied(n, exact))
    return out


def ideal(matches, sky, good, n_unknown, spread):
    """Mean square error of the star positions by a linear model that knows the truth's widths.

    Positions, static distortion and poses are of any size, what changes has the covariance `spread` (2 k, 2 k) of its
    Chebyshev coefficients. A similarity and the `n_unknown` directions of the largest error are taken off.
    """
    obs, n = matches.observations, len(sky)
    i, j = np.nonzero(np.add(*np.indices((DEGREE + 1, DEGREE + 1))) <= DEGREE)
    k, n_exposures = len(i), len(matches.names)
    first = 2 * n + 2 * k  # x and y of the stars, the static distortion, then exposure by exposure that and a pose
    precision = np.zeros((first + n_exposures * (2 * k + 4),) * 2)
    precision[np.diag_indices(len(precision))] = 1e-7
    known = np.linalg.inv(spread + 1e-8 * np.eye(2 * k))
    for e, name in enumerate(matches.names):
        rows, pose = obs.exposure == e, matches.poses[name]
        star = np.asarray(matches.stars)[obs.star[rows]]
        q = sky[star] @ pose[:, :2].T + pose[:, 2]
        values = (chebyshev.chebvander2d(*(2 * (q + 0.5) / SIZE - 1).T, [DEGREE, DEGREE]))[:, i * (DEGREE + 1) + j]
        own = first + e * (2 * k + 4) + np.arange(2 * k + 4)
        design = np.zeros((2 * len(q), len(precision)))
        for axis in (0, 1):
            mine = axis * len(q) + np.arange(len(q))
            design[mine, star] = pose[axis, 0]
            design[mine, n + star] = pose[axis, 1]
            for start in (2 * n, own[0]):
                design[mine[:, None], start + axis * k + np.arange(k)] = values
        design[:, own[-4:]] = similarity_fields(2 * (q + 0.5) / SIZE - 1, centre=np.zeros(2))
        precision += design.T @ design / obs.covariance[rows, 0][0]
        precision[np.ix_(own[:-4], own[:-4])] += known
    stars = np.r_[good, n + good]
    covariance = np.linalg.inv(precision)[np.ix_(stars, stars)]
    similar = np.linalg.qr(similarity_fields(sky[good]))[0]
    left = np.eye(len(stars)) - similar @ similar.T
    return np.linalg.eigvalsh(left @ covariance @ left)[: len(stars) - n_unknown].sum() / len(stars)


@cache
def dynamic_spread():
    """Covariance of the Chebyshev coefficients up to `DEGREE` of what changes from exposure to exposure."""
    i, j = np.nonzero(np.add(*np.indices((DEGREE + 1, DEGREE + 1))) <= DEGREE)
    rng = np.random.default_rng(0)
    draws = np.array([random_field(rng, DYNAMIC)[:, i, j].ravel() for _ in range(1000)])
    return draws.T @ draws / len(draws)


def expected(solution, true):
    """Reported mean square error of what `accuracy.known_offsets` leaves of noise and common map.

    Of the stars that have a position: one that contradicts itself has none.
    """
    good = np.isfinite(solution.estimate.positions).all(axis=1)
    both = np.tile(good, 2)
    known = np.einsum("nkk->nk", solution.absolute_covariance(without_unknown=True))[good]
    columns = [each.stars.T.reshape(-1, 1)[both] for each in solution.gauge.unknown]
    if solution.gauge.tie is None:
        columns.append(similarity_fields(true[good]))
    if not columns:
        return np.mean(known)
    maps = solution.gauge.directions[good].transpose(1, 0, 2).reshape(known.size, -1)
    covariance = solution.estimate.uncertainty.star_matrix[np.ix_(both, both)]
    hidden = solution.gauge.absolute_covariance
    if len(hidden) == maps.shape[1]:
        covariance = covariance + maps @ hidden @ maps.T
    taken_off = np.linalg.qr(np.hstack(columns))[0]
    return np.mean(known) - np.trace(taken_off.T @ covariance @ taken_off) / known.size


def one(seed, simulating, solving, *, with_ideal=False):
    """True, reported and ideal mean square error, what is unknown, and the status, of one set."""
    matches, sky, common = simulated(seed, **simulating)
    rng = np.random.default_rng(1_000_000 + seed)
    solution = ld.solve(matches, **solving(matches, sky, common, rng))
    star = solution.estimate.star_names
    left = accuracy.known_offsets(solution, sky[star])
    reported = expected(solution, sky[star])
    unknown, best = solution.gauge.unknown, np.nan
    if with_ideal:
        found = star[np.isfinite(left[:, 0])]
        best = ideal(matches, sky, found, len(unknown), dynamic_spread())
    return np.nanmean(left**2), reported, best, tuple(each.name for each in unknown), solution.status


def row(name, n_sets, **changed):
    """The figures of a setting over many sets: `Row`."""
    simulating, solving = settings()[name]
    with_ideal = name in ("no prior", "no prior, 400 px dithers", "no prior, rolls")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        results = [one(seed, simulating | changed, solving, with_ideal=with_ideal) for seed in range(n_sets)]
    true, reported, best = np.array([r[:3] for r in results]).T
    named = [r[3] for r in results]
    usual = max(set(named), key=named.count)
    ratio, each = true.mean() / reported.mean(), true / reported
    return Row(
        true=true.mean() ** 0.5,
        reported=reported.mean() ** 0.5,
        ratio=ratio,
        error=np.sqrt(np.sum((true - ratio * reported) ** 2)) / reported.sum(),
        each=each.mean(),
        each_error=each.std() / n_sets**0.5,
        over_ideal=(true.mean() / best.mean()) ** 0.5,
        unknown={part: usual.count(part) for part in usual},
        share=named.count(usual) / n_sets,
        unsettled=sum("not settled" in r[4] for r in results),
    )


@dataclass(frozen=True)
class Row:
    """Rms true and reported error, pixels; ratio of their squares with its standard error; true over ideal error.

    `each` is the mean of that ratio over the sets, with its standard error: where few sets have by far the largest
    errors, as with few reference stars, the ratio of the means is theirs alone; it is larger where the reported error
    scatters. `unknown` is the list most frequently
    named, with numbers, `share` how often it was; `unsettled` the number of sets whose tie to a reference did not
    settle.
    """

    true: float
    reported: float
    ratio: float
    error: float
    each: float
    each_error: float
    over_ideal: float
    unknown: dict
    share: float
    unsettled: int

    HEAD = (
        f"{'setting':28s} {'exposures':>9s} {'true rms':>9s} {'reported':>9s} {'ratio of squares':>17s} "
        f"{'set by set':>17s} {'true/ideal':>10s}  unknown"
    )

    def line(self, name, n):
        """The row as text."""
        words = ", ".join(f"{k} {part}" if k > 1 else part for part, k in self.unknown.items()) or "nothing"
        best = f"{self.over_ideal:10.2f}" if np.isfinite(self.over_ideal) else f"{'':10s}"
        ratio, each = f"{self.ratio:.2f} +- {self.error:.2f}", f"{self.each:.2f} +- {self.each_error:.2f}"
        rest = f"; {self.unsettled} ties not settled" if self.unsettled else ""
        figures = f"{self.true:9.4f} {self.reported:9.4f} {ratio:>17s} {each:>17s} {best}"
        return f"{name:28s} {n:9d} {figures}  {words} ({self.share:.0%}){rest}"


def command_line(description):
    """What was asked for; the package keeps silent."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--exposures", type=int, nargs="+", default=[11, 6, 4])
    parser.add_argument("--only", default="", help="settings whose names contain this")
    parser.add_argument("--ties", action="store_true", help="instead: do ties to references settle?")
    parser.add_argument("--exactly", nargs="+", default=None, metavar="SETTING", help="these settings")
    logging.getLogger("legdistort").setLevel(logging.ERROR)
    return parser.parse_args()


def main():
    arguments = command_line(__doc__)
    if arguments.ties:
        ties()
        return
    print(Row.HEAD)
    for name in settings():
        wanted = arguments.only in name if arguments.exactly is None else name in arguments.exactly
        for n in arguments.exposures if wanted else []:
            print(row(name, arguments.sets, n_exposures=n).line(name, n), flush=True)


if __name__ == "__main__":
    main()
