"""The notebooks in `examples/` as programs: their cells run in order in one namespace, without Jupyter.

What a cell shows is what Jupyter would show: what it prints, the value of its last line, and its pictures.
`python tests/notebooks.py` runs them all, or those that are named, and writes what the cells show into them.
"""

import ast
import base64
import contextlib
import io
import json
import pathlib
import sys
from collections.abc import Iterator
from typing import Any

import matplotlib
import matplotlib.pyplot as plt

FOLDER = pathlib.Path(__file__).resolve().parent.parent / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def cells_of(path: pathlib.Path) -> list[dict[str, Any]]:
    """The cells of a notebook that hold code."""
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def run(path: pathlib.Path) -> Iterator[list[dict[str, Any]]]:
    """Runs the cells one after the other, and yields what each of them shows."""
    plt.close("all")  # what others have left open in this process is no picture of the notebook
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells_of(path)):
        yield _run_cell("".join(cell["source"]), f"{path.name}, cell {number}", namespace)


def text_of(outputs: list[dict[str, Any]]) -> str:
    """What a cell shows, without its pictures."""
    parts = (output.get("text") or output.get("data", {}).get("text/plain", []) for output in outputs)
    return "\n".join("".join(part) for part in parts)


def pictures_of(outputs: list[dict[str, Any]]) -> list[bytes]:
    """The pictures that a cell shows, as files."""
    encoded = (output.get("data", {}).get("image/png") for output in outputs)
    return [base64.b64decode(text) for text in encoded if text]


def _run_cell(source: str, name: str, namespace: dict[str, Any]) -> list[dict[str, Any]]:
    tree, printed, value = ast.parse(source, name), io.StringIO(), None
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, name, "exec"), namespace)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), name, "eval"), namespace)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": _lines(printed.getvalue())})
    if value is not None and not source.endswith(";"):
        shown = {"execution_count": None, "data": _shown(value), "metadata": {}}
        outputs.append({"output_type": "execute_result", **shown})
    return outputs + [_picture(plt.figure(number)) for number in plt.get_fignums()]


def _shown(value: Any) -> dict[str, list[str]]:
    shown = {"text/plain": _lines(repr(value))}
    if hasattr(value, "_repr_html_"):
        shown["text/html"] = _lines(value._repr_html_())
    return shown


def _picture(figure: plt.Figure) -> dict[str, Any]:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=80, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
    encoded = base64.b64encode(file.getvalue()).decode()
    data = {"image/png": encoded, "text/plain": ["<Figure>"]}
    return {"data": data, "metadata": {}, "output_type": "display_data"}


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def _write(path: pathlib.Path) -> None:
    """Runs a notebook and keeps what its cells show."""
    notebook, shown = json.loads(path.read_text()), list(run(path))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, (cell, outputs) in enumerate(zip(code, shown, strict=True), 1):
        cell["execution_count"] = number
        cell["outputs"] = [out | {"execution_count": number} if "execution_count" in out else out for out in outputs]
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    matplotlib.use("Agg")
    for path in map(pathlib.Path, sys.argv[1:]) if sys.argv[1:] else NOTEBOOKS:
        _write(path)
        print(f"{path}: {len(cells_of(path))} cells")
