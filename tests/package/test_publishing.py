"""What is published says the same everywhere: one version, one list of requirements, every Python that is promised."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
#: Of packages whose smaller part conda has under a name of its own.
CONDA = {"astropy": "astropy-base", "dask": "dask-core", "matplotlib": "matplotlib-base"}


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_recipe_needs_what_the_package_needs(project):
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    wanted = [re.fullmatch(r"([\w-]+)(>=[\d.]+)", each).groups() for each in project["dependencies"]]
    wanted = {f"{CONDA.get(name.lower(), name.lower())} {least}" for name, least in wanted}
    assert set(recipe["requirements"]["run"]) == wanted | {f"python {project['requires-python']}"}
    assert recipe["about"]["license"] == project["license"]
    assert recipe["about"]["summary"] == project["description"]
    assert recipe["build"]["python"]["entry_points"] == [f"legdistort = {project['scripts']['legdistort']}"]


def test_the_version_stands_in_one_place(project):
    others = [path for path in ("CITATION.cff", "docs/conf.py", "conda/recipe.yaml", "legdistort/__init__.py")
              if project["version"] in (ROOT / path).read_text()]  # fmt: skip
    assert not others


def test_every_python_that_is_promised_is_checked(project):
    promised = [each.rpartition(" ")[2] for each in project["classifiers"] if re.search(r":: 3\.\d+$", each)]
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "check.yml").read_text())
    checked = {each["python"] for each in workflow["jobs"]["check"]["strategy"]["matrix"]["include"]}
    assert set(promised) == checked
    assert f">={promised[0]}" == project["requires-python"]


def test_workflows_call_what_is_there():
    """Templates and workflows are texts that nothing else reads."""
    for path in sorted((ROOT / ".github").rglob("*.yml")):
        content = yaml.safe_load(path.read_text())
        assert content["name"]
        for command in re.findall(r"run: (\.ci/\w+)", path.read_text()):
            assert (ROOT / command).stat().st_mode & 0o100, (path, command)


@pytest.mark.skipif(shutil.which("bash") is None, reason="the script is one of bash")
@pytest.mark.parametrize(("tag", "words"), [("v9.9.9", "the tag v9.9.9 is not v"), ("0.1", "the tag 0.1 is not v")])
def test_a_tag_of_another_version_is_refused(tag, words):
    done = subprocess.run([ROOT / ".ci" / "release", tag], capture_output=True, text=True)
    assert done.returncode == 1
    assert words in done.stderr
