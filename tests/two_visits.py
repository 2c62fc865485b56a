"""A camera of two detectors in two visits, half a year and a roll apart, of stars that all move; numpy alone."""

from types import SimpleNamespace

import numpy as np
from astropy.table import Table
from numpy.polynomial import Legendre

import legdistort as ld

SIZE, GAP, REF_EPOCH = 1024, 60, 2016.0
_P = [Legendre.basis(k) for k in range(4)]  # so that layouts stay as they are
EPOCHS, ROLLS = (2026.10, 2026.64), (0.0, 7.0)


def visits(seed, *, n_stars=150, n_dithers=4, sigma=0.01, bend=0.05, common=(0.03, -0.04), scatter=0.007):
    """Two visits of so many dithers each, with the truth and a reference.

    Static distortions are of degree 3, with coefficients of `bend`, motions `common` with a scatter, pixels a year.
    The reference, of a third of the stars, has their positions of `REF_EPOCH` in the plane of the truth, and their
    motions. Headers are a pixel off.
    """
    rng, step = np.random.default_rng(seed), SIZE + GAP
    corners = np.array([[0.0, 0.0], [step, 0.0]])
    stars = rng.uniform([-250, -250], [2 * step + 190, SIZE + 250], (n_stars, 2))
    motions = np.array(common) + rng.normal(0, scatter, (n_stars, 2))
    powers = [(i, j) for i in range(4) for j in range(4 - i) if i + j > 1]
    static = rng.normal(size=(2, 2, len(powers))) * bend
    middle, rows, poses = np.array([step - GAP / 2, SIZE / 2]), [], {}
    for visit, (begun, roll) in enumerate(zip(EPOCHS, ROLLS, strict=True)):
        c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
        turn = np.array([[c, s], [-s, c]])
        for d in range(n_dithers):
            name, shift, epoch = f"v{visit}d{d}", rng.uniform(-200, 200, 2), begun + 1e-4 * d
            plane = (stars + motions * (epoch - REF_EPOCH) - middle) @ turn.T + middle + shift
            poses[name] = np.column_stack([turn, middle - turn @ middle + shift + rng.normal(0, 1, 2)])
            for k, corner in enumerate(corners):
                q = plane - corner
                x, y = 2 * (q.T + 0.5) / SIZE - 1
                q = q + np.stack([_P[i](x) * _P[j](y) for i, j in powers], axis=1) @ static[k].T
                for star in np.flatnonzero(((q > 0) & (q < SIZE - 1)).all(axis=1)):
                    rows.append((name, str(k), f"s{star}", *(q[star] + rng.normal(0, sigma, 2)), sigma, sigma, epoch))
    names = ["exposure", "detector", "star", "x", "y", "x_err", "y_err", "epoch"]
    layouts = {str(k): np.column_stack([np.eye(2), -corner]) for k, corner in enumerate(corners)}
    camera = ld.Camera("TWO", {k: ld.Detector((SIZE, SIZE), layout=v) for k, v in layouts.items()})
    matches = ld.Matches.from_table(Table(rows=rows, names=names), camera=camera, poses=poses)
    return SimpleNamespace(matches=matches, stars=stars, motions=motions, reference=_reference(rng, stars, motions))


def _reference(rng, stars, motions, error=0.005, rate=0.001):
    known = np.arange(0, len(stars), 3)
    xy, v = stars[known] + rng.normal(0, error, (len(known), 2)), motions[known] + rng.normal(0, rate, (len(known), 2))
    columns = {"star": [f"s{k}" for k in known], "x": xy[:, 0], "y": xy[:, 1], "vx": v[:, 0], "vy": v[:, 1]}
    same = {"x_err": error, "y_err": error, "vx_err": rate, "vy_err": rate, "ref_epoch": REF_EPOCH}
    return Table(columns | {name: np.full(len(known), value) for name, value in same.items()})


def truth_at(made, names, epoch):
    """Positions (n, 2) at an epoch and motions (n, 2) of some stars."""
    index = np.array([int(str(name)[1:]) for name in names])
    return made.stars[index] + made.motions[index] * (epoch - REF_EPOCH), made.motions[index]
