"""Compiled twins of the loops over observations in `legdistort.solving.equations.criterion`, for large problems.

For small problems, where loading numba would not pay, the plain NumPy code runs. Both give the same numbers.
Observations are taken in batches, so that the inner loops run over neighbours in memory and become vector
instructions; exposures of many observations are shared out among threads, each with star sums of its own, so results
do not depend on timing. Of so many the coupling is kept in single precision: it steers the step, while the gradient,
which decides where the minimum is, stays in double. Sets of fewer observations may have directions that hardly
anything determines, and steps along these need all digits.
"""

import itertools
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar

import numpy as np
from numba import config

from ...geometry import basis
from ...runtime.compiling import compiled_loop

#: Number of observations from which they are shared out among threads, and couplings are kept in single precision.
THREADS_FROM = 200_000
_BATCH = 128
#: Bytes of a line of the cache. A vector that crosses the end of one takes twice as long to load or store.
_LINE = 64
#: Threads that are kept, see `threads_kept`.
_kept = ContextVar("kept", default=None)
_FAST = {"contract", "reassoc", "nsz"}  # sums may be reordered; NaN and infinity keep their meaning


def _chunks(problem):
    """Numbers of exposures ``[(low, high), ...]`` of about as many observations, one chunk for each thread.

    One alone for few observations: they are done before threads have met, above all on a machine with other work.
    """
    start, n = problem.start, config.NUMBA_NUM_THREADS
    if start[-1] < THREADS_FROM:
        return [(0, len(start) - 1)]
    inner = np.searchsorted(start, start[-1] * np.arange(1, n) // n).tolist()
    return list(itertools.pairwise([0, *inner, len(start) - 1]))


def _shared_out(function, chunks, *outputs):
    """Call ``function(low, high, *outputs[chunk])`` for every chunk; what it returns, as a list.

    The first in this thread, the others in one each.
    """
    first, *others = [(low, high, *each) for (low, high), *each in zip(chunks, *outputs, strict=True)]
    if not others:
        return [function(*first)]
    kept = _kept.get()
    with ThreadPoolExecutor(len(others)) if kept is None else nullcontext(kept) as threads:
        later = [threads.submit(function, *call) for call in others]
        return [function(*first), *(each.result() for each in later)]


@contextmanager
def threads_kept():
    """Keep the threads that begin in the block to its end: many short calls spend their time on new ones otherwise."""
    with ThreadPoolExecutor(config.NUMBA_NUM_THREADS) as threads:
        before = _kept.set(threads)
        try:
            yield
        finally:
            _kept.reset(before)


@compiled_loop(nogil=True)
def _workspace(rows):
    """An array (rows, _BATCH) of anything, which begins with a line of the cache."""
    whole = np.empty((rows + 1) * _BATCH)
    first = (-whole.ctypes.data % _LINE) // whole.itemsize
    return whole[first : first + rows * _BATCH].reshape(rows, _BATCH)


@compiled_loop(nogil=True)
def _recurrence(top):
    """Factors that lead from orders k and k - 1 to k + 1 < top, see `_legendre`; (top, 4).

    Of the usual polynomials (k + 1) P_{k+1} = (2k + 1) u P_k - k P_{k-1} and P'_{k+1} = P'_{k-1} + (2k + 1) P_k.
    Outside the loops over observations, where a compiler that may reorder sums would divide anew for each of these.
    """
    out = np.zeros((top, 4))
    for k in range(1, top - 1):
        one, two = np.sqrt((2 * k + 3) / (2 * k + 1)), np.sqrt((2 * k + 3) / (2 * k - 1))
        out[k, 0], out[k, 1] = (2 * k + 1) / (k + 1) * one, k / (k + 1) * two
        out[k, 2], out[k, 3] = (2 * k + 1) * one, two
    return out


@compiled_loop(nogil=True, fastmath=_FAST)
def _legendre(u, factors, p, d):
    """Normalised Legendre polynomials and derivatives at u (_BATCH,), into p and d (top, _BATCH)."""
    top = len(p)
    for o in range(_BATCH):
        p[0, o], d[0, o] = np.sqrt(0.5), 0.0
    if top > 1:
        for o in range(_BATCH):
            p[1, o], d[1, o] = np.sqrt(1.5) * u[o], np.sqrt(1.5)
    for k in range(1, top - 1):
        forward, back, rise, two = factors[k, 0], factors[k, 1], factors[k, 2], factors[k, 3]
        before, here, after, slope_before, slope_after = p[k - 1], p[k], p[k + 1], d[k - 1], d[k + 1]
        for o in range(_BATCH):
            after[o] = forward * u[o] * here[o] - back * before[o]
        for o in range(_BATCH):
            slope_after[o] = two * slope_before[o] + rise * here[o]


@compiled_loop(nogil=True, fastmath=_FAST)
def _model(a, orders, size, q, work):
    """Distorted positions and I + A grad b of a batch; q (2, _BATCH) is overwritten with the positions."""
    factors, pu, du, pv, dv, u, b, g = work
    su, sv = 2.0 / size[1], 2.0 / size[0]
    for o in range(_BATCH):
        u[0, o], u[1, o] = (q[0, o] + 0.5) * su - 1.0, (q[1, o] + 0.5) * sv - 1.0
        g[0, o], g[1, o], g[2, o], g[3, o] = 1.0, 0.0, 0.0, 1.0
    _legendre(u[0], factors, pu, du)
    _legendre(u[1], factors, pv, dv)
    for m in range(orders.shape[1]):
        i, j, ax, ay = orders[0, m], orders[1, m], a[0, m], a[1, m]
        aux, auy, avx, avy = ax * su, ay * su, ax * sv, ay * sv
        for o in range(_BATCH):
            p, r = pu[i, o], pv[j, o]
            value, by_u, by_v = p * r, du[i, o] * r, p * dv[j, o]
            b[m, o] = value
            q[0, o] += ax * value
            q[1, o] += ay * value
            g[0, o] += aux * by_u
            g[1, o] += avx * by_v
            g[2, o] += auy * by_u
            g[3, o] += avy * by_v


@compiled_loop(nogil=True, fastmath=_FAST)
def _normal_block(weight, b, weighted, out):
    """Add ``sum w b b'`` of a batch to the lower triangle of out (n_modes, n_modes)."""
    for m in range(len(out)):
        for o in range(_BATCH):
            weighted[o] = weight[o] * b[m, o]
        for other in range(m + 1):
            total = 0.0
            for o in range(_BATCH):
                total += weighted[o] * b[other, o]
            out[m, other] += total


@compiled_loop(nogil=True, fastmath=_FAST)
def _dots(b, x, out):
    for m in range(len(out)):
        total = 0.0
        for o in range(_BATCH):
            total += b[m, o] * x[o]
        out[m] += total


@compiled_loop(nogil=True, fastmath=_FAST)
def _to_star_sums(number, j, n_block, mine):
    """Add the blocks and gradients of the positions of a batch, j (5, _BATCH), to the sums of the stars."""
    for o in range(len(number)):
        row = mine[number[o]]
        row[0] += j[0, o]
        row[1] += j[1, o]
        row[2] += j[2, o]
        row[n_block] += j[3, o]
        row[n_block + 1] += j[4, o]


@compiled_loop(nogil=True, fastmath=_FAST)
def _terms(row, n_block, phi, f, j, r):
    """Add to the sums of a star what an observation contributes to the terms beside its position, phi (2, n_terms)."""
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


@compiled_loop(nogil=True, fastmath=_FAST)
def _take(first, size, star, stars, weight, phi, pose, q, w):
    """Undistorted positions and weights of a batch; that at the end of an exposure is filled up with no weight."""
    for o in range(size):
        k = first + o
        x, y = stars[0, star[k]], stars[1, star[k]]
        for t in range(phi.shape[1]):
            x += phi[0, t] * stars[2 + t, star[k]]
            y += phi[1, t] * stars[2 + t, star[k]]
        q[0, o] = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2]
        q[1, o] = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2]
        w[0, o], w[1, o], w[2, o] = weight[0, k], weight[1, k], weight[2, k]
    for o in range(size, _BATCH):
        q[0, o], q[1, o], w[0, o], w[1, o], w[2, o] = 0.0, 0.0, 0.0, 0.0, 0.0


@compiled_loop(nogil=True, fastmath=_FAST)
def _linearise(low, high, mine, start, star, xy, weight, unequal, moving, model, made):
    """The exposures from `low` to `high` into what is `made`, and their star sums into `mine`; returns their chi2."""
    (stars, columns), (coefficients, poses, sizes, orders) = moving, model
    residual, values, coupling, u_blocks, gradient = made
    n_all, n_terms, n_modes, top = orders.shape[1], columns.shape[2], len(values), orders.max() + 1
    n_block = (2 + n_terms) * (3 + n_terms) // 2
    q, w, r, wr, u, b = _workspace(2), _workspace(3), _workspace(2), _workspace(2), _workspace(2), _workspace(n_all)
    g, f, j, weighted, chi2 = _workspace(4), _workspace(4), _workspace(5), _workspace(1)[0], 0.0
    work = (_recurrence(top), _workspace(top), _workspace(top), _workspace(top), _workspace(top), u, b, g)
    r[:] = 0.0  # what fills up a batch has no weight, and must be finite
    for i in range(low, high):
        pose, phi = poses[i], columns[i]
        r00, r01, r10, r11 = pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1]
        for first in range(start[i], start[i + 1], _BATCH):
            size = min(_BATCH, start[i + 1] - first)
            _take(first, size, star, stars, weight, phi, pose, q, w)
            _model(coefficients[i], orders, sizes[i], q, work)
            for axis in range(2):  # slices have no negative indices to be watched for: vector instructions serve
                seen, kept = xy[axis, first : first + size], residual[axis, first : first + size]
                for o in range(size):
                    r[axis, o] = seen[o] - q[axis, o]
                    kept[o] = r[axis, o]
            total = 0.0
            for o in range(_BATCH):
                jxx, jxy = g[0, o] * r00 + g[1, o] * r10, g[0, o] * r01 + g[1, o] * r11
                jyx, jyy = g[2, o] * r00 + g[3, o] * r10, g[2, o] * r01 + g[3, o] * r11
                fxx, fxy = jxx * w[0, o] + jyx * w[2, o], jxx * w[2, o] + jyx * w[1, o]
                fyx, fyy = jxy * w[0, o] + jyy * w[2, o], jxy * w[2, o] + jyy * w[1, o]
                f[0, o], f[1, o], f[2, o], f[3, o] = fxx, fxy, fyx, fyy
                g[0, o], g[1, o], g[2, o], g[3, o] = jxx, jxy, jyx, jyy
                j[0, o], j[1, o] = fxx * jxx + fxy * jyx, fyx * jxy + fyy * jyy
                j[2, o] = fxx * jxy + fxy * jyy
                j[3, o], j[4, o] = fxx * r[0, o] + fxy * r[1, o], fyx * r[0, o] + fyy * r[1, o]
                wr[0, o] = w[0, o] * r[0, o] + w[2, o] * r[1, o]
                wr[1, o] = w[2, o] * r[0, o] + w[1, o] * r[1, o]
                total += r[0, o] * wr[0, o] + r[1, o] * wr[1, o]
            chi2 += total
            for axis in range(2):
                for other in range(2):
                    out = coupling[axis, other, first : first + size]
                    for o in range(size):
                        out[o] = f[2 * axis + other, o]
            for m in range(n_modes):
                out = values[m, first : first + size]
                for o in range(size):
                    out[o] = b[m, o]
            number = star[first : first + size]
            _to_star_sums(number, j, n_block, mine)
            if n_terms:
                for o in range(size):
                    _terms(mine[number[o]], n_block, phi, f[:, o], g[:, o], r[:, o])
            _normal_block(w[0], b, weighted, u_blocks[i, 0])
            if unequal:
                _normal_block(w[1], b, weighted, u_blocks[i, 1])
                _normal_block(w[2], b, weighted, u_blocks[i, 2])
            _dots(b, wr[0], gradient[i, 0])
            _dots(b, wr[1], gradient[i, 1])
    return chi2


@compiled_loop(nogil=True, fastmath=_FAST)
def _to_stars(low, high, mine, start, star, values, coupling, columns, a):
    n_modes, n_terms = len(values), columns.shape[2]
    x, y = _workspace(1)[0], _workspace(1)[0]
    for i in range(low, high):
        for first in range(start[i], start[i + 1], _BATCH):
            size = min(_BATCH, start[i + 1] - first)
            x[:], y[:] = 0.0, 0.0
            for m in range(n_modes):
                row, ax, ay = values[m, first : first + size], a[i, m], a[i, n_modes + m]
                for o in range(size):
                    x[o] += ax * row[o]
                    y[o] += ay * row[o]
            f, number = coupling[:, :, first : first + size], star[first : first + size]
            for o in range(size):
                row = mine[number[o]]
                px = f[0, 0, o] * x[o] + f[0, 1, o] * y[o]
                py = f[1, 0, o] * x[o] + f[1, 1, o] * y[o]
                row[0] += px
                row[1] += py
                for t in range(n_terms):
                    row[2 + t] += columns[i, 0, t] * px + columns[i, 1, t] * py


@compiled_loop(nogil=True, fastmath=_FAST)
def _to_exposures(low, high, out, start, star, values, coupling, columns, stars):
    n_modes, n_terms = len(values), columns.shape[2]
    x, y = _workspace(1)[0], _workspace(1)[0]
    for i in range(low, high):
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


@compiled_loop(nogil=True, fastmath=_FAST)
def _displaced(a, orders, size, x, q, work):
    """``x - A b(q)`` of a batch, into q (2, _BATCH)."""
    factors, pu, du, pv, dv, u = work
    for o in range(_BATCH):
        u[0, o], u[1, o] = (q[0, o] + 0.5) * (2.0 / size[1]) - 1.0, (q[1, o] + 0.5) * (2.0 / size[0]) - 1.0
        q[0, o], q[1, o] = x[0, o], x[1, o]
    _legendre(u[0], factors, pu, du)
    _legendre(u[1], factors, pv, dv)
    for m in range(orders.shape[1]):
        i, j, ax, ay = orders[0, m], orders[1, m], a[0, m], a[1, m]
        if ax != 0.0 or ay != 0.0:
            for o in range(_BATCH):
                value = pu[i, o] * pv[j, o]
                q[0, o] -= ax * value
                q[1, o] -= ay * value


@compiled_loop(nogil=True, fastmath=_FAST)
def _undistorted(low, high, out, order, start, xy, coefficients, sizes, orders):
    top = orders.max() + 1
    x, q = _workspace(2), _workspace(2)
    work = (_recurrence(top), _workspace(top), _workspace(top), _workspace(top), _workspace(top), _workspace(2))
    x[:] = 0.0  # what fills up a batch must be finite
    for i in range(low, high):
        for first in range(start[i], start[i + 1], _BATCH):
            size = min(_BATCH, start[i + 1] - first)
            for axis in range(2):
                seen = xy[axis, first : first + size]
                for o in range(size):
                    x[axis, o] = seen[o]
            q[:] = x
            for _ in range(order):
                _displaced(coefficients[i], orders, sizes[i], x, q, work)
            for axis in range(2):
                found = out[axis, first : first + size]
                for o in range(size):
                    found[o] = q[axis, o]


@compiled_loop(nogil=True, fastmath=_FAST)
def _carried_back(low, high, mine, start, star, q, inverses, weight):
    for i in range(low, high):
        back = inverses[i]
        for k in range(start[i], start[i + 1]):
            row, w, x, y = mine[star[k]], weight[k], q[0, k], q[1, k]
            row[0] += w
            row[1] += w * (back[0, 0] * x + back[0, 1] * y + back[0, 2])
            row[2] += w * (back[1, 0] * x + back[1, 1] * y + back[1, 2])


@compiled_loop(nogil=True, fastmath=_FAST)
def _distances(low, high, out, start, star, q, poses, positions):
    for i in range(low, high):
        pose = poses[i]
        for k in range(start[i], start[i + 1]):
            x, y = positions[0, star[k]], positions[1, star[k]]
            dx = q[0, k] - (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2])
            dy = q[1, k] - (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2])
            out[k] = dx * dx + dy * dy


@compiled_loop(nogil=True, fastmath=_FAST)
def _moments(low, high, out, start, star, q, weight, positions):
    """Per exposure: means of source and target, cross moments xx, xy, yx, yy (target, source), power of the source."""
    for i in range(low, high):
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


def linearise(problem, state):
    """Twin of the sums in `legdistort.solving.equations.criterion.linearise`; the same arrays, and chi2."""
    orders = np.stack(basis.orders(basis.degree_of(state.coefficients.shape[2])))
    n, n_star, n_exposures, n_modes = problem.xy.shape[1], problem.n_star, problem.n_exposures, problem.n_modes
    precision = np.float32 if n >= THREADS_FROM else np.float64
    values, coupling = np.empty((n_modes, n), precision), np.empty((2, 2, n), precision)
    parts, gradient = np.zeros((n_exposures, 3, n_modes, n_modes)), np.zeros((n_exposures, 2, n_modes))
    residual, chunks = np.empty((2, n)), _chunks(problem)
    sums = np.zeros((len(chunks), problem.n_stars, n_star * (n_star + 3) // 2))
    moving = np.ascontiguousarray(state.stars), problem.terms.columns
    model = state.coefficients, state.poses, np.ascontiguousarray(problem.size[:, ::-1]), orders
    given = problem.start, problem.star, problem.xy, problem.weight, problem.unequal, moving, model
    made = residual, values, coupling, parts, gradient
    chi2 = sum(_shared_out(lambda *chunk: _linearise(*chunk, *given, made), chunks, sums))
    sums = sums.sum(axis=0).T
    xx, yy, xy = (parts + np.tril(parts, -1).swapaxes(2, 3)).swapaxes(0, 1)
    u = np.block([[xx, xy], [xy, yy if problem.unequal else xx]])
    v, g_star = sums[:-n_star].copy(), sums[-n_star:].copy()
    return values, coupling, residual, v, g_star, u, gradient.reshape(n_exposures, -1), chi2


def to_stars(problem, blocks, a):
    """Twin of `legdistort.solving.equations.elimination.to_stars`."""
    given = problem.start, problem.star, blocks.values, blocks.coupling, problem.terms.columns, a
    chunks = _chunks(problem)
    sums = np.zeros((len(chunks), problem.n_stars, problem.n_star))
    _shared_out(lambda *chunk: _to_stars(*chunk, *given), chunks, sums)
    return sums.sum(axis=0).T.copy()


def to_exposures(problem, blocks, y):
    """Twin of `legdistort.solving.equations.elimination.to_exposures`."""
    terms = blocks.values, blocks.coupling, problem.terms.columns
    given = problem.start, problem.star, *terms, np.ascontiguousarray(y)
    out = np.zeros((problem.n_exposures, 2, problem.n_modes))
    _shared_out(lambda *chunk: _to_exposures(*chunk, out, *given), _chunks(problem))
    return out.reshape(len(out), -1)


def undistorted(problem, order):
    """Twin of `legdistort.solving.start_values.undistorted`."""
    orders = np.stack(basis.orders(basis.degree_of(problem.prior_mean.shape[2])))
    out, sizes = np.empty_like(problem.xy), np.ascontiguousarray(problem.size[:, ::-1])
    given = out, order, problem.start, problem.xy, problem.prior_mean, sizes, orders
    _shared_out(lambda *chunk: _undistorted(*chunk, *given), _chunks(problem))
    return out


def carried_back(problem, inverses, q, weight):
    """Twin of `legdistort.solving.start_values.carried_back`."""
    chunks, given = _chunks(problem), (problem.start, problem.star, q, inverses, weight)
    sums = np.zeros((len(chunks), problem.n_stars, 3))
    _shared_out(lambda *chunk: _carried_back(*chunk, *given), chunks, sums)
    return sums.sum(axis=0).T


def distances(problem, pose_list, q, positions):
    """Twin of `legdistort.solving.start_values.distances`."""
    out, given = np.empty(q.shape[1]), (problem.start, problem.star, q, pose_list, np.ascontiguousarray(positions))
    _shared_out(lambda *chunk: _distances(*chunk, out, *given), _chunks(problem))
    return out


def moments(problem, q, weight, positions):
    """Twin of `legdistort.solving.start_values.moments`."""
    out, given = np.zeros((problem.n_exposures, 9)), (problem.start, problem.star, q, weight)
    positions = np.ascontiguousarray(positions)
    _shared_out(lambda *chunk: _moments(*chunk, out, *given, positions), _chunks(problem))
    with np.errstate(divide="ignore", invalid="ignore"):
        return out[:, :2], out[:, 2:4], (out[:, 4:8] / out[:, 8:]).reshape(-1, 2, 2)
