"""Compiled twins of the loops over observations in `legdistort.solving.equations.criterion`, for large problems.

They need numba (the extra ``fast``); without it, and for small problems where compiling would not pay, the plain
NumPy code runs. Both give the same numbers. Observations are taken in batches, so that the inner loops run over
neighbours in memory and become vector instructions; exposures are shared out among threads, each with star sums of
its own, so results do not depend on timing. The coupling is kept in single precision: it steers the step, while the
gradient, which decides where the minimum is, stays in double.
"""

from types import FunctionType

import numpy as np
from numba import get_num_threads, prange

from ...geometry import basis
from ...runtime.optional import compiled_loop

#: Number of observations from which they are shared out among threads.
THREADS_FROM = 30_000
_BATCH = 64
_FAST = {"contract", "reassoc", "nsz"}  # sums may be reordered; NaN and infinity keep their meaning


def _shared_out(function):
    """Decorator: compiled with its loop over chunks of exposures shared out among threads, and, as `alone`, in one.

    Few observations are done before threads have met, above all on a machine with other work.
    """
    alone = FunctionType(function.__code__, function.__globals__, f"{function.__name__}_alone")
    alone.__module__ = function.__module__  # what is compiled is kept by module and name
    threaded, alone = compiled_loop(parallel=True, fastmath=_FAST)(function), compiled_loop(fastmath=_FAST)(alone)

    def call(problem, *arguments):
        return (threaded if _n_chunks(problem) > 1 else alone)(*arguments)

    return call


def _n_chunks(problem):
    """Parts that the exposures are shared out in: one for each thread, if there are so many observations."""
    return get_num_threads() if problem.xy.shape[1] >= THREADS_FROM else 1


@compiled_loop(nogil=True, fastmath=_FAST)
def _legendre(u, p, d):
    """Normalised Legendre polynomials and derivatives at u (n,), into p and d (top, n)."""
    n = len(u)
    top = len(p)
    for o in range(n):
        p[0, o], d[0, o] = 1.0, 0.0
    if top > 1:
        for o in range(n):
            p[1, o], d[1, o] = u[o], 1.0
    for k in range(1, top - 1):
        for o in range(n):
            p[k + 1, o] = ((2 * k + 1) * u[o] * p[k, o] - k * p[k - 1, o]) / (k + 1)
            d[k + 1, o] = d[k - 1, o] + (2 * k + 1) * p[k, o]
    for k in range(top):
        scale = np.sqrt(k + 0.5)
        for o in range(n):
            p[k, o] *= scale
            d[k, o] *= scale


@compiled_loop(nogil=True)
def _bounds(start, n_chunks):
    """Exposure numbers that cut the observations in chunks of about equal size."""
    out = np.zeros(n_chunks + 1, np.int64)
    for c in range(1, n_chunks):
        out[c] = np.searchsorted(start, start[-1] * c // n_chunks)
    out[n_chunks] = len(start) - 1
    return out


@compiled_loop(nogil=True, fastmath=_FAST)
def _model(a, orders, size, q, work):
    """Distorted positions and I + A grad b of a batch; q (2, n) is overwritten with the positions."""
    pu, du, pv, dv, b, g = work
    ix, iy = orders
    n = q.shape[1]
    su, sv = 2.0 / size[1], 2.0 / size[0]
    _legendre((q[0] + 0.5) * su - 1.0, pu, du)
    _legendre((q[1] + 0.5) * sv - 1.0, pv, dv)
    for o in range(n):
        g[0, o], g[1, o], g[2, o], g[3, o] = 1.0, 0.0, 0.0, 1.0
    for m in range(len(ix)):
        p, dp, r, dr, ax, ay, row = pu[ix[m]], du[ix[m]], pv[iy[m]], dv[iy[m]], a[0, m], a[1, m], b[m]
        for o in range(n):
            row[o] = p[o] * r[o]
            slope_u, slope_v = dp[o] * r[o] * su, p[o] * dr[o] * sv
            q[0, o] += ax * row[o]
            q[1, o] += ay * row[o]
            g[0, o] += ax * slope_u
            g[1, o] += ax * slope_v
            g[2, o] += ay * slope_u
            g[3, o] += ay * slope_v


@compiled_loop(nogil=True, fastmath=_FAST)
def _normal_block(weight, b, out):
    """Add ``sum w b b'`` of a batch to the lower triangle of out (n_modes, n_modes)."""
    n_modes = len(out)
    n = len(weight)
    for m in range(n_modes):
        for other in range(m + 1):
            total = 0.0
            for o in range(n):
                total += weight[o] * b[m, o] * b[other, o]
            out[m, other] += total


@compiled_loop(nogil=True, fastmath=_FAST)
def _dots(b, x, out):
    for m in range(len(out)):
        total = 0.0
        for o in range(len(x)):
            total += b[m, o] * x[o]
        out[m] += total


@compiled_loop(nogil=True, fastmath=_FAST)
def _terms(row, n_block, phi, f, j, r):
    """Add to the sums of a star what an observation says of the terms beside its position, phi (2, n_terms)."""
    mxx, myy, mxy = f[0] * j[0] + f[1] * j[2], f[2] * j[1] + f[3] * j[3], f[0] * j[1] + f[1] * j[3]
    px, py = f[0] * r[0] + f[1] * r[1], f[2] * r[0] + f[3] * r[1]
    place = 3
    for t in range(phi.shape[1]):
        mx, my = mxx * phi[0, t] + mxy * phi[1, t], mxy * phi[0, t] + myy * phi[1, t]
        row[place] += mx
        row[place + 1] += my
        for other in range(t + 1):
            row[place + 2 + other] += phi[0, other] * mx + phi[1, other] * my
        row[n_block + 2 + t] += phi[0, t] * px + phi[1, t] * py
        place += 3 + t


@_shared_out
def _linearise(n_chunks, start, star, xy, weight, unequal, moving, coefficients, poses, sizes, orders, n_modes):
    n_exposures, n, n_all, n_terms = len(start) - 1, len(star), orders.shape[1], moving[1].shape[2]
    (stars, columns), residual = moving, np.empty((2, n))
    n_block = (2 + n_terms) * (3 + n_terms) // 2
    values, coupling = np.empty((n_modes, n), np.float32), np.empty((2, 2, n), np.float32)
    sums = np.zeros((n_chunks, stars.shape[1], n_block + 2 + n_terms))
    u_blocks, gradient = np.zeros((n_exposures, 3, n_modes, n_modes)), np.zeros((n_exposures, 2, n_modes))
    chi2 = np.zeros(n_chunks)
    bounds, top = _bounds(start, n_chunks), orders.max() + 1
    for c in prange(n_chunks):
        q_, wr_ = np.empty((2, _BATCH)), np.empty((2, _BATCH))
        legendre_, b_, g_ = np.empty((4, top, _BATCH)), np.empty((n_all, _BATCH)), np.empty((4, _BATCH))
        mine = sums[c]
        for i in range(bounds[c], bounds[c + 1]):
            pose, phi = poses[i], columns[i]
            r00, r01, r10, r11 = pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1]
            for first in range(start[i], start[i + 1], _BATCH):
                size = min(_BATCH, start[i + 1] - first)
                q, wr, b, g = q_[:, :size], wr_[:, :size], b_[:, :size], g_[:, :size]
                for o in range(size):
                    x, y = stars[0, star[first + o]], stars[1, star[first + o]]
                    for t in range(n_terms):
                        x += phi[0, t] * stars[2 + t, star[first + o]]
                        y += phi[1, t] * stars[2 + t, star[first + o]]
                    q[0, o] = r00 * x + r01 * y + pose[0, 2]
                    q[1, o] = r10 * x + r11 * y + pose[1, 2]
                work = (legendre_[0], legendre_[1], legendre_[2], legendre_[3], b, g)
                _model(coefficients[i], orders, sizes[i], q, work)
                w = weight[:, first : first + size]
                total = 0.0
                for o in range(size):
                    k = first + o
                    jxx, jxy = g[0, o] * r00 + g[1, o] * r10, g[0, o] * r01 + g[1, o] * r11
                    jyx, jyy = g[2, o] * r00 + g[3, o] * r10, g[2, o] * r01 + g[3, o] * r11
                    fxx, fxy = jxx * w[0, o] + jyx * w[2, o], jxx * w[2, o] + jyx * w[1, o]
                    fyx, fyy = jxy * w[0, o] + jyy * w[2, o], jxy * w[2, o] + jyy * w[1, o]
                    rx, ry = xy[0, k] - q[0, o], xy[1, k] - q[1, o]
                    residual[0, k], residual[1, k] = rx, ry
                    coupling[0, 0, k], coupling[0, 1, k] = fxx, fxy
                    coupling[1, 0, k], coupling[1, 1, k] = fyx, fyy
                    wr[0, o], wr[1, o] = w[0, o] * rx + w[2, o] * ry, w[2, o] * rx + w[1, o] * ry
                    total += rx * wr[0, o] + ry * wr[1, o]
                    row = mine[star[k]]
                    row[0] += fxx * jxx + fxy * jyx
                    row[1] += fyx * jxy + fyy * jyy
                    row[2] += fxx * jxy + fxy * jyy
                    row[n_block] += fxx * rx + fxy * ry
                    row[n_block + 1] += fyx * rx + fyy * ry
                    if n_terms:
                        _terms(row, n_block, phi, (fxx, fxy, fyx, fyy), (jxx, jxy, jyx, jyy), (rx, ry))
                chi2[c] += total
                for m in range(n_modes):
                    for o in range(size):
                        values[m, first + o] = b[m, o]
                _normal_block(w[0], b, u_blocks[i, 0])
                if unequal:
                    _normal_block(w[1], b, u_blocks[i, 1])
                    _normal_block(w[2], b, u_blocks[i, 2])
                _dots(b, wr[0], gradient[i, 0])
                _dots(b, wr[1], gradient[i, 1])
    return values, coupling, residual, sums, u_blocks, gradient, chi2.sum()


@_shared_out
def _to_stars(n_chunks, start, star, values, coupling, columns, a, n_stars):
    n_terms = columns.shape[2]
    sums = np.zeros((n_chunks, n_stars, 2 + n_terms))
    bounds, n_modes = _bounds(start, n_chunks), len(values)
    for c in prange(n_chunks):
        x, y = np.empty(_BATCH), np.empty(_BATCH)
        for i in range(bounds[c], bounds[c + 1]):
            for first in range(start[i], start[i + 1], _BATCH):
                size = min(_BATCH, start[i + 1] - first)
                x[:], y[:] = 0.0, 0.0
                for m in range(n_modes):
                    row, ax, ay = values[m, first : first + size], a[i, m], a[i, n_modes + m]
                    for o in range(size):
                        x[o] += ax * row[o]
                        y[o] += ay * row[o]
                for o in range(size):
                    k = first + o
                    px = coupling[0, 0, k] * x[o] + coupling[0, 1, k] * y[o]
                    py = coupling[1, 0, k] * x[o] + coupling[1, 1, k] * y[o]
                    sums[c, star[k], 0] += px
                    sums[c, star[k], 1] += py
                    for t in range(n_terms):
                        sums[c, star[k], 2 + t] += columns[i, 0, t] * px + columns[i, 1, t] * py
    return sums


@_shared_out
def _to_exposures(n_chunks, start, star, values, coupling, columns, stars):
    n_modes, n_terms = len(values), columns.shape[2]
    out = np.zeros((len(start) - 1, 2, n_modes))
    bounds = _bounds(start, n_chunks)
    for c in prange(n_chunks):
        x, y = np.empty(_BATCH), np.empty(_BATCH)
        for i in range(bounds[c], bounds[c + 1]):
            for first in range(start[i], start[i + 1], _BATCH):
                size = min(_BATCH, start[i + 1] - first)
                for o in range(size):
                    k = first + o
                    sx, sy = stars[0, star[k]], stars[1, star[k]]
                    for t in range(n_terms):
                        sx += columns[i, 0, t] * stars[2 + t, star[k]]
                        sy += columns[i, 1, t] * stars[2 + t, star[k]]
                    x[o] = coupling[0, 0, k] * sx + coupling[1, 0, k] * sy
                    y[o] = coupling[0, 1, k] * sx + coupling[1, 1, k] * sy
                for m in range(n_modes):
                    row, sum_x, sum_y = values[m, first : first + size], 0.0, 0.0
                    for o in range(size):
                        sum_x += row[o] * x[o]
                        sum_y += row[o] * y[o]
                    out[i, 0, m] += sum_x
                    out[i, 1, m] += sum_y
    return out


@_shared_out
def _distances(start, star, q, poses, positions):
    out = np.empty(q.shape[1])
    for i in prange(len(start) - 1):
        pose = poses[i]
        for k in range(start[i], start[i + 1]):
            x, y = positions[0, star[k]], positions[1, star[k]]
            dx = q[0, k] - (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2])
            dy = q[1, k] - (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2])
            out[k] = dx * dx + dy * dy
    return out


@_shared_out
def _moments(start, star, q, weight, positions):
    """Per exposure: means of source and target, cross moments xx, xy, yx, yy (target, source), power of the source."""
    out = np.zeros((len(start) - 1, 9))
    for i in prange(len(start) - 1):
        total, row = 0.0, out[i]
        for k in range(start[i], start[i + 1]):
            w = weight[k]
            total += w
            row[0] += w * positions[0, star[k]]
            row[1] += w * positions[1, star[k]]
            row[2] += w * q[0, k]
            row[3] += w * q[1, k]
        if total > 0:
            row[:4] /= total
        for k in range(start[i], start[i + 1]):
            w, sx, sy = weight[k], positions[0, star[k]] - row[0], positions[1, star[k]] - row[1]
            tx, ty = q[0, k] - row[2], q[1, k] - row[3]
            row[4] += w * tx * sx
            row[5] += w * tx * sy
            row[6] += w * ty * sx
            row[7] += w * ty * sy
            row[8] += w * (sx * sx + sy * sy)
    return out


def linearise(problem, state):
    """Twin of the sums in `legdistort.solving.equations.criterion.linearise`; the same arrays, and chi2."""
    orders = np.stack(basis.orders(basis.degree_of(state.coefficients.shape[2])))
    values, coupling, residual, sums, parts, gradient, chi2 = _linearise(
        problem,
        _n_chunks(problem),
        problem.start,
        problem.star,
        problem.xy,
        problem.weight,
        problem.unequal,
        (np.ascontiguousarray(state.stars), problem.terms.columns),
        state.coefficients,
        state.poses,
        np.array(problem.shapes, dtype=float),
        orders,
        problem.n_modes,
    )
    sums = sums.sum(axis=0).T
    xx, yy, xy = (parts + np.tril(parts, -1).swapaxes(2, 3)).swapaxes(0, 1)
    u = np.block([[xx, xy], [xy, yy if problem.unequal else xx]])
    n_star = problem.n_star
    v, g_star = sums[:-n_star].copy(), sums[-n_star:].copy()
    return values, coupling, residual, v, g_star, u, gradient.reshape(len(u), -1), chi2


def to_stars(problem, blocks, a):
    """Twin of `legdistort.solving.equations.elimination.to_stars`."""
    terms = blocks.values, blocks.coupling, problem.terms.columns
    sums = _to_stars(problem, _n_chunks(problem), problem.start, problem.star, *terms, a, problem.n_stars)
    return sums.sum(axis=0).T.copy()


def to_exposures(problem, blocks, y):
    """Twin of `legdistort.solving.equations.elimination.to_exposures`."""
    terms = blocks.values, blocks.coupling, problem.terms.columns
    out = _to_exposures(problem, _n_chunks(problem), problem.start, problem.star, *terms, np.ascontiguousarray(y))
    return out.reshape(len(out), -1)


def distances(problem, pose_list, q, positions):
    """Twin of `legdistort.solving.start_values.distances`."""
    return _distances(problem, problem.start, problem.star, q, pose_list, np.ascontiguousarray(positions))


def moments(problem, q, weight, positions):
    """Moments of the similarities positions -> q of all exposures.

    Returns
    -------
    mean_s, mean_t : ndarray, shape (n_exposures, 2)
    cross : ndarray, shape (n_exposures, 2, 2)
        See `legdistort.geometry.similarity.similarity_of`; NaN where the stars lie at one place.
    """
    out = _moments(problem, problem.start, problem.star, q, weight, np.ascontiguousarray(positions))
    with np.errstate(divide="ignore", invalid="ignore"):
        return out[:, :2], out[:, 2:4], (out[:, 4:8] / out[:, 8:]).reshape(-1, 2, 2)
