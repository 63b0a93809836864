"""Every code block of the README and the documentation runs and prints what the page says; nothing points nowhere."""

import importlib
import re
import struct

import matplotlib
import pytest
from doc_pages import DOCS, PAGES, README, ROOT, blocks_of, differences, pictures_of, prose_of, run_step, steps_of
from notebooks import NOTEBOOKS

import jaxhom
from jaxhom import interop, plotting, sweeps

matplotlib.use("Agg")

NAMES = [str(path.relative_to(ROOT)) for path in PAGES]
RESULTS = "bench/results/"  # made from rows that take minutes
MAIN_JOB_PICTURE = "jaxhom_policies.png"  # made by the main job, which .ci/run runs
DIRECTIVES = {
    name: path.name for path in PAGES for name in re.findall(r"^::: ([\w.]+)$", path.read_text(), flags=re.MULTILINE)
}
FROM_NOTEBOOKS = {DOCS / "examples" / f"{path.stem}.md" for path in NOTEBOOKS}  # made when the site is


def named(dotted):
    """The object that a directive of the reference names."""
    module, _, name = dotted.rpartition(".")
    return getattr(importlib.import_module(module), name)


# Pages with one model go through one process: what JAX compiles for the first serves the others.
RUNNING = [path for path in PAGES if steps_of(path.read_text())]
GROUPS = {
    "cliff": [path for path in RUNNING if "CliffWalking" in path.read_text()],
    "others": [path for path in RUNNING if "CliffWalking" not in path.read_text()],
}


@pytest.mark.parametrize("group", GROUPS)
def test_pages_print_what_they_say_and_draw_their_pictures(group, tmp_path, monkeypatch):
    for path in GROUPS[group]:
        directory = tmp_path / path.stem
        directory.mkdir()
        monkeypatch.chdir(directory)
        run_page(path, directory)
        matplotlib.pyplot.close("all")


def run_page(path, directory):
    page, namespace = path.read_text(), {"__name__": "__main__"}
    for step in steps_of(page):
        printed = run_step(step, namespace, path)
        if step.output is None and step.block.language == "bash":
            continue  # that a command runs is enough
        expected = "" if step.output is None else step.output.text
        found = differences(printed, expected)
        where = f"{path.name} line {step.block.line}"
        assert found is None, f"{where}: {found}; printed\n{printed}\nfor\n{expected}"
    for picture in pictures_of(page):
        if picture.rpartition("/")[2] != MAIN_JOB_PICTURE and not picture.startswith(RESULTS):
            assert png_size(directory / picture) == pytest.approx(png_size(path.parent / picture), rel=0.05), picture


def png_size(path):
    """Width and height in pixels, from the header."""
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">2I", header[16:])


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_blocks_have_a_known_kind(path):
    page = path.read_text()
    blocks = blocks_of(page)
    assert page.count("```") == 2 * len(blocks), "a fence that is indented or has no end"
    outputs = {step.output for step in steps_of(page)}
    for block in blocks:
        assert block.language in ("python", "bash", "text", ""), f"line {block.line}: {block.language}"
        assert block.language != "text" or block in outputs, f"line {block.line}: the output of nothing"


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_links_and_pictures_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", prose_of(path.read_text())):
        if "://" not in target:
            assert (path.parent / target).exists() or path.parent / target in FROM_NOTEBOOKS, target


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert listed == {str(path.relative_to(DOCS)) for path in {*PAGES, *FROM_NOTEBOOKS} - {README}}


@pytest.mark.parametrize("name", DIRECTIVES)
def test_the_reference_names_what_exists(name):
    assert named(name).__doc__


@pytest.mark.parametrize("module", [jaxhom, interop, plotting, sweeps], ids=lambda module: module.__name__)
def test_public_names_are_in_the_reference(module):
    assert len({*jaxhom.__all__} - {"maximum_entropy"}) <= 58  # but for the former name of another
    listed = [named(name) for name in DIRECTIVES]
    for name in module.__all__:
        public = getattr(module, name)
        if not name.isupper():  # colours
            assert public.__doc__, name
            assert any(public is other for other in listed), f"{name} is missing in docs/api"


@pytest.mark.parametrize(
    ("printed", "expected", "agree"),
    [
        ("e = 0.7001", "e  =  0.7", True),
        ("gap 2.1e-07", "gap 3.4e-09", True),
        ("e = 0.71", "e = 0.70", False),
        ("12 states", "13 states", False),
        ("12 states", "12 state", False),
        ("1 2", "1", False),
        ("", "one line", False),
        ("a  b\n-------", "a b\n---", True),
    ],
)
def test_outputs_agree_up_to_rounding(printed, expected, agree):
    assert (differences(printed, expected) is None) == agree
