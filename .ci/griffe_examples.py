"""Tells griffe, which reads docstrings for the site, that a section `Example:` is one of examples.

It knows the plural alone, and takes the singular for a remark, whose prompts become quotations.
"""

import re
from typing import Any

import griffe

_HEADING = re.compile(r"^([ \t]*)Example:$", re.MULTILINE)


class ExampleSections(griffe.Extension):
    """Reads `Example:` as a section of examples with that title."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Changes the docstring of an object as soon as it is read."""
        if obj.docstring:
            obj.docstring.value = _HEADING.sub(r"\1Examples: Example", obj.docstring.value)
