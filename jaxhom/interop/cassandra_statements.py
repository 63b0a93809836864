"""The statements of Cassandra's format for MDPs and POMDPs, and tables in which the last statement that fits counts.

    discount: 0.95                           states, actions, observations: their number or their names
    values: reward                           or cost
    start: uniform | states | S numbers      start include: states          start exclude: states
    T: action : state : next state  p        O: action : next state : observation  p
    R: action : state : next state : observation  r

`*` stands for all; a number for the thing of that number, from 0 on. Where the last fields are missing, as many values
follow as they have, row by row, or `uniform`, or for T `identity` (a matrix) or `reset` (back to the start). `#` begins
a comment. A statement ends where the next one begins, on the same line perhaps.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Sequence

import numpy as np

from jaxhom.interop.archives import FileError
from jaxhom.interop.numbering import real_of
from jaxhom.interop.text_files import open_text
from jaxhom.models.construction import check_initial

Rule = tuple[np.ndarray, np.ndarray, np.ndarray]  # fields, values and times, of many

WILD = -1  # the number of `*`
_CHUNK = 100_000  # statements that are split at once
_KNOWN = "discount, values, states, actions, observations, start, T, O, R"
_COMMENT = re.compile(r"#[^\n]*")
_HEAD = re.compile(
    r"(?:^[ \t]*|(?<=[^\s:])[ \t]+)"  # behind a colon such a word is a name
    r"(discount|values|states|actions|observations|start(?:[ \t]+(?:include|exclude))?|T|O|R)[ \t]*:",
    re.MULTILINE,
)


class Statements:
    """The statements of a file: `bodies` has what follows the colon of each, `numbers` which begin with a word."""

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = path
        with open_text(path) as file:
            self._first, *pieces = _HEAD.split(_COMMENT.sub("", file.read()))
        self._words, self.bodies = pieces[::2], pieces[1::2]
        self.numbers: dict[str, list[int]] = {}
        for number, word in enumerate(self._words):
            self.numbers.setdefault(word, []).append(number)
        if text := self._first.lstrip():
            line = self._first[: -len(text)].count("\n") + 1
            raise FileError(f"{path} line {line}: expected a statement such as `states: ...`, got {_short(text)}")

    def line(self, number: int) -> int:
        """Where a statement begins."""
        return 1 + self._first.count("\n") + sum(body.count("\n") for body in self.bodies[:number])

    def error(self, number: int, message: object) -> FileError:
        """What is wrong with a statement."""
        word = " ".join(self._words[number].split())
        return FileError(f"{self.path} line {self.line(number)} ({word}): {message}")

    def only(self, word: str) -> tuple[int, list[str]] | None:
        """Number and words of the only statement that begins with a word, None if there is none."""
        found = sorted(n for other, ns in self.numbers.items() if other.split()[0] == word for n in ns)
        if len(found) > 1:
            raise self.error(found[1], f"it stands on line {self.line(found[0])} already")
        if not found:
            return None
        number, body = found[0], self.bodies[found[0]]
        before, colon, _ = body.partition(":")
        if colon:  # of a statement that is not known, which was taken for more of this one
            line, name = self.line(number) + before.count("\n"), before.splitlines()[-1].strip() if before else ""
            raise FileError(f"{self.path} line {line}: no statement {name!r} is known; those that are: {_KNOWN}")
        return number, body.split()

    def last_word(self, number: int) -> str:
        """`exclude` of `start exclude`."""
        return self._words[number].split()[-1]


@dataclasses.dataclass(frozen=True, eq=False)
class Things:
    """The states, actions or observations of a file.

    Attributes:
      kind: "state", "action" or "observation".
      count: how many.
      names: None where they are only counted.
      numbers: from what was written to the number; grows as numbers are met.
    """

    kind: str
    count: int
    names: tuple[str, ...] | None
    numbers: dict[str, int]

    @classmethod
    def read(cls, statements: Statements, word: str) -> Things | None:
        """What a file declares, None if it does not."""
        found = statements.only(word)
        if found is None:
            return None
        number, words = found
        kind = word[:-1]
        if len(words) == 1 and words[0].isdecimal():
            if not 0 < int(words[0]) < 2**31:
                raise statements.error(number, f"there must be one {kind} at least, got {words[0]}")
            return cls(kind, int(words[0]), None, {"*": WILD})
        if not words:
            raise statements.error(number, f"expected the number of {word} or their names")
        numbers = {name: n for n, name in enumerate(words)}
        if len(numbers) < len(words):
            twice = next(name for n, name in enumerate(words) if numbers[name] != n)
            raise statements.error(number, f"{kind} {twice!r} is named twice")
        return cls(kind, len(words), tuple(words), {**numbers, "*": WILD})

    def all_numbers(self, texts: list[str]) -> list[int]:
        """`number` of each."""
        for text in {*texts} - self.numbers.keys():
            self.number(text)
        return [*map(self.numbers.__getitem__, texts)]

    def number(self, text: str) -> int:
        """The number of what is written; `ValueError` if there is no such thing."""
        if text in self.numbers:
            return self.numbers[text]
        if text.isdecimal() and int(text) < self.count:
            return self.numbers.setdefault(text, int(text))
        if not text:
            raise ValueError(f"expected {'an' if self.kind[0] in 'ao' else 'a'} {self.kind}")
        which = f"{self.count} of them" if self.names is None else ", ".join(self.names)
        raise ValueError(f"no {self.kind} {text!r} among {_short(which)}")


@dataclasses.dataclass(frozen=True, eq=False)
class Rules:
    """What the statements of one table say, in their order: the last one that fits counts.

    Attributes:
      fields: int [N, D], `WILD` for all.
      value: float [N].
      time: int [N], ascending: the number of the statement.
      clears: (time, leading fields) of statements that set all entries there before.
    """

    fields: np.ndarray
    value: np.ndarray
    time: np.ndarray
    clears: list[tuple[int, tuple[int, ...]]]

    @classmethod
    def read(cls, statements: Statements, word: str, axes: Sequence[Things], start: np.ndarray) -> Rules:
        """The statements T, O or R, whose fields are those of `axes`."""
        rules = [(np.zeros((0, len(axes)), int), np.zeros(0), np.zeros(0, int))]
        clears = []
        plain: list[int] = []
        for time in statements.numbers.get(word, ()):
            if statements.bodies[time].count(":") == len(axes) - 1:
                plain.append(time)
                continue
            numbers, words = _fields(statements, time, axes)
            try:
                places, value = _block(word, axes[len(numbers) :], words, start)
            except ValueError as error:
                raise statements.error(time, error) from None
            leading = np.broadcast_to(numbers, (len(places), len(numbers)))
            rules.append((np.concatenate([leading, places], axis=1), value, np.full(len(places), time)))
            clears.append((time, tuple(numbers)))
        for first in range(0, len(plain), _CHUNK):
            rules.append(_plain(statements, plain[first : first + _CHUNK], axes))
        fields, values, times = (np.concatenate(column) for column in zip(*rules, strict=True))
        order = np.argsort(times, kind="stable")
        return cls(fields[order], values[order], times[order], clears)

    def at(self, places: np.ndarray, shape: Sequence[int]) -> np.ndarray:
        """float [M]: the last value that was set at each of the places [M, D] of a table of the shape; 0 where none."""
        value, time = np.zeros(len(places)), np.full(len(places), -1)
        given = (self.fields != WILD) @ (1 << np.arange(len(shape)))
        for pattern in np.unique(given):
            axes = np.flatnonzero(pattern >> np.arange(len(shape)) & 1)
            sizes = [shape[int(axis)] for axis in axes]
            (rules,) = np.nonzero(given == pattern)
            key, last = _last_of_each(_key(self.fields[rules][:, axes], sizes))
            wanted = _key(places[:, axes], sizes)
            found = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
            rule = rules[last[found]]
            better = (key[found] == wanted) & (self.time[rule] > time)
            value[better], time[better] = self.value[rule[better]], self.time[rule[better]]
        return value

    def entries(self, shape: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Places [M, D], in ascending order, and values [M], of the entries of a table that are not 0."""
        sets_row = self.fields[:, -1] == WILD
        kept = ~sets_row | (self.value != 0)  # a table that is set to 0 first is not written out
        fields, value, time = self.fields[kept], self.value[kept], self.time[kept]
        for axis, size in enumerate(shape):
            is_wild = fields[:, axis] == WILD
            times = np.where(is_wild, size, 1)
            rule = np.repeat(np.arange(len(fields)), times)
            place = np.arange(len(rule)) - (np.cumsum(times) - times)[rule]
            fields, value, time = fields[rule], value[rule], time[rule]
            fields[:, axis] += np.where(is_wild[rule], place + 1, 0)  # WILD is -1
        cleared = np.full(shape[:-1], -1)
        rows = zip(self.time[sets_row].tolist(), map(tuple, self.fields[sets_row, :-1].tolist()), strict=True)
        for when, leading in sorted([*self.clears, *rows]):
            cleared[tuple(slice(None) if number == WILD else number for number in leading)] = when
        kept = time >= cleared[tuple(fields[:, :-1].T)]
        fields, value = fields[kept], value[kept]
        _, last = _last_of_each(_key(fields, shape))
        last = last[value[last] != 0]
        return fields[last], value[last]


def _plain(statements: Statements, times: Sequence[int], axes: Sequence[Things]) -> Rule:
    """Many statements with all fields and one value each, which most lines of a large file are, at once."""
    width = len(axes) + 2
    words = " ; ".join([statements.bodies[time] for time in times]).replace(":", " ").split()
    if len(words) != width * len(times) - 1 or words[width - 1 :: width] != [";"] * (len(times) - 1):
        return _one_by_one(statements, times, axes)
    try:
        columns = [axis.all_numbers(words[place::width]) for place, axis in enumerate(axes)]
        values = np.array([*map(float, words[len(axes) :: width])])
    except ValueError:
        return _one_by_one(statements, times, axes)
    if not np.isfinite(values).all() or any("_" in word for word in words[len(axes) :: width]):
        return _one_by_one(statements, times, axes)
    return np.array(columns).T, values, np.array(times)


def _one_by_one(statements: Statements, times: Sequence[int], axes: Sequence[Things]) -> Rule:
    """The same, or the error of the first that is wrong."""
    fields, values = [], []
    for time in times:
        numbers, words = _fields(statements, time, axes)
        try:
            _require_count(words, 1)
            values.append(_number(words[0]))
        except ValueError as error:
            raise statements.error(time, error) from None
        fields.append(numbers)
    return np.array(fields), np.array(values), np.array(times)


def _fields(statements: Statements, time: int, axes: Sequence[Things]) -> tuple[list[int], list[str]]:
    """The numbers of a statement's fields, and the words that follow."""
    *texts, tail = statements.bodies[time].split(":")
    last, *words = tail.split() or [""]
    texts = [*map(str.strip, texts), last]
    try:
        if len(texts) > len(axes):
            raise ValueError(f"{len(texts)} fields, but the table has {len(axes)}")
        return [axis.number(text) for text, axis in zip(texts, axes, strict=False)], words
    except ValueError as error:
        raise statements.error(time, error) from None


def start_of(statements: Statements, states: Things) -> np.ndarray | None:
    """The distribution of the first state, None if a file has none."""
    found = statements.only("start")
    if found is None:
        return None
    number, words = found
    try:
        how = statements.last_word(number)
        are_names = {*words} <= {*(states.names or ())}
        if words == ["uniform"]:
            return np.full(states.count, 1.0 / states.count)
        if how in ("include", "exclude") or are_names or (len(words) == 1 < states.count):
            chosen = np.zeros(states.count, bool)
            chosen[[_state(states, word) for word in words]] = True
            chosen ^= how == "exclude"
            if not chosen.any():
                raise ValueError("no state is left to start in")
            return chosen / chosen.sum()
        _require_count(words, states.count)
        return check_initial(np.array([_number(word) for word in words]), states.count)
    except ValueError as error:
        raise statements.error(number, error) from None


def _state(states: Things, word: str) -> int:
    if word == "*":
        raise ValueError("expected a state, got '*'")
    return states.number(word)


def _block(word: str, axes: Sequence[Things], words: list[str], start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places [M, missing fields] and values [M] of the values that follow a statement's fields."""
    shape = [axis.count for axis in axes]
    if words in (["uniform"], ["identity"], ["reset"]) and word != "R" and shape:
        if words == ["identity"] and word == "T" and len(shape) == 2:
            return np.repeat(np.arange(shape[0])[:, None], 2, axis=1), np.ones(shape[0])
        if words == ["uniform"] or (words == ["reset"] and word == "T"):
            row = np.full(shape[-1], 1.0 / shape[-1]) if words == ["uniform"] else start
            return _nonzero(np.broadcast_to(row, shape))
        raise ValueError(f"{words[0]!r} is not for this table or part of it")
    _require_count(words, math.prod(shape))
    value = np.array([_number(word) for word in words]).reshape(shape)
    return _fewest_rules(value) if word == "R" else _nonzero(value)


def _nonzero(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    places = np.argwhere(value != 0)
    return places, value[tuple(places.T)]


def _fewest_rules(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trailing axes along which nothing changes are wild: rewards seldom depend on what is observed."""
    wild = 0
    while wild < value.ndim and (value[..., :1] == value).all():
        value, wild = value[..., 0], wild + 1
    places = np.argwhere(np.ones(value.shape, bool))
    return np.pad(places, ((0, 0), (0, wild)), constant_values=WILD), value.ravel()


def _require_count(words: list[str], count: int) -> None:
    if len(words) != count:
        raise ValueError(f"expected {count} number{'s' * (count != 1)}, got {len(words)}: {_short(' '.join(words))}")


def _number(word: str) -> float:
    try:
        return real_of(word)
    except ValueError:
        raise ValueError(f"expected a number, got {word!r}") from None


def number_of(statements: Statements, word: str) -> tuple[int, float] | None:
    """Statement and value of a setting that is one number, None if it is not there."""
    found = statements.only(word)
    if found is None:
        return None
    try:
        _require_count(found[1], 1)
        return found[0], _number(found[1][0])
    except ValueError as error:
        raise statements.error(found[0], error) from None


def _key(places: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """One number per place."""
    key = np.zeros(len(places), np.int64)
    for axis, size in enumerate(shape):
        key = key * size + places[:, axis]
    return key


def _last_of_each(key: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different keys, ascending, and where each stands last."""
    different, last = np.unique(key[::-1], return_index=True)
    return different, len(key) - 1 - last


def _short(text: str) -> str:
    text = " ".join(text.split())
    return repr(text if len(text) <= 60 else text[:57] + "...")
