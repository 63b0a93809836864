"""Tells mypy what `chex.dataclass` adds to a class beside what its source says: the method `replace`."""

from collections.abc import Callable

from mypy.nodes import ARG_STAR2, Argument, Var
from mypy.plugin import ClassDefContext, Plugin
from mypy.plugins.common import add_method_to_class
from mypy.plugins.dataclasses import dataclass_tag_callback
from mypy.types import AnyType, TypeOfAny
from mypy.typevars import fill_typevars

_DECORATORS = ("chex.dataclass", "chex._src.dataclass.dataclass")


class _Chex(Plugin):
    def get_class_decorator_hook(self, fullname: str) -> Callable[[ClassDefContext], None] | None:
        return _add_replace if fullname in _DECORATORS else None


def _add_replace(context: ClassDefContext) -> None:
    dataclass_tag_callback(context)  # what mypy does by itself with a decorator that makes dataclasses
    anything = AnyType(TypeOfAny.explicit)
    changes = Argument(Var("changes", anything), anything, None, ARG_STAR2)
    if "replace" not in context.cls.info.names:
        add_method_to_class(context.api, context.cls, "replace", [changes], fill_typevars(context.cls.info))


def plugin(version: str) -> type[Plugin]:
    """What mypy looks for."""
    return _Chex
