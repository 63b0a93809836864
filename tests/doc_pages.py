"""The pages of the documentation and the README as programs: their code blocks, run in order, and what they print.

Blocks of a page share one namespace and one directory, as for a reader who types them in one after the other: a
tutorial builds on what it made before. What a block is:

    python    runs
    bash      lines that begin with `python -m jaxhom` run, in this process: starting Python and JAX anew costs
              seconds. Lines that install run elsewhere (`.ci/run`); their extras have to exist
    text      what the block before it printed; commands may leave it out, Python may not
    (none)    formulas, and tables that other programs print

`python tests/doc_pages.py` writes what the blocks print, and their pictures, into the pages.
"""

import contextlib
import io
import itertools
import math
import os
import pathlib
import re
import shlex
import tempfile
import tomllib
from typing import NamedTuple

ROOT = pathlib.Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = (README, *sorted(DOCS.rglob("*.md")))

_BLOCK = re.compile(r"^```(.*)\n((?:.*\n)*?)```$", re.MULTILINE)
_PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")
_RELATIVE, _ABSOLUTE = 5e-3, 1e-4  # of numbers with a decimal point; pages show three or four digits


class Block(NamedTuple):
    """A fenced block: its language, its text, the line that it begins on and where it stands in the page."""

    language: str
    text: str
    line: int
    start: int
    end: int


class Step(NamedTuple):
    """A block that runs, and the one after it that says what it prints, if any."""

    block: Block
    output: Block | None


def blocks_of(page: str) -> list[Block]:
    """The fenced blocks of a page."""
    return [
        Block(match[1].strip(), match[2], page.count("\n", 0, match.start(2)) + 1, match.start(2), match.end(2))
        for match in _BLOCK.finditer(page)
    ]


def steps_of(page: str) -> list[Step]:
    """The blocks that run, in order."""
    steps = []
    for block, following in itertools.pairwise([*blocks_of(page), None]):
        if block.language in ("python", "bash"):
            is_output = following is not None and following.language == "text"
            steps.append(Step(block, following if is_output else None))
    return steps


def prose_of(page: str) -> str:
    """A page without its blocks."""
    return _BLOCK.sub("", page)


def pictures_of(page: str) -> list[str]:
    """Paths of the pictures that a page shows, relative to it."""
    return _PICTURE.findall(prose_of(page))


def run_step(step: Step, namespace: dict, path: pathlib.Path) -> str:
    """Runs one block and returns what it printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        if step.block.language == "python":
            code = "\n" * (step.block.line - 1) + step.block.text  # tracebacks name the page's lines
            exec(compile(code, str(path), "exec"), namespace)
        else:
            for line in step.block.text.replace("\\\n", " ").splitlines():
                _run_command(line)
    return printed.getvalue()


def differences(printed: str, expected: str) -> str | None:
    """None if the texts agree, their numbers up to rounding and their spaces up to how many; else how they differ."""
    (words, numbers), (other_words, other_numbers) = _split(printed), _split(expected)
    if words != other_words:
        return "other words"
    for one, other in zip(numbers, other_numbers, strict=True):
        exact = one.lstrip("+-").isdigit() and other.lstrip("+-").isdigit()
        if one != other and (exact or not math.isclose(float(one), float(other), rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)):
            return f"{one} for {other}"
    return None


def _split(text: str) -> tuple[list[str], list[str]]:
    """Words, with a mark for every number, and the numbers; rules of tables are as long as their columns."""
    words = _NUMBER.sub(" # ", re.sub("-{3,}", "---", text))
    return words.split(), _NUMBER.findall(text)


def _run_command(line: str) -> None:
    words = shlex.split(line)
    if words[:3] == ["python", "-m", "jaxhom"]:
        from jaxhom.cli.parser import main

        if main(words[3:]):
            raise RuntimeError(f"{line}: failed")
    elif words[:3] == ["python", "-m", "bench.reproduce"]:
        from bench import reproduce

        reproduce.parser().parse_args(words[3:])  # the sweeps take minutes: their own tests run them
    elif words and words not in (["python", "-m", "bench.report"], ["python", "-m", "bench.critical_states"]):
        _require_installs(line)


def _require_installs(line: str) -> None:
    """Raises unless the line installs this project with extras that it has."""
    installs = re.search(r"pip install (?:-\w+ )*'?\.(?:\[([\w,]+)\])?'?", line)
    if installs is None:
        raise RuntimeError(f"{line}: a command that the tests do not know")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    unknown = set((installs[1] or "").split(",")) - {"", *extras}
    if unknown:
        raise RuntimeError(f"{line}: there are no extras {unknown}")


def _rewrite(path: pathlib.Path) -> None:
    """Runs a page and writes what its blocks print, and the pictures that it shows, where they belong."""
    page, namespace, parts, done = path.read_text(), {"__name__": "__main__"}, [], 0
    for step in steps_of(page):
        printed = run_step(step, namespace, path)
        if step.output is not None:
            parts += [page[done : step.output.start], printed]
            done = step.output.end
    path.write_text("".join([*parts, page[done:]]))
    for picture in pictures_of(page):
        if os.path.exists(picture):
            (path.parent / picture).write_bytes(pathlib.Path(picture).read_bytes())


if __name__ == "__main__":
    import sys

    import matplotlib

    matplotlib.use("agg")
    for path in map(pathlib.Path, sys.argv[1:]) if sys.argv[1:] else PAGES:
        path = path.resolve()
        with tempfile.TemporaryDirectory() as directory, contextlib.chdir(directory):
            _rewrite(path)
            print(f"{path}: {len(steps_of(path.read_text()))} blocks")
