"""What the tests of sweeps have done: small functions that workers import, and what their rows must be."""

import os
import pathlib
import time

NUMBERS = [{"x": x, "scale": 0.1} for x in range(12)]


def scaled(case):
    """Fails at 5."""
    if case["x"] == 5:
        raise ValueError("five\nis right out")
    return {"y": case["scale"] * case["x"]}


def each(work):
    """`work` of cases or of batches of them."""
    return lambda given: [work(case) for case in given] if isinstance(given, list) else work(given)


def expected(cases=NUMBERS):
    """Case, result and error of each."""
    return [
        {**case, "y": 0.1 * case["x"], "error": None}
        if case["x"] != 5
        else {**case, "error": "ValueError: five is right out"}
        for case in cases
    ]


def found(rows):
    """The same of rows, in the order of their cases; each has its provenance."""
    for row in rows:
        assert list(row)[-6:] == ["seconds", "time", "host", "x64", "commit", "versions"]
        assert row["host"] is None or (row["seconds"] >= 0 and "jax " in row["versions"] and row["x64"])
    columns = ("seconds", "time", "host", "x64", "commit", "versions")
    kept = [{name: value for name, value in row.items() if name not in columns} for row in rows]
    return sorted(kept, key=lambda row: row["x"])


def slow(case):
    """Says in a file that it has begun."""
    if "log" in case:
        with pathlib.Path(case["log"]).open("a") as file:
            file.write(f"{case['x']}\n")
    time.sleep(case.get("pause", 0.05))
    return {"y": 0.1 * case["x"], "pid": os.getpid()}


def deadly(case):
    """Takes its process with it, once or always."""
    marker = pathlib.Path(case["marker"])
    if case["kills"] == "always" or (case["kills"] == "once" and not marker.exists()):
        marker.touch()
        os._exit(9)
    return {"y": 0.1 * case["x"]}
