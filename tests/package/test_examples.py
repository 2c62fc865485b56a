"""The examples in docstrings of the public face, run as they stand, each in an empty folder."""

import doctest
import warnings

import matplotlib.pyplot as plt
import pytest

import legdistort
from legdistort.results.view import View

#: Members of views that say what they are of; the others are what views are for.
WITHOUT_EXAMPLE = {
    "check_pixels", "chip", "common", "detectors", "index", "label", "n_stars", "parts", "prior_mean", "shape",
}  # fmt: skip


#: What co-adds or measures whole nights.
LONG = ("Catalogue", "Mosaic", "catalogue", "run", "coadd", "refine", "measure")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in legdistort.__all__]
)
def test_examples_do_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    public = getattr(legdistort, name)
    (examples,) = doctest.DocTestFinder(recurse=False).find(public, name, globs={})
    assert examples.examples, "no example"
    assert "\nSee Also\n" in public.__doc__.replace("    ", "")
    assert not failures(examples)


def test_examples_of_views_do_what_they_show():
    parser = doctest.DocTestParser()  # the finder passes over cached properties
    names = {key for key in vars(View) if not key.startswith("_")} - set(View.__dataclass_fields__)
    examples = {key: parser.get_doctest(getattr(View, key).__doc__, {}, key, None, 0) for key in names}
    assert {key for key in names if not examples[key].examples} == WITHOUT_EXAMPLE
    try:
        assert [key for key in sorted(names) if failures(examples[key])] == []
    finally:
        plt.close("all")


def failures(examples):
    """Number of the examples of a docstring that do something else."""
    with warnings.catch_warnings():
        return doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(examples).failed
