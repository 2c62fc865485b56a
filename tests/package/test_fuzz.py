"""Every reader and every argument: read, or refused by an error of the package; see `fuzz.py`."""

import fuzz
import fuzz_kinds
import pytest

#: Inputs that once led to other errors, to endless counting or to a full memory.
KNOWN = [32, 189, 208, 325, 965, 990, 993, 1058, 1082, 1171, 1194, 1303, 1336, 1379, 1603, 1658, 1812, 100696, 100723,
         101935, 102542, 102706, 103667, 203697]  # fmt: skip


def test_inputs_that_once_broke_something():
    _, faults = fuzz.fuzz(KNOWN)
    assert not faults


@pytest.mark.parametrize(("kind", "inputs"), [("fits", 4), ("trees", 4), ("cells", 30)])
def test_values_without_sense(kind, inputs):
    """A few of each kind; ``python tests/fuzz_kinds.py`` has the thousands."""
    assert not fuzz_kinds.fuzz_kind(kind, range(inputs))


@pytest.mark.parametrize("part", [pytest.param(4, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.sets)])
@pytest.mark.parametrize("kind", fuzz_kinds.KINDS)
def test_many_values_without_sense(kind, part):
    assert not fuzz_kinds.fuzz_kind(kind, range((30 if kind == "folders" else 100) // part))


@pytest.mark.parametrize("n", [pytest.param(500, marks=pytest.mark.slow), pytest.param(2000, marks=pytest.mark.sets)])
def test_many_inputs(n):
    counts, faults = fuzz.fuzz(range(n))
    assert counts.total() == n
    assert counts.keys() == fuzz.READERS.keys()
    assert not faults


@pytest.mark.slow
def test_nonsense_for_every_argument():
    n, faults = fuzz.nonsense(list(fuzz.argument_calls()), fuzz.VALUES)
    assert n > 2000
    assert not faults


@pytest.mark.slow
def test_extreme_values_in_every_column():
    n, faults = fuzz.nonsense(list(fuzz.value_calls()), [0.0, 1e-320, 1e300, 10**30])
    assert n > 80
    assert not faults


def test_all_files_of_the_corpus_are_read():
    """Undamaged they are no reason for an error, but for lists of three stars."""
    for entry, (use, names) in fuzz.READERS.items():
        for name in names:
            if entry == "tables" and not name.startswith(("matched", "detected")):
                with pytest.raises(fuzz.LegdistortError, match=r"only \d usable detections|on one line"):
                    use(fuzz.source(name))
            else:
                use(fuzz.source(name))
