"""What is said of answers that did not end as asked for: nothing of the others."""

import types

import numpy as np
import pytest
from cli_cases import Files

from jaxhom.cli import methods, statuses
from jaxhom.cli.parser import main
from jaxhom.generalization.uniform import uniform_elsewhere
from jaxhom.status import Status

SOLVED, LIMIT, STALLED = map(int, Status)


def answer(status=None, undecided=None):
    return types.SimpleNamespace(status=status, undecided=undecided)


@pytest.mark.parametrize(
    ("answers", "lines"),
    [
        ([], []),
        ([answer()], []),
        ([answer(np.array(SOLVED))], []),
        ([answer(np.zeros(3, int), np.zeros(4, int))], []),
        ([answer(np.array(LIMIT))], [f"it: {Status.ITERATION_LIMIT.message}"]),
        ([answer(np.array([SOLVED, STALLED, LIMIT]))], [f"it (2 of 3): {Status.STALLED.message}"]),
        ([answer(np.array(SOLVED)), answer(np.array(LIMIT))], [f"it (1 of 2): {Status.ITERATION_LIMIT.message}"]),
        ([answer(None, np.array([0, 2, 1]))], ["it: undecided are 3 pairs, of 2 states; they count as different"]),
        ([answer(None, np.array([0, 1]))], ["it: undecided are 1 pair, of 1 state; they count as different"]),
    ],
)
def test_remarks_are_about_what_did_not_end_as_asked(answers, lines):
    assert statuses.remarks("it", *answers) == lines


def unfinished(problem, demonstrations, *_, **__):
    """A generalization with pairs that stayed undecided."""
    general = uniform_elsewhere(problem.mdp, demonstrations)
    undecided = 3 * (np.arange(problem.mdp.num_states) == 1)
    return general.replace(undecided=undecided, status=np.array(LIMIT)), {}


@pytest.fixture
def files(tmp_path, monkeypatch):
    method = methods.Method("unfinished", unfinished)
    monkeypatch.setitem(methods.METHODS, "maximum-entropy", method)
    return Files(tmp_path)


def test_learn_prints_and_writes_them(files, capsys):
    assert main(["learn", *files.options(), "--method", "maximum-entropy", "--no-pictures"]) == 0
    printed = capsys.readouterr().out
    assert "pairs left undecided" in printed and "3 pairs, of 1 state; they count as different" in printed
    assert Status.ITERATION_LIMIT.message in printed
    found = files.report()["generalization"]
    assert (found["status"], found["undecided_pairs"], found["undecided_states"]) == ("ITERATION_LIMIT", 3, 1)
    assert files.report()["status_of_the_optimal_policy"] == "SOLVED"


def test_explain_says_them_on_stderr(files, capsys):
    arguments = [*files.options()[:4], "--method", "maximum-entropy"]
    assert main(["explain", "0", *arguments]) == 0
    assert capsys.readouterr().err.splitlines() == [
        f"jaxhom: warning: generalization: {Status.ITERATION_LIMIT.message}",
        "jaxhom: warning: generalization: undecided are 3 pairs, of 1 state; they count as different",
    ]
