"""Rows that are committed come from clean trees, and commands refuse to write others among them."""

import csv
import json

import pytest

from bench import provenance, reproduce, scale, speed, sweep_costs

KINDS = ("raw/*.csv", "*.jsonl", "speed_*.csv", "sweep_costs.csv")
COMMITTED = sorted(path for kind in KINDS for path in provenance.RESULTS.glob(kind))


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.name)
def test_committed_rows_are_of_clean_trees(path):
    lines = path.read_text().splitlines()
    rows = csv.DictReader(lines) if path.suffix == ".csv" else map(json.loads, lines)
    commits = {row["commit"] for row in rows}
    assert commits and not [commit for commit in commits if not commit or commit.endswith("+")]


@pytest.mark.parametrize("name", ["reproduce", "scale", "speed", "sweep_costs"])
def test_trees_with_changes_are_refused(name, monkeypatch, capsys):
    monkeypatch.setattr(provenance, "commit", lambda folder: "0123456789ab+")
    module, arguments = {
        "reproduce": (reproduce, ["table1"]),
        "scale": (scale, []),
        "speed": (speed, ["lpal"]),
        "sweep_costs": (sweep_costs, []),
    }[name]
    monkeypatch.setattr("sys.argv", [name, *arguments])
    with pytest.raises(SystemExit):
        module.main()
    assert "the tree has changes: commit them" in capsys.readouterr().err


def test_other_folders_and_trials_are_not(monkeypatch, tmp_path):
    monkeypatch.setattr(provenance, "commit", lambda folder: "0123456789ab+")
    command = reproduce.parser()
    for options in (["--output", str(tmp_path)], ["--dirty"]):
        provenance.require_clean(command, command.parse_args(["table1", *options]))
    monkeypatch.setattr(provenance, "commit", lambda folder: "0123456789ab")
    provenance.require_clean(command, command.parse_args(["table1"]))
