"""Sets of a camera of four detectors in which one of three things is not as its layout has it; numpy alone."""

import numpy as np
from astropy.table import Table

import legdistort as ld

SIZE, GAP = 1024, 60
#: What is wrong: the option that counts it.
CURES = {"layout": "--layout fit", "static": "--static fit", "departures": "--dynamic detector"}


def matches(kind, seed, *, n=9, n_stars=160, sigma=0.02, dither=250.0):
    """Detectors are right, or misplaced, distorted, displaced in every exposure by other shifts: a pixel or two rms."""
    rng, step = np.random.default_rng(seed), SIZE + GAP
    nominal = {k: np.array([k % 2, k // 2]) * step for k in range(4)}
    stars, rows, poses = rng.uniform(-400, 2 * step + 340, (n_stars, 2)), [], {}
    turn, move = rng.normal(0, 0.001, 4), rng.normal(0, 2, (4, 2))
    bend = rng.normal(size=(4, 2, 3))
    for i in range(n):
        shift = rng.normal(0, dither, 2) * (i > 0)
        poses[f"e{i}"] = np.column_stack([np.eye(2), shift])
        for k, corner in nominal.items():
            q = stars + shift - corner
            if kind == "layout":
                q = q + turn[k] * np.stack([-q[:, 1], q[:, 0]], axis=1) + move[k]
            elif kind == "departures":
                q = q + rng.normal(size=2)
            elif kind == "static":
                x, y = 2 * (q.T + 0.5) / SIZE - 1
                q = q + np.stack([x**2, x * y, y**2], axis=1) @ bend[k].T
            for j in np.flatnonzero(((q > 0) & (q < SIZE - 1)).all(axis=1)):
                rows.append((f"e{i}", str(k), j, *(q[j] + sigma * rng.normal(size=2)), sigma, sigma))
    table = Table(rows=rows, names=["exposure", "detector", "star", "x", "y", "x_err", "y_err"])
    layouts = {str(k): np.column_stack([np.eye(2), -corner]) for k, corner in nominal.items()}
    camera = ld.Camera("FOUR", {k: ld.Detector((SIZE, SIZE), layout=v) for k, v in layouts.items()})
    return ld.Matches.from_table(table, camera=camera, poses=poses)
