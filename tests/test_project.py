"""What the project says of itself in several places agrees, and what its pages for contributors name is there."""

import pathlib
import re
import tomllib

import test_architecture

import jaxhom

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()


def test_one_version():
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)
    assert PROJECT["version"] == jaxhom.__version__ == cited[1]
    assert f"\n## {jaxhom.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_every_room_is_in_the_table():
    rows = re.findall(r"^\| (`.*?) \|", CONTRIBUTING, re.MULTILINE)
    listed = {name for row in rows for name in re.findall(r"\w+", row)}
    assert set(test_architecture.MAY_IMPORT) - {"jaxhom"} <= listed


def test_files_that_are_named_exist():
    named = re.findall(r"`(?:python )?((?:[\w.]+/)+[\w.]+\.(?:py|md|txt))[` ]", CONTRIBUTING)
    assert len(named) > 10
    missing = [name for name in named if not (ROOT / name).exists() and not (ROOT / "jaxhom" / name).exists()]
    assert not missing
