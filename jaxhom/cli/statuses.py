"""Answers that did not end as they were asked to, in words: plans, generalizations, solutions of LPAL.

Whatever passes such an answer on says so. What is right is said by nobody.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from jaxhom.status import Status


def worst_status(*answers: Any) -> Status | None:
    """The worst status among answers, batches of them included; None if no answer has one."""
    codes = _codes(answers)
    return Status(int(codes.max())) if codes.size else None


def undecided(*answers: Any) -> tuple[int, int]:
    """How many pairs stayed undecided in generalizations, and of how many states; (0, 0) if none did."""
    counts = [np.asarray(answer.undecided) for answer in answers if getattr(answer, "undecided", None) is not None]
    return sum(int(count.sum()) for count in counts), sum(int((count > 0).sum()) for count in counts)


def in_words(pairs: int, states: int) -> str:
    """What `undecided` found."""
    return f"{pairs} pair{'s' * (pairs != 1)}, of {states} state{'s' * (states != 1)}; they count as different"


def remarks(what: str, *answers: Any) -> list[str]:
    """Lines about answers of one kind that did not end as asked for; none if all did."""
    codes, lines = _codes(answers), []
    bad = codes[codes != Status.SOLVED]
    if bad.size:
        of_how_many = "" if codes.size == 1 else f" ({bad.size} of {codes.size})"
        lines.append(f"{what}{of_how_many}: {Status(int(bad.max())).message}")
    pairs, states = undecided(*answers)
    if pairs:
        lines.append(f"{what}: undecided are {in_words(pairs, states)}")
    return lines


def warn(lines: list[str]) -> None:
    """Says them on stderr."""
    for line in lines:
        print(f"jaxhom: warning: {line}", file=sys.stderr, flush=True)


def _codes(answers: tuple[Any, ...]) -> np.ndarray:
    """The statuses of answers, one after the other."""
    statuses = (getattr(answer, "status", None) for answer in answers)
    return np.array([code for status in statuses if status is not None for code in np.ravel(status)], int)
