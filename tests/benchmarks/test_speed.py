"""The benchmark's quick setting: every row settled, and our brackets' certificate holds for HiGHS too."""

import csv
import importlib.util
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
HAS_HIGHS = importlib.util.find_spec("highspy") is not None


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    path = tmp_path_factory.mktemp("speed") / "rows.csv"
    command = [sys.executable, "-m", "bench.speed", "similarity", "--quick", "--output", str(path)]
    subprocess.run(command, check=True, cwd=ROOT, timeout=500)
    assert "## brackets" in path.with_suffix(".md").read_text()
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_row_is_settled(rows):
    assert {row["work"] for row in rows} == {"brackets", "decisions", "value and gradient"}
    for row in rows:
        if row["status"] == "not installed":
            continue
        assert row["status"] == "measured", row
        assert float(row["settled"]) == 1.0, row
        assert float(row["ms_per_pair"]) > 0, row
        if row["work"] == "brackets":
            assert float(row["gap_certified"]) <= float(row["gap_asked"]), row


@pytest.mark.skipif(not HAS_HIGHS, reason="needs highspy")
def test_highs_is_measured_in_two_processes(rows):
    measured = [row for row in rows if row["method"].startswith("highs")]
    assert {(row["method"], row["n"]) for row in measured} == {
        (method, n) for method in ("highs_simplex", "highs_interior_point") for n in "35"
    }
    assert {row["processes"] for row in measured} == {"2"}
    assert all(0 < float(row["build_s"]) < float(row["seconds"]) for row in measured)
