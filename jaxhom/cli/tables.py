"""Plain-text tables."""

from collections.abc import Sequence


class GrowingTable:
    """A table whose lines are made one at a time, before the later ones are known.

    Args:
      header: the columns' names, as wide as the columns, but for the first.
      first_width: of the first column, which is aligned to the left; the others are aligned to the right.
    """

    def __init__(self, header: Sequence[str], first_width: int):
        self._names = header
        self._widths = [first_width, *map(len, header[1:])]

    def line(self, cells: Sequence[str]) -> str:
        """One line."""
        first, *others = zip(cells, self._widths, strict=True)
        return "  ".join([f"{first[0]:<{first[1]}}", *(f"{cell:>{width}}" for cell, width in others)]).rstrip()

    def rule(self) -> str:
        """A line between blocks."""
        return "  ".join("-" * width for width in self._widths)

    def header(self) -> str:
        """The first two lines."""
        return f"{self.line(self._names)}\n{self.rule()}"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Aligns columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    padded = [header[0], *(f"{name:>{width}}" for name, width in zip(header[1:], widths[1:], strict=True))]
    table = GrowingTable(padded, widths[0])
    return "\n".join([table.header(), *map(table.line, rows)])


def format_facts(title: str, facts: Sequence[tuple[str, str]]) -> str:
    """A title, and below it a line per fact: its name and its value, both to the left."""
    width = max(len(name) for name, _ in facts)
    return "\n".join([title, *(f"  {name:<{width}}  {value}" for name, value in facts)])
