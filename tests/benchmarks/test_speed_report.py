"""The tables and figures of `bench.speed` are made from rows alone, and measurements of others stay."""

import csv
import itertools
import time

import numpy as np
import pytest
import scipy.optimize

import jaxhom
from bench import first_report, instances, lp_peers, processes, speed, speed_report
from bench.linear_programs import Conic, Homomorphisms, Lpal
from bench.lp_peers import Settings
from bench.models import Model


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
    speed.write(path, LPAL_ROWS, speed.KINDS["lpal"].fields)
    return path


def test_ratios_are_to_the_best_settled_peer_of_the_same_column(lpal_path):
    rows = speed.read(lpal_path)
    best = speed_report.lpal_best_peers(rows)
    assert best == {("grid16", False): 0.4, ("grid16", True): 0.1, ("grid48", False): 9.0, ("grid48", True): 9.0}
    table = speed_report.lpal_table(rows)
    line = {text.split(" | ")[0].strip("| "): text for text in table.splitlines() if text.startswith("| ")}
    assert "| 0.2 | 0.1 | 2 times | 32 | 0.01 | 0.1 | 10 times |" in table
    assert "| 3 | 0.1 | 3 times |" in table
    assert "0.1 (open) | 10 |" in line["clarabel"] and "| no answer in 300 s |" in line["mpax"]
    assert "failed" in table and "times" not in line["moreau"]


def test_the_default_is_held_against_the_quickest_of_ours():
    others = [
        lpal_row("jaxhom columns", 1, 0.05),
        lpal_row("jaxhom pdhg", 1, 0.01, settled=0.0),  # fast, but the gap is open
        lpal_row("jaxhom columns", 32, 0.02),
        lpal_row("jaxhom pdhg", 32, 0.5, "grid48"),
    ]
    quickest = speed_report.lpal_quickest_of_ours(LPAL_ROWS[:6] + others)
    named = {key: (row["method"], ratio) for key, (row, ratio) in quickest.items()}
    assert named == {
        ("grid16", False): ("jaxhom columns", pytest.approx(4.0)),
        ("grid16", True): ("jaxhom", 1.0),
        ("grid48", False): ("jaxhom", 1.0),
        ("grid48", True): ("jaxhom pdhg", None),
    }
    table = speed_report.lpal_table(LPAL_ROWS[:6] + others)
    assert "| a grid | columns | 0.05 | 4.00 times | default | 0.01 | 1.00 times |" in table
    assert "| a grid | default | 3 | 1.00 times | pdhg | 0.5 |  |" in table


def test_curves_hold_settled_rows_by_states(lpal_path):
    found = speed_report.lpal_curves(speed.read(lpal_path))
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
            for work, lanes, method in itertools.product(speed_report.WORKS, (1, 32), ("jaxhom", "another"))
        ]
        path = tmp_path / "planning.csv"
        speed.write(path, rows, speed.KINDS["planning"].fields)
    monkeypatch.setattr("sys.argv", ["speed", kind, "--report", "--output", str(path)])
    speed.main()
    text = path.with_suffix(".md").read_text()
    assert ("1 times" if kind == "planning" else "10 times") in text
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_rows_of_other_sections_and_methods_stay():
    rows = [lpal_row("jaxhom", 1, 1.0), lpal_row("glop", 1, 1.0), lpal_row("jaxhom", 1, 1.0, "grid48")]
    assert speed.replace_rows(rows, "grid16", None) == rows[2:]
    assert speed.replace_rows(rows, "grid16", ["jaxhom"]) == rows[1:]


def test_kinds_name_their_sections():
    assert set(speed.KINDS["lpal"].sections) == set(instances.LPAL)
    assert set(speed_report.OVER_STATES) <= set(instances.LPAL)
    assert set(speed.KINDS["planning"].sections) == set(instances.PLANNING)
    for kind in speed.KINDS.values():
        assert set(kind.quick) <= set(kind.sections) and len(set(kind.fields)) == len(kind.fields)


def test_committed_rows_have_the_fields(request):
    path = request.config.rootpath / "bench" / "results" / "speed_similarity.csv"
    with path.open(newline="") as file:
        assert set(csv.DictReader(file).fieldnames) == set(speed.KINDS["similarity"].fields)


# ----------------------------------------------------------------------------------------------------------- programs


@pytest.fixture(scope="module")
def small():
    """A small grid's model, and expectations that no policy quite reaches."""
    mdp = instances.regions(4, 4)
    expert = jaxhom.optimal_policy(mdp, mdp.features @ np.array([0.0, 0.2, 1.0, 0.1])).policy
    return mdp, np.asarray(jaxhom.feature_expectations(mdp, expert)) * np.array([1.1, 0.9, 1.05, 1.2])


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("shares", [False, True])
def test_both_programs_have_the_value_that_lpal_certifies(small, form, shares):
    mdp, expectations = small
    program = Lpal(Model.of(mdp), form, shares)
    lp, ours = program.given(expectations), jaxhom.lpal(mdp, expectations)
    is_equation = lp.is_equation
    matrix = lp.matrix.toarray()
    bounds = [(low if np.isfinite(low) else None, None) for low in lp.lower]
    equations = {"A_eq": matrix[is_equation], "b_eq": lp.right[is_equation]}
    inequalities = {"A_ub": -matrix[~is_equation], "b_ub": -lp.right[~is_equation]}
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
    lp = Lpal(Model.of(mdp), form, True).given(expectations)
    _check_conic(lp, rng)


def _check_conic(lp, rng):
    conic, z = Conic(lp), rng.random(len(lp.cost))
    slack, rows = conic.right(lp) - conic.matrix @ z, lp.matrix @ z - lp.right
    fixed, equations = np.split(slack[: conic.num_zero], [(lp.upper == 0.0).sum()])
    np.testing.assert_allclose(fixed, -z[lp.upper == 0.0], atol=1e-12)
    np.testing.assert_allclose(equations, -rows[lp.is_equation], atol=1e-12)
    inequalities, bounds = np.split(slack[conic.num_zero :], [(~lp.is_equation).sum()])
    np.testing.assert_allclose(inequalities, rows[~lp.is_equation], atol=1e-12)
    np.testing.assert_allclose(bounds, z[(lp.lower == 0.0) & (lp.upper > 0.0)], atol=1e-12)


def random_pairs(rng, count, n, m):
    return [(rng.dirichlet(np.ones(n), (n, 2)), rng.dirichlet(np.ones(m), (m, 2))) for _ in range(count)]


@pytest.mark.parametrize("anchored", [True, False])
def test_a_homomorphisms_program_is_what_the_pair_says(anchored, rng):
    """Rows against einsum, for another pair than the one that the program was made from."""
    one, (source, target) = random_pairs(rng, 2, 3, 4)
    lp = Homomorphisms(*one, anchored).given((source, target))
    f, e = rng.dirichlet(np.ones(4), 3), 0.3
    error = np.einsum("iaj,jk->iak", source, f) - np.einsum("il,lak->iak", f, target)
    expected = np.concatenate([f.sum(axis=1), e - error.ravel(), e + error.ravel()])
    np.testing.assert_allclose(lp.matrix @ np.append(f.ravel(), e), expected, atol=1e-12)
    assert np.flatnonzero(lp.upper == 0.0).tolist() == ([1, 2, 3] if anchored else [])
    assert lp.is_equation.sum() == 3 and not lp.lower.any()
    _check_conic(lp, rng)


# -------------------------------------------------------------------------------------------------------------- peers


@pytest.mark.parametrize("method", lp_peers.PEERS)
def test_every_peer_solves_what_it_is_given(method, small, rng):
    """LPAL for two expectations in a row and an LP (9) for two pairs, against SciPy and our own bounds."""
    if not lp_peers.is_installed(method):
        pytest.skip("not installed")
    mdp, expectations = small
    options = {"threads": 1, "limit": 60.0}
    for programs, lanes in (
        (Lpal(Model.of(mdp), "dual", True), [expectations, 0.9 * expectations]),
        (None, random_pairs(rng, 2, 3, 3)),
    ):
        settings = Settings(1e-7, {"sparse": False} if method == "mpax" else {})
        programs = programs or Homomorphisms(*lanes[0], anchored=True)
        peer = lp_peers.PEERS[method][1](settings, **options)
        for lane in lanes:
            lp = programs.given(lane)
            peer.load([lp])
            ((z, multipliers, _),) = peer.solve(60.0)
            assert lp.cost @ z == pytest.approx(_value(lp), abs=1e-5)
            assert multipliers @ lp.right == pytest.approx(_value(lp), abs=1e-5)  # strong duality


def _value(lp):
    rows, right, equation = lp.matrix.toarray(), lp.right, lp.is_equation
    bounds = np.stack([lp.lower, lp.upper], axis=1)
    parts = {"A_eq": rows[equation], "b_eq": right[equation], "A_ub": -rows[~equation], "b_ub": -right[~equation]}
    return scipy.optimize.linprog(lp.cost, **parts, bounds=bounds).fun


# ---------------------------------------------------------------------------------------------------------- processes


class Doubling:
    """Answers twice a lane; as slow as it is told."""

    def __init__(self, seconds, **_):
        self.seconds = seconds

    def load(self, lanes):
        self.lanes = lanes

    def solve(self, limit):
        time.sleep(self.seconds)
        return [(2 * lane, "done", 1) for lane in self.lanes]


@pytest.fixture
def here(monkeypatch, request):
    """Processes find this file as `bench.test_speed_report`."""
    monkeypatch.setitem(__import__("sys").modules, "bench.doubling", __import__(__name__))


@pytest.mark.parametrize("together", [False, True])
def test_lanes_come_back_in_order_with_their_times(together, here):
    groups = [[1, 2, 3]] if together else [[1], [2], [3]]
    (found,) = processes.run("doubling:Doubling", {"seconds": 0.02}, groups, 10.0, "numpy", 3, False)
    assert (found.answers, found.words, found.iterations) == ([2, 4, 6], ["done"] * 3, [1] * 3)
    assert found.seconds == pytest.approx([0.02 / len(groups[0])] * 3, rel=0.5)
    assert found.build_s < 0.01 and found.processes == 1


def test_lanes_that_the_limit_leaves_no_time_for_are_left_out(here):
    (found,) = processes.run("doubling:Doubling", {"seconds": 0.2}, [[1], [2], [3]], 0.3, "numpy", 0, False)
    assert found.answers == [2]


def test_processes_share_lanes_and_are_ended_at_their_limit():
    pairs = random_pairs(np.random.default_rng(0), 3, 2, 2)
    shared = {"method": "numpy solve", "work": "policy_value", "model": None}
    with pytest.raises(processes.NoAnswer, match="AttributeError"):
        processes.measure("planning_peers:opened", shared, pairs, 60.0, processes=2)
    start = time.perf_counter()
    with pytest.MonkeyPatch.context() as patch, pytest.raises(processes.NoAnswer, match="time limit"):
        patch.setattr(processes, "_START_UP", 0.0)
        processes.measure("planning_peers:opened", shared, pairs, 0.0)
    assert time.perf_counter() - start < 60.0


def test_the_first_answer_has_a_table_and_bars():
    def row(instance, method, cache, first, second=None, section="steps"):
        times = {"first_s": str(first), "seconds": "" if second is None else str(second)}
        fields = {"section": section, "instance": instance, "method": method, "cache": cache, "status": "measured"}
        return {"draws": "1", "devices": "1", "prepare_s": "", "peak_gb": "", "settled": ""} | fields | times

    rows = [
        row("planning", "jaxhom", "none", 0.01, 0.008),
        row("planning", "jaxhom", "kept", 0.009, 0.008),
        row("planning", "quantecon", "none", 0.66, 0.004),
        row("a command", "jaxhom", "none", 2.5),
        row("pairs", "jaxhom", "", 0.5, 0.01, section="pairs_mixed"),
    ]
    text = first_report.table(rows)
    assert "| planning | quantecon | none | 0.66 | 4 |" in text
    assert "| a command | jaxhom | none | 2.5 |  |" in text
    assert text.index("## steps") < text.index("## pairs")
    (axes,) = first_report.figure(rows).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a command", "planning"]
    widths = sorted(patch.get_width() for patch in axes.patches if patch.get_width())
    assert widths == [0.009, 0.01, 0.66, 2.5]
    assert first_report.figure(rows[-1:]) is None
