"""The house: which room imports from which, how long the way through it is, and that importing has no side effects.

`python tests/test_architecture.py` prints the rooms, the longest chain of imports between them, and the largest files.
"""

import ast
import functools
import graphlib
import json
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "jaxhom"

# Every room, and all the rooms that it may import from. `jaxhom` is the face, jaxhom/__init__.py.
TOOLS = {"checks", "status", "programs"}
GIVEN = TOOLS | {"models", "solvers"}
CORE = GIVEN | {"planning", "similarity", "generalization", "apprenticeship", "domains", "guarantees"}
MAY_IMPORT = {
    "checks": set(),
    "status": set(),
    "programs": set(),
    "interrupts": set(),
    "models": TOOLS,
    "solvers": TOOLS,
    "planning": GIVEN,
    "similarity": GIVEN,
    "generalization": GIVEN | {"planning", "similarity"},
    "apprenticeship": GIVEN | {"planning"},
    "guarantees": GIVEN | {"planning", "similarity", "generalization", "apprenticeship"},
    "domains": TOOLS | {"models", "planning"},
    "jaxhom": CORE | {"interrupts"},
    "interop": CORE,
    "plotting": CORE,
    "sweeps": CORE,
    "cli": CORE | {"interrupts", "interop", "plotting"},
    "__main__": {"interrupts", "cli"},
}
MOST_ROOMS, LONGEST_CHAIN = 17, 8
NO_FACE = sorted(CORE - TOOLS | {"cli"})


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def room(module):
    """The room that a module belongs to."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else parts[0]


def imported_names(module):
    """Every dotted name that a module imports anywhere in its file, functions included."""
    path = FILES[module]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
                here = here[: len(here) - node.level + 1]
                base = ".".join([*here, base] if base else here)
            for alias in node.names:
                name = f"{base}.{alias.name}"
                yield name if name in FILES else base


def arrows(module):
    """The modules of the library that `module` imports."""
    return {name for name in imported_names(module) if name.split(".")[0] == "jaxhom"}


def rooms():
    """From each room to those that it imports from."""
    graph = {}
    for module in FILES:
        graph.setdefault(room(module), set()).update(room(other) for other in arrows(module))
    return {name: others - {name} for name, others in graph.items()}


def longest_chain(graph):
    """The rooms of the longest chain of imports."""

    @functools.cache
    def below(name):
        return [name, *max((below(other) for other in graph[name]), key=len, default=[])]

    return max(map(below, graph), key=len)


def test_imports_are_found():
    assert "jaxhom.models.mdp" in arrows("jaxhom.planning.occupancy")
    assert "jaxhom.checks" in arrows("jaxhom.models.mdp")  # `from jaxhom import checks`
    assert "numpy" in set(imported_names("jaxhom.models.mdp"))


def test_rooms_import_from_the_rooms_that_they_may():
    for name, others in rooms().items():
        assert others <= MAY_IMPORT[name], f"{name} imports from {sorted(others - MAY_IMPORT[name])}"


def test_the_house_is_small_and_has_no_circle():
    assert len(MAY_IMPORT) - 1 <= MOST_ROOMS  # the face is no room
    list(graphlib.TopologicalSorter(rooms()).static_order())  # raises CycleError
    assert len(longest_chain(rooms())) <= LONGEST_CHAIN


@pytest.mark.parametrize("name", sorted(n for n in MAY_IMPORT if (PACKAGE / n).is_dir()))
def test_imports_inside_a_room_point_one_way(name):
    graph = {module: {m for m in arrows(module) if room(m) == name} for module in FILES if room(module) == name}
    list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("name", NO_FACE)
def test_only_the_library_itself_and_its_doors_export(name):
    assert not list(imported_names(f"jaxhom.{name}"))  # so no function stands where its module does


@pytest.mark.parametrize("library", ["jaxopt"])
def test_unmaintained_libraries_are_imported_in_one_module_only(library):
    users = [m for m in FILES if library in {n.split(".")[0] for n in imported_names(m)}]
    assert len(users) <= 1, f"{library} is imported in {users}"


def test_oracles_are_independent():
    tree = ast.parse((ROOT / "tests" / "oracles.py").read_text())
    names = {n.name.split(".")[0] for i in ast.walk(tree) if isinstance(i, ast.Import) for n in i.names}
    names |= {i.module.split(".")[0] for i in ast.walk(tree) if isinstance(i, ast.ImportFrom)}
    assert names <= {"itertools", "math", "numpy", "scipy"}


PROBE = """
import importlib, json, sys
import jax
settings = dict(jax.config.values)
import jaxhom
for module in {modules}:
    importlib.import_module(module)
changed = [name for name, value in jax.config.values.items() if settings.get(name, value) != value]
print(json.dumps([changed, jax.config.jax_enable_x64, sorted(sys.modules)]))
"""


@pytest.mark.parametrize("x64", ["0", "1"])
def test_importing_changes_no_setting_and_brings_in_no_optional_library(x64):
    """`import jaxhom`, its modules up to the domains, and the doors to other libraries, in a fresh interpreter."""
    core = [m for m in FILES if room(m) in CORE | {"interop", "sweeps"}]
    result = subprocess.run(
        [sys.executable, "-c", PROBE.format(modules=core)],
        cwd=ROOT,
        env={"PATH": "", "JAX_PLATFORMS": "cpu", "JAX_ENABLE_X64": x64},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    changed, x64_after, loaded = json.loads(result.stdout)
    assert changed == []
    assert x64_after == (x64 == "1")
    unwanted = {"matplotlib", "gymnasium", "minari", "imitation", "torch", "tensorflow", "pandas"}
    unwanted |= {"networkx", "pyarrow", "h5py", "distributed"}
    assert not unwanted & {name.split(".")[0] for name in loaded}


def test_importing_waits_for_nothing_that_is_not_needed_yet():
    """What takes JAX's own time again: solvers of SciPy, jaxopt with what it brings, and the like."""
    probe = (
        "import json, sys, jax; before = {*sys.modules}; import jaxhom; print(json.dumps([*{*sys.modules} - before]))"
    )
    environment = {"PATH": "", "JAX_PLATFORMS": "cpu"}
    found = subprocess.run([sys.executable, "-c", probe], cwd=ROOT, env=environment, capture_output=True, check=True)
    solvers = {f"scipy.{part}" for part in ("optimize", "linalg", "special", "spatial", "sparse")}
    late = {"jaxopt", "optax", "numba", "threadpoolctl", "matplotlib"} | solvers
    assert not late & set(json.loads(found.stdout))


if __name__ == "__main__":
    for name, others in rooms().items():
        print(f"{name:16}{', '.join(sorted(others))}")
    sizes = {module: len(path.read_text().splitlines()) for module, path in FILES.items()}
    print(len(rooms()) - 1, "rooms in jaxhom/, longest chain of imports:", " > ".join(longest_chain(rooms())))
    print("largest files:", ", ".join(f"{m} {sizes[m]}" for m in sorted(sizes, key=sizes.get, reverse=True)[:5]))
