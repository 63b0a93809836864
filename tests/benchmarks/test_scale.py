"""The growth of time and memory: what a row holds, and what becomes of rows."""

import json

import pytest

from bench import scale


@pytest.mark.parametrize(("kind", "size"), [("grid", 6), ("roads", 4)])
def test_a_row_has_every_step(kind, size):
    row = scale.work({"kind": kind, "size": size})
    assert {f"seconds_{step}" for step in scale.STEPS} < set(row)
    assert row["is_finite"] and row["statuses"] == "0 0 0" and row["states"] > 10


def rows():
    for kind in ("grid", "roads"):
        for states in (100, 1000, 10_000):
            seconds = {f"seconds_{step}": 1e-4 * states**1.5 for step in scale.STEPS}
            yield {"kind": kind, "size": states, "states": states, "peak_gib": 1.0, "error": "", **seconds}


def test_exponents_and_the_figure(tmp_path, capsys):
    lines = [json.dumps(row | {"case": ["kind", "size"]}) for row in rows()]
    (tmp_path / "scale.jsonl").write_text("\n".join(lines) + "\n")
    assert scale.main(["--output", str(tmp_path), "--figure", str(tmp_path / "scale.png")]) == 0
    assert capsys.readouterr().out.count("| exponent | 1.50 |") == 2
    assert (tmp_path / "scale.png").stat().st_size > 10_000
