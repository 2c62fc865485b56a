"""The hierarchical model of the exposures of one detector, and sets that obey it, in dense numpy by itself.

Unknown are the stars X, the series A_i of every exposure, and the static S of the detector::

    x = q + A_i b(q) + C b'(q) + noise,    q = P_i X,    A_i - S ~ N(0, Lambda),   S ~ N(m, v^2),   C ~ N(0, c^2)

b are the modes up to the degree d, b' those of degrees d + 1 ... 2 d - 1; Lambda is by degree. Similarities of single
exposures are free, their mean is held. Sizes that are not given are those of the largest evidence.
"""

import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import minimize


def orders(degree):
    return [(t - k, k) for t in range(degree + 1) for k in range(t + 1)]


def basis(q, degree, n):
    """Normalised Legendre modes at q (k, 2) of a square detector, and their gradients by q: (k, m), (k, m, 2)."""
    u, unit = (np.asarray(q) + 0.5) * 2 / n - 1, np.sqrt(np.arange(degree + 1) + 0.5)
    v = [legendre.legvander(u[:, a], degree) * unit for a in (0, 1)]
    der = np.zeros((degree + 1, degree + 1))
    for k in range(1, degree + 1):
        der[:k, k] = legendre.legder(np.eye(degree + 1)[k])[:k]
    w = [legendre.legvander(u[:, a], degree) @ der * unit * 2 / n for a in (0, 1)]
    i, j = np.array(orders(degree)).T
    return v[0][:, i] * v[1][:, j], np.stack([w[0][:, i] * v[1][:, j], v[0][:, i] * w[1][:, j]], -1)


def rows(degree):
    """Orthonormal rows of the similarities (4, 2 m), of all else (2 m - 4, 2 m), and the degrees of the latter."""
    o, m = orders(degree), len(orders(degree))
    e = np.eye(2 * m)
    x10, x01 = e[o.index((1, 0))], e[o.index((0, 1))]
    y10, y01 = e[m + o.index((1, 0))], e[m + o.index((0, 1))]
    high = [k for k in range(2 * m) if sum(o[k % m]) > 1]
    similar = np.stack([e[0], e[m], (x10 + y01) / 2**0.5, (y10 - x01) / 2**0.5])
    other = np.concatenate([[(x10 - y01) / 2**0.5, (y10 + x01) / 2**0.5], e[high]])
    return similar, other, np.array([1, 1] + [sum(o[k % m]) for k in high])


class Model:
    """Minimum of the posterior, sizes and covariance; `mean` (2, m) and width `v` of the static, None = found."""

    def __init__(self, xy, err, star, exposure, poses, n, degree, *, mean=None, v=None, scatter=None, closure=False):
        self.xy, self.w, self.star, self.exposure, self.n, self.d = xy, 1 / err, star, exposure, n, degree
        self.top, self.P = 2 * degree - 1 if closure else degree, np.array(poses, float)
        self.m, self.mt = len(orders(degree)), len(orders(self.top))
        self.N, self.M = exposure.max() + 1, star.max() + 1
        self.similar, self.other, self.degrees = rows(degree)
        self.K, self.nc = len(self.other), 2 * (self.mt - self.m)
        self.mean = np.zeros(2 * self.m) if mean is None else np.ravel(mean)
        self.v, self.scatter = v, scatter
        self.sizes = np.r_[np.ones(degree), 1.0, 0.01]  # Lambda by degree, v, c
        self.A, self.C, self.S = np.tile(self.mean, (self.N, 1)), np.zeros(self.nc), self.other @ self.mean
        # unknowns after the stars: similarities less their mean, other modes, C, S
        less_mean = np.linalg.svd(np.ones((1, self.N)))[2][1:]
        t = np.einsum("ri,sa->rsia", less_mean, self.similar).reshape(-1, self.N * 2 * self.m)
        d = np.einsum("ri,sa->rsia", np.eye(self.N), self.other).reshape(-1, self.N * 2 * self.m)
        self.rows, self.nt = np.concatenate([t, d]), len(t)
        self.X = self._start()

    def _start(self):
        q = self.xy.copy()
        for _ in range(30):
            q = self.xy - self._series(q, self.exposure)[0]
        back = np.linalg.inv(self.P[:, :, :2])[self.exposure]
        x, w = np.einsum("nab,nb->na", back, q - self.P[self.exposure, :, 2]), self.w[:, 0] ** 2
        return np.stack([np.bincount(self.star, x[:, a] * w) for a in (0, 1)], -1) / np.bincount(self.star, w)[:, None]

    def _series(self, q, i):
        b, g = basis(q, self.top, self.n)
        c = np.broadcast_to(self.C.reshape(2, -1), (len(i), 2, self.mt - self.m))
        a = np.concatenate([self.A.reshape(self.N, 2, self.m)[i], c], 2)
        return np.einsum("nam,nm->na", a, b), b, np.einsum("nam,nmc->nac", a, g)

    def linear(self):
        """Normal matrix and gradient of the data on (X, rows, C), and chi2."""
        i, j, nx, na = self.exposure, self.star, 2 * self.M, self.N * 2 * self.m
        q = np.einsum("nab,nb->na", self.P[i, :, :2], self.X[j]) + self.P[i, :, 2]
        f, b, g = self._series(q, i)
        r, row = (self.xy - q - f) * self.w, np.arange(len(j))
        by_x = (np.eye(2) + g) @ self.P[i, :, :2] * self.w[..., None]
        J = np.zeros((len(j), 2, nx + na + self.nc))
        for a in (0, 1):
            for c in (0, 1):
                J[row, a, 2 * j + c] = by_x[:, a, c]
            for k in range(self.mt):
                own = nx + i * 2 * self.m + a * self.m + k
                J[row, a, own if k < self.m else nx + na + (a * self.nc) // 2 + k - self.m] = b[:, k] * self.w[:, a]
        J = J.reshape(2 * len(j), -1)
        J = np.concatenate([J[:, :nx], J[:, nx : nx + na] @ self.rows.T, J[:, nx + na :]], 1)
        return J.T @ J, J.T @ r.ravel(), (r**2).sum()

    def factors(self, sizes):
        """Rows of the factors on (rows, C, S), their values here, and widths; S is left out where it is exact."""
        n, k = len(self.rows), self.K
        here = (self.A - self.mean) @ self.other.T
        s = self.S - self.other @ self.mean
        F = np.zeros((self.N * k + self.nc + k, n + self.nc + k))
        F[: n - self.nt, self.nt : n] = np.eye(self.N * k)
        F[: self.N * k, n + self.nc :] = np.tile(-np.eye(k), (self.N, 1))
        F[self.N * k :, n:] = np.eye(self.nc + k)
        value = np.concatenate([(here - s).ravel(), self.C, s])
        width = np.concatenate([np.tile(sizes[self.degrees - 1], self.N), np.full(self.nc, sizes[-1])])
        if self.v == 0:
            return F[:-k, :-k], value[:-k], width
        return F, value, np.concatenate([width, np.full(k, sizes[-2])])

    def find_sizes(self, H, g):
        """The sizes of the largest evidence where the data are linear."""
        nx, which = 2 * self.M, [*([] if self.scatter is not None else range(self.d))]
        which += [self.d] * (self.v is None) + [self.d + 1] * bool(self.nc)
        vi = np.linalg.inv(H[:nx, :nx])
        n = H.shape[0] - nx + self.K * (self.v != 0)
        R, h = np.zeros((n, n)), np.zeros(n)
        R[: len(H) - nx, : len(H) - nx] = H[nx:, nx:] - H[nx:, :nx] @ vi @ H[:nx, nx:]
        h[: len(H) - nx] = g[nx:] - H[nx:, :nx] @ vi @ g[:nx]
        group = np.concatenate([np.tile(self.degrees - 1, self.N), np.full(self.nc, self.d + 1)])
        group = np.concatenate([group, np.full(self.K * (self.v != 0), self.d)])

        def cost(theta):
            sizes = self.sizes.copy()
            sizes[which] = np.exp(theta)
            F, value, width = self.factors(sizes)
            Q = F.T / width**2
            V = np.linalg.inv(R + Q @ F)
            z = V @ (h - Q @ value)
            left, var = value + F @ z, np.einsum("ra,ab,rb->r", F, V, F)
            total = -2 * h @ z + z @ R @ z + ((left / width) ** 2).sum() - np.linalg.slogdet(V)[1]
            slope = 2 - 2 * (left**2 + var) / width**2
            return total + 2 * np.log(width).sum(), np.bincount(group, slope, len(self.sizes))[which]

        if which:
            out = minimize(cost, np.log(self.sizes[which]), jac=True, method="L-BFGS-B", bounds=[(-9, 7)] * len(which))
            self.sizes[which], self.evidence = np.exp(out.x), -out.fun / 2

    def absorb(self):
        """Similarities of single exposures into their poses, but for their mean."""
        t = (self.A - self.mean) @ self.similar.T
        self.A -= t @ self.similar
        grid = np.array([[0.0, 0], [self.n, 0], [0, self.n]])
        for i, s in enumerate(t):
            to = grid + basis(grid, 1, self.n)[0] @ (s @ self.similar).reshape(2, -1)[:, :3].T
            linear = np.linalg.solve(np.c_[grid, np.ones(3)], to).T
            self.P[i] = linear[:, :2] @ self.P[i] + np.c_[np.zeros((2, 2)), linear[:, 2]]

    def normal(self):
        """Normal matrix and gradient of the posterior, J, and chi2."""
        H, g, chi2 = self.linear()
        F, value, width = self.factors(self.sizes)
        Q, nx = F.T / width**2, 2 * self.M
        k = nx + Q.shape[0] - len(H)
        T, h = np.pad(H, (0, k)), np.pad(g, (0, k))
        T[nx:, nx:] += Q @ F
        h[nx:] -= Q @ value
        return T, h, chi2 + ((value / width) ** 2).sum(), chi2, H, g

    def move(self, z):
        nx, n = 2 * self.M, len(self.rows)
        self.X = self.X + z[:nx].reshape(-1, 2)
        self.A = self.A + (z[nx : nx + n] @ self.rows).reshape(self.N, -1)
        self.C = self.C + z[nx + n :][: self.nc]
        self.S = self.S + (z[nx + n + self.nc :] if self.v != 0 else 0)
        self.absorb()

    def fit(self, n_iter=60, tol=1e-6, damping=1e-6):
        if self.scatter is not None:
            self.sizes[: self.d] = self.scatter
        if self.v is not None:
            self.sizes[self.d] = self.v
        for self.iterations in range(n_iter):
            H, g = self.normal()[-2:]
            before = self.sizes.copy()
            self.find_sizes(H, g)
            T, h, cost = self.normal()[:3]
            state = self.X, self.A, self.C, self.S, self.P.copy()
            while True:
                step = np.linalg.solve(T + damping * np.diag(np.diag(T)), h)
                self.move(step)
                if self.normal()[2] <= cost * (1 + 1e-10) or damping > 1e6:
                    break
                self.X, self.A, self.C, self.S, self.P = *state[:4], state[4].copy()
                damping *= 10
            damping = max(damping / 100, 1e-14)
            if step @ h < tol and np.allclose(self.sizes, before, rtol=1e-3):
                break
        T, h, self.cost, self.chi2, H, _ = self.normal()
        self.covariance = np.linalg.inv(T)
        self.dof = 2 * len(self.star) - np.trace(self.covariance[: len(H), : len(H)] @ H)
        return self


def drawn_set(
    seed, *, n_stars=110, n=11, static=1.0, dynamic=0.4, degree=3, size=2048, dither=150.0, rolls=0.0,
    errors=(0.005, 0.08), higher=0.0, odd=None, shifts=None, given=None, angles=None, years=None, motion=0.0,
    nightly=0.0,
):  # fmt: skip
    """What `Model` takes, and the truth: stars, static (2, m), departures; px/mode, errors log-uniform by star.

    Departures of the last exposure are `odd` px/mode; `shifts` (n, 2) are in the place of random dithers, `given`
    (2, m) of a static that is drawn, and `angles` [deg] of equal rolls. Stars with motions from N(0, `motion`) are
    where they are seen at the mean of the `years` (n,) of the exposures; those of a year depart by `nightly` px/mode.
    """
    rng = np.random.default_rng(seed)
    m, other = len(orders(degree)), rows(degree)[1]
    middle, half = (size - 1) / 2, size / 2 + 1.5 * dither
    reach = half if shifts is None else size / 2 + np.abs(shifts).max()
    stars = rng.uniform(middle - reach, middle + reach, (n_stars, 2))
    drawn = (static * rng.normal(size=len(other)) @ other).reshape(2, m)
    given = drawn if given is None else given
    n = n if shifts is None else len(shifts)
    years = np.full(n, 2020.0) if years is None else years
    n = len(years)
    motions = np.random.default_rng((seed, 1)).normal(0, motion, (n_stars, 2))
    own = (dynamic * rng.normal(size=(n, len(other))) @ other).reshape(n, 2, m)
    if nightly:
        of = np.unique(years, return_inverse=True)[1]
        shared = np.random.default_rng((seed, 2)).normal(0, nightly, (of.max() + 1, len(other)))
        own = own + (shared @ other).reshape(-1, 2, m)[of]
    if odd is not None:
        own[-1] *= odd / dynamic
    beyond = np.zeros((2, len(orders(2 * degree - 1))))
    beyond[:, m:] = higher * rng.normal(size=beyond[:, m:].shape)
    shift = dither * rng.normal(size=(n, 2))
    shift[0] = 0
    if shifts is not None:
        shift = -shifts
    angles = rolls * np.arange(n) if angles is None else angles
    angle, sigma = np.deg2rad(angles), np.exp(rng.uniform(*np.log(errors), n_stars))
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], 1).reshape(n, 2, 2)
    poses = np.concatenate([turn, (middle + shift - turn.sum(axis=2) * middle)[:, :, None]], axis=2)
    seen = []
    for i, pose in enumerate(poses):
        q = (stars + (years[i] - np.mean(years)) * motions) @ pose[:, :2].T + pose[:, 2]
        b = basis(q, 2 * degree - 1, size)[0]
        xy = q + b[:, :m] @ (given + own[i]).T + b @ beyond.T
        on = np.flatnonzero(((xy > -0.5) & (xy < size - 0.5)).all(axis=1))
        noise = sigma[on, None] * rng.normal(size=(len(on), 2))
        seen.append((xy[on] + noise, np.tile(sigma[on, None], 2), on, np.full(len(on), i)))
    xy, err, star, exposure = (np.concatenate(each) for each in zip(*seen, strict=True))
    use = np.bincount(star, minlength=n_stars)[star] > 1
    used, star = np.unique(star[use], return_inverse=True)
    data = {"xy": xy[use], "err": err[use], "star": star, "exposure": exposure[use], "poses": poses, "n": size}
    data |= {"degree": degree} | ({"epoch": years[data["exposure"]]} if motion else {})
    truth = {"stars": stars[used], "static": given, "dynamic": own, "beyond": beyond}
    return data, truth | {"motions": motions[used], "epoch": np.mean(years)}
