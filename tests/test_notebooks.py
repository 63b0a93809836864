"""The notebooks in `examples/` run, and what they show is what is stored in them."""

import json

import matplotlib
import notebooks
import pytest
from doc_pages import differences

matplotlib.use("Agg")

_LARGEST = 150_000  # bytes of a picture, which git keeps for ever
_NEEDS = {"frozen_lakes": "gymnasium", "road_network": "networkx", "sweep": "distributed"}


@pytest.mark.parametrize("path", notebooks.NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_and_show_what_they_say(path):
    if path.stem in _NEEDS:
        pytest.importorskip(_NEEDS[path.stem])
    cells = notebooks.cells_of(path)
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)]
    for cell, shown in zip(cells, notebooks.run(path), strict=True):
        printed, stored = notebooks.text_of(shown), notebooks.text_of(cell["outputs"])
        found = differences(printed, stored)
        assert found is None, f"cell {cell['execution_count']}: {found}; printed\n{printed}\nfor\n{stored}"


@pytest.mark.parametrize("path", notebooks.NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_as_jupyter_reads_them(path):
    notebook = json.loads(path.read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert notebook["cells"][0]["source"][0].startswith("# ")
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    pictures = [picture for cell in notebooks.cells_of(path) for picture in notebooks.pictures_of(cell["outputs"])]
    assert pictures
    assert max(map(len, pictures)) < _LARGEST
