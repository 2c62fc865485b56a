"""Exposures of several fields without a common star, taken by one detector, in numpy by itself."""

import dense_model
import numpy as np


def drawn_fields(seed, k=2, *, static=2.0, degree=3, rolls=(0.0, 90.0), n=8, step=0.5, static_of=None, **words):
    """What `drawn_sets.as_matches` takes, and the truth, with the field of every star and exposure.

    As `dense_model.drawn_set`; exposures of a field are rolled by each of `rolls` [deg] in turn, by `step` [deg]
    more from one to the next. Every field has coordinates of its own. `static_of` (2, m) is in the place of one that is
    drawn.
    """
    rng = np.random.default_rng((seed, k))
    given = (static * rng.normal(size=len(dense_model.rows(degree)[1])) @ dense_model.rows(degree)[1]).reshape(2, -1)
    given = given if static_of is None else static_of
    angles = np.array(rolls)[np.arange(n) % len(rolls)] + step * np.arange(n)
    parts = [
        dense_model.drawn_set(seed * 100 + field, degree=degree, given=given, angles=angles, n=n, **words)
        for field in range(k)
    ]
    star = np.cumsum([0, *(len(truth["stars"]) for _, truth in parts)])
    data = {"n": parts[0][0]["n"], "degree": degree}
    data |= {name: np.concatenate([each[name] for each, _ in parts]) for name in ("xy", "err", "poses")}
    data["star"] = np.concatenate([each["star"] + s for (each, _), s in zip(parts, star, strict=False)])
    data["exposure"] = np.concatenate([each["exposure"] + n * field for field, (each, _) in enumerate(parts)])
    truth = {name: np.concatenate([each[name] for _, each in parts]) for name in ("stars", "dynamic")}
    truth |= {
        "static": given,
        "field": np.repeat(np.arange(k), np.diff(star)),
        "exposure_field": np.repeat(range(k), n),
    }
    return data, truth


def static_bound(data, truth, *, scatter=None):
    """Covariance of the static distortion beyond shears, (K - 2,) squared, by the modes of `dense_model.rows`.

    All else is unknown. Exposures depart from it by N(0, scatter^2) in every mode beside a similarity; None: by any
    shear, and nothing else.
    """
    degree, n, m = data["degree"], data["n"], len(dense_model.orders(data["degree"]))
    similar, other, _ = dense_model.rows(degree)
    i, j = data["exposure"], data["star"]
    q = np.einsum("nab,nb->na", data["poses"][i, :, :2], truth["stars"][j]) + data["poses"][i, :, 2]
    b, slope = dense_model.basis(q, degree, n)
    a = truth["static"] + truth["dynamic"][i]
    by_q = np.eye(2) + np.einsum("nam,nmc->nac", a, slope)
    by_x = by_q @ data["poses"][i, :, :2]
    modes = np.einsum("nm,ab->nabm", b, np.eye(2)).reshape(len(i), 2, 2 * m)
    shears, other = (other[:2], other[2:]) if scatter is None else (other[:0], other)
    free = np.concatenate([similar, shears if scatter is None else other])
    n_stars, n_own, n_exposures = len(truth["stars"]), len(free), len(data["poses"])
    columns = np.zeros((len(i), 2, 2 * n_stars + n_own * n_exposures + len(other)))
    row = np.arange(len(i))
    for c in (0, 1):
        columns[row, :, 2 * j + c] = by_x[:, :, c]
    own = modes @ free.T
    own[:, :, :4] = by_q @ own[:, :, :4]  # similarities are poses, in front of the distortion
    for c in range(n_own):
        columns[row, :, 2 * n_stars + i * n_own + c] = own[:, :, c]
    columns[:, :, -len(other) :] = modes @ other.T
    design = (columns / data["err"][:, :, None]).reshape(2 * len(i), -1)
    normal = design.T @ design
    if scatter is not None:
        index = 2 * n_stars + np.arange(n_exposures)[:, None] * n_own + len(similar) + np.arange(len(other))
        normal[index, index] += scatter**-2.0
    unit = 1 / np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(unit[:, None] * normal * unit)
    vectors = unit[-len(other) :, None] * vectors[-len(other) :]
    kept = values > 1e-10
    covariance = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    return covariance if scatter is None else covariance[2:, 2:]


def misplaced_field(seed, label, *, camera=0, n=6, n_stars=140, sigma=0.02, dither=250.0, size=1024, gap=60):
    """Table, poses and stars of a field seen by four detectors, which lie 2 px from their layout, and that layout.

    `camera` says by how much each of them does, the same for all fields.
    """
    of_camera, rng, step = np.random.default_rng(camera), np.random.default_rng((seed, 7)), size + gap
    layout = {str(k): np.column_stack([np.eye(2), -np.array([k % 2, k // 2]) * step]) for k in range(4)}
    turn, move = of_camera.normal(0, 1e-3, 4), of_camera.normal(0, 2, (4, 2))
    stars, rows, poses = rng.uniform(-400, 2 * step + 340, (n_stars, 2)), [], {}
    for i in range(n):
        shift = rng.normal(0, dither, 2) * (i > 0)
        poses[f"{label}{i}"] = np.column_stack([np.eye(2), shift])
        for k, (key, place) in enumerate(layout.items()):
            q = stars + shift + place[:, 2]
            q = q + turn[k] * np.stack([-q[:, 1], q[:, 0]], axis=1) + move[k]
            for j in np.flatnonzero(((q > 0) & (q < size - 1)).all(axis=1)):
                rows.append((f"{label}{i}", key, j, *(q[j] + sigma * rng.normal(size=2)), sigma, sigma))
    names = ["exposure", "detector", "star", "x", "y", "x_err", "y_err"]
    return dict(zip(names, zip(*rows, strict=True), strict=True)), poses, stars, layout
