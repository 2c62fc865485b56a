"""The examples in docstrings of the public face, run as they stand, each in an empty folder."""

import doctest
import warnings

import pytest

import legdistort


@pytest.mark.parametrize("name", legdistort.__all__)
def test_examples_do_what_they_show(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    public = getattr(legdistort, name)
    (examples,) = doctest.DocTestFinder(recurse=False).find(public, name, globs={})
    assert examples.examples, "no example"
    assert "\nSee Also\n" in public.__doc__.replace("    ", "")
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    with warnings.catch_warnings():
        failed, _ = runner.run(examples)
    assert not failed
