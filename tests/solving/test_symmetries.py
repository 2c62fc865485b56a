"""What must not matter does not: the order of rows, names, how the sky is turned, what is worth nothing."""

import warnings
from dataclasses import dataclass, replace

import dense_model
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

SIZE, DEGREE = 2048, 3


@dataclass(frozen=True)
class Night:
    """Columns of a table of positions, poses by exposure, options of `solve`, and a reference if there is one.

    Stars and exposures are numbers here, and get their names on the way.
    """

    columns: dict
    poses: dict
    options: dict
    reference: dict | None = None

    def with_columns(self, **changes):
        return replace(self, columns=self.columns | changes)

    def added(self, rows, **changes):
        """With more observations: copies of some rows but for what changes."""
        more = {name: changes.get(name, values[rows]) for name, values in self.columns.items()}
        return replace(self, columns={name: np.concatenate([v, more[name]]) for name, v in self.columns.items()})

    def solved(self, star="{}", exposure="{}", order=slice(None)):
        """The solution, with stars and exposures named by patterns and rows in some order."""
        table = Table({name: values[order] for name, values in self.columns.items()})
        table["star"] = [star.format(each) for each in table["star"]]
        table["exposure"] = [exposure.format(each) for each in table["exposure"]]
        poses = {exposure.format(name): pose for name, pose in self.poses.items()}
        options = dict(self.options)
        if self.reference is not None:
            known = Table(self.reference)
            known["star"] = [star.format(each) for each in known["star"]]
            options["reference"] = known
        with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
            matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
            return ld.solve(matches, degree=options.pop("degree", DEGREE), **options)


def night(seed, *, noise=1.0, worse=None, motion=0.0, gross=0, reference=0, options=None, **words):
    words = {"static": 1.0, "dynamic": 0.6, "rolls": 13.0, "n_stars": 70, "n": 8, "errors": (0.01, 0.04)} | words
    data, truth = dense_model.drawn_set(seed, **words)
    rng, xy = np.random.default_rng((seed, 1)), data["xy"].copy()
    err = data["err"].copy()
    if worse is not None:
        bad = data["exposure"] == 3
        xy[bad] += worse * err[bad] * rng.normal(size=xy[bad].shape)
        err[bad] *= worse
    columns = {"exposure": data["exposure"], "star": data["star"]}
    years = 2010.0 + 1.3 * np.arange(len(data["poses"]))
    if motion:
        own = rng.normal(0, motion, (data["star"].max() + 1, 2))[data["star"]]
        turn = data["poses"][data["exposure"], :, :2]
        xy += np.einsum("nab,nb->na", turn, own) * (years[data["exposure"]] - years.mean())[:, None]
        columns["epoch"] = years[data["exposure"]]
    if noise > 1:
        xy += np.sqrt(noise**2 - 1) * err * rng.normal(size=xy.shape)
    if gross:
        xy[rng.choice(len(xy), gross, replace=False)] += rng.choice([-3.0, 3.0], (gross, 2))
    columns |= {"x": xy[:, 0], "y": xy[:, 1], "x_err": err[:, 0], "y_err": err[:, 1]}
    known = None
    if reference:
        places = truth["stars"][:reference] + rng.normal(0, 0.05, (reference, 2))
        known = {"star": np.arange(reference), "x": places[:, 0], "y": places[:, 1]}
        known |= {"x_err": np.full(reference, 0.05), "y_err": np.full(reference, 0.05)}
    options = {} if options is None else options(truth) if callable(options) else options
    return Night(columns, dict(enumerate(data["poses"])), options, known)


SETTINGS = {
    "plain": {},
    "prior": {"options": lambda truth: {"prior": ld.Prior(truth["static"], sigma=0.6, static_sigma=0.05)}},
    "exact prior": {"options": lambda truth: {"prior": ld.Prior(truth["static"])}},
    "evidence": {"options": lambda truth: {"prior": ld.Prior(truth["static"], sigma="evidence", static_sigma=0.05)}},
    "degree chosen": {"options": {"degree": "auto"}},
    "huber": {"gross": 6, "options": {"loss": "huber", "clip": None}},
    "cauchy": {"gross": 6, "options": {"loss": "cauchy", "clip": None}},
    "clipped": {"gross": 6},
    "motions": {"motion": 0.01, "options": {"motion": "proper"}},
    "motions by evidence": {"motion": 0.01, "options": {"motion": "proper", "motion_sigma": "evidence"}},
    "reference": {"reference": 25},
    "static fitted": {"dynamic": 0.0, "options": {"static": "fit"}},
    "floor": {"noise": 1.6, "options": {"errors": "floor"}},
    "scale": {"noise": 1.6, "options": {"errors": "scale"}},
    "affine": {"degree": 1, "static": 0.0, "options": {"degree": 1}},
    "no rolls": {"rolls": 0.0},
    "one exposure 50 times worse": {"worse": 50.0},
    "large distortions": {"static": 1.0, "dynamic": 8.0, "options": lambda truth: {"prior": ld.Prior(truth["static"])}},
}


#: One of each kind of estimation.
QUICK = {"plain", "exact prior", "cauchy", "clipped", "motions", "reference", "static fitted", "scale"}
#: Beside these, of those that are much like another.
SLOW = {"evidence", "large distortions"}


def found(solution, names=None):
    """Positions, errors (n, 2) and the others (n, k) of the stars in the order of their numbers, and the solution."""
    stars = solution.stars
    number = np.array([int("".join(c for c in str(each) if c.isdigit())) for each in stars["star"]])
    order = np.argsort(number)
    columns = [np.stack([np.asarray(stars[c]) for c in pair], axis=1)[order]
               for pair in (("x", "y"), ("x_err", "y_err"), ("x_err_known", "y_err_known"))]  # fmt: skip
    return number[order], *columns


def assert_same(first, second, part=1e-3):
    """The same positions to a part of their errors, the same errors to a part."""
    a, b = found(first), found(second)
    assert_allclose(b[0], a[0])
    assert np.nanmax(np.abs(b[1] - a[1]) / np.nanmax(a[2], axis=1, keepdims=True)) < part
    for mine, other in zip(a[2:], b[2:], strict=True):
        assert_allclose(other, mine, rtol=part)


def assert_as_good(first, second):
    """To 1e-2 of their errors the same positions relative to one another, and in the plane but for its pointing.

    And the same errors to 1 %.
    """
    number, xy, relative, known = found(first)
    others = found(second)
    keep = np.isin(others[0], number)
    offset = others[1][keep] - xy
    degree = first.degree if first.settings.static != "fit" else 1
    for maps, error in ((dense_model.basis(xy, degree, SIZE)[0], relative), (None, known)):
        if maps is None:  # shift, rotation and scale
            z, d = xy @ [1, 1j], offset @ [1, 1j]
            columns = np.stack([np.ones(len(z)), z], axis=1)
            left = d - columns @ np.linalg.lstsq(columns, d, rcond=None)[0]
            left = np.stack([left.real, left.imag], axis=1)
        else:
            left = offset - maps @ np.linalg.lstsq(maps, offset, rcond=None)[0]
        assert np.nanmax(np.abs(left) / np.nanmax(error, axis=1, keepdims=True)) < 1e-2
    assert_allclose(others[2][keep], relative, rtol=1e-2)
    assert_allclose(others[3][keep], known, rtol=1e-2)


@pytest.fixture(scope="module")
def solved():
    made = {}

    def of(setting, seed):
        if (setting, seed) not in made:
            one = night(seed, **SETTINGS[setting])
            made[setting, seed] = one, one.solved()
        return made[setting, seed]

    return of


def cases(*without):
    """Settings and seeds; those beyond the first are sets, and so is most of what is much like another."""
    made = [(setting, seed) for setting in SETTINGS if setting not in without for seed in range(2)]
    others = [seed > 0 or setting not in QUICK | SLOW for setting, seed in made]
    return [
        pytest.param(*each, marks=pytest.mark.sets if other else [pytest.mark.slow] * (each[0] not in QUICK))
        for each, other in zip(made, others, strict=True)
    ]


@pytest.mark.parametrize(("setting", "seed"), cases())
def test_order_and_names(setting, seed, solved):
    one, first = solved(setting, seed)
    order = np.random.default_rng(0).permutation(len(one.columns["x"]))
    assert_same(first, one.solved(star="s{}", exposure="é {} ß", order=order))


@pytest.mark.parametrize(("setting", "seed"), cases())
def test_reading(setting, seed, solved, tmp_path):
    _, first = solved(setting, seed)
    first.write(tmp_path / "s.asdf")
    assert_same(first, ld.Solution.read(tmp_path / "s.asdf"), 1e-9)


def turned(one, linear, shift):
    """The night with another reference plane: ``X' = linear X + shift``."""
    back = np.linalg.inv(linear)
    poses = {
        name: np.column_stack([p[:, :2] @ back, p[:, 2] - p[:, :2] @ back @ shift]) for name, p in one.poses.items()
    }
    known = one.reference
    if known is not None:
        x, y = linear @ np.stack([known["x"], known["y"]]) + shift[:, None]
        size = np.sqrt(abs(np.linalg.det(linear)))
        known = known | {"x": x, "y": y, "x_err": size * known["x_err"], "y_err": size * known["y_err"]}
    return replace(one, poses=poses, reference=known)


PLANES = {  # reflections alone by default
    "shifted": (np.eye(2), np.array([1234.5, -777.7])),
    "turned": (np.array([[0.0, -1.0], [1.0, 0.0]]), np.zeros(2)),
    "scaled": (1.02 * np.eye(2), np.zeros(2)),
    "mirrored": (np.diag([-1.0, 1.0]), np.zeros(2)),
}


@pytest.mark.parametrize(
    "plane", [pytest.param(name, marks=[pytest.mark.slow] * (name != "mirrored")) for name in PLANES]
)
@pytest.mark.parametrize(("setting", "seed"), cases())
def test_the_plane(setting, seed, plane, solved):
    """What counts as unknown has an error beyond a pixel of the plane, which is another one where that is scaled."""
    if plane == "scaled" and SETTINGS[setting].get("motion"):
        return
    one, first = solved(setting, seed)
    linear, shift = PLANES[plane]
    number, xy, err, known = found(first)
    b = found(turned(one, linear, shift).solved())
    size, axes = np.sqrt(abs(np.linalg.det(linear))), [0, 1] if linear[0, 0] else [1, 0]
    assert_allclose(b[0], number)
    wanted = xy @ linear.T + shift
    assert np.nanmax(np.abs(b[1] - wanted) / np.nanmax(size * err, axis=1, keepdims=True)) < 1e-3
    assert_allclose(b[2], size * err[:, axes], rtol=1e-3)
    assert_allclose(b[3], size * known[:, axes], rtol=1e-3)


#: Sizes that are found from all residuals, and a degree that is chosen from them, change by chance with every row.
FOUND = "floor", "scale", "degree chosen"


@pytest.mark.parametrize(("setting", "seed"), cases(*FOUND))
def test_a_worthless_star(setting, seed, solved):
    one, first = solved(setting, seed)
    rng, n = np.random.default_rng((seed, 1)), len(one.poses)
    rows = np.array([np.flatnonzero(one.columns["exposure"] == name)[0] for name in one.poses])
    xy = np.stack([pose[:, :2] @ [1100.0, 900.0] + pose[:, 2] for pose in one.poses.values()]) + rng.normal(
        0, 20, (n, 2)
    )
    wide = np.full(n, 20.0)
    more = one.added(rows, star=np.full(n, 999), x=xy[:, 0], y=xy[:, 1], x_err=wide, y_err=wide)
    assert_as_good(first, more.solved())


#: The scatter of exposures is found, or given, and takes part in where the stars are.
SCATTERS = "plain", "clipped", "prior", "evidence", "large distortions", "motions", "motions by evidence"


@pytest.mark.parametrize(("setting", "seed"), cases(*FOUND))
def test_a_worthless_exposure(setting, seed, solved):
    """One of 20 px, or of 200 px where beside the scatter of exposures one of 20 px is worth a hundredth of another."""
    one, first = solved(setting, seed)
    rows = np.flatnonzero(one.columns["exposure"] == 2)
    scatters = setting in SCATTERS
    error, rng = 200.0 if scatters else 20.0, np.random.default_rng((seed, 2))
    noise = {axis: one.columns[axis][rows] + rng.normal(0, error, len(rows)) for axis in "xy"}
    wide = np.full(len(rows), error)
    more = one.added(rows, exposure=np.full(len(rows), 99), x_err=wide, y_err=wide, **noise)
    assert_as_good(first, replace(more, poses=more.poses | {99: one.poses[2]}).solved())
