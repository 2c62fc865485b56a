"""What stands in the names of lists and is not used: it is said."""

import pytest

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.inputs.detector_files import named_detectors


def test_names_of_several_detectors():
    names = [f"jw0122_0000{i}_{key}_cat" for i in (1, 2) for key in ("nrca1", "nrca2", "nrcblong")]
    assert named_detectors(names) == (["nrca1", "nrca2", "nrcblong"], ["jw0122_00001_cat", "jw0122_00002_cat"])
    assert named_detectors(["night1", "night2"]) == ([], [])
    assert named_detectors(["a_nrca1", "b_nrca2"]) == ([], [])


@pytest.mark.parametrize(("keys", "told"), [(("nrca1", "nrca2"), True), (("one", "two"), False)])
def test_match_says_that_lists_are_of_several_detectors(tmp_path, capsys, keys, told):
    table = ld.simulate_matches(n_stars=60, n_exposures=4, dither=30, seed=1).matches.table
    table.remove_column("star")
    for name, pair in zip(dict.fromkeys(table["exposure"]), [(i, key) for i in (1, 2) for key in keys], strict=True):
        part = table[table["exposure"] == name]
        part.remove_column("exposure")
        part.write(tmp_path / f"jw_{pair[0]}_{pair[1]}_cat.ecsv")
    lists = sorted(map(str, tmp_path.glob("*.ecsv")))
    assert main(["match", *lists, "--shape", "2048", "2048", "--out", str(tmp_path / "m.ecsv")]) == 0
    assert ("2 detectors (nrca1, nrca2) of 2 exposures" in capsys.readouterr().err) is told
