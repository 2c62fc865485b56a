"""Real star lists from Keck NIRC2 behind adaptive optics, through the same comparison as the twin of the GeMS data.

``python docs/paper/keck.py`` prints the figures of the page and draws its pictures, if the data are there.
"""

import numpy as np
from astropy.table import Table, vstack
from families import data_folder, nirc2_files

import legdistort as ld
from legdistort.assessment import baselines
from legdistort.geometry import basis
from legdistort.geometry.detector_modes import similarity_basis
from legdistort.results import accuracy

SHAPE = (1100, 1100)
FLOOR = 0.02


def orion(folder):
    """Matches of the four dither positions in Orion BN/KL, stars in at least three."""
    lists = [_read(folder / "keck_nirc2_onc_bn" / f"{name}.lis", name) for name in "ABCD"]
    return ld.match(vstack(lists), shape=SHAPE, min_exposures=3)


def ob150029(folder, *, faintest=18.0):
    """Matches of two epochs five days apart in the field of OB150029, stars brighter than K = 18."""
    lists = []
    for day in ("14", "19"):
        table = _read(folder / "keck_nirc2_ob150029" / f"mag17jul{day}_ob150029_kp_rms_named.lis", f"jul{day}")
        lists.append(table[table["m"] < faintest])
    return ld.match(vstack(lists), shape=SHAPE, min_exposures=2)


def _read(path, name):
    table = Table.read(path, format="ascii.commented_header")
    table.rename_columns(["xe", "ye"], ["x_err", "y_err"])
    table["exposure"] = [name] * len(table)
    table = table["exposure", "x", "y", "x_err", "y_err", "flux", "m"]
    for column in ("x_err", "y_err"):  # some are zero
        table[column] = np.hypot(np.asarray(table[column]), FLOOR)
    table.meta.clear()
    return table


def priors(folder):
    """Static distortion of NIRC2 from the published map, as it is, with its sign turned, and from the polynomials.

    The map covers the central 512 x 512 pixels: the polynomial of degree 3 that fits it is continued over the
    detector. The Drizzle polynomial covers all of it.
    """
    whole = ld.Prior.from_file(
        folder / "static_distortion" / "nirc2_kai" / "nirc2_narrow_ACS.coeffs.txt", shape=(1024, 1024), degree=5
    )
    central = ld.Prior.from_file(nirc2_files(folder), degree=3)
    mean = continued(central.mean, central.shape, SHAPE)
    polynomial = continued(whole.mean, whole.shape, SHAPE)
    return {
        "map": ld.Prior(mean),
        "map, sign turned": ld.Prior(-mean),
        "polynomial": ld.Prior(polynomial),
        "polynomial, sign turned": ld.Prior(-polynomial),
    }


def continued(mean, shape, larger):
    """Coefficients of the same polynomial on a larger detector about the same middle, its similarity left out."""
    factor = np.array(larger[::-1]) / np.array(shape[::-1])
    degree = basis.degree_of(mean.shape[1])
    out = basis.project(lambda u, v: mean @ basis.values(degree, u * factor[0], v * factor[1]), degree)
    similar = similarity_basis(larger, out.shape[1])
    return out - (similar.T @ (similar @ out.ravel())).reshape(out.shape)


def solve(matches, degree, prior=None):
    """The method on real lists: errors brought to the residuals by a floor, gross mismatches left out."""
    return ld.solve(matches, degree=degree, prior=prior, errors="floor", clip=5.0)


def by_degree(matches, known, degrees=(0, 1, 2, 3)):
    """``{(degree, prior name): Solution}`` for priors ``{name: Prior or None}``; at degree 0 only poses are fitted."""
    return {(degree, name): solve(matches, degree, prior) for degree in degrees for name, prior in known.items()}


def compare(matches, *, degree, prior=None):
    """The four corrections on the observations that the solution uses."""
    return baselines.compare(matches, solve(matches, degree, prior), prior=prior)


def held_out(matches, solution, prior=None, *, n=5, seed=0):
    """Predicted minus measured positions of a fifth of the observations left out in turn: rms per axis, pixels.

    A star left out in one exposure keeps its place in the others: this shows whether a model follows the distortion
    or the noise. From the median over the observations, since mismatches are among them.
    """
    table = matches.table
    part = np.random.default_rng(seed).integers(0, n, len(table))
    floor, squares = solution.diagnostics.error_floor, []
    for k in range(n):
        kept = ld.Matches.from_table(table[part != k], shape=matches.shapes, poses=matches.poses)
        other = ld.solve(kept, degree=solution.degree, prior=prior, error_floor=floor, clip=5.0)
        place = dict(zip(other.estimate.star_names.tolist(), other.estimate.positions, strict=True))
        rows = table[part == k]
        rows = rows[[star in place for star in rows["star"]]]
        for name in other.names:
            own = rows[rows["exposure"] == name]
            measured = np.column_stack([own["x"].value, own["y"].value])
            predicted = other[name].distort(np.array([place[star] for star in own["star"]]).reshape(-1, 2))
            squares.append((predicted - measured) ** 2)
    return float(np.sqrt(np.nanmedian(np.concatenate(squares)) / 0.4549))  # median of chi2 with one degree of freedom


def wanted_scale(matches, solution, prior):
    """How many times the prior the data want, its standard error, and the chi2 gained over none of it.

    From a parabola through chi2 at several multiples, on the observations and with the floor of a solution.
    """
    table = matches.table[np.asarray(solution.residuals["used"])]
    same = ld.Matches.from_table(table, shape=matches.shapes, poses={n: matches.poses[n] for n in solution.names})
    floor, multiples = solution.diagnostics.error_floor, np.array([-2.0, -1.0, 0.0, 1.0])
    fits = [
        ld.solve(same, degree=solution.degree, prior=ld.Prior(k * prior.mean), error_floor=floor) for k in multiples
    ]
    a, b, _ = np.polyfit(multiples, [fit.chi2 for fit in fits], 2)
    return float(-b / (2 * a)), float(1 / np.sqrt(a)), float(b**2 / (4 * a))


def summary(folder):
    """All figures of the page: ``{set: {"matches", "floor", "held_out", "used", "corrections"}}``."""
    known = {"none": None, **priors(folder)}
    sets = (("Orion BN", orion(folder), 2, known), ("OB150029", ob150029(folder), 3, {"none": None}))
    out = {}
    for label, matches, degree, choices in sets:
        fits = by_degree(matches, choices)
        out[label] = {
            "matches": matches,
            "floor": {key: s.diagnostics.error_floor for key, s in fits.items()},
            "used": {key: int(np.count_nonzero(s.residuals["used"])) for key, s in fits.items()},
            "held_out": {key: held_out(matches, s, choices[key[1]]) for key, s in fits.items()},
            "scale": {
                (d, "polynomial"): wanted_scale(matches, fits[d, "none"], known["polynomial"])
                for d in ((1, 2) if "polynomial" in choices else ())
            },
            "corrections": compare(matches, degree=degree, prior=known["polynomial"]),
        }
    return out


def report(figures):
    """The figures as lines of text."""
    for label, found in figures.items():
        yield f"{label}: {found['matches']!r}"
        for (degree, name), floor in found["floor"].items():
            left = found["held_out"][degree, name]
            yield f"  degree {degree}, prior {name:22s} error floor {floor:.3f}, left out and predicted {left:.3f} px"
        for (degree, name), (scale, error, gain) in found["scale"].items():
            yield f"  degree {degree}: {scale:.2f} +- {error:.2f} times the {name} wanted (chi2 falls by {gain:.0f})"
        for name, made in found["corrections"].items():
            s = accuracy.scatter_summary(made)
            yield f"  {name:22s} sigma_j {s['mean']:.3f} +- {s['std']:.3f} px per axis, {s['n_stars']} stars"


if __name__ == "__main__":
    if data_folder() is None:
        raise SystemExit("real data absent: set LEGDISTORT_DATA to their folder")
    for line in report(summary(data_folder())):
        print(line, flush=True)
