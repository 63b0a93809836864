"""The sweeps: rows that survive being stopped, intervals, comparison with the paper, and a report from rows alone."""

import csv
import dataclasses
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import scipy.stats

from bench import comparison, report, reproduce, summaries, sweep
from bench.intervals import mean_interval
from bench.methods import TABLE1, Learned
from bench.rows import COLUMNS, Row, RowFile, read_rows
from bench.settings import Setting

ROOT = pathlib.Path(__file__).resolve().parent.parent
SETTING = Setting("grid4", regions=4, demonstrations=2, pool=2, length=5, trial=5)
METHODS = {name: TABLE1[name] for name in ("expert", "maximum_entropy")}


def test_interval_against_scipy(rng):
    values = rng.normal(size=9)
    found = mean_interval(values)
    low, high = scipy.stats.t.interval(0.95, 8, values.mean(), scipy.stats.sem(values))
    np.testing.assert_allclose([found.mean, found.low, found.high], [values.mean(), low, high])
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


def test_a_file_of_another_version_is_refused(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("domain,regions\n")
    with pytest.raises(ValueError, match=r"rows\.csv has other columns"):
        RowFile(path)


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
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    first = file.path.read_text()
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    assert calls == [(0, 1)] and file.path.read_text() == first
    both = methods | {"maximum_entropy": METHODS["maximum_entropy"]}
    sweep.run(sweep.Sweep([SETTING], both, draws=3, sampled=True), file)
    rows = file.read()
    assert {(row.method, row.draw) for row in rows} == {(name, draw) for name in METHODS for draw in range(3)}
    assert file.path.read_text().startswith(first)
    for row in rows:
        assert row.dtype == "float64" and "jax " in row.versions and row.seconds > 0 and row.seed == 0
        assert row.method != "expert" or row.reward_per_step == pytest.approx(row.expert_reward)
        assert row.reward_per_step <= row.expert_reward + row.loss_bound + 1e-9 or row.method != "expert"
    learned = [row for row in rows if row.method == "maximum_entropy"]
    assert {row.status for row in learned} == {"SOLVED"} and all(row.certificate < 1e-4 for row in learned)
    for row in learned:
        assert row.sampled_reward == pytest.approx(row.reward_per_step, abs=5 * row.sampled_error)


def test_a_failed_cell_is_a_row_and_can_be_tried_again(tmp_path):
    def broken(problem):
        raise RuntimeError("no such luck\nsecond line")

    def without_numbers(problem):
        return Learned(np.nan * problem.expert.policy)

    file = RowFile(tmp_path / "rows.csv")
    methods = {"broken": broken, "nan": without_numbers, "expert": METHODS["expert"]}
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    errors = {row.method: row.error for row in file.read()}
    assert errors["broken"] == "RuntimeError: no such luck second line"
    assert errors["nan"].startswith("FloatingPointError") and not errors["expert"]
    methods |= dict.fromkeys(("broken", "nan"), METHODS["expert"])
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file)
    assert sum(bool(row.error) for row in file.read()) == 4
    sweep.run(sweep.Sweep([SETTING], methods, draws=2), file, retry=True)
    assert not any(row.error for row in file.read())


def test_an_interrupt_keeps_what_is_finished(tmp_path, monkeypatch, capsys):
    def interrupted(problem):
        raise KeyboardInterrupt

    def experiment(methods):
        columns = summaries.QUESTION_COLUMNS
        return reproduce.Experiment("tiny", lambda: [SETTING], methods, 2, summaries.summarise_question, columns)

    command = ["questions", "--output", str(tmp_path)]
    monkeypatch.setitem(reproduce.EXPERIMENTS, "questions", [experiment(METHODS | {"maximum_entropy": interrupted})])
    assert reproduce.main(command) == 130
    assert "the same command goes on from here" in capsys.readouterr().err
    before = (tmp_path / "raw" / "tiny.csv").read_text()
    assert [row.method for row in read_rows(tmp_path / "raw" / "tiny.csv")] == ["expert", "expert"]
    monkeypatch.setitem(reproduce.EXPERIMENTS, "questions", [experiment(METHODS)])
    assert reproduce.main(command) == 0
    assert (tmp_path / "raw" / "tiny.csv").read_text().startswith(before)
    with (tmp_path / "tiny.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert {line["method"] for line in lines} == set(METHODS) and {line["draws"] for line in lines} == {"2"}


def test_a_killed_sweep_goes_on_where_it_was(tmp_path):
    """SIGKILL as soon as the first rows are on the disk; the second run leaves them and adds the others."""
    names = ["expert", "maximum_entropy"]
    command = [sys.executable, "-m", "bench.reproduce", "table1", "--rows", "grid16/16", "--draws", "2"]
    command += ["--methods", *names, "--output", str(tmp_path)]
    path = tmp_path / "raw" / "table1.csv"
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 300
        while process.poll() is None and time.monotonic() < deadline:
            if path.exists() and path.read_bytes().count(b"\n") > 2:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    kept = read_rows(path)
    assert 0 < len(kept) < 4
    assert reproduce.main(command[3:]) == 0
    rows = read_rows(path)
    assert rows[: len(kept)] == kept
    assert {(row.method, row.draw) for row in rows} == {(name, draw) for name in names for draw in range(2)}
    assert not any(row.error for row in rows)
    assert path.read_text().count("\n") == 5  # nothing twice


@pytest.mark.parametrize("name", ["table1", "figure1", "questions"])
def test_settings_and_methods_of_the_shipped_experiments(name):
    for experiment in reproduce.EXPERIMENTS[name]:
        names = [setting.name for setting in experiment.settings()]
        assert len(set(names)) == len(names)
        assert "expert" in experiment.methods
    if name == "table1":
        rows = {(int(s.domain[4:]), s.regions, m) for s in experiment.settings() for m in experiment.methods}
        assert rows == set(summaries.paper_table1())


# --------------------------------------------------------------------------------- comparison, report


def table1_rows(ratios, method="maximum_entropy"):
    rows = []
    for draw, ratio in enumerate(ratios):
        rows.append(blank(draw, reward_per_step=0.5, expert_reward=0.5, sampled_error=1e-4))
        rows.append(dataclasses.replace(rows[-1], method=method, reward_per_step=0.5 * ratio))
    return rows


def test_verdicts():
    printed = summaries.paper_table1()
    ratio = printed[16, 16, "maximum_entropy"] / printed[16, 16, "expert"]
    spread = np.linspace(-0.05, 0.05, 21)
    for shift, verdict in ((0.0, "agrees"), (0.04, "one draw"), (0.2, "differs")):
        rows = table1_rows(ratio + shift + spread)
        cells = comparison.compare_table1(rows)
        found = {cell.method: cell.verdict for cell in cells}
        assert found == {"expert": "agrees", "maximum_entropy": verdict}
        words = " ".join(comparison.table1_words(cells, comparison.compare_orders(rows)))
        assert ("differs by more than draws and trials explain" in words) == (verdict == "differs")


def test_an_order_that_is_not_the_papers_is_said_in_words():
    """The paper's expert is far above maximum entropy; these rows have it the other way round."""
    rows = table1_rows(1.1 + np.linspace(-0.01, 0.01, 5))
    (order,) = comparison.compare_orders(rows)
    assert (order.better, order.worse) == ("expert", "maximum_entropy")
    assert not order.is_reproduced and order.is_reversed
    words = comparison.table1_words(comparison.compare_table1(rows), [order])
    assert any(text.startswith("Not reproduced: expert above maximum_entropy") for text in words)


def figure1_rows():
    for track in ("track_a", "track_b"):
        for count in (2, 10):
            for draw in range(3):
                for k, name in enumerate(("expert", "soft_local_homomorphism", "manhattan_knn")):
                    numbers = {"reward_per_step": 10.0 - k + 0.1 * draw, "steps": 20.0 + k, "off_roads": 0.1 * k}
                    yield Row(track, 0, count, 20, 30, 1, 0.0, 0, name, draw, 0, expert_reward=10.0, **numbers)


def test_report_from_rows_alone(tmp_path, capsys):
    RowFile(tmp_path / "raw" / "table1.csv").append(table1_rows([0.8, 0.9, 0.85]))
    RowFile(tmp_path / "raw" / "figure1.csv").append(figure1_rows())
    assert report.main(["--results", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "| 16x16 | 16 |" in text and "85.0 ±12.4" in text
    assert "Racetrack (a), 2 demonstrations: Algorithm 1 (anchored) against k-NN: reward per step +1" in text
    latex = (tmp_path / "table1.tex").read_text()
    assert latex.count(r"\begin{tabular}") == 2 == latex.count(r"\end{tabular}") and "%" not in latex.replace(r"\%", "")
    for name in ("figure1.png", "figure1.svg", "table1.md"):
        assert (tmp_path / name).stat().st_size > 100
    with (tmp_path / "figure1.csv").open(newline="") as file:
        assert tuple(csv.DictReader(file).fieldnames) == summaries.FIGURE1_COLUMNS
    assert set(COLUMNS) >= {"seed", "commit", "versions", "dtype", "seconds", "status", "certificate", "error"}


def test_report_without_rows(tmp_path, capsys):
    assert report.main(["--results", str(tmp_path)]) == 2
    assert "run python -m bench.reproduce first" in capsys.readouterr().err
