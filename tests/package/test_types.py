"""What type checkers and editors are told of the package."""

import ast
from importlib.resources import files

import legdistort


def test_the_face_has_the_same_places_for_type_checkers():
    """The imports that they read are the table that Python goes by."""
    tree = ast.parse(files("legdistort").joinpath("__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    told = {alias.asname: (node.module, alias.name) for node in block.body for alias in node.names}
    assert told == {name: (place, name) for name, place in legdistort._PLACES.items()}


def test_the_package_says_that_it_is_typed():
    assert files("legdistort").joinpath("py.typed").is_file()


def test_dir_shows_public_names_alone():
    legdistort.Solution  # noqa: B018 - modules are loaded
    shown = [name for name in dir(legdistort) if not name.startswith("__")]
    assert shown == legdistort.__all__
