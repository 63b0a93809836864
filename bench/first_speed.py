"""Measures what a fresh process waits for: steps, pairs of local models, and the whole path as one program of a key.

The section of steps is `bench.fresh_processes`.

A section of pairs solves so many random pairs of five states, four actions, or sixty pairs of two to 25 states, nine
actions, as brackets or decisions: the first call, and the median of three more, beside HiGHS, which solves one after
the other on one core.

A section of draws is a domain. Its rows: the program over all draws at once, the same sharded over two devices that are
forced on the host, and the plain calls in a loop. They are judged against each other: votes and radii have to be the
same draw by draw, and the bounds of margins have to overlap. "settled" is the share of draws for which that holds and
whose certificates are closed.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxhom  # noqa: E402
from bench import fresh_processes, similarity_speed  # noqa: E402
from bench.linear_programs import Homomorphisms  # noqa: E402
from bench.lp_peers import Highs, Settings  # noqa: E402
from bench.processes import peak_gb  # noqa: E402
from bench.provenance import provenance  # noqa: E402
from jaxhom.similarity.brackets import Goal, bracket_errors  # noqa: E402

SEED = 0
_LOOP = 5  # draws of the plain calls, after the first
_PACKAGES = ("jax", "numpy", "highspy")
_LIMIT = 60.0  # seconds of a pair
_HIGHS_PAIRS = 512  # at most: its time is proportional


@dataclasses.dataclass(frozen=True)
class Domain:
    """What draws are made of.

    Attributes:
      title: for tables.
      path: prepares what is concrete, and returns the path from a key to its results.
      draws: at a time; quick: of a quick run.
      devices: over which they are sharded.
    """

    title: str
    path: Callable[[], Callable[[Any], dict]]
    draws: int
    quick: int
    devices: int = 1


def _grid() -> Callable[[Any], dict]:
    """Section VI.A: 10 demonstrations of 50 steps, Algorithm 1, expectations, LPAL, and the learned policy's value."""
    mdp = jaxhom.gridworld(16, num_regions=64).mdp
    reward = mdp.features @ jaxhom.sample_weights(jax.random.key(SEED), 64)
    expert = jaxhom.optimal_policy(mdp, reward).policy
    table = jaxhom.SimilarityTable(mdp).complete()

    def path(key):
        walks = jaxhom.sample_demonstrations(key, mdp, expert, 10, 50)
        general = jaxhom.soft_local_homomorphism(mdp, walks, table=table)
        vhat = jaxhom.feature_expectations(mdp, general.policy)
        learned = jaxhom.lpal(mdp, vhat, initial_policy=general.policy)
        value = jaxhom.policy_value(mdp, learned.policy, reward) @ mdp.initial
        bounds = {"lower": learned.margin, "upper": learned.margin_bound, "status": learned.status}
        return {"radius": general.radius, "value": value} | bounds

    return path


def _racetrack() -> Callable[[Any], dict]:
    """Section VI.B: 5 demonstrations of at most 100 steps, Algorithm 1, and its policy's value. No LPAL."""
    track = jaxhom.racetrack("a")
    reward = track.mdp.features @ track.weights
    expert = jaxhom.optimal_policy(track.mdp, reward).policy
    table = jaxhom.SimilarityTable(track.mdp).complete()

    def path(key):
        walks = jaxhom.sample_demonstrations(key, track.mdp, expert, 5, 100, terminal=track.terminal)
        general = jaxhom.soft_local_homomorphism(track.mdp, walks, table=table)
        value = jaxhom.policy_value(track.mdp, general.policy, reward) @ track.mdp.initial
        return {"radius": general.radius, "value": value, "lower": value, "upper": value, "status": general.status}

    return path


DOMAINS = {
    "draws_grid16": Domain("16 x 16 grid, 64 regions, with LPAL", _grid, 100, 8),
    "draws_grid16_two_devices": Domain("16 x 16 grid, 64 regions, with LPAL", _grid, 100, 8, devices=2),
    "draws_racetrack_a": Domain("racetrack (a), without LPAL", _racetrack, 8, 2),
}


PAIRS = {f"{work}_{count}": (work, count) for work in ("pairs", "decisions") for count in (2, 100, 1000, 10_000)}


def section(name: str, quick: bool, methods: None, limit: None) -> Iterator[dict]:
    """All rows of a section."""
    del methods, limit
    if name == "steps":
        fields = {"devices": 1, "draws": 1, "status": "measured", "note": "", "settled": ""} | provenance(*_PACKAGES)
        yield from (fields | row for row in fresh_processes.rows(quick))
    elif name in MIXED:
        yield from _mixed_rows(MIXED[name], 6 if quick else _MIXED_PAIRS)
    else:
        yield from _pair_rows(*PAIRS[name]) if name in PAIRS else _draw_rows(name, quick)


MIXED = {"pairs_mixed": "pairs", "decisions_mixed": "decisions"}
_MIXED_PAIRS, _MIXED_ACTIONS, _MIXED_STATES = 60, 9, 60
_MIXED_PEERS = {"highs_simplex": "simplex", "highs_interior_point": "ipm"}


def _mixed_rows(work: str, count: int) -> Iterator[dict]:
    """Pairs of local models of two to 25 states of one model, brackets or decisions: ours, and HiGHS's."""
    mdp = _mixed_model(np.random.default_rng(SEED))
    source, target = np.random.default_rng(SEED + 1).permutation(_MIXED_STATES * 2).reshape(2, -1)[:, :count]
    source, target = source % _MIXED_STATES, target % _MIXED_STATES
    is_decision = work == "decisions"

    def ours():
        table = jaxhom.SimilarityTable(mdp)
        if is_decision:
            return table.decisions(source, target, similarity_speed.THRESHOLD)
        return table.brackets(source, target, tolerance=similarity_speed.GAP)

    found, first, seconds, _ = similarity_speed.clocked(ours)
    settled = float(np.mean(found.status == jaxhom.Status.SOLVED))
    fields = {"instance": f"{work} of 2 to 25 states", "devices": 1, "draws": count, "status": "measured", "note": ""}
    fields |= provenance(*_PACKAGES)
    times = {"first_s": first, "seconds": seconds / count, "peak_gb": peak_gb(), "settled": settled}
    yield fields | {"method": "jaxhom"} | times
    bounds = jaxhom.SimilarityTable(mdp).brackets(source, target, tolerance=similarity_speed.GAP)
    models = [tuple(_local_model(mdp, state) for state in pair) for pair in zip(source, target, strict=True)]
    for method, solver in _MIXED_PEERS.items():
        begun = time.perf_counter()
        errors = np.array([_highs_error(solver, *pair) for pair in models])
        seconds = time.perf_counter() - begun
        agrees = (errors >= bounds.lower - 1e-5) & (errors <= bounds.upper + 1e-5)
        yield fields | {"method": method, "first_s": seconds, "seconds": seconds / count, "settled": agrees.mean()}


def _mixed_model(rng: np.random.Generator) -> jaxhom.MDP:
    """States on a ring, each with a reach of its own: an action leads to at most four states within it."""
    transition = np.zeros((_MIXED_STATES, _MIXED_ACTIONS, _MIXED_STATES))
    reach = rng.integers(0, 25, _MIXED_STATES)
    for state in range(_MIXED_STATES):
        for action in range(_MIXED_ACTIONS):
            number = rng.integers(1, 5)
            successors = (state + rng.integers(0, 2 * reach[state] + 1, number)) % _MIXED_STATES
            np.add.at(transition[state, action], successors, rng.dirichlet(np.ones(number)))
    return jaxhom.MDP.from_dense(transition, discount=0.9)


def _local_model(mdp: jaxhom.MDP, state: int) -> np.ndarray:
    """The model within a step of a state, centre first; what leaves it stays where it is. In NumPy."""
    transition = np.asarray(mdp.transition)
    near = np.flatnonzero((transition[state] > 0).any(axis=0))
    states = np.append(state, near[near != state])
    within = transition[np.ix_(states, range(mdp.num_actions), states)]
    own = np.arange(len(states))
    within[own, :, own] += 1.0 - within.sum(axis=2)
    return within


def _highs_error(solver: str, source: np.ndarray, target: np.ndarray) -> float:
    settings = Settings(1e-7, {"presolve": "off"}) if solver == "simplex" else Settings(0.1 * similarity_speed.GAP)
    peer, pair = Highs(solver, settings, threads=1), (source, target)
    peer.load([Homomorphisms(*pair, anchored=True).given(pair)])
    return float(peer.solve(_LIMIT)[0][0][-1])


def _pair_rows(work: str, count: int) -> Iterator[dict]:
    """Brackets or decisions of random pairs: ours, and HiGHS's."""
    source, target = similarity_speed.random_pairs(5, count)
    threshold = similarity_speed.THRESHOLD if work == "decisions" else np.nan
    goal = Goal(tolerance=similarity_speed.GAP, threshold=threshold)
    found, first, seconds, _ = similarity_speed.clocked(lambda: bracket_errors(source, target, goal=goal))
    settled = similarity_speed.judged(found.lower, found.upper, threshold=threshold)["settled"]
    fields = {"instance": f"{work} of 5 states", "devices": 1, "status": "measured", "note": ""} | provenance(
        *_PACKAGES
    )
    times = {"first_s": first, "seconds": seconds / count, "peak_gb": peak_gb(), "settled": settled}
    yield fields | {"method": "jaxhom", "draws": count} | times
    some = similarity_speed.random_pairs(5, min(count, _HIGHS_PAIRS))
    pairs, settings = list(zip(*some, strict=True)), similarity_speed.PEERS["highs_simplex"]
    row = similarity_speed.peer_row(
        work, "highs_simplex", pairs, settings, similarity_speed.pair_problem(*some), processes=1
    )
    ours = {name: row.get(name, "") for name in ("status", "note", "settled")}
    ours |= {"seconds": row["seconds"] / len(pairs)} if "seconds" in row else {}
    yield fields | {"method": "highs_simplex", "draws": len(pairs)} | ours


def _draw_rows(name: str, quick: bool) -> Iterator[dict]:
    """The rows of a domain."""
    domain = DOMAINS[name]
    if domain.devices > 1:  # before the first computation
        flag = f"--xla_force_host_platform_device_count={domain.devices}"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    draws = domain.quick if quick else domain.draws
    begun = time.perf_counter()
    path = domain.path()
    prepared = time.perf_counter() - begun
    keys = jax.random.split(jax.random.key(SEED), draws)
    fields = {"instance": domain.title, "draws": draws, "devices": domain.devices, "prepare_s": prepared}
    fields |= {"status": "measured", "note": ""} | provenance(*_PACKAGES)
    first, seconds, found = _measured(_program(path, domain.devices), keys)
    inside = {"method": "jaxhom jit vmap", "first_s": first, "seconds": seconds / draws, "peak_gb": peak_gb()}
    if domain.devices > 1:
        yield fields | inside | {"settled": float((found["status"] == 0).mean())}
        return
    first, seconds, plain = _looped(path, keys[: _LOOP + 1])
    yield fields | inside | {"settled": _agreement(found, plain)}
    yield fields | {
        "method": "jaxhom in a loop",
        "draws": len(plain["status"]),
        "first_s": first,
        "seconds": seconds,
        "settled": float((plain["status"] == 0).mean()),
    }


def _program(path: Callable, devices: int) -> Callable:
    mapped = jax.vmap(path)
    if devices == 1:
        return jax.jit(mapped)
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("draws",))
    spec = jax.sharding.PartitionSpec("draws")
    return jax.jit(jax.shard_map(mapped, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))


def _measured(run: Callable, keys) -> tuple[float, float, dict]:
    """Seconds of the first call, which compiles, the median of three more, and what is found."""
    times = []
    for _ in range(4):
        begun = time.perf_counter()
        found = jax.block_until_ready(run(keys))
        times.append(time.perf_counter() - begun)
    return times[0], float(np.median(times[1:])), jax.tree.map(np.asarray, found)


def _looped(path: Callable, keys) -> tuple[float, float, dict]:
    """Seconds of the first draw by plain calls, the median of the others, and what is found."""
    times, found = [], []
    for key in keys:
        begun = time.perf_counter()
        found.append(jax.tree.map(np.asarray, path(key)))
        times.append(time.perf_counter() - begun)
    return times[0], float(np.median(times[1:])), jax.tree.map(lambda *leaves: np.stack(leaves), *found)


def _agreement(found: dict, plain: dict) -> float:
    """The share of draws with the same radii, bounds that overlap, and a closed certificate."""
    some = jax.tree.map(lambda leaf: leaf[: len(plain["status"])], found)
    same = (some["radius"] == plain["radius"]).all(axis=1)
    slack = 1e-9 * np.abs(plain["upper"])
    overlap = (some["lower"] <= plain["upper"] + slack) & (plain["lower"] <= some["upper"] + slack)
    return float((same & overlap).mean() * (found["status"] == 0).mean())
