"""Everything that users call says what it takes and what it gives: no parameter and no result without annotation.

That what is written there is true is checked by mypy (`pyproject.toml` says how strictly, `.ci/run` runs it).
"""

import dataclasses
import inspect

import pytest

import jaxhom
from jaxhom import interop, plotting, sweeps

DOORS = (jaxhom, interop, plotting, sweeps)


def public_functions():
    """The functions, constructors, methods and properties that users see, by dotted name."""
    found = {}
    for door in DOORS:
        for name in door.__all__:
            public = getattr(door, name)
            if inspect.isclass(public):
                found |= {f"{door.__name__}.{name}.{method}": f for method, f in methods_of(public).items()}
            elif inspect.isfunction(inspect.unwrap(public)):  # what `jax.jit` made is unwrapped
                found[f"{door.__name__}.{name}"] = public
    return found


def methods_of(cls):
    """What a class of ours and those that it derives from define for its users, by name; not what Python writes."""
    found = {}
    for name, member in {name: member for base in cls.__mro__[::-1] for name, member in vars(base).items()}.items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        function = inspect.unwrap(getattr(function, "func", function))  # of a cached property
        generated = dataclasses.is_dataclass(cls) and name == "__init__"
        is_public = name == "__init__" or not name.startswith("_")
        if inspect.isfunction(function) and function.__module__.startswith("jaxhom") and is_public and not generated:
            found[name] = function
    return found


def unannotated(function):
    """Parameters, and "return", without annotation."""
    signature = inspect.signature(function)
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    missing = [p.name for p in parameters if p.annotation is p.empty]
    is_constructor = function.__name__ == "__init__"
    return missing + ["return"] * (signature.return_annotation is signature.empty and not is_constructor)


PUBLIC = public_functions()


def test_functions_and_methods_are_found():
    assert {"jaxhom.lpal", "jaxhom.occupancy", "jaxhom.MDP.from_dense", "jaxhom.Plan.replace"} <= set(PUBLIC)
    assert {"jaxhom.interop.from_gymnasium", "jaxhom.plotting.plot_policy"} <= set(PUBLIC)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_public_functions_are_annotated(name):
    assert not unannotated(PUBLIC[name])
