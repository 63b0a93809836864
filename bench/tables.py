"""Table I and the answers to the questions as Markdown and LaTeX."""

from collections.abc import Sequence

from bench.comparison import DIFFERS, ONE_DRAW, Cell
from bench.intervals import Interval

HEADINGS = {
    "expert": "expert",
    "full_policy": "full policy",
    "soft_local_homomorphism": "soft local hom.",
    "monte_carlo": "Monte Carlo",
    "maximum_entropy": "max. entropy",
    "euclidean_knn": "Euclidean k-NN",
    "regression": "regression",
    "manhattan_knn": "Manhattan k-NN",
}

MARKS = {DIFFERS: "*", ONE_DRAW: "†"}


def table1_reward(cells: Sequence[Cell]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: average reward per step, ours and (in brackets) the paper's."""
    return _table1(cells, lambda cell: _cell(cell.reward, cell.paper_reward, 1.0, 3))


def table1_ratio(cells: Sequence[Cell]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: percent of the expert's reward in the same draw, marked where the paper's differs."""

    def show(cell: Cell) -> str:
        return _cell(cell.ratio, cell.paper_ratio, 100.0, 1) + MARKS.get(cell.verdict, "")

    return _table1(cells, show)


def _table1(cells: Sequence[Cell], show) -> tuple[list[str], list[list[str]]]:
    found = {(cell.grid, cell.regions, cell.method): cell for cell in cells}
    methods = [name for name in HEADINGS if any(cell.method == name for cell in cells)]
    rows = []
    for grid, regions in sorted({(cell.grid, cell.regions) for cell in cells}):
        row = [found.get((grid, regions, method)) for method in methods]
        rows.append([f"{grid}x{grid}", str(regions)] + ["" if cell is None else show(cell) for cell in row])
    return ["grid", "regions"] + [HEADINGS[name] for name in methods], rows


def _cell(interval: Interval, paper: float, scale: float, digits: int) -> str:
    """Mean, half-width of the interval, and the paper's number."""
    text = f"{scale * interval.mean:.{digits}f}"
    if interval.count > 1:
        text += f" ±{scale * interval.half_width:.{digits}f}"
    return text if paper != paper else f"{text} ({scale * paper:.{digits}f})"


def to_markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first two columns to the left."""
    rule = [":--" if i < 2 else "--:" for i in range(len(header))]
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, rule, *rows])


def to_latex(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A LaTeX tabular for booktabs."""
    lines = [r"\begin{tabular}{ll" + "r" * (len(header) - 2) + "}", r"\toprule", _latex_line(header), r"\midrule"]
    return "\n".join([*lines, *map(_latex_line, rows), r"\bottomrule", r"\end{tabular}"]) + "\n"


def _latex_line(cells: Sequence[str]) -> str:
    replacements = {"&": r"\&", "%": r"\%", "_": r"\_", "±": r"$\pm$", "†": r"$^\dagger$", "*": r"$^*$"}
    return " & ".join(cell.translate(str.maketrans(replacements)) for cell in cells) + r" \\"
