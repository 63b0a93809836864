"""Everything that users call says what it takes and what it gives: no parameter and no result without annotation.

That what is written there is true is checked by mypy (`pyproject.toml` says how strictly, `.ci/run` runs it).
"""

import dataclasses
import inspect

import pytest

import jaxhom
from jaxhom import interop, plotting

DOORS = (jaxhom, interop, plotting)
NOT_YET = {}  # public functions that wait for their annotations; nothing is added here


def public_functions():
    """The functions, constructors, methods and properties that users see, by dotted name."""
    found = {}
    for door in DOORS:
        for name in door.__all__:
            public = getattr(door, name)
            if inspect.isclass(public):
                found |= {f"{door.__name__}.{name}.{method}": f for method, f in methods_of(public)}
            elif callable(public) and not isinstance(public, str):
                found[f"{door.__name__}.{name}"] = public
    return found


def methods_of(cls):
    """What a class of ours defines for its users; what `dataclasses` writes is left out."""
    for name, member in vars(cls).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        function = getattr(function, "func", function)  # of a cached property
        is_ours = inspect.isfunction(function) and function.__module__.startswith("jaxhom")
        generated = dataclasses.is_dataclass(cls) and name == "__init__"
        if is_ours and not generated and (name == "__init__" or not name.startswith("_")):
            yield name, function


def unannotated(function):
    """Parameters, and "return", without annotation."""
    signature = inspect.signature(function)
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    missing = [p.name for p in parameters if p.annotation is p.empty]
    is_constructor = getattr(function, "__name__", "") == "__init__"
    return missing + ["return"] * (signature.return_annotation is signature.empty and not is_constructor)


PUBLIC = public_functions()


def test_functions_and_methods_are_found():
    assert {"jaxhom.lpal", "jaxhom.MDP.from_dense", "jaxhom.interop.from_gymnasium"} <= set(PUBLIC)
    assert set(PUBLIC) >= NOT_YET


@pytest.mark.parametrize("name", sorted(set(PUBLIC) - NOT_YET))
def test_public_functions_are_annotated(name):
    assert not unannotated(PUBLIC[name])
