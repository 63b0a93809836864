"""Builds the source distribution and from it the wheel, and looks at both: what has to be inside is, and it imports.

`python .ci/packages.py FOLDER`, in an environment with the extra `test`, leaves both in the folder.
"""

import os
import pathlib
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping, Sequence

ROOT = pathlib.Path(__file__).resolve().parent.parent


def main() -> None:
    """Raises where a distribution lacks something, or has too much."""
    folder = pathlib.Path(sys.argv[1])
    run([sys.executable, "-m", "build", "--outdir", folder, ROOT], ROOT, os.environ)
    (wheel,) = folder.glob("*.whl")
    (source,) = folder.glob("*.tar.gz")
    check_wheel(wheel)
    with tempfile.TemporaryDirectory() as unpacked:
        check_source(source, pathlib.Path(unpacked))


def check_wheel(path: pathlib.Path) -> None:
    """The package with its data, and nothing beside it."""
    names = {name for name in zipfile.ZipFile(path).namelist() if ".dist-info/" not in name}
    files = [file for pattern in ("*.py", "*.track", "py.typed") for file in (ROOT / "jaxhom").rglob(pattern)]
    expected = {str(file.relative_to(ROOT)) for file in files}
    assert {"jaxhom/py.typed", "jaxhom/domains/tracks/a.track"} <= expected
    assert names == expected, f"{path.name}: missing {expected - names}, superfluous {names - expected}"


def check_source(path: pathlib.Path, folder: pathlib.Path) -> None:
    """Its tests import its own package."""
    with tarfile.open(path) as archive:
        archive.extractall(folder, filter="data")
    (root,) = folder.iterdir()
    environment = {**os.environ, "PYTHONPATH": str(root)}
    collected = run([sys.executable, "-m", "pytest", "--collect-only", "-n", "0"], root, environment)
    print(f"{path.name}: {collected.count('::')} tests are collected")


def run(command: Sequence[str | pathlib.Path], folder: pathlib.Path, environment: Mapping[str, str]) -> str:
    """What a command prints; all of it is shown if the command fails."""
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{done.stdout}{done.stderr}\n{command} failed")
    return done.stdout


if __name__ == "__main__":
    main()
