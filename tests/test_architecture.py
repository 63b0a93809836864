"""The arrows between the modules point one way, and importing the library has no side effects."""

import ast
import graphlib
import json
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "jaxhom"

# The table of the design: a module imports only from rows with a smaller number than its own.
# Inside a package (pdhg, lpal, domains, interop, plotting, cli) the modules may import one another, one way.
ROWS = {
    "interrupts": -1,  # signals and pipes
    "status": -1,  # how an answer ended
    "checks": -1,  # host-side checks know nothing of models: above everything, mdp.py included
    "outward": -1,
    "programs": -1,
    "canonical_forms": -1,  # arrays in, keys out
    "first_order": -1,  # a value in, the same value out
    "padded_rows": -1,  # arrays in, arrays out
    "policy_chain": -0.5,
    "mdp": 0,
    "inputs": 0.5,
    "chain_solver": 0.5,
    "host_chains": 0.5,
    "occupancy": 1,
    "policy_iteration": 1.05,
    "planning_sensitivity": 1.1,
    "planning": 1.2,
    "impossible_steps": 0.6,
    "episode_ends": 0.6,
    "demonstrations": 1,
    "host_graph": 0.6,
    "local_models": 1,
    "lane_queue": 0.5,
    "inverse_factor": 0.5,
    "block_tridiagonal": 0.5,
    "game_interior_point": 0.6,
    "pdhg": 1,
    "homomorphism_newton": 1.2,
    "interior_point": 1.3,
    "normal_equations": 1.2,
    "sparse_interior_point": 1.3,
    "host_certificates": 1.4,
    "brackets": 1.6,
    "homomorphism": 2,
    "homomorphism_map": 2,
    "certified_maps": 2,
    "lpal": 2,
    "evidence": 2,
    "votes": 2,
    "explanation": 2.3,
    "explainers": 2.6,
    "generalization": 3,
    "global_homomorphism": 3.5,
    "occupancy_regression": 3.5,
    "evaluation": 4,
    "domains": 4,
    "jaxhom": 4.5,  # the public names, jaxhom/__init__.py
    "interop": 5,
    "plotting": 5,
    "cli": 6,  # the command line, started by __main__.py
    "__main__": 7,
}
LAST_CORE_ROW = 4


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def row_name(module):
    """The entry of the table that a module belongs to."""
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


def test_imports_are_found():
    assert "jaxhom.mdp" in arrows("jaxhom.occupancy")
    assert "jaxhom.checks" in arrows("jaxhom.mdp")  # `from jaxhom import checks`
    assert "numpy" in set(imported_names("jaxhom.mdp"))


@pytest.mark.parametrize("module", FILES)
def test_imports_point_to_rows_above(module):
    assert row_name(module) in ROWS, f"give {module} a row in the design and in this test"
    row = ROWS[row_name(module)]
    for other in arrows(module):
        if row_name(other) != row_name(module):
            other_row = ROWS[row_name(other)]
            assert other_row < row, f"{module} (row {row}) imports {other} (row {other_row})"


@pytest.mark.parametrize("package", ["pdhg", "lpal", "domains", "interop", "plotting", "cli"])
def test_imports_inside_a_package_point_one_way(package):
    inside = [module for module in FILES if row_name(module) == package]
    graph = {module: [m for m in arrows(module) if m in inside] for module in inside}
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError


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
    core = [m for m in FILES if ROWS.get(row_name(m), 9) <= LAST_CORE_ROW or row_name(m) == "interop"]
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
    assert not unwanted & {name.split(".")[0] for name in loaded}
