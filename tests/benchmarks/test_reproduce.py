"""The sweeps: rows that survive being stopped, intervals, comparison with the paper, and a report from rows alone."""

import csv
import dataclasses
import os
import pathlib
import signal
import subprocess
import time

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from interrupt_often import watching

from bench import comparison, problems, report, reproduce, settings, summaries, sweep, tables
from bench.methods import CONTROLS, FIGURE1, TABLE1, Learned, excess_of, manhattan_knn, monte_carlo, soft
from bench.rows import Row, RowFile, read_rows
from bench.settings import Setting
from bench.summaries import mean_interval
from jaxhom import Demonstrations, SimilarityTable, empirical_policy

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
SETTING = Setting("grid4", regions=4, demonstrations=2, pool=2, length=5, trial=5)
METHODS = {name: TABLE1[name] for name in ("expert", "maximum_entropy")}


def test_interval_against_scipy(rng):
    values = rng.normal(size=9)
    found = mean_interval(values)
    low, high = scipy.stats.t.interval(0.95, 8, values.mean(), scipy.stats.sem(values))
    np.testing.assert_allclose([found.mean, found.low, found.high], [values.mean(), low, high])
    assert found.half_width == pytest.approx(0.5 * (high - low))
    assert np.isnan(mean_interval([1.0]).low) and mean_interval([]).count == 0


# ----------------------------------------------------------------------------------------------- rows


def blank(draw=0, **fields):
    return Row("grid16", 16, 10, 50, 50, 1, 0.0, 0, "expert", draw, 0, **fields)


def test_rows_come_back_as_they_were(tmp_path):
    rows = [blank(0, reward_per_step=0.25, status="SOLVED", batch=2), blank(1, error='a, "quoted"\nfailure')]
    file = RowFile(tmp_path / "rows.csv")
    file.append(rows)
    assert file.read() == [rows[0], dataclasses.replace(rows[1], error='a, "quoted" failure')]


def test_a_line_cut_short_is_dropped_and_the_latest_row_of_a_key_counts(tmp_path):
    path = tmp_path / "rows.csv"
    RowFile(path).append([blank(0, error="first"), blank(1, reward_per_step=1.0)])
    whole = path.read_bytes()
    path.write_bytes(whole + b"grid16,16,10,5")
    assert len(read_rows(path)) == 2
    file = RowFile(path)
    assert path.read_bytes() == whole
    file.append([blank(0, reward_per_step=2.0)])
    assert [row.reward_per_step for row in file.read()] == [2.0, 1.0]


def test_a_header_cut_short_is_written_again(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("domain,reg")
    assert RowFile(path).read() == [] and path.read_text().count("\n") == 1


def test_a_file_of_another_version_is_refused(tmp_path, capsys):
    path = tmp_path / "raw" / "table1.csv"
    path.parent.mkdir()
    path.write_text("domain,regions\n")
    with pytest.raises(ValueError, match=r"table1\.csv has other columns"):
        RowFile(path)
    assert reproduce.main(["table1", "--output", str(tmp_path)]) == 2
    assert "move it away" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------- problems


@pytest.fixture(scope="module")
def problem():
    """Two draws of the small setting."""
    return problems.draw_problem(SETTING, (0, 1), 0)


def test_a_draw_is_the_same_in_every_batch(problem):
    other = problems.draw_problem(SETTING, (1, 2), 0)
    np.testing.assert_array_equal(problem.reward[1], other.reward[0])
    np.testing.assert_array_equal(problem.demonstrations[1].states, other.demonstrations[0].states)
    assert (np.asarray(problem.reward[0]) != np.asarray(problem.reward[1])).any()
    other_seed = problems.draw_problem(SETTING, (0, 1), 1)
    assert (np.asarray(problem.reward) != np.asarray(other_seed.reward)).any()


@pytest.mark.filterwarnings("ignore::jaxhom.ImpossibleStepsWarning")  # any states will do
def test_the_action_on_the_finish_line_is_hidden(rng):
    """Of the pool the learner sees the first trajectories, without the steps that put the car back."""
    domain = problems.build_domain("track_corner", 0)
    states = jnp.asarray(rng.integers(domain.bare.num_states, size=(2, 3, 10)))
    samples = Demonstrations(states=states, actions=states % 5, mask=jnp.ones((2, 3, 10), bool))
    shown = problems._shown(settings.track("track_corner", 2, 3), domain, samples)
    terminal = np.asarray(domain.terminal)
    assert len(shown) == 2 and terminal[states[:, :2]].any()
    for lane, found in enumerate(shown):
        np.testing.assert_array_equal(found.states, states[lane, :2])
        np.testing.assert_array_equal(found.mask, ~terminal[states[lane, :2]])
        visited, _ = empirical_policy(domain.bare, found)
        assert not (np.asarray(visited) & terminal).any() and visited.any()


def test_an_estimated_model_holds_frequencies():
    estimated = problems.draw_problem(dataclasses.replace(SETTING, samples=4), (0, 1), 0)
    known = np.asarray(estimated.domain.bare.transition)
    one, other = (np.asarray(model.transition) for model in estimated.models)
    np.testing.assert_allclose(4 * one, np.round(4 * one), atol=1e-12)
    assert (known[one > 0] > 0).all() and (one != other).any()


def test_algorithm_1_says_how_it_ended(problem):
    """At epsilon = 1 every pair is accepted, which is k-NN."""
    everything = dataclasses.replace(problem, setting=dataclasses.replace(SETTING, threshold=1.0))
    learned = soft(everything)
    np.testing.assert_allclose(learned.policy, manhattan_knn(problem).policy)
    assert (learned.status == 0).all() and (learned.certificate <= 1e-4).all()


def test_the_excess_is_that_of_the_pairs_that_count_as_similar(problem):
    """Of a table that has met all pairs: by how much the worst upper bound that is accepted exceeds epsilon."""
    table = SimilarityTable(problem.domain.bare).complete(0.3)
    upper = table.known()[1].upper
    accepted = upper[upper <= 0.3 + 1e-4]
    assert excess_of(table, 0.3) == max(accepted.max() - 0.3, 0.0) and len(accepted) < len(upper)
    assert excess_of(table, float(accepted.max()) - 5e-5) == pytest.approx(5e-5)


def test_monte_carlo_per_step_is_even_over_regions(problem):
    """Expectations that hardly count: the four regions of a noisy 4 x 4 grid get the same time in the long run."""
    mdp = problem.domain.mdp
    features = np.asarray(mdp.features)

    def shares(policy):
        """Share of the discounted time in each region, by a dense solve."""
        chain = np.einsum("sa,saz->sz", policy, np.asarray(mdp.transition))
        mass = np.linalg.solve(np.eye(16) - 0.99 * chain.T, np.asarray(mdp.initial)) * 0.01
        return np.einsum("s,sa,sak->k", mass, policy, features)

    for sums, averages in zip(monte_carlo(problem).policy, monte_carlo(problem, per_step=True).policy, strict=True):
        assert np.ptp(shares(np.asarray(averages))) < 0.2 * np.ptp(shares(np.asarray(sums))) + 1e-3


# --------------------------------------------------------------------------------------------- sweeps


def counting(method, calls):
    def counted(problem):
        calls.append(problem.draws)
        return method(problem)

    return counted


def test_a_sweep_computes_only_what_is_missing(tmp_path):
    """More draws and another method later; every row carries where it comes from."""
    file, calls = RowFile(tmp_path / "rows.csv"), []
    methods = {"expert": counting(METHODS["expert"], calls)}
    sweep.run(sweep.Sweep([SETTING], methods, draws=1), file)
    first = file.path.read_text()
    sweep.run(sweep.Sweep([SETTING], methods, draws=1), file)
    assert calls == [(0,)] and file.path.read_text() == first
    both = methods | {"maximum_entropy": METHODS["maximum_entropy"]}
    sweep.run(sweep.Sweep([SETTING], both, draws=2, sampled=True), file)
    assert file.path.read_text().startswith(first)
    assert file.path.read_text().count("\n") == 1 + 4
    rows = file.read()
    assert {(row.method, row.draw) for row in rows} == {(name, draw) for name in METHODS for draw in range(2)}
    for row in rows:
        assert row.dtype == "float64" and "jax " in row.versions and row.seconds > 0 and row.seed == 0
        assert row.reward_per_step is not None and row.batch in (1, 2) and row.certificate < 1e-4
        if row.method == "expert":
            assert row.reward_per_step == pytest.approx(row.expert_reward) and row.status == "none"
            assert row.loss_bound == row.certificate
        else:
            assert row.status == "SOLVED"
            assert row.sampled_reward == pytest.approx(row.reward_per_step, abs=5 * row.sampled_error)


def test_a_failed_draw_is_a_row_and_can_be_tried_again(tmp_path):
    """A draw that fails in its batch, one whose policy is not finite, and draws beside them that are fine."""

    def broken(problem):
        if 1 in problem.draws:
            raise RuntimeError("no such luck\nsecond line")
        return METHODS["expert"](problem)

    def without_numbers(problem):
        policy = problem.expert.policy
        return Learned(policy.at[problem.draws.index(0)].set(np.nan) if 0 in problem.draws else policy)

    file = RowFile(tmp_path / "rows.csv")
    methods = {"broken": broken, "nan": without_numbers, "expert": METHODS["expert"]}
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    rows = {(row.method, row.draw): row for row in file.read()}
    assert rows["broken", 1].error == "RuntimeError: no such luck second line"
    assert rows["nan", 0].error == "the policy is not finite"
    assert not rows["broken", 0].error and rows["broken", 0].batch == 1
    assert rows["broken", 0].reward_per_step == pytest.approx(rows["expert", 0].reward_per_step)
    assert not rows["nan", 1].error and not rows["expert", 1].error
    before = file.path.read_text()
    methods = dict.fromkeys(methods, METHODS["expert"])
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    assert file.path.read_text() == before
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file, retry=True)
    assert not any(row.error for row in file.read())


def test_an_interrupt_waits_for_the_method_in_progress(tmp_path, capsys):
    """The exception of one worker stops the others, and what they were at is written."""

    def interrupted(problem):
        raise KeyboardInterrupt

    file = RowFile(tmp_path / "rows.csv")
    methods = {"expert": METHODS["expert"], "stop": interrupted, "after": METHODS["expert"]}
    with pytest.raises(KeyboardInterrupt):
        sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    assert [row.method for row in file.read()] == ["expert", "expert"]
    assert "stopping" in capsys.readouterr().err


TINY = """
import sys
from bench import methods, reproduce, settings

chosen = {name: getattr(methods, name) for name in ("expert", "manhattan_knn")}
tiny = [settings.Setting("grid4", 4, 2, 2, 5, 5, threshold=0.1 * i) for i in range(20)]
reproduce.SWEEPS["questions"] = {"tiny": reproduce.Sweep(tiny, chosen, draws=2)}
if __name__ == "__main__":
    sys.exit(reproduce.main(sys.argv[1:]))
"""


def test_a_stopped_sweep_goes_on_where_it_was(tmp_path, monkeypatch):
    """SIGINT, later SIGKILL, as soon as new rows are on the disk; then to the end. Nothing is lost or done twice."""
    command = ["questions", "--output", str(tmp_path)]
    path = tmp_path / "raw" / "tiny.csv"
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    options = {"cwd": ROOT, "env": os.environ | cache, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    kept = []
    for stop, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        with subprocess.Popen(watching("-c", TINY, *command), **options) as process:
            deadline = time.monotonic() + 300
            while process.poll() is None and time.monotonic() < deadline:
                if path.exists() and path.read_bytes().count(b"\n") > len(kept) + 1:
                    break
                time.sleep(0.01)
            process.send_signal(stop)
            _, errors = process.communicate(timeout=300)
        assert process.returncode == code, errors.decode()
        assert (b"the same command goes on from here" in errors) == (stop == signal.SIGINT)
        rows = read_rows(path)
        assert rows[: len(kept)] == kept and len(kept) < len(rows) < 80
        kept = rows
    monkeypatch.setitem(reproduce.SWEEPS, "questions", None)
    exec(TINY, {"__name__": "tiny"})
    assert reproduce.main(command) == 0
    rows = read_rows(path)
    assert rows[: len(kept)] == kept and path.read_text().count("\n") == 1 + 80
    keys = {(row.threshold, row.method, row.draw) for row in rows if not row.error}
    assert len(keys) == 80 and {(line["method"], line["draws"]) for line in read_csv(tmp_path / "tiny.csv")} == {
        ("expert", "2"),
        ("manhattan_knn", "2"),
    }


@pytest.mark.parametrize("name", ["table1", "figure1", "questions"])
def test_settings_and_methods_of_the_shipped_experiments(name):
    for sweeping in reproduce.SWEEPS[name].values():
        names = [setting.name for setting in sweeping.settings]
        assert len(set(names)) == len(names)
    if name == "table1":
        printed = set(sweeping.methods) - set(CONTROLS)
        rows = {(int(s.domain[4:]), s.regions, m) for s in sweeping.settings for m in printed}
        assert rows == set(summaries.paper_table1()) and sweeping.draws >= 100
    if any("lpal" in method or "monte_carlo" in method for method in sweeping.methods):
        assert set(CONTROLS) <= set(sweeping.methods)
    if name == "figure1":
        points = {(setting.domain, setting.demonstrations) for setting in sweeping.settings}
        assert points == {("track_a", n) for n in range(2, 11)} | {("track_b", n) for n in range(10, 101, 10)}
        assert set(sweeping.methods) == set(FIGURE1) and sweeping.draws >= 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--draws", "0"], "--draws must be at least 1"),
        (["--workers", "0"], "--workers must be at least 1"),
        (["--rows", "grid17"], "--rows grid17: no setting of table1"),
        (["--rows", "grid1"], "--rows grid1: no setting of table1"),
        (["--methods", "oracle"], "--methods oracle: not one of"),
    ],
)
def test_wrong_options_are_refused(tmp_path, capsys, options, message):
    assert reproduce.main(["table1", *options, "--output", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "raw").exists()


# ----------------------------------------------------------------------------------------- comparison


def table1_rows(ratios, method="maximum_entropy"):
    rows = []
    for draw, ratio in enumerate(ratios):
        rows.append(blank(draw, reward_per_step=0.5, expert_reward=0.5, sampled_error=1e-4))
        rows.append(dataclasses.replace(rows[-1], method=method, reward_per_step=0.5 * ratio))
    return rows


def test_table1_summary():
    """Means by hand; the order is that of the numbers, whichever rows came first; failed rows do not count."""
    rows = [dataclasses.replace(row, domain="grid48") for row in table1_rows([0.5])] + table1_rows([0.8, 0.9])
    lines = summaries.table1([*rows, blank(7, error="failed")])
    assert list(lines[["grid", "method", "draws"]].itertuples(index=False, name=None)) == [
        (16, "expert", 2),
        (16, "maximum_entropy", 2),
        (48, "expert", 1),
        (48, "maximum_entropy", 1),
    ]
    line = lines.iloc[1]
    assert line["mean"] == pytest.approx(0.425) and line["ratio"] == pytest.approx(0.85)
    half = scipy.stats.t.ppf(0.975, 1) * 0.05  # two values 0.1 apart
    assert line["ratio_ci_high"] == pytest.approx(0.85 + half) and line["paper"] == 0.3825


def test_verdicts():
    printed = summaries.paper_table1()
    ratio = printed[16, 16, "maximum_entropy"] / printed[16, 16, "expert"]
    spread = np.linspace(-0.05, 0.05, 21)
    texts = {"agrees": "", "one draw": "a single draw may differ as much", "differs": "by more than draws and trials"}
    for shift, verdict in ((0.0, "agrees"), (0.04, "one draw"), (0.2, "differs")):
        rows = table1_rows(ratio + shift + spread)
        cells = summaries.table1(rows)
        found = dict(zip(cells["method"], cells["verdict"], strict=True))
        assert found == {"expert": "agrees", "maximum_entropy": verdict}
        words = " ".join(comparison.table1_words(cells, comparison.compare_orders(rows)))
        assert ("**maximum_entropy** differs" in words) == (verdict != "agrees") and texts[verdict] in words
        mark = {"agrees": ")", "one draw": ")†", "differs": ")*"}[verdict]
        assert tables.table1_ratio(cells)[1][0][-1].endswith(f"({100 * ratio:.1f}{mark}")


def test_an_order_that_is_not_the_papers_is_said_in_words():
    """The paper's expert is far above maximum entropy; these rows have it the other way round."""
    rows = table1_rows(1.1 + np.linspace(-0.01, 0.01, 5))
    (order,) = comparison.compare_orders(rows)
    assert (order.better, order.worse) == ("expert", "maximum_entropy")
    assert order.ours.high < 0
    words = comparison.table1_words(summaries.table1(rows), [order])
    assert any(text.startswith("Not reproduced: expert above maximum_entropy") for text in words)


def figure1_rows(rewards):
    """Rows of two points and three draws; `rewards`: method -> reward per step, from which the others follow."""
    for track in ("track_a", "track_b"):
        for count in (2, 10):
            for draw in range(3):
                for name, reward in rewards.items():
                    numbers = {"reward_per_step": reward + 0.1 * draw, "steps": 30.0 - reward, "off_roads": 0.1}
                    yield Row(track, 0, count, 20, 30, 1, 0.0, 0, name, draw, 0, expert_reward=10.0, **numbers)


REWARDS = {"soft_local_homomorphism": 9.0, "manhattan_knn": 8.0, "lpal_manhattan_knn": 8.5}


def test_claims_about_figure1():
    orders = {(o.track, o.worse, o.metric): o for o in comparison.compare_curves(figure1_rows(REWARDS)) if o.is_printed}
    gain = orders["track_a", "manhattan_knn", "reward_per_step"]
    assert gain.ours.mean == pytest.approx(1.0) and (gain.clear, gain.reversed, gain.points) == (2, 0, 2)
    fewer_steps = orders["track_a", "manhattan_knn", "steps"]
    assert fewer_steps.ours.mean == pytest.approx(1.0) and fewer_steps.clear == 2
    assert orders["track_b", "manhattan_knn", "off_roads"].clear == 0
    beaten = orders["track_b", "lpal_manhattan_knn", "reward_per_step"]
    assert (beaten.clear, beaten.reversed) == (0, 2) and beaten.ours.high < 0
    words = dict(zip(orders, comparison.figure1_words(list(orders.values())), strict=True))
    assert "reproduced: soft_local_homomorphism better than manhattan_knn" in words["track_a", "manhattan_knn", "steps"]
    assert "-1 ± 0 on average over 2 points" in words["track_a", "manhattan_knn", "steps"]
    assert "open: " in words["track_a", "manhattan_knn", "off_roads"]
    assert "**not reproduced**" in words["track_b", "lpal_manhattan_knn", "reward_per_step"]


# --------------------------------------------------------------------------------------------- report


def read_csv(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_report_from_rows_alone(tmp_path):
    RowFile(tmp_path / "raw" / "table1.csv").append(table1_rows([0.8, 0.9, 0.85]))
    RowFile(tmp_path / "raw" / "figure1.csv").append(figure1_rows(REWARDS))
    assert report.main(["--results", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "| 16x16 | 16 |" in text and "85.0 ±12.4 (81.9)" in text and "reproduced: soft_local" in text
    assert "![Figure 1](figure1.png)" in text
    latex = (tmp_path / "table1.tex").read_text()
    assert latex.count(r"\begin{tabular}") == 2 == latex.count(r"\end{tabular}")
    assert r"85.0 $\pm$12.4 (81.9)" in latex and not set("%_±†") & set(latex.replace(r"\%", "").replace(r"\_", ""))
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in body} == {3}
    for name in ("figure1.png", "figure1.svg", "table1.md"):
        assert (tmp_path / name).stat().st_size > 100
    names = ("track", "demonstrations", "method", "metric", "sets", "mean", "ci_low", "ci_high")
    assert tuple(read_csv(tmp_path / "figure1.csv")[0]) == names
    assert tuple(read_csv(tmp_path / "table1.csv")[0]) == summaries.TABLE1_COLUMNS
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.*")}
    assert report.main(["--results", str(tmp_path)]) == 0
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.*")} == before


def question_rows(domain, regions=0, methods=("soft_local_homomorphism", "manhattan_knn"), ratio=0.9, **fields):
    """Two draws 0.002 apart."""
    numbers = {"steps": 20.0, "off_roads": 0.1} if domain.startswith("track") else {}
    for name in methods:
        for draw, shift in enumerate((-0.001, 0.001)):
            key = {"demonstrations": 2, "distance": 1, "threshold": 0.0, "samples": 0} | fields
            row = Row(domain, regions, length=20, trial=30, method=name, draw=draw, seed=0, **key, **numbers)
            yield dataclasses.replace(row, reward_per_step=ratio + shift, expert_reward=1.0)


def test_report_on_the_questions(tmp_path):
    raw = tmp_path / "raw"
    for distance, threshold in ((1, 0.0), (1, 0.4), (2, 0.0)):
        rows = question_rows("track_corner", distance=distance, threshold=threshold)
        RowFile(raw / "threshold.csv").append(rows)
    for samples in (0, 5):
        RowFile(raw / "noise.csv").append(question_rows("track_corner", samples=samples))
    for count, ratio in ((1, 0.995), (2, 0.98), (5, 0.9905), (10, 1.004)):
        RowFile(raw / "enough.csv").append(question_rows("grid16", 64, demonstrations=count, ratio=ratio))
    RowFile(raw / "normalisation.csv").append(question_rows("grid16", 64, ("monte_carlo", "monte_carlo_per_step")))
    assert report.main(["--results", str(tmp_path)]) == 0
    for name in ("threshold", "noise", "enough", "normalisation"):
        assert {(tmp_path / f"{name}.{end}").exists() for end in ("png", "svg", "csv")} == {True}
    text = (tmp_path / "report.md").read_text()
    # One demonstration is within 1% by luck: counted is from where on it stays so. The interval takes ten.
    assert "| gridworld 16 x 16 | 5 (10) | 5 (10) |" in text
    (line,) = [
        line
        for line in read_csv(tmp_path / "enough.csv")
        if (line["method"], line["demonstrations"], line["metric"]) == ("manhattan_knn", "2", "ratio")
    ]
    assert float(line["mean"]) == pytest.approx(0.98) and line["draws"] == "2"
    assert float(line["ci_high"]) == pytest.approx(0.98 + scipy.stats.t.ppf(0.975, 1) * 0.001, abs=1e-6)


def test_report_without_rows(tmp_path, capsys):
    assert report.main(["--results", str(tmp_path)]) == 2
    assert "run python -m bench.reproduce first" in capsys.readouterr().err
