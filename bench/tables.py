"""Table I and the answers to the questions as Markdown and LaTeX."""

from collections.abc import Sequence

import pandas as pd

from bench.summaries import DIFFERS, ONE_DRAW

HEADINGS = {
    "expert": "expert",
    "full_policy": "full policy",
    "soft_local_homomorphism": "soft local hom.",
    "monte_carlo": "Monte Carlo",
    "maximum_entropy": "max. entropy",
    "euclidean_knn": "Euclidean k-NN",
    "regression": "regression",
    "manhattan_knn": "Manhattan k-NN",
    "lpal_zeros": "zeros",
    "uniform": "uniform policy",
}
_MARKS = {DIFFERS: "*", ONE_DRAW: "†"}
Table = tuple[list[str], list[list[str]]]  # header and rows


def table1_reward(cells: pd.DataFrame) -> Table:
    """Average reward per step, ours and (in brackets) the paper's."""
    return _table1(cells, lambda cell: _cell(cell.draws, cell.mean, cell.ci_low, cell.ci_high, cell.paper, 3))


def table1_ratio(cells: pd.DataFrame) -> Table:
    """Percent of the expert's reward in the same draw, marked where the paper's differs."""

    def show(cell) -> str:
        numbers = (100.0 * x for x in (cell.ratio, cell.ratio_ci_low, cell.ratio_ci_high, cell.paper_ratio))
        return _cell(cell.draws, *numbers, 1) + _MARKS.get(cell.verdict, "")

    return _table1(cells, show)


def _table1(cells: pd.DataFrame, show) -> Table:
    found = {(cell.grid, cell.regions, cell.method): show(cell) for cell in cells.itertuples()}
    methods = [name for name in HEADINGS if name in set(cells["method"])]
    rows = [
        [f"{grid}x{grid}", str(regions), *(found.get((grid, regions, method), "") for method in methods)]
        for grid, regions in sorted({key[:2] for key in found})
    ]
    return ["grid", "regions"] + [HEADINGS[name] for name in methods], rows


def _cell(draws: int, mean: float, low: float, high: float, paper: float, digits: int) -> str:
    """Mean, half-width of the interval, and the paper's number."""
    text = f"{mean:.{digits}f}" + (f" ±{0.5 * (high - low):.{digits}f}" if draws > 1 else "")
    return text if paper != paper else f"{text} ({paper:.{digits}f})"


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
