"""Makes a page of the site of every notebook in `examples/`: its text, its code, and what that showed when it ran."""

import base64
import json
import pathlib
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_EXAMPLES = pathlib.Path(__file__).resolve().parent.parent / "examples"
_SOURCE = "*This page is the notebook `examples/{}`, as it was last run.*"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """What MkDocs calls when it knows its files."""
    for path in sorted(_EXAMPLES.glob("*.ipynb")):
        text, pictures = page_of(path)
        files.append(File.generated(config, f"examples/{path.stem}.md", content=text))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"examples/{name}", content=picture))
    return files


def page_of(path: pathlib.Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source.replace("](../docs/", "](../"))
            continue
        parts.append(f"```python\n{source}\n```")
        for shown in map(_data, cell["outputs"]):
            if "image/png" in shown:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(shown["image/png"])
                parts.append(f"![What the code draws]({name})")
            else:
                parts.append(f"```text\n{''.join(shown['text/plain']).rstrip()}\n```")
    return "\n\n".join([*parts, _SOURCE.format(path.name)]), pictures


def _data(output: dict[str, Any]) -> dict[str, Any]:
    """What was shown, by its type; what was printed is text."""
    return output.get("data") or {"text/plain": output["text"]}
