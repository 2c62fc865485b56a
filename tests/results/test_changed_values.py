"""One value of a file changed: it is refused in words that name the file, or what was read can be used."""

import copy
import warnings
from contextlib import suppress

import asdf
import gsaoi_images
import numpy as np
import pytest
from moving_stars import field, gaia
from numpy.testing import assert_array_equal

import legdistort
from legdistort.exceptions import InputError, LegdistortError, LegdistortWarning
from legdistort.priors.prior import Prior
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs

#: What takes the place of a number.
NONSENSE = (np.nan, np.inf, -1.0, 1e300)


def plain():
    sim = simulate_matches(n_stars=15, n_exposures=4, degree=2, shape=(300, 500), dither=20, corr=0.4, seed=1)
    return solve(sim.matches, degree=2, prior=Prior(sim.truth.static, static_sigma=0.02), clip=5)


def moving():
    sim = field(40)
    stars = gaia(sim, np.random.default_rng(3), parallax=False, n=20)[0]
    return solve(sim.matches, degree=2, motion="proper", reference=stars, clip=None)


def tied():
    sim = simulate_gsaoi_matches(small=True, seed=1)
    first = solve(sim.matches, degree=2)
    return solve(sim.matches, degree=2, reference=first.stars["ra", "dec", "ra_error", "dec_error"][::3])


def static():
    return solve(simulate_gsaoi_matches(small=True, seed=1).matches, static="fit")


def camera():
    table = gsaoi_images.Night(n_exposures=4, n_stars=40, dither=8.0, turn=0.3).table(sigma=0.01)
    matches = legdistort.Matches.from_table(table, camera=legdistort.Camera.gsaoi())
    return solve(matches, degree=2, layout="fit", static="fit")


KINDS = {"plain": plain, "moving": moving, "tied": tied, "static": static, "camera": camera}


def use_solution(solution):
    """What a user does first."""
    for each in (solution, solution.gauge, solution.stars, solution.residuals, solution.diagnostics.in_words()):
        str(each)
    view = solution[solution.names[0]].parts[0]
    for action in (
        lambda: view.correct(np.array([[5.0, 5.0]]), errors=np.array([[0.1, 0.1]])),
        lambda: view.errors,
        lambda: view.wcs(10.0, 10.0),
    ):
        with suppress(LegdistortError):
            action()


def use_wcs(wcs):
    wcs.invert(*wcs(10.0, 20.0))


def numbers(tree, path=()):
    """Paths to every number and array of numbers of a tree; of lists the first two items stand for all."""
    if isinstance(tree, (dict, list)):
        for key in tree if isinstance(tree, dict) else range(min(len(tree), 2)):
            yield from numbers(tree[key], (*path, key))
    elif isinstance(tree, np.ndarray):
        if tree.dtype.kind in "fiu" and tree.size:
            yield path
    elif isinstance(tree, (int, float)) and not isinstance(tree, bool):
        yield path


def changes(value, rng):
    """The value with nonsense in one place, or a row less along one axis."""
    if not isinstance(value, np.ndarray):
        yield from NONSENSE
        return
    for number in NONSENSE:
        out = value.astype(float)
        out.flat[rng.integers(out.size)] = number
        yield out
    for axis in range(value.ndim):
        yield np.delete(value, 0, axis=axis)


def changed(tree, rng):
    """Copies of a tree, with one value changed in each, and what was changed."""
    for path in list(numbers(tree)):
        *outer, last = path
        place = tree
        for key in outer:
            place = place[key]
        for value in changes(place[last], rng):
            out = copy.copy(tree)
            inner = out
            for key in outer:
                inner[key] = copy.copy(inner[key])
                inner = inner[key]
            inner[last] = value
            yield out, f"{path}: {value!r:.60}"


def tree_of(path):
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        tree = {key: value for key, value in file.tree.items() if key not in ("asdf_library", "history")}
    return asdf.treeutil.walk_and_modify(
        tree, lambda node: np.array(node) if isinstance(node, asdf.tags.core.NDArrayType) else node
    )


def check(path, read, use, monkeypatch, module, n):
    """Read and use n of the changed trees; the file is not written anew, which takes longest."""
    rng, used = np.random.default_rng(1), 0
    cases = list(changed(tree_of(path), rng))
    for k in rng.permutation(len(cases))[:n]:
        tree, what = cases[k]
        monkeypatch.setattr(f"legdistort.{module}.storage.read_tree", lambda *_, tree=tree, **__: copy.deepcopy(tree))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LegdistortWarning)
                use(read(path))
            used += 1
        except InputError as error:
            assert path.name in str(error), what  # noqa: PT017
            assert "Error" not in str(error), what  # noqa: PT017
        except Exception as error:
            pytest.fail(f"{what}: {error!r}")
    assert n < 10 or used < n


SOME_OR_MANY = pytest.mark.parametrize(
    "n", [pytest.param(4, id="some"), pytest.param(30, id="many", marks=pytest.mark.sets)]
)


@SOME_OR_MANY
@pytest.mark.parametrize(
    "kind", [pytest.param(each, marks=[pytest.mark.slow] * (each in ("tied", "camera"))) for each in KINDS]
)
@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")  # these sets tell little
def test_solutions(kind, n, tmp_path, monkeypatch):
    path = KINDS[kind]().write(tmp_path / "s.asdf")
    check(path, Solution.read, use_solution, monkeypatch, "results", n)


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")
def test_what_fits_together_is_refused_by_name(tmp_path, monkeypatch):
    """A row of every array less, along every axis: all are known to belong together."""
    path = plain().write(tmp_path / "s.asdf")
    tree = tree_of(path)
    for part, name, axis in (("covariance", "stars", 1), ("gauge", "motion", 0), ("gauge", "dynamic", 1)):
        cut = copy.deepcopy(tree)
        whole = cut["legdistort"][part][name]
        cut["legdistort"][part][name] = np.delete(whole, 0, axis=axis)
        monkeypatch.setattr("legdistort.results.storage.read_tree", lambda *_, cut=cut, **__: cut)
        shape = list(whole.shape)
        expected = ", ".join(map(str, shape[: axis + 1]))  # others may have no other place that tells them
        shape[axis] -= 1
        found = ", ".join(map(str, shape))
        message = rf"entry legdistort\.{part}\.{name}: shape \({found}\); it should be \(.*\) = \({expected}[,)]"
        with pytest.raises(InputError, match=message):
            Solution.read(path)


@SOME_OR_MANY
@pytest.mark.parametrize("kind", ["prior", "camera", "wcs"])
def test_other_files(kind, n, tmp_path, monkeypatch):
    path, static = tmp_path / "f.asdf", np.array([[0, 0, 0, 0.3, 0, 0.1]] * 2)
    if kind == "prior":
        Prior(static, sigma=0.1, static_sigma=np.inf, shape=(300, 400), plane=np.eye(2, 3)).write(path)
        check(path, Prior.read, str, monkeypatch, "priors", n)
    elif kind == "camera":
        chip = {"layout_covariance": 0.01 * np.eye(6), "static": static, "static_sigma": 0.02}
        layouts = {"1": np.eye(2, 3), "2": np.array([[1.0, 0.0, -24.0], [0.0, 1.0, 0.5]])}
        chips = {key: legdistort.Detector((10, 20), layout=layout, **chip) for key, layout in layouts.items()}
        legdistort.Camera("pair", chips, common_sigma=np.full((2, 6), 0.1)).write(path)
        check(path, legdistort.Camera.read, str, monkeypatch, "cameras", n)
    else:
        solution = plain()
        write_wcs(solution[solution.names[0]], path)
        check(path, legdistort.read_wcs, use_wcs, monkeypatch, "wcs", n)


def test_unchanged(tmp_path):
    """What is changed above opens as it stands."""
    solution = plain()
    again = Solution.read(solution.write(tmp_path / "s.asdf"))
    assert_array_equal(again.estimate.uncertainty.common.stars, solution.estimate.uncertainty.common.stars)


def test_units_and_sizes_that_nothing_can_be_done_with(tmp_path):
    """Flags and names with a unit would be quantities, which nothing is to be chosen by."""
    path = tmp_path / "s.asdf"
    plain().write(path)
    with asdf.open(path, memmap=False, lazy_load=False) as opened:
        tree = dict(opened.tree)
    for name, unit, words in (
        ("used", "pix", "'used' has a unit, pix"),
        ("star", "pix", "'star' must hold names or integers"),
        ("dx", "", "'dx' should be in pixels, its unit is None"),
        ("dy", "arcsec", "'dy' should be in pixels, its unit is arcsec"),
    ):
        changed = copy.deepcopy(tree["legdistort"])
        changed["observations"][name]["unit"] = unit
        asdf.AsdfFile({"legdistort": changed}, version="1.5.0").write_to(path)
        with pytest.raises(InputError, match=rf"s\.asdf is damaged: .*{words}"):
            Solution.read(path)
    tree["legdistort"]["gauge"]["box"] = np.array([[1.0, 2.0], [0.0, 3.0]])
    asdf.AsdfFile({"legdistort": tree["legdistort"]}, version="1.5.0").write_to(path)
    with pytest.raises(InputError, match=r"gauge\.box: half sizes should be positive, got \[0\.0, 3\.0\]"):
        Solution.read(path)
