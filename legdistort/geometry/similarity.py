"""Similarities between the reference plane and detectors, and the tie to the sky.

A *pose* is a (2, 3) array ``[M | t]`` that maps a position X (pixels of the
reference plane) to undistorted pixels of one exposure, ``q = M X + t``; M is a
rotation, possibly with a flip, times a scale.
"""

import math

import numpy as np

from ..exceptions import InputError


def identity():
    """The pose that changes nothing, shape (2, 3)."""
    return np.eye(2, 3)


def apply(pose, xy):
    """Map positions (..., 2) through a pose."""
    return as_positions(xy) @ pose[:, :2].T + pose[:, 2]


def as_positions(xy):
    """Positions (..., 2) as an array of floats; `InputError` for anything else."""
    xy = np.asarray(xy, dtype=float)
    if xy.size and xy.shape[-1:] != (2,):
        raise InputError(f"positions must be x and y in pixels, an array of shape (n, 2), got shape {xy.shape}")
    return xy


def invert(pose):
    """The pose of the opposite direction, or those of poses (..., 2, 3)."""
    inverse = np.linalg.inv(pose[..., :2])
    return np.concatenate([inverse, -inverse @ pose[..., 2:]], axis=-1)


def apply_inverses(poses, xy):
    """Positions (..., k, 2) carried back through poses (n, 2, 3), shape (n, k, 2)."""
    return (xy - poses[:, None, :, 2]) @ np.linalg.inv(poses[:, :, :2]).mT


def apply_each(poses, xy):
    """Positions (n, 2), each through a pose of its own (n, 2, 3)."""
    return np.einsum("nab,nb->na", poses[:, :, :2], xy) + poses[:, :, 2]


def compose(second, first):
    """The pose ``x -> second(first(x))``, or those for poses `second` (..., 2, 3)."""
    out = second[..., :2] @ first
    out[..., 2] += second[..., 2]
    return out


def check(pose, name="pose"):
    """Return `pose` as a (2, 3) float array; raise `InputError` if it is not a similarity."""
    pose = np.asarray(pose, dtype=float)
    if pose.shape != (2, 3) or not all(map(math.isfinite, pose.ravel().tolist())):
        raise InputError(f"{name} must be a finite (2, 3) array [M | t], got shape {pose.shape}")
    (xx, xy), (yx, yy) = pose[:, :2].tolist()
    scale2 = abs(xx * yy - xy * yx)
    off = max(abs(xx * xx + xy * xy - scale2), abs(yx * yx + yy * yy - scale2), abs(xx * yx + xy * yy))
    if scale2 == 0 or off > 1e-6 * scale2:
        raise InputError(
            f"{name} is not a similarity (rotation, flip, scale, shift): its linear part is {pose[:, :2].tolist()}; "
            "leave shear to the distortion"
        )
    return pose


def describe(pose):
    """Shift [pix], rotation [deg], scale and parity (+1 or -1) of a pose, as a dict."""
    m = pose[:, :2]
    return {
        "dx": float(pose[0, 2]),
        "dy": float(pose[1, 2]),
        "rotation": float(np.degrees(np.arctan2(m[1, 0], m[0, 0]))),
        "scale": float(np.sqrt(abs(np.linalg.det(m)))),
        "parity": 1 if np.linalg.det(m) > 0 else -1,
    }


def fit_similarity(source, target, *, weights=None, parity=None):
    """Least-squares similarity that carries `source` to `target`.

    Parameters
    ----------
    source, target : array_like, shape (n, 2)
    weights : array_like, shape (n,), optional
        Non-negative; at least two distinct points need a positive one.
    parity : {1, -1, None}
        Keep the orientation, flip it, or take whichever fits better.

    Returns
    -------
    ndarray, shape (2, 3)

    Raises
    ------
    InputError
        With fewer than two distinct points.
    """
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    return _pose(*_fit(_complex(source), _complex(target), w, parity))


def log_scales(poses):
    """Logarithms (n,) of the scales of similarities (n, 2, 3)."""
    return np.log(np.abs(np.linalg.det(poses[:, :, :2]))) / 2


def alike(poses, scale, angle):
    """Which of similarities (n, 2, 3) have one parity, scale and orientation, bool (n, n).

    Parameters
    ----------
    poses : ndarray, shape (n, 2, 3)
    scale : float
        By which logarithms of scales may differ.
    angle : float
        By which they may be turned against one another, degrees.
    """
    parity, logs = np.linalg.det(poses[:, :, :2]) > 0, log_scales(poses)
    turn = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    turned = np.abs((turn[:, None] - turn + 180) % 360 - 180)
    return (parity[:, None] == parity) & (np.abs(logs[:, None] - logs) < scale) & (turned < angle)


def robust_similarity(source, target, *, weights=None, n_iterations=10):
    """Similarity by iteratively reweighted least squares with Cauchy weights at the observed scale.

    Parameters as for `fit_similarity`. The scale is the median residual; when it
    stands to 1e-4 of its square the weights do.
    """
    s, t = _complex(source), _complex(target)
    base = np.ones(len(s)) if weights is None else np.asarray(weights, float)
    w, before = base, np.inf
    for _ in range(n_iterations):
        turn, shift, parity = _fit(s, t, w, None)
        off = turn * (s if parity > 0 else s.conj())
        off += shift - t
        r2 = off.real**2 + off.imag**2
        scale2 = median(r2)
        if scale2 <= 1e-20 * max(np.ptp(t.real), np.ptp(t.imag)) ** 2 or abs(scale2 - before) < 1e-4 * scale2:
            break
        w, before = base / (1 + r2 / (2 * scale2)), scale2
    return _pose(turn, shift, parity)


def _complex(xy):
    """Positions (n, 2) as complex numbers x + iy, (n,)."""
    return np.ascontiguousarray(xy, dtype=float).view(complex)[:, 0]


def _fit(s, t, w, parity):
    """Similarity ``turn * s + shift``, of the conjugate of s where parity is -1; `parity` None: the one that fits."""
    if len(s) < 2 or np.count_nonzero(w) < 2:
        raise InputError(f"a similarity needs at least two points, got {np.count_nonzero(w)}")
    w = w / w.sum()
    mean_s, mean_t = w @ s, w @ t
    ds, dt = s - mean_s, t - mean_t
    power = w @ (ds.real**2 + ds.imag**2)
    if power == 0:
        raise InputError("a similarity needs at least two distinct points, all are at the same place")
    dt *= w / power
    keep, flip = np.vdot(ds, dt), ds @ dt  # scale and rotation that leave least of dt, without and with a flip of y
    if parity is None:
        parity = 1 if abs(keep) >= abs(flip) else -1
    turn, mean_s = (keep, mean_s) if parity > 0 else (flip, mean_s.conjugate())
    return turn, mean_t - turn * mean_s, parity


def _pose(turn, shift, parity):
    """The pose of a similarity of complex numbers."""
    a, b = turn.real, turn.imag
    return np.array([[a, -b * parity, shift.real], [b, a * parity, shift.imag]])


def median(values):
    """`numpy.median` of one array without what that does beside, which for short arrays is most of its time."""
    half = len(values) // 2
    if len(values) % 2:
        return np.partition(values, half)[half]
    return np.partition(values, (half - 1, half))[half - 1 : half + 1].mean()


def similarity_of(mean_s, mean_t, cross, parity):
    """Least-squares similarities from the moments of their points.

    Parameters
    ----------
    mean_s, mean_t : ndarray, shape (..., 2)
        Weighted mean of source and target.
    cross : ndarray, shape (..., 2, 2)
        Weighted sum of target times source about their means, over the sum of squares of the source.
    parity : ndarray of 1 or -1, shape (...)

    Returns
    -------
    ndarray, shape (..., 2, 3)
    """
    a, b = np.where(np.asarray(parity) > 0, *_turns(cross))
    m = np.stack([np.stack([a, -b * parity], axis=-1), np.stack([b, a * parity], axis=-1)], axis=-2)
    shift = mean_t - np.einsum("...ab,...b->...a", m, mean_s)
    return np.concatenate([m, shift[..., None]], axis=-1)


def _turns(cross):
    """Scale times cosine and sine of the best rotation, and of the best rotation after a flip of y."""
    (xx, xy), (yx, yy) = np.moveaxis(cross, (-2, -1), (0, 1))
    return np.stack([xx + yy, yx - xy]), np.stack([xx - yy, yx + xy])
