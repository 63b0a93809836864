"""The tables and figures of `bench.speed` are made from rows alone, and measurements of others stay."""

import csv
import itertools
import time

import numpy as np
import pytest
import scipy.optimize
from bench.lpal_program import ConicProgram, Model, Program

import jaxhom
from bench import limits, lpal_report, planning_report, similarity_report, speed, speed_rows
from bench.lpal_instances import INSTANCES, regions


def lpal_row(method, lanes, seconds, section="grid16", states=256, **fields):
    row = {"section": section, "instance": "a grid", "S": states, "A": 4, "K": 64, "method": method, "lanes": lanes}
    row |= {"seconds": seconds, "status": "measured", "settled": 1.0, "gap_asked": 1e-3, "gap_certified": 1e-4}
    return row | fields


LPAL_ROWS = [
    lpal_row("jaxhom", 1, 0.2),
    lpal_row("jaxhom", 32, 0.01),
    lpal_row("jaxhom", 1, 3.0, "grid48", 2304),
    lpal_row("glop", 1, 0.4),
    lpal_row("glop", 1, 9.0, "grid48", 2304),
    lpal_row("moreau", 1, 0.5),
    lpal_row("moreau", 32, 0.1),
    lpal_row("clarabel", 1, 0.1, settled=0.0, gap_certified=1e-2),  # fast, but the gap is open
    lpal_row("mpax", 1, None, status="time limit", note="no answer in 300 s (primal)", settled=None),
    {"section": "grid100", "status": "failed", "note": "exit code 1"},
]


@pytest.fixture
def lpal_path(tmp_path):
    path = tmp_path / "rows.csv"
    speed_rows.write(path, LPAL_ROWS, lpal_report.FIELDS)
    return path


def test_ratios_are_to_the_best_settled_peer_of_the_same_column(lpal_path):
    rows = speed_rows.read(lpal_path)
    best = lpal_report.best_peers(rows)
    assert best == {("grid16", False): 0.4, ("grid16", True): 0.1, ("grid48", False): 9.0, ("grid48", True): 9.0}
    table = lpal_report.table(rows)
    line = {text.split(" | ")[0].strip("| "): text for text in table.splitlines() if text.startswith("| ")}
    assert "| 0.2 | 0.1 | 2 times | 32 | 0.01 | 0.1 | 10 times |" in table
    assert "| 3 | 0.1 | 3 times |" in table
    assert "0.1 (open) | 10 |" in line["clarabel"] and "| no answer in 300 s |" in line["mpax"]
    assert "failed" in table and "times" not in line["moreau"]


def test_curves_hold_settled_rows_by_states(lpal_path):
    found = lpal_report.curves(speed_rows.read(lpal_path))
    assert found["jaxhom", False] == [(256, 0.2), (2304, 3.0)]
    assert found["moreau", True] == [(256, 0.1)]
    assert not any(method in ("clarabel", "mpax") for method, _ in found)


@pytest.mark.parametrize("kind", ["lpal", "planning"])
def test_report_writes_table_and_figure(kind, lpal_path, tmp_path, monkeypatch):
    path = lpal_path
    if kind == "planning":
        rows = [
            {"section": "grid16", "instance": "a grid", "work": work, "S": 256, "lanes": lanes, "method": method}
            | {"seconds": 0.5, "status": "measured", "settled": 1.0, "error": 1e-9}
            for work, lanes, method in itertools.product(planning_report.WORKS, (1, 32), ("jaxhom", "another"))
        ]
        path = tmp_path / "planning.csv"
        speed_rows.write(path, rows, planning_report.FIELDS)
    monkeypatch.setattr("sys.argv", ["speed", kind, "--report", "--output", str(path)])
    speed.main()
    text = path.with_suffix(".md").read_text()
    assert ("1 times" if kind == "planning" else "10 times") in text
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_rows_of_other_sections_and_methods_stay():
    rows = [lpal_row("jaxhom", 1, 1.0), lpal_row("glop", 1, 1.0), lpal_row("jaxhom", 1, 1.0, "grid48")]
    assert speed_rows.replace_rows(rows, "grid16", None) == rows[2:]
    assert speed_rows.replace_rows(rows, "grid16", ["jaxhom"]) == rows[1:]


def test_kinds_name_their_sections():
    assert set(lpal_report.SECTIONS) == set(INSTANCES)
    assert set(lpal_report.OVER_STATES) <= set(INSTANCES)
    for report in (lpal_report, planning_report, similarity_report):
        assert set(report.QUICK) <= set(report.SECTIONS) and len(set(report.FIELDS)) == len(report.FIELDS)


def test_committed_rows_have_the_fields(request):
    path = request.config.rootpath / "bench" / "results" / "speed_similarity.csv"
    with path.open(newline="") as file:
        assert set(csv.DictReader(file).fieldnames) == set(similarity_report.FIELDS)


# ----------------------------------------------------------------------------------------------------------- programs


@pytest.fixture(scope="module")
def small():
    """A small grid's model, and expectations that no policy quite reaches."""
    mdp = regions(4, 4)
    expert = jaxhom.optimal_policy(mdp, mdp.features @ np.array([0.0, 0.2, 1.0, 0.1])).policy
    return mdp, np.asarray(jaxhom.feature_expectations(mdp, expert)) * np.array([1.1, 0.9, 1.05, 1.2])


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("shares", [False, True])
def test_both_programs_have_the_value_that_lpal_certifies(small, form, shares):
    mdp, expectations = small
    program = Program(Model.of(mdp), form, shares)
    lp, ours = program.given(expectations), jaxhom.lpal(mdp, expectations)
    is_equation = lp.row_lower == lp.row_upper
    matrix = lp.matrix.toarray()
    bounds = [(low if np.isfinite(low) else None, None) for low in lp.lower]
    equations = {"A_eq": matrix[is_equation], "b_eq": lp.row_lower[is_equation]}
    inequalities = {"A_ub": -matrix[~is_equation], "b_ub": -lp.row_lower[~is_equation]}
    found = scipy.optimize.linprog(lp.cost, **equations, **inequalities, bounds=bounds)
    value = found.fun / program.unit * (-1.0 if form == "primal" else 1.0)
    assert float(ours.margin) - 1e-7 <= value <= float(ours.margin_bound) + 1e-7
    multipliers = np.empty(len(is_equation))
    multipliers[is_equation], multipliers[~is_equation] = found.eqlin.marginals, -found.ineqlin.marginals
    x, w = program.read(found.x, multipliers)
    expected = Model.of(mdp).features.T @ x.ravel() / program.unit - expectations
    assert w.sum() == pytest.approx(1.0) and expected.min() == pytest.approx(value)
    assert w @ expected == pytest.approx(value)  # complementary slackness


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_conic_program_holds_the_same_rows(small, form, rng):
    mdp, expectations = small
    program = Program(Model.of(mdp), form, True)
    conic, lp = ConicProgram.of(program), program.given(expectations)
    q, b = conic.given(expectations)
    z = rng.random(len(q))
    slack, rows = b - conic.matrix @ z, lp.matrix @ z - lp.row_lower
    is_equation = lp.row_lower == lp.row_upper
    assert conic.num_zero == is_equation.sum()
    np.testing.assert_allclose(slack[: conic.num_zero], -rows[is_equation], atol=1e-12)
    np.testing.assert_allclose(slack[conic.num_zero : len(rows)], rows[~is_equation], atol=1e-12)
    np.testing.assert_allclose(slack[len(rows) :], z[lp.lower == 0.0], atol=1e-12)


# ------------------------------------------------------------------------------------------------------------- limits


def test_a_process_is_ended_at_its_limit():
    start = time.perf_counter()
    assert limits.start("speed_rows", "matches", {"method": "glop", "wanted": ["gl"]}).result(60.0) is True
    assert limits.start("test_limits_nothing", "nothing", {}).result(0.0) is None
    assert time.perf_counter() - start < 60.0
    with pytest.raises(RuntimeError, match="unexpected keyword argument 'wrong'"):
        limits.start("speed_rows", "matches", {"wrong": 1}).result(60.0)
