"""How often checks warn of sets in which nothing is wrong, and how surely they see what is.

``python tests/benchmarks/checks_table.py alarms --sets 2000``, ``... power --sets 200``, and ``... images --sets 100``
for runs on simulated frames; ``... priors --sets 40`` and ``... references --sets 40`` for those that are wrong;
``... names --sets 30`` for what displaces stars, ``... cures --sets 20`` for cures that are applied,
``... lattices --sets 100`` for masks; ``... cost`` for what the checks cost.
Distortions of all but the frames are Chebyshev polynomials (`calibration_table.simulated`) or those of
`dense_model.drawn_set`, none of them made by the package.
"""

import argparse
import logging
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import vstack
from astropy.wcs import WCS, Sip
from calibration_table import SIZE, simulated
from photutils.psf import ImagePSF
from scipy.stats import beta

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.inputs.exposures import Exposure
from legdistort.matching.lattices.periods import periods
from legdistort.simulation.pupil import PupilPSF

sys.path.insert(0, str(Path(__file__).parents[1]))
import dense_model
import drawn_sets
import flawed_sets
import known_displacements
import made_catalogues
import masks
import outside_settings

SIGMA = 0.02
#: Pixels: the largest of the distortion in the headers that is not used.
SIP = 1.0


def limits(count, n):
    """Upper 95 % limit of a share of which `count` of n were seen (Clopper & Pearson 1934)."""
    return 1.0 if count == n else beta.ppf(0.95, count + 1, n - count)


def solved(matches, prior=None, **options):
    """The solution; messages on what is not known are not what is looked at."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        return ld.solve(matches, prior=prior, **{"degree": 3} | options)


def clean(seed):
    """A set in which nothing is wrong: 4 to 40 exposures, 20 to 1000 stars on a frame, with and without dithers."""
    rng = np.random.default_rng(seed)
    n_exposures = int(np.exp(rng.uniform(np.log(4), np.log(40.99))))
    n_stars = int(np.exp(rng.uniform(np.log(20), np.log(1000))))
    matches, _, static = simulated(
        seed, n_exposures=n_exposures, n_stars=n_stars, dither=rng.choice([0.0, 50.0, 150.0]), sigma=SIGMA
    )
    return matches, static


def legendre(static):
    """A Chebyshev series (2, 4, 4) as the mean of a `Prior`, by a fit at points of the detector."""
    from legdistort.geometry import basis

    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 9)] * 2))
    values = np.stack([np.polynomial.chebyshev.chebval2d(x, y, each) for each in static])
    return np.linalg.lstsq(basis.values(3, x, y).T, values.T, rcond=None)[0].T


def alarms(n_sets):
    """Print how often each check warns."""
    for label, with_prior in (("no prior", False), ("exact prior", True)):
        seen = Counter()
        for seed in range(n_sets // 2):
            matches, static = clean(seed)
            solution = solved(matches, ld.Prior(legendre(static)) if with_prior else None)
            bad = [check for check in solution.checks if check.state in ("warn", "fail")]
            seen.update(check.name for check in bad)
            seen["any"] += bool(bad)
            names = [check.name for check in solution.checks]
        n = n_sets // 2
        print(f"{label}: {n} sets")
        for name in [*names, "any"]:
            print(f"  {name:18s} {seen[name]:4d}  upper 95 % limit {100 * limits(seen[name], n):.2f} %", flush=True)


def _moved(table, rows, shift):
    table["x"][rows] += shift[:, 0] * u.pix
    table["y"][rows] += shift[:, 1] * u.pix


def spoiled(kind, seed, *, n_exposures=11, n_stars=70):
    """A set with one fault; the matches, and further arguments of `solve`."""
    rng = np.random.default_rng(10_000 + seed)
    matches = simulated(seed, n_exposures=n_exposures, n_stars=n_stars, dither=50.0, sigma=SIGMA)[0]
    table = matches.table.copy()
    exposure = np.unique(table["exposure"], return_inverse=True)[1]
    stars, star = np.unique(table["star"], return_inverse=True)
    if kind == "errors 1.3 x too small":
        table["x_err"] /= 1.3
        table["y_err"] /= 1.3
    elif kind == "half of the stars move":  # by 3 errors of the mean of an epoch, over three epochs
        v = rng.normal(size=(len(stars), 2))
        v *= 3 * SIGMA / np.sqrt(n_exposures / 3) / np.hypot(*v.T)[:, None]
        v[rng.permutation(len(stars))[: len(stars) // 2]] = 0
        _moved(table, slice(None), v[star] * (exposure * 3 // n_exposures)[:, None])
    elif kind == "degree too low":  # 3 errors of a star's mean position, of degree 4, drawn for every exposure
        x, y = (2 * (table[k].value + 0.5) / SIZE - 1 for k in "xy")
        modes = np.stack(
            [np.polynomial.chebyshev.chebval2d(x, y, np.eye(5)[:, [i]] * np.eye(5)[4 - i]) for i in range(5)]
        )
        c = rng.normal(size=(2, n_exposures, 5))
        shift = np.einsum("ane,en->na", c[:, exposure], modes)
        _moved(table, slice(None), 3 * SIGMA * shift / np.sqrt(np.mean(shift**2)))
    elif kind == "a duplicate, measured again":
        again = table[exposure == 3].copy()
        again["exposure"] = "e99"
        _moved(again, slice(None), rng.normal(0, 0.3 * SIGMA, (len(again), 2)))
        table = vstack([table, again])
    elif kind == "20 % mismatches":
        wrong = np.flatnonzero(rng.random(len(table)) < 0.2)
        _moved(table, wrong, rng.uniform(-20, 20, (len(wrong), 2)))
    elif kind == "an exposure twice as noisy":
        rows = np.flatnonzero(exposure == 5)
        _moved(table, rows, rng.normal(0, np.sqrt(3) * SIGMA, (len(rows), 2)))
    elif kind == "an exposure with a third of its stars":
        rows = rng.permutation(np.flatnonzero(exposure == 5))
        table.remove_rows(rows[len(rows) // 3 :])
    elif kind == "SIP of 1 px unused":
        table.remove_column("star")
        return ld.match(table, exposures=headers_with_sip(rng, matches.poses))
    poses = dict(matches.poses) | {"e99": matches.poses["e03"]}
    poses = {name: poses[name] for name in np.unique(table["exposure"])}
    return ld.Matches.from_table(table, shape=matches.shapes[matches.names[0]], poses=poses)


def headers_with_sip(rng, poses):
    """Exposures at these poses with one distortion of `SIP` pixels at most, of degree 3, in their headers."""
    i, j = np.indices((4, 4))
    a, b = rng.normal(size=(2, 4, 4)) * ((i + j > 1) & (i + j < 4)) / (SIZE / 2) ** (i + j)
    x, y = np.meshgrid(*[np.linspace(-SIZE / 2, SIZE / 2, 33)] * 2)
    largest = np.hypot(*(np.polynomial.polynomial.polyval2d(x, y, c) for c in (a, b))).max()
    exposures = []
    for name, pose in poses.items():
        wcs, middle = WCS(naxis=2), pose @ [SIZE / 2, SIZE / 2, 1]
        wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN-SIP", "DEC--TAN-SIP"], [84.9, -69.1], middle + 1
        wcs.wcs.cd = np.diag([-1e-5, 1e-5]) @ np.linalg.inv(pose[:, :2])
        wcs.sip = Sip(a * SIP / largest, b * SIP / largest, None, None, wcs.wcs.crpix)
        exposures.append(Exposure(name, np.zeros((SIZE, SIZE), dtype=np.float32), wcs=wcs))
    return exposures


#: One exposure trailed by 1 FWHM: of cores in a halo; of Moffat profiles, whose width and angle change. Others in which
#: the guiding jumped by 1 FWHM, or a ghost of 5 % lies beside every star. The profile of the stars, and what is done to
#: them along a direction, as a function of cycles a FWHM.
BLURRED = {
    "a trail of 1 FWHM, adaptive optics": (PupilPSF(strehl=0.3, elongation=0.5), np.sinc),
    "a trail of 1 FWHM, seeing": (None, np.sinc),
    "a jump of 1 FWHM, seeing": (None, lambda f: 0.6 + 0.4 * np.exp(-2j * np.pi * f)),
    "a ghost of 5 %, seeing": (None, lambda f: 1 + 0.05 * np.exp(-3j * np.pi * f)),
}
#: Frames of 4.2 to 4.9 px FWHM, measured with a Moffat profile of this many.
OF_OTHERS = {"a PSF file of 6 px": 6.0, "a PSF file of 3 px": 3.0}
#: What is wrong, and the check that should say so.
FAULTS = {
    "errors 1.3 x too small": "chi2",
    "half of the stars move": "time",
    "degree too low": "degree",
    "a duplicate, measured again": "duplicates",
    "20 % mismatches": "rejection",
    "an exposure twice as noisy": "exposures",
    "an exposure with a third of its stars": "completeness",
    "SIP of 1 px unused": "header distortion",
} | dict.fromkeys([*BLURRED, *OF_OTHERS], "images")


def blurred(psf, transfer, seed):
    """A night of 11 frames, to one of which something was done during the exposure, along any direction."""
    settings = {"small": True, "seed": 100 + seed, "n_exposures": 11, "psf": psf}
    night, still = (ld.simulate_exposures(noise=noise, **settings) for noise in (True, False))
    rng = np.random.default_rng(seed)
    name = str(rng.choice(list(night.hdus)))
    angle, image, header = rng.uniform(0, np.pi), still.hdus[name][0].data, still.hdus[name][0].header
    fy, fx = (np.fft.fftfreq(n) for n in image.shape)
    length = still.psfs[name].fwhm if psf is None else psf.resolution
    along = length * (np.cos(angle) * fx + np.sin(angle) * fy[:, None])
    image = np.fft.ifft2(np.fft.fft2(image) * transfer(along)).real
    electrons = rng.poisson(np.clip(image, 0, None) * header["GAIN"]) + rng.normal(0, header["RDNOISE"], image.shape)
    counts = np.clip(np.rint(electrons / header["GAIN"]), 0, header["SATURATE"])
    night.hdus[name][0].data = counts.astype(np.uint16)
    return night


def moffat(fwhm, *, fine=4):
    """A round Moffat profile as a PSF of others."""
    y, x = np.mgrid[-12 * fine : 12 * fine + 1, -12 * fine : 12 * fine + 1] / fine
    image = (1 + (x**2 + y**2) / fwhm**2) ** -3.0  # of 1.02 times this width
    return ImagePSF(image * fine**2 / image.sum(), oversampling=fine)


def checks_of_run(night, **options):
    """The checks of a run on simulated frames."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ld.run(night.write(Path(folder) / "night"), out=Path(folder) / "out", degree=3, **options).checks


def power(n_sets, faults):
    """Print how often each fault is seen, and by the check that should."""
    for kind in faults:
        seen, expected = Counter(), FAULTS[kind]
        for seed in range(n_sets):
            if kind in BLURRED:
                checks = checks_of_run(blurred(*BLURRED[kind], seed), psf="moffat")  # of shapes, not positions
            elif kind in OF_OTHERS:
                night = ld.simulate_exposures(small=True, seed=100 + seed, n_exposures=6)
                checks = checks_of_run(night, psf=moffat(OF_OTHERS[kind]))
            else:
                checks = solved(spoiled(kind, seed), clip=5).checks
            bad = {check.name for check in checks if check.state in ("warn", "fail")}
            seen.update(bad)
            seen["any"] += bool(bad)
        others = ", ".join(f"{name} {count}" for name, count in seen.most_common() if name not in ("any", expected))
        print(f"{kind:40s} {seen['any']:4d} of {n_sets}; {expected} {seen[expected]}; {others}", flush=True)


def images(n_sets):
    """Print how often each check warns of a run on frames in which nothing is wrong: 4 to 11 of them."""
    seen = Counter()
    for n in range(1, n_sets + 1):
        seed, frames = n - 1, 4 + (n - 1) % 8
        checks = checks_of_run(ld.simulate_exposures(small=True, seed=100 + seed, n_exposures=frames))
        bad = [check for check in checks if check.state in ("warn", "fail")]
        seen.update([check.name for check in bad] + ["any"] * bool(bad))
        if bad or n % 10 == 0:
            print(f"{n} runs, {seen['any']} with a warning, upper 95 % limit {100 * limits(seen['any'], n):.1f} %")
            print("".join(f"  seed {seed}, {frames} frames: {check}\n" for check in bad), end="", flush=True)


#: How exposures of `priors` are taken, and what is given as their static distortion, by that which is true (2, m).
TAKEN = {
    "dithers of 150 px": {},
    "dithers of 400 px": {"dither": 400.0},
    "rolls of 30 degrees": {"rolls": 30.0},
    "rolls of 90 degrees": {"rolls": 90.0},
    "six exposures, rolls": {"rolls": 30.0, "n": 6},
    "no dithers": {"dither": 1.0},
}
GIVEN = {"right": lambda static, rng: static} | outside_settings.PRIORS


def priors(n_sets):
    """Print what the check "prior" says of right and wrong priors, and how large absolute errors are then."""
    print(f"{'':22s} {'prior':22s}  pass unknown warn fail  true over stated absolute error where passed")
    for taken, changes in TAKEN.items():
        for given, made in GIVEN.items():
            states, ratios = Counter(), []
            for seed in range(n_sets):
                data, truth = dense_model.drawn_set(seed, **changes)
                static = made(truth["static"], np.random.default_rng(10_000 + seed))
                solution = solved(drawn_sets.as_matches(data), ld.Prior(static))
                state = next(check.state for check in solution.checks if check.name == "prior")
                states[state] += 1
                if state == "pass":
                    ratios.append(_ratio(solution, truth["stars"]))
            ratio = f"{np.sqrt(np.mean(np.square(ratios))):.2f}" if ratios else ""
            counts = " ".join(f"{states[each]:5d}" for each in ("pass", "unknown", "warn", "fail"))
            print(f"{taken:22s} {given:22s} {counts}  {ratio}", flush=True)


#: How exposures of `references` are taken, and whether with the exact prior.
TIED = {
    "prior, dithers of 150 px": ({}, True),
    "prior, rolls of 30 degrees": ({"rolls": 30.0}, True),
    "dithers of 150 px": ({}, False),
    "rolls of 30 degrees": ({"rolls": 30.0}, False),
}


def references(n_sets):
    """Print what the check "reference" says of right and wrong catalogues, and how large absolute errors are."""
    print(
        f"{'':28s} {'catalogue':16s}  pass unknown warn fail  true over stated absolute error: all, without a warning"
    )
    for taken, (changes, with_prior) in TIED.items():
        for fault in (None, *made_catalogues.FAULTS):
            states, ratios, silent = Counter(), [], []
            for seed in range(n_sets):
                data, truth = dense_model.drawn_set(seed, **changes)
                table = made_catalogues.catalogue(truth["stars"], seed, fault)
                prior = ld.Prior(truth["static"]) if with_prior else None
                options = {"reference": table, "epoch": made_catalogues.EPOCH}
                solution = solved(drawn_sets.as_matches(data), prior, **options)
                state = next(check.state for check in solution.checks if check.name == "reference")
                states[state] += 1
                ratios.append(_ratio(solution, truth["stars"]))
                silent += [ratios[-1]] * (state in ("pass", "unknown"))
            ratio = " ".join(f"{np.sqrt(np.mean(np.square(each))):.2f}" for each in (ratios, silent) if each)
            counts = " ".join(f"{states[each]:5d}" for each in ("pass", "unknown", "warn", "fail"))
            print(f"{taken:28s} {fault or 'right':16s} {counts}  {ratio}", flush=True)


def _ratio(solution, stars):
    """Absolute errors of the stars over those stated, rms, after a similarity."""
    found = np.stack([solution.stars[k].value for k in "xy"], axis=1)
    stated = np.stack([solution.stars[f"{k}_err_abs"].value for k in "xy"], axis=1)
    z, other = (stars[solution.stars["star"]] @ [1, 1j]), found @ [1, 1j]
    design = np.stack([np.ones_like(z), z], axis=1)
    off = other - design @ np.linalg.lstsq(design, other, rcond=None)[0]
    known = np.isfinite(stated).all(axis=1)
    return np.sqrt(np.mean(np.abs(off[known]) ** 2) / np.mean((stated[known] ** 2).sum(axis=1)))


#: A part of the words for what displaces stars.
WORDS = {
    "refraction by colour": "displaced by their colours",
    "refraction by magnitude": "displaced by their magnitudes",
    "pixel phase": "(pixel phase)",
    "charge trails": "(charge trails)",
    "step": "(stitching",
    "pattern of the detector": "it is of the detector",
    "pattern of the telescope": "it is of the telescope",
    "turbulence": "(turbulence)",
}


def _named(data):
    text = "; ".join(check.sentence for check in solved(drawn_sets.as_matches(data), clip=None).checks)
    return {name for name, words in WORDS.items() if words in text}


def names(n_sets):
    """Print how often what displaces stars is named, where it does by the size of the errors and where it does not."""
    for name in WORDS:
        found = [_named(known_displacements.displaced(name, 100 + seed)[0]) for seed in range(n_sets)]
        print(f"{name:24s} named in {sum(name in each for each in found):3d} of {n_sets}; "
              f"another in {sum(bool(each - {name}) for each in found)}", flush=True)  # fmt: skip
    taken, false = (known_displacements.TAKEN, known_displacements.ROLLED, {}, {"dither": 0.5}, {"n": 5}), Counter()
    rng = np.random.default_rng(1)
    for seed in range(3 * n_sets):
        data = dense_model.drawn_set(1000 + seed, **taken[seed % 5])[0]
        if seed % 2:
            data["err"] = data["err"] * np.where(data["exposure"] == 3, 0.5, rng.uniform(0.5, 1))[:, None]
        false.update(found := _named(data))
        false["any"] += bool(found)
    print(f"none, errors right and wrong: {false['any']} of {3 * n_sets} name one {dict(false)}")


def _promised(matches):
    """The first cure with a figure, a match of `PROMISE` or None, and the checks by name once it was applied."""
    named = next(filter(None, (PROMISE.search(check.cure) for check in solved(matches, clip=None).checks)), None)
    if named is None:
        return None, {}
    how = {named[1]: int(named[2]) if named[1] == "degree" else named[2]}
    return named, {check.name: check for check in solved(matches, clip=None, **how).checks}


def cures(n_sets):
    """Print what a cure promises of chi2/dof, and what it is when the cure is applied."""
    for kind, (option, value) in flawed_sets.CURES.items():
        right, passed, off = 0, 0, []
        for seed in range(n_sets):
            named, after = _promised(drawn_sets.as_matches(flawed_sets.flawed(kind, seed)))
            if named is None:
                continue
            right += named.groups()[:2] == (option, value)
            passed += not {after[k].state for k in ("chi2", "brightness", "degree")} & {"warn", "fail"}
            off.append(after["chi2"].value - float(named[3]))
        print(f"{kind:12s} --{option} {value}: named in {right} of {n_sets}, passes in {passed}; chi2/dof less promise "
              f"{np.mean(off):+.3f} +- {np.std(off):.3f}", flush=True)  # fmt: skip
    for size in (0.5, 1.0, 3.0):
        ratios = {"": [], "about ": []}
        for seed in range(n_sets):
            data = known_displacements.displaced("turbulence", 100 + seed, size=size)[0]
            named, after = _promised(drawn_sets.as_matches(data))
            if named is not None and named[1] == "degree":
                ratios["about " * ("about " in named[0])].append(float(named[3]) / after["chi2"].value)
        for about, found in ratios.items():
            low, high = (min(found), max(found)) if found else (np.nan, np.nan)
            print(f"turbulence of {size} errors: in {len(found)} of {n_sets} a degree would bring chi2/dof to "
                  f"{about}{low:.2f} to {high:.2f} times what is reached", flush=True)  # fmt: skip


def lattices(n_sets):
    """Print how often the periods of a mask are found, and how often stars are taken for one."""
    for kind in ({}, {"turned": 10}, {"hexagonal": True}, {"lost": 0.3}, {"wrong": 2.0}, {"distortion": 30.0}):
        found = [len(periods(masks.mask(np.random.default_rng(seed), **kind))) for seed in range(n_sets)]
        print(f"mask {kind}: both periods in {sum(n == 2 for n in found)} of {n_sets}", flush=True)
    n = 40 * n_sets
    false = sum(len(periods(masks.field(10_000 + seed))) > 0 for seed in range(n))
    print(f"stars: {false} of {n}, upper 95 % limit {limits(false, n):.2%}")


PROMISE = re.compile(r"--(errors|degree) (\S+) would bring chi2/dof to (?:about )?([\d.]+(?:e[+-]?\d+)?)")

#: Exposures, stars on a frame, part of the observations that are gross errors.
SIZES = ((11, 120, 0.0), (65, 700, 0.0), (40, 1000, 0.0), (100, 300, 0.0), (65, 700, 0.01))


def cost(n_rounds):
    """Print CPU times of the default solve and of the first use of its checks, the least of some rounds in turn."""
    sets = []
    for n_exposures, n_stars, share in SIZES:
        matches = simulated(0, n_exposures=n_exposures, n_stars=n_stars, dither=50.0, sigma=SIGMA)[0]
        table, rng = matches.table.copy(), np.random.default_rng(0)
        wrong = np.flatnonzero(rng.random(len(table)) < share)
        _moved(table, wrong, rng.uniform(-20, 20, (len(wrong), 2)))
        sets.append(ld.Matches.from_table(table, shape=matches.shapes[matches.names[0]], poses=matches.poses))
    times = np.empty((n_rounds, len(sets), 2))
    for each in times:
        for matches, out in zip(sets, each, strict=True):
            start = time.process_time()
            solution = solved(matches)
            middle = time.process_time()
            solution.checks  # noqa: B018 - made at first use
            out[:] = middle - start, time.process_time() - middle
    for (n_exposures, n_stars, share), (solve, checks) in zip(SIZES, times.min(axis=0), strict=True):
        print(f"{n_exposures:4d} exposures x {n_stars:4d} stars, {share:.0%} gross errors: solve {solve:.2f} s, "
              f"checks {checks:.3f} s, {checks / solve:.0%}")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    made = (alarms, images, priors, references, names, cures, lattices, cost)
    parser.add_argument("what", choices=("power", *(each.__name__ for each in made)))
    parser.add_argument("--sets", type=int, default=100, help="how many; rounds of `cost`")
    parser.add_argument("--fault", nargs="+", choices=FAULTS, default=list(FAULTS), help="of `power` (default: all)")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    if arguments.what == "power":
        power(arguments.sets, arguments.fault)
    else:
        {each.__name__: each for each in made}[arguments.what](arguments.sets)
