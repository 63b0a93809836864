"""Measures the similarity engine and its peers on the same instances, judged by the same certificate.

Each section runs in a process of its own, so that a first call there is cold, compilation included. Every time of ours
is the median of three calls after a first one; `compile_s` is what the first took beyond them. Peers are measured as
`bench.processes` says, and what they spend on building their programs counts.
"""

import functools
import itertools
import time
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxhom  # noqa: E402
from bench import lp_peers  # noqa: E402
from bench.linear_programs import Conic, Homomorphisms  # noqa: E402
from bench.lp_peers import Settings  # noqa: E402
from bench.processes import NoAnswer, measure, timed  # noqa: E402
from bench.provenance import provenance  # noqa: E402
from bench.road_graph import road_graph  # noqa: E402
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem  # noqa: E402
from jaxhom.similarity.brackets import Goal, bracket_errors  # noqa: E402
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem  # noqa: E402
from jaxhom.similarity.local_models import restricted_model  # noqa: E402
from jaxhom.solvers import pdhg  # noqa: E402
from jaxhom.solvers.lane_queue import is_settled  # noqa: E402

NUM_ACTIONS = 4
GAP = 1e-4  # the library's default tolerance
THRESHOLD = 0.05  # which some of the random pairs of five states are within, and some are not
GLOBAL_GAP = 1e-3  # HiGHS takes minutes for a tenth of it
SIZES = (3, 5, 8, 13, 25)  # 5 is a cell of a grid and its neighbours, 13 and 25 what is two and three steps away
OUR_PAIRS = {3: 2048, 5: 2048, 8: 512, 13: 128, 25: 32}
PEER_PAIRS = {  # larger ones take a peer minutes
    "highs_simplex": {3: 512, 5: 512, 8: 64, 13: 4},
    "mpax": {3: 64, 5: 64, 8: 32, 13: 8},
    "others": {3: 512, 5: 512, 8: 128, 13: 32, 25: 2},
}
_TIGHT = {"run_crossover": "off", "primal_feasibility_tolerance": 1e-7, "dual_feasibility_tolerance": 1e-7}
PEERS = {  # tolerances a tenth of the gap, HiGHS without what only costs time here
    "highs_simplex": Settings(1e-7, {"presolve": "off"}),
    "highs_interior_point": Settings(0.1 * GAP, _TIGHT),
    "moreau": Settings(0.1 * GAP),
    "mpax": Settings(0.1 * GAP, {"sparse": False}),
}
MAX_PDHG_SIZE = 8  # tight brackets of larger random models take it a tenth of a second a pair, and more
OUR_COUNTS = (1, 8, 64, 512, 4096, 32768)
PEER_COUNTS = (1, 8, 64, 512)
_LIMIT = 300.0  # seconds for a peer's row
_ROAD_PAIRS = 60_000
_PACKAGES = ("jax", "highspy", "moreau", "mpax")


def row(work: str, method: str, pairs: int, seconds: float | None = None, **fields) -> dict:
    """One row of the table; what is not given stays empty."""
    base = {"work": work, "method": method, "pairs": pairs, "device": jax.default_backend(), "gap_asked": GAP}
    base |= {"devices": jax.device_count(), "processes": 1, "dtype": "float64", "status": "measured"}
    if seconds is not None:
        base |= {"seconds": seconds, "ms_per_pair": 1e3 * seconds / max(pairs, 1)}
    return base | provenance(*_PACKAGES) | fields


def clocked(call, repeats: int = 3) -> tuple:
    """(result, seconds of the first call, median of the next ones, a field of what the first took beyond them)."""
    result, first, seconds = timed(lambda: jax.block_until_ready(call()), repeats)
    return result, first, seconds, {"compile_s": max(first - seconds, 0.0)} if repeats else {}


def sizes(n: int, m: int | None = None, actions: int = NUM_ACTIONS) -> dict:
    """Fields: states of both models, and actions."""
    return {"n": n, "m": n if m is None else m, "actions": actions}


def random_pairs(n: int, count: int, dtype=np.float64) -> tuple[np.ndarray, np.ndarray]:
    """[P, n, A, n] twice, rows uniform on the simplex; fewer pairs are a prefix of more."""
    draw = (np.random.default_rng([n, side]).dirichlet(np.ones(n), (count, n, NUM_ACTIONS)) for side in (0, 1))
    source, target = (models.astype(dtype) for models in draw)
    return source, target


# ------------------------------------------------------------------------------------------------------- certificates


def pair_problem(source: np.ndarray, target: np.ndarray) -> HomomorphismProblem:
    """The batch of anchored LPs (9) of P pairs."""
    count, n, m = len(source), source.shape[1], target.shape[1]
    return HomomorphismProblem(
        source=jnp.moveaxis(jnp.asarray(source), 0, -1),
        target=jnp.moveaxis(jnp.asarray(target), 0, -1),
        source_size=jnp.full(count, n, jnp.int32),
        target_size=jnp.full(count, m, jnp.int32),
        anchored=True,
    )


def certified(problem, answers: list, anchored: bool) -> tuple[np.ndarray, np.ndarray]:
    """Our bounds [P] of a peer's maps f [n, m] and multipliers y [n, A, m]; f is made a map first."""
    f, y = map(np.stack, zip(*answers, strict=True))
    f = np.maximum(f, 0.0)
    f /= np.maximum(f.sum(axis=-1, keepdims=True), 1e-300)
    if anchored:
        f[:, 0] = np.eye(f.shape[2])[0]
    f, y = (jnp.moveaxis(jnp.asarray(array), 0, -1) for array in (f, y))
    lower, upper = problem.bounds(f, y, problem.forward(f), problem.adjoint(y))
    return np.asarray(lower), np.asarray(upper)


def judged(lower, upper, *, asked: float = GAP, threshold: float = np.nan) -> dict:
    """Worst gap, and the share of pairs that are settled."""
    gap = np.asarray(upper - lower)
    settled = is_settled(lower, upper, asked, threshold)
    return {"gap_certified": float(gap.max()), "settled": float(settled.mean())}


# --------------------------------------------------------------------------------------------- random pairs, our side


def our_pairs(n: int, count: int, method: str, dtype=np.float64, threshold=np.nan, work="brackets") -> dict:
    """Brackets or decisions of random pairs."""
    source, target = random_pairs(n, count, dtype)
    goal = Goal(tolerance=GAP, threshold=threshold, method=method)
    found, _, seconds, compiling = clocked(lambda: bracket_errors(source, target, goal=goal))
    fields = sizes(n) | compiling | {"dtype": np.dtype(dtype).name}
    fields |= judged(found.lower, found.upper, threshold=threshold)
    return row(work, f"jaxhom {method}", count, seconds, **fields)


def section_brackets(quick: bool) -> Iterator[dict]:
    """Random pairs of every size, each method of ours."""
    for n in (3, 5) if quick else SIZES:
        count = 8 if quick else OUR_PAIRS[n]
        yield our_pairs(n, count, "interior_point")
        for dtype in (np.float64, np.float32) if n <= (3 if quick else MAX_PDHG_SIZE) else ():
            yield our_pairs(n, count, "pdhg", dtype)


def section_counts(quick: bool) -> Iterator[dict]:
    """Random pairs of five states, few and many."""
    for count in (8,) if quick else OUR_COUNTS:
        yield our_pairs(5, count, "auto", work="counts")
    for method, count in () if quick else itertools.product(("highs_simplex", "moreau"), PEER_COUNTS):
        yield peer_pairs(method, 5, count, "counts")


def section_decisions(quick: bool) -> Iterator[dict]:
    """e <= 0.05 for random pairs of five states."""
    for dtype in (np.float64, np.float32):
        yield our_pairs(5, 8 if quick else OUR_PAIRS[5], "auto", dtype, THRESHOLD, "decisions")


def section_gradients(quick: bool) -> Iterator[dict]:
    """Value and both gradients of random pairs of five states."""
    source, target = map(jnp.asarray, random_pairs(5, 8 if quick else 512))
    exact = bracket_errors(np.asarray(source), np.asarray(target), goal=Goal(1e-6))

    def measured(method, value, asked):
        function = jax.jit(jax.vmap(jax.value_and_grad(value, argnums=(0, 1))))
        (found, _), _, seconds, compiling = clocked(lambda: function(source, target))
        away = float(np.maximum(np.maximum(exact.lower - found, found - exact.upper), 0.0).max())
        fields = sizes(5) | compiling | {"gap_certified": away, "settled": 1.0, "gap_asked": asked}
        note = "gap: distance of the value from a bracket of 1e-6"
        return row("value and gradient", method, len(source), seconds, **fields, note=note)

    yield measured("jaxhom", jaxhom.homomorphism_error, 1e-6)
    if not quick and lp_peers.is_installed("moreau"):
        yield measured("moreau", _moreau_error(5, GAP), GAP)
    elif not quick:
        yield row("value and gradient", "moreau", len(source), status="not installed")


def _moreau_error(n: int, gap: float):
    """The error of a pair of models with n states by Moreau, which JAX can differentiate."""
    from jax.experimental.sparse import BCOO
    from moreau.jax import Solver

    pair = [models[0] for models in random_pairs(n, 1)]
    programs = Homomorphisms(*pair, anchored=True)
    lp = programs.given(pair)
    conic, fill = Conic(lp), BCOO.from_scipy_sparse(programs.fill)
    solver = Solver(**lp_peers.moreau_arguments(conic, 0.1 * gap, enable_grad=True))
    q, b = jnp.asarray(lp.cost), jnp.asarray(conic.right(lp))

    def value(source, target):
        entries = fill @ jnp.concatenate([source.ravel(), target.ravel(), jnp.ones(1)])
        matrix = conic.sign * jnp.append(entries, 1.0)[conic.take]
        return solver.solve(jnp.zeros(0), matrix, q, b).x[-1]

    return value


# -------------------------------------------------------------------------------------------------------------- peers


def peer_row(work: str, method: str, pairs: list, settings: Settings, problem, processes: int, **fields) -> dict:
    """LPs (8) or (9) of pairs of models by a peer, certified by `problem`, which is ours and says which of the two."""
    anchored = isinstance(problem, HomomorphismProblem)
    options = {"method": method, "settings": settings, "make": functools.partial(Homomorphisms, *pairs[0], anchored)}
    how = {"package": lp_peers.PEERS[method][0], "together": method in ("moreau", "mpax"), "processes": processes}
    fields = {"device": "cpu", "gap_asked": GAP} | fields
    try:
        found = measure("lp_peers:Opened", options, pairs, _LIMIT, **how)
        if len(found.answers) < len(pairs):
            raise NoAnswer("time limit", f"{len(found.answers)} of {len(pairs)} pairs in {_LIMIT:g} s")
    except NoAnswer as error:  # a row, not the end of the benchmark
        return row(work, method, len(pairs), **fields | error.fields)
    fields |= {"processes": found.processes, "compile_s": found.compile_s, "build_s": found.build_s}
    fields |= {"note": ", ".join([*filter(None, [fields.get("note")]), *sorted(set(found.words))])}
    fields |= judged(*certified(problem, found.answers, anchored), asked=fields["gap_asked"])
    return row(work, method, len(pairs), found.build_s + sum(found.seconds), **fields)


def peer_pairs(method: str, n: int, count: int, work: str = "brackets") -> dict:
    """Brackets of random pairs by a peer."""
    if not lp_peers.is_installed(method):
        return row(work, method, 0, **sizes(n), device="cpu", status="not installed")
    models = random_pairs(n, count)
    pairs, processes = list(zip(*models, strict=True)), 1 if method in lp_peers.USES_BOTH_CORES else 2
    return peer_row(work, method, pairs, PEERS[method], pair_problem(*models), processes, **sizes(n))


def section_peers(quick: bool) -> Iterator[dict]:
    """Random pairs of every size, each peer."""
    for n in (3, 5) if quick else SIZES:
        for method in PEERS:
            count = PEER_PAIRS.get(method, PEER_PAIRS["others"]).get(n)
            if count and (method.startswith("highs") or not quick):
                yield peer_pairs(method, n, 8 if quick else count)


# ------------------------------------------------------------------------------------------------------ whole problems


def cold_and_warm(work: str, method: str, pairs: int, call, describe, repeats: int = 3) -> list[dict]:
    """Rows of the first call in this process and, if it is repeated, of the median of the next."""
    result, cold, seconds, compiling = clocked(call, repeats)
    fields = describe(result) | compiling
    rows = [row(f"{work}, cold", method, pairs, cold, **fields)]
    return rows + [row(f"{work}, warm", method, pairs, seconds, **fields)] * bool(repeats)


def section_racetrack(quick: bool) -> list[dict]:
    """All ordered pairs of states of the racetrack: classes, brackets of their pairs, expansion by label."""
    mdp = jaxhom.racetrack("a").mdp

    def call():
        table = jaxhom.SimilarityTable(mdp)
        classes = table.classes()
        number = table.num_classes
        _, first = np.unique(classes, return_index=True)  # a state of each class
        found = table.brackets(np.repeat(first, number), np.tile(first, number), tolerance=GAP)
        index = np.ix_(classes, classes)
        return tuple(bound.reshape(number, number)[index] for bound in (found.lower, found.upper)), number

    def describe(result):
        (lower, upper), number = result
        return judged(lower, upper) | {"actions": mdp.num_actions, "note": f"{number} classes"}

    return cold_and_warm("racetrack, all pairs", "jaxhom auto", mdp.num_states**2, call, describe)


def section_roads(quick: bool) -> Iterator[dict]:
    """Decisions about an irregular graph: pairs of classes at distance 2, at one threshold after the other."""
    roads = road_graph(6 if quick else 15)
    start = time.perf_counter()
    table = jaxhom.SimilarityTable(roads.mdp, distance=2)
    classes = table.classes()
    seconds = time.perf_counter() - start
    _, first = np.unique(classes, return_index=True)  # a state of each class
    states = f"{roads.mdp.num_states} links, {len(first)} classes"
    yield row("road network, classes", "jaxhom", len(classes), seconds, actions=roads.mdp.num_actions, note=states)
    pairs = first[np.random.default_rng(0).integers(0, len(first), (2, _ROAD_PAIRS))]
    for threshold in (0.0, 0.1, 0.2):
        before, start = table.num_solved, time.perf_counter()
        similar = table.decide(*pairs, threshold)
        seconds = time.perf_counter() - start
        note = f"threshold {threshold:g}: {similar.mean():.2%} similar, {table.num_solved - before} pairs took a solver"
        yield row("road network, decisions", "jaxhom", _ROAD_PAIRS, seconds, actions=roads.mdp.num_actions, note=note)


def section_algorithm1(quick: bool) -> list[dict]:
    """Algorithm 1 on the racetrack with ten demonstrations."""
    track = jaxhom.racetrack("a")
    policy = jaxhom.optimal_policy(track.mdp, track.mdp.features @ track.weights).policy
    demonstrations = jaxhom.sample_demonstrations(jax.random.key(0), track.mdp, policy, 10, 20)

    def describe(result):
        return {"actions": track.mdp.num_actions, "note": "epsilon 0, d 1; the expert's own planning is not counted"}

    def call():
        return jaxhom.soft_local_homomorphism(track.mdp, demonstrations)

    return cold_and_warm("Algorithm 1, racetrack", "jaxhom", track.mdp.num_states, call, describe)


def grid_demonstrations(size: int, horizon: int):
    """A grid, and ten demonstrations of an expert whose reward is random over regions of two by two cells."""
    num_regions = (size // 2) ** 2
    mdp = jaxhom.gridworld(size, num_regions=num_regions).mdp
    reward = mdp.features @ jaxhom.sample_weights(jax.random.key(1), num_regions)
    policy = jaxhom.optimal_policy(mdp, reward).policy
    return mdp, jaxhom.sample_demonstrations(jax.random.key(2), mdp, policy, 10, horizon)


def section_global(quick: bool) -> Iterator[dict]:
    """LP (8): ours on the 16 x 16 grid and on the grids that HiGHS takes too."""
    for size in (4,) if quick else (6, 8, 10, 16):
        mdp, demonstrations = grid_demonstrations(size, 50)
        yield from our_global(size, mdp, demonstrations, repeats=1)
        if size <= 10 and lp_peers.is_installed("highs_interior_point"):
            yield highs_global(size, mdp, demonstrations)


def section_global_large(quick: bool) -> list[dict]:
    """LP (8) on the 48 x 48 grid, demonstrations of 200 steps: a certified bracket after a few hundred iterations."""
    size = 4 if quick else 48
    return our_global(size, *grid_demonstrations(size, 200), repeats=0, max_iterations=500)


def our_global(size: int, mdp, demonstrations, repeats: int, **options) -> list[dict]:
    """One LP (8), cold and, if it is repeated, warm."""

    def describe(result):
        lower, upper = float(result.error_lower), float(result.error_upper)
        fields = sizes(mdp.num_states, int(result.visited.sum()), mdp.num_actions)
        fields |= judged(np.array(lower), np.array(upper), asked=GLOBAL_GAP)
        return fields | {"gap_asked": GLOBAL_GAP, "note": f"{size} x {size} grid, e in [{lower:.5f}, {upper:.5f}]"}

    def call():
        return jaxhom.soft_homomorphism(mdp, demonstrations, tolerance=GLOBAL_GAP, **options)

    return cold_and_warm("LP (8)", "jaxhom", 1, call, describe, repeats=repeats)


def highs_global(size: int, mdp, demonstrations) -> dict:
    """LP (8) by HiGHS's interior point, certified by us."""
    experts = np.unique(np.asarray(demonstrations.states)[np.asarray(demonstrations.mask)])
    restricted = restricted_model(mdp, experts)
    problem = GlobalHomomorphismProblem(
        mdp=mdp,
        target=jnp.asarray(restricted),
        pinned=jnp.zeros((mdp.num_states, len(experts)), bool),
        exists=jnp.ones(len(experts), bool),
        labels=None,
        target_labels=None,
    )
    pairs, settings = [(np.asarray(mdp.transition), restricted)], Settings(0.1 * GLOBAL_GAP, _TIGHT)
    fields = sizes(mdp.num_states, len(experts), mdp.num_actions) | {"gap_asked": GLOBAL_GAP}
    fields |= {"note": f"{size} x {size} grid, one process"}
    return peer_row("LP (8), cold", "highs_interior_point", pairs, settings, problem, 1, **fields)


# --------------------------------------------------------------------------------------------- floating-point peak


def section_peak(quick: bool) -> Iterator[dict]:
    """What a large product reaches, and the share of it that a PDHG iteration does."""
    size = 256 if quick else 2048
    for dtype in (np.float64, np.float32):
        matrix = jnp.asarray(np.random.default_rng(0).random((size, size)), dtype)
        product = jax.jit(lambda a: a @ a)
        _, _, seconds, compiling = clocked(functools.partial(product, matrix))
        peak = 2.0 * size**3 / seconds
        fields = compiling | {"dtype": np.dtype(dtype).name, "gflops": peak / 1e9, "gap_asked": None}
        yield row("peak", f"matrix product of {size}", 1, seconds, **fields)
        for n in (5,) if quick else SIZES:
            yield _iteration(n, dtype, peak)


def _iteration(n: int, dtype, peak: float, lanes: int = 64, calls: int = 20) -> dict:
    """One iteration of a batch of PDHG lanes, from calls of `pdhg.step`: enough of them for the clock."""
    problem = pair_problem(*random_pairs(n, lanes, dtype))
    state, step = pdhg.init(problem), jax.jit(pdhg.step)
    _, _, seconds, compiling = clocked(lambda: [step(problem, state).lower.block_until_ready() for _ in range(calls)])
    fields = sizes(n) | compiling | {"dtype": np.dtype(dtype).name}
    seconds /= calls * pdhg.STEPS_PER_CHECK
    flops = 4.0 * n * NUM_ACTIONS * n * (n + n) * lanes
    # Both models for K and for K^T; the iterate read, its anchor read, the next written.
    numbers = lanes * (2 * NUM_ACTIONS * 2 * n * n + 3 * (n * n + n * NUM_ACTIONS * n))
    fields |= {"gflops": flops / seconds / 1e9, "peak_fraction": flops / seconds / peak, "gap_asked": None}
    fields |= {"gbytes_per_s": numbers * np.dtype(dtype).itemsize / seconds / 1e9}
    return row("one PDHG iteration", "jaxhom pdhg", lanes, seconds, **fields)


SECTIONS = {
    name.removeprefix("section_"): function for name, function in list(globals().items()) if name.startswith("section_")
}


def section(name: str, quick: bool, methods: None, limit: None) -> Iterator[dict]:
    """All rows of a section."""
    del methods, limit
    yield from SECTIONS[name](quick)
