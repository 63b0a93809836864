"""Work over several processes of `jax.distributed`, as they run on several hosts: here two, on the loopback."""

import os
import pathlib
import socket
import subprocess
import sys

import numpy as np
import pytest

import jaxhom
from jaxhom.similarity import pair_blocks

SETTINGS = {"_MOST": 64, "_LEAST": 64, "_UNDECIDED": 1.0}  # several blocks of a small model

PROGRAM = """
import sys
number, count, port, folder = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4]
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(f"localhost:{port}", count, number)
import numpy as np
import test_hosts
from jaxhom.similarity.class_pairs import ClassPairs

assert jax.process_count() == count and len(jax.local_devices()) == 1
for name, value in test_hosts.SETTINGS.items():
    setattr(test_hosts.pair_blocks, name, value)
answers = test_hosts.answers(across_processes=True)

# What goes wrong in one process ends the call in all of them, and they go on together.
plain, said = ClassPairs.brackets, []

def fails(error):
    def brackets(self, pairs, *options):
        if number == 1:
            raise error
        return plain(self, pairs, *options)
    return brackets

for error in (MemoryError("too many pairs"), KeyboardInterrupt("Ctrl-C")):
    ClassPairs.brackets = fails(error)
    try:
        test_hosts.answers(across_processes=True)
    except BaseException as caught:
        said.append(f"{type(caught).__name__}: {caught}")
ClassPairs.brackets = plain
table = test_hosts.jaxhom.SimilarityTable(test_hosts.model(), across_processes=True)
try:
    table.brackets([0, 1], [2, 3 + number])
except ValueError as caught:
    said.append(str(caught))
again = test_hosts.answers(across_processes=True)
assert all(np.array_equal(again[name], answers[name]) for name in answers if name != "solved")
np.savez(f"{folder}/{number}.npz", said=said, **answers)
"""


def model():
    """Forty states on a ring, each with successors and probabilities of its own."""
    rng, n = np.random.default_rng(0), 40
    transition = np.zeros((n, 2, n))
    for s in range(n):
        for a in range(2):
            transition[s, a, [(s + 1 + a) % n, (s - 1) % n]] = rng.dirichlet([1.0, 1.0])
    return jaxhom.MDP.from_dense(transition, discount=0.9)


def answers(**options):
    """Similarities and Algorithm 1, with a table of these options."""
    mdp, table = model(), jaxhom.SimilarityTable(model(), **options)
    sources, targets = np.divmod(np.arange(0, 1600, 7), 40)
    bounds = table.brackets(sources, targets, tolerance=1e-3)
    shown = jaxhom.Demonstrations.from_trajectories([([0, 1, 2, 4], [0, 0, 1, 0])])
    rule = {"threshold": 0.3, "voters": 4, "weights": "similarity", "tolerance": 1e-3}
    general = jaxhom.soft_local_homomorphism(mdp, shown, table=table, **rule)
    pairs, known = table.known()
    return {
        **{name: leaf for name, leaf in dict(bounds).items() if name != "iterations"},
        **{f"known_{name}": leaf for name, leaf in dict(known).items()},
        "pairs": pairs,
        "policy": np.asarray(general.policy),
        "radius": np.asarray(general.radius),
        "support": np.asarray(general.support),
        "solved": np.array(table.num_solved),
    }


def run_processes(folder, count=2):
    """The program in as many processes; what each wrote."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    here = pathlib.Path(__file__).resolve().parent
    path = os.pathsep.join([str(here), str(here.parent), os.environ.get("PYTHONPATH", "")])
    started = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(number), str(count), port, str(folder)],
            env={**os.environ, "PYTHONPATH": path},
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(count)
    ]
    try:
        errors = [process.communicate(timeout=120)[1] for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [0] * count, errors
    return [dict(np.load(folder / f"{number}.npz")) for number in range(count)]


def test_two_processes_answer_as_one(monkeypatch, tmp_path):
    first, second = run_processes(tmp_path)
    for name in first.keys() - {"said", "solved"}:
        np.testing.assert_array_equal(first[name], second[name])  # to the bit
    for name, value in SETTINGS.items():
        monkeypatch.setattr(pair_blocks, name, value)
    alone = answers()
    for name in ("status", "pairs", "radius", "support"):
        np.testing.assert_array_equal(first[name], alone[name])
    assert (np.maximum(first["lower"], alone["lower"]) <= np.minimum(first["upper"], alone["upper"]) + 1e-12).all()
    np.testing.assert_allclose(first["policy"], alone["policy"], atol=0.05)  # exp(-e / 0.05), e to 1e-3
    assert first["solved"] + second["solved"] == alone["solved"]
    assert abs(int(first["solved"]) - int(second["solved"])) < 0.2 * alone["solved"]
    different = "the processes that share a table of similarities have asked it different things"
    assert first["said"].tolist() == [
        "RuntimeError: process 1 failed: MemoryError: too many pairs",
        "KeyboardInterrupt: process 1 was interrupted",
        different,
    ]
    assert second["said"].tolist() == ["MemoryError: too many pairs", "KeyboardInterrupt: Ctrl-C", different]


def test_a_process_alone_shares_with_itself():
    one, other = (answers(across_processes=shared) for shared in (False, True))
    for name, array in one.items():
        np.testing.assert_array_equal(other[name], array)


def test_renamings_are_not_shared():
    with pytest.raises(ValueError, match='relation="lax" is not shared by processes'):
        jaxhom.SimilarityTable(model(), relation="lax", across_processes=True)
