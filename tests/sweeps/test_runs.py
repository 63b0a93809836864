"""One core: rows and what is in them, going on, errors, batches, groups, and whatever is refused."""

import dataclasses
import enum
import functools
import math
import threading
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
import sweep_works
from sweep_works import NUMBERS, expected, found, scaled

from jaxhom import Status, sweeps
from jaxhom.sweeps.provenance import folder_of

run = functools.partial(sweeps.run, progress=False)


def counting(function):
    """The function, and the cases it was called with."""
    calls = []

    def counted(case):
        calls.append(case)
        return function(case)

    return counted, calls


@pytest.fixture
def file(tmp_path):
    return tmp_path / "folder" / "rows.jsonl"


def test_a_row_for_each_case(file):
    rows = run(scaled, NUMBERS, file)
    assert found(rows) == expected() and [row["x"] for row in rows] == list(range(12))
    assert sweeps.read(file) == rows and file.read_text().count("\n") == 12


def test_a_second_call_does_what_is_missing(file):
    work, calls = counting(scaled)
    run(work, NUMBERS[:3], file)
    before = file.read_bytes()
    assert run(work, NUMBERS[:3], file) == sweeps.read(file) and file.read_bytes() == before
    rows = run(work, NUMBERS[::-1], file)
    assert [case["x"] for case in calls] == [0, 1, 2, *range(11, 2, -1)]
    assert file.read_bytes().startswith(before) and len(sweeps.read(file)) == 12
    assert [row["x"] for row in rows] == list(range(11, -1, -1)) and found(rows) == expected()


def test_what_failed_is_tried_again_on_request(file):
    run(scaled, NUMBERS, file)
    work, calls = counting(lambda case: {"y": -1.0})
    run(work, NUMBERS, file)
    assert not calls
    rows = run(work, NUMBERS, file, retry=True)
    assert [case["x"] for case in calls] == [5]
    assert rows[5]["y"] == -1.0 and rows[5]["error"] is None and len(sweeps.read(file)) == 12


@dataclasses.dataclass(frozen=True)
class Point:
    x: int
    scale: float = 0.1


def test_dataclasses_are_cases_and_come_as_they_are(file):
    work, calls = counting(lambda point: {"y": point.scale * point.x})
    rows = run(work, [Point(x) for x in range(3)], file)
    assert found(rows) == expected(NUMBERS[:3]) and calls[1] == Point(1)
    run(scaled, NUMBERS[:3], file)
    assert len(calls) == 3 and file.read_text().count("\n") == 3  # equal columns, equal case


def test_values_come_back_as_they_were(file):
    values = {
        "text": 'a, "b"\n\u2028\ud800é',
        "tiny": 5e-324,
        "third": 1 / 3,
        "big": 10**30,
        "yes": True,
        "nothing": None,
        "nan": math.nan,
        "infinite": -math.inf,
    }
    results = {f"{name}_found": value for name, value in values.items()}
    arrays = {"numpy": np.float32(0.1), "jax": jnp.float64(0.1), "count": np.int64(3), "flag": np.bool_(True)}
    results |= arrays | {"status": Status.SOLVED, "text_of_numpy": np.str_("x")}
    run(lambda case: results, [values], file)
    (row,) = sweeps.read(file)
    for name, value in values.items():
        for key in (name, f"{name}_found"):
            assert type(row[key]) is type(value) and (row[key] == value or (row[key] != row[key] and value != value))
    assert row["numpy"] == float(np.float32(0.1)) and row["jax"] == 0.1
    assert row["count"] == 3 and row["flag"] is True and row["status"] == "SOLVED" and row["text_of_numpy"] == "x"
    work, calls = counting(lambda case: {})
    run(work, [values], file)
    assert not calls  # NaN is a value like any other


def test_numbers_of_different_types_are_different_cases(file):
    rows = run(lambda case: {"kind": type(case["x"]).__name__}, [{"x": 1}, {"x": 1.0}, {"x": True}, {"x": "1"}], file)
    assert [row["kind"] for row in rows] == ["int", "float", "bool", "str"]


def test_columns_may_differ_and_the_order_of_keys_does_not_matter(file):
    cases = [{"method": "a"}, {"method": "b", "rate": 0.5}, {"rate": 0.5, "method": "c"}]
    rows = run(lambda case: {f"only_{case['method']}": 1}, cases, file)
    assert [set(row) & {"only_a", "only_b", "only_c"} for row in rows] == [{"only_a"}, {"only_b"}, {"only_c"}]
    work, calls = counting(lambda case: {})
    run(work, [{"rate": 0.5, "method": "b"}, {"method": "a", "rate": 0.5}], file)
    assert calls == [{"method": "a", "rate": 0.5}]


BAD_RESULTS = {
    "the result must be a mapping": 3.0,
    "the result must have names as keys, got 3": {3: 1.0},
    "the result['y'] must be text, a number, a truth value or None, got an array of shape (2,)": {"y": np.ones(2)},
    "the result['y'] is a whole number of 20000 bits, more than a row holds": {"y": 1 << 19_999},
    "the result['z'] must be text, a number, a truth value or None, got [1]": {"z": [1]},
    "the result['c'] must be text, a number, a truth value or None": {"c": np.complex64(1j)},
    "the result has a column 'x', and so has the case": {"x": 1},
    "the result has a column 'seconds', which every row has already": {"seconds": 1},
    "the result's error must be text or None, got 1": {"error": 1},
}


@pytest.mark.parametrize("message", BAD_RESULTS)
def test_a_result_that_no_row_can_hold_is_an_error(file, message):
    (row,) = run(lambda case: BAD_RESULTS[message], [{"x": 1}], file)
    assert message in row["error"] and row["seconds"] >= 0


def test_work_may_say_itself_that_a_case_failed(file):
    (row,) = run(lambda case: {"error": "no convergence", "steps": 7}, [{"x": 1}], file)
    assert row["error"] == "no convergence" and row["steps"] == 7
    assert run(lambda case: {"steps": 8}, [{"x": 1}], file, retry=True)[0]["error"] is None


class Unspeakable(Exception):
    def __str__(self):
        return self.args[0]  # a number


def test_an_error_without_a_text_is_an_error(file):
    def fail(case):
        raise Unspeakable(7)

    rows = run(fail, NUMBERS[:2], file)
    assert [row["error"] for row in rows] == ["Unspeakable: its text cannot be made"] * 2


def test_an_exit_is_an_error(file):
    def leaves(case):
        raise SystemExit(2)

    assert run(leaves, [{"x": 1}], file)[0]["error"] == "SystemExit: 2"


def test_batches_come_whole_without_what_is_done(file):
    work, calls = counting(lambda cases: [{"y": 0.1 * case["x"]} for case in cases])
    run(scaled, NUMBERS[1:2], file)
    rows = run(work, [NUMBERS[:3], NUMBERS[3:5]], file)
    assert [[case["x"] for case in batch] for batch in calls] == [[0, 2], [3, 4]]
    assert found(rows) == expected(NUMBERS[:5])


def test_the_case_at_fault_in_a_batch_has_the_error_alone(file):
    """One raises, the result of another is no row, and a batch comes back too short."""

    def work(cases):
        results = [{"y": [1] if case["x"] == 3 else scaled(case)["y"]} for case in cases]
        return results[:-1] if len(cases) == 2 else results

    batches = [NUMBERS[:4], NUMBERS[4:7], NUMBERS[7:9]]
    rows = run(work, batches, file)
    assert "the result['y']" in rows.pop(3)["error"]
    assert found(rows) == expected([case for case in NUMBERS[:9] if case["x"] != 3])


def test_what_a_batch_must_return(file):
    rows = run(lambda cases: {"y": 1}, [[{"x": 1}]], file)
    assert "work must return a list for a batch" in rows[0]["error"]


def test_groups_go_one_after_another(file):
    """Never two of one group at a time, in their order, beside those of other groups."""
    busy, order, lock = set(), [], threading.Lock()

    def work(case):
        with lock:
            assert case["model"] not in busy
            busy.add(case["model"])
            order.append((case["model"], case["x"]))
        sweep_works.slow({"x": 1, "pause": 0.002})
        with lock:
            busy.remove(case["model"])
        return {}

    cases = [{"model": model, "x": x} for x in range(8) for model in "abc"]
    with ThreadPoolExecutor(4) as threads:
        rows = run(work, cases, file, executor=threads, group=lambda case: case["model"])
    assert not any(row["error"] for row in rows)
    for model in "abc":
        assert [x for name, x in order if name == model] == list(range(8))


def test_progress_is_shown(file, capsys):
    sweeps.run(scaled, NUMBERS, file)
    assert "12/12" in capsys.readouterr().err
    run(scaled, [*NUMBERS, {"x": 100, "scale": 1.0}], file)
    assert not capsys.readouterr().err


def test_a_row_says_where_its_code_is():
    class Callable:
        def __call__(self, case):
            return {}

    here = folder_of(scaled)
    assert (here / "test_runs.py").exists() or (here / "sweep_works.py").exists()
    assert folder_of(functools.partial(scaled)) == folder_of(Callable()) == folder_of(Callable().__call__) == here
    assert folder_of(len) == folder_of(dict) == folder_of(eval("lambda case: {}")) == type(here).cwd()


class Colour(enum.Enum):
    RED = object()


BAD_CASES = {
    "cases must be a sequence of mappings, got {'x': 1}": {"x": 1},
    "cases must be a sequence of mappings, got 3": 3,
    "cases must be a sequence of mappings, got 'abc'": "abc",
    r"cases\[1\] must be a mapping of names to values, got 3": [{"x": 1}, 3],
    r"cases\[0\] must have names as keys, got 1": [{1: 2}],
    r"cases\[0\]\['x'\] must be text, .*, got an array of shape \(3,\)": [{"x": np.ones(3)}],
    r"cases\[0\]\['x'\] must be text, .*, got <object": [{"x": object()}],
    r"cases\[1\] has a column 'host', which every row has already": [{"x": 1}, {"host": "a"}],
    r"cases\[2\] is cases\[0\] once more: \{'x': 1, 'y': 0.5\}": [{"x": 1, "y": 0.5}, {"x": 2}, {"y": 0.5, "x": 1}],
    r"cases\[1\]\[1\] is cases\[0\] once more": [{"x": 1}, [{"x": 2}, {"x": 1}]],
    r"cases\[0\] is a batch without cases": [[]],
    r"cases\[0\]\[1\] must be a mapping": [[{"x": 1}, None]],
}


@pytest.mark.parametrize("message", BAD_CASES)
def test_bad_cases_are_refused_before_anything_is_written(file, message):
    with pytest.raises(ValueError, match=message):
        run(scaled, BAD_CASES[message], file)
    assert not file.parent.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"executor": "two"}, "executor must be None, a number of processes, .* got 'two'"),
        ({"executor": 1.5}, "executor must be None, a number of processes"),
        ({"executor": 0}, "executor must be at least 1, got 0"),
        ({"executor": True}, "executor must be a whole number, got True"),
        ({"in_flight": 0}, "in_flight must be at least 1"),
        ({"work": 3}, "work must be a function, got 3"),
        ({"group": 1}, "group must be a function, got 1"),
        ({"group": lambda case: [1]}, r"group\(case\) must be hashable, got \[1\]"),
        (
            {"executor": 2, "work": threading.Lock().acquire},
            "cannot be sent to other processes: cannot pickle '_thread.lock' object",
        ),
    ],
)
def test_bad_options_are_refused(file, options, message):
    work = options.pop("work", scaled)
    with pytest.raises(ValueError, match=message):
        run(work, NUMBERS, file, **options)
    assert not file.exists() or file.read_bytes() == b""
