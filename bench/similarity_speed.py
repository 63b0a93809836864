"""Measures the similarity engine and its peers on the same instances, judged by the same certificate.

Each section runs in a process of its own (`python -m bench.similarity_speed SECTION`), which prints its rows as JSON:
so a first call there is cold, compilation included, and the number of XLA's host devices can be set per section. Every
time is the median of three calls after a first one that compiles; `compile_s` is what the first took beyond the second.
"""

import argparse
import statistics
import time
from collections.abc import Iterator

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jaxhom.similarity.homomorphism import ClassSimilarity  # noqa: E402

import jaxhom  # noqa: E402
from bench import peers  # noqa: E402
from bench.speed_rows import commit, print_row, versions  # noqa: E402
from jaxhom.generalization.global_lp import GlobalHomomorphismProblem  # noqa: E402
from jaxhom.similarity.brackets import bracket_errors  # noqa: E402
from jaxhom.similarity.homomorphism_lp import HomomorphismProblem  # noqa: E402
from jaxhom.similarity.local_models import local_model_classes, restricted_model  # noqa: E402
from jaxhom.solvers import pdhg  # noqa: E402

NUM_ACTIONS = 4
GAP = 1e-4
THRESHOLD = 0.05
GLOBAL_GAP = 1e-3
SIZES = (3, 5, 8, 13, 25)
OUR_PAIRS = {3: 2048, 5: 2048, 8: 512, 13: 128, 25: 32}
PEER_PAIRS = {  # larger ones take a peer minutes
    "highs_simplex": {3: 512, 5: 512, 8: 64, 13: 4},
    "mpax": {3: 64, 5: 64, 8: 32, 13: 8},
    "others": {3: 512, 5: 512, 8: 128, 13: 32, 25: 2},
}
MAX_PDHG_SIZE = 8  # tight brackets of larger random models take it a tenth of a second a pair, and more
OUR_COUNTS = (1, 8, 64, 512, 4096, 32768)
PEER_COUNTS = (1, 8, 64, 512)
_HIGHS_SECONDS = 300.0
_PACKAGES = ("jax", "highspy", "moreau", "mpax")

# --------------------------------------------------------------------------------------------------- rows and timing


def row(work: str, method: str, pairs: int, seconds: float | None = None, **fields) -> dict:
    """One row of the table; what is not given stays empty."""
    base = {"work": work, "method": method, "pairs": pairs, "device": jax.default_backend()}
    base |= {"devices": jax.device_count(), "processes": 1, "dtype": "float64", "gap_asked": GAP, "status": "measured"}
    if seconds is not None:
        base |= {"seconds": seconds, "ms_per_pair": 1e3 * seconds / max(pairs, 1)}
    return base | {"versions": versions(*_PACKAGES), "commit": commit()} | fields


def timed(call, repeats: int = 3):
    """(result, compile seconds, median seconds) of a call that returns when its answer is there."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return result, max(seconds[0] - seconds[1], 0.0), statistics.median(seconds[1:])


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


def feasible_map(f: np.ndarray) -> np.ndarray:
    """Clips a solver's map and makes its rows sum to 1; leading axes stay."""
    f = np.maximum(f, 0.0)
    return f / np.maximum(f.sum(axis=-1, keepdims=True), 1e-300)


def certify(source, target, f, y) -> tuple[np.ndarray, np.ndarray]:
    """Our bounds [P] of a peer's maps f [P, n, m] and multipliers y [P, n, A, m]."""
    problem = pair_problem(source, target)
    f = feasible_map(f)
    f[:, 0] = np.eye(f.shape[2])[0]
    f, y = jnp.moveaxis(jnp.asarray(f), 0, -1), jnp.moveaxis(jnp.asarray(y), 0, -1)
    lower, upper = problem.bounds(f, y, problem.forward(f), problem.adjoint(y))
    return np.asarray(lower), np.asarray(upper)


def judged(lower, upper, *, threshold: float | None = None) -> dict:
    """Worst gap, and the share of pairs that are settled."""
    gap = np.asarray(upper - lower)
    settled = gap <= GAP
    if threshold is not None:
        settled |= (lower > threshold) | (upper <= threshold + GAP)
    return {"gap_certified": float(gap.max()), "settled": float(settled.mean())}


# --------------------------------------------------------------------------------------------- random pairs, our side


def our_pairs(n: int, count: int, method: str, dtype=np.float64, threshold=None, work="brackets") -> dict:
    """Brackets or decisions of random pairs."""
    source, target = random_pairs(n, count, dtype)

    def call():
        return bracket_errors(source, target, tolerance=GAP, threshold=threshold, method=method)

    found, compile_s, seconds = timed(call)
    fields = {"n": n, "m": n, "actions": NUM_ACTIONS, "dtype": np.dtype(dtype).name, "compile_s": compile_s}
    fields |= judged(found.lower, found.upper, threshold=threshold)
    return row(work, f"jaxhom {method}", count, seconds, **fields)


def section_brackets(quick: bool) -> list[dict]:
    """Random pairs of every size, each method of ours."""
    rows = []
    for n in (3, 5) if quick else SIZES:
        count = 8 if quick else OUR_PAIRS[n]
        rows.append(our_pairs(n, count, "interior_point"))
        if n <= (3 if quick else MAX_PDHG_SIZE):
            rows += [our_pairs(n, count, "pdhg", dtype) for dtype in (np.float64, np.float32)]
    return rows


def section_counts(quick: bool) -> list[dict]:
    """Random pairs of five states, few and many."""
    rows = [our_pairs(5, count, "auto", work="counts") for count in ((8,) if quick else OUR_COUNTS)]
    for method in ("highs_simplex", "moreau"):
        rows += [peer_pairs(method, 5, count, "counts") for count in (() if quick else PEER_COUNTS)]
    return rows


def section_decisions(quick: bool) -> list[dict]:
    """e <= 0.05 for random pairs of five states."""
    count = 8 if quick else OUR_PAIRS[5]
    dtypes = (np.float64, np.float32)
    return [our_pairs(5, count, "auto", dtype, THRESHOLD, "decisions") for dtype in dtypes]


def section_gradients(quick: bool) -> list[dict]:
    """Value and both gradients of random pairs of five states."""
    count = 8 if quick else 512
    source, target = map(jnp.asarray, random_pairs(5, count))
    fields = {"n": 5, "m": 5, "actions": NUM_ACTIONS}
    ours = jax.jit(jax.vmap(jax.value_and_grad(jaxhom.homomorphism_error, argnums=(0, 1))))
    (value, _), compile_s, seconds = timed(lambda: ours(source, target))
    exact = bracket_errors(np.asarray(source), np.asarray(target), tolerance=1e-6)
    away = _distance(value, exact)
    fields |= {"gap_certified": away, "settled": 1.0, "compile_s": compile_s, "gap_asked": 1e-6}
    fields["note"] = "gap: distance of the value from a bracket of 1e-6"
    rows = [row("value and gradient", "jaxhom", count, seconds, **fields)]
    if quick:
        return rows
    return [*rows, _moreau_gradients(source, target, exact, fields)]


def _distance(value, exact) -> float:
    return float(np.maximum(np.maximum(exact.lower - value, value - exact.upper), 0.0).max())


def _moreau_gradients(source, target, exact, fields) -> dict:
    if not peers.is_installed("moreau"):
        return row("value and gradient", "moreau", len(source), status="not installed")
    call = peers.moreau_value_and_gradient(5, 5, NUM_ACTIONS, GAP)
    (value, _), compile_s, seconds = timed(lambda: call(source, target))
    fields = fields | {"gap_certified": _distance(value, exact), "compile_s": compile_s, "gap_asked": GAP}
    return row("value and gradient", "moreau", len(source), seconds, **fields)


# -------------------------------------------------------------------------------------------------------------- peers


def peer_pairs(method: str, n: int, count: int, work: str = "brackets") -> dict:
    """Brackets of random pairs by a peer, certified by us."""
    fields = {"n": n, "m": n, "actions": NUM_ACTIONS, "device": "cpu"}
    if not peers.is_installed(method):
        return row(work, method, 0, **fields, status="not installed")
    source, target = random_pairs(n, count)
    try:
        answer = peers.solve_pairs(method, source, target, GAP)
    except Exception as error:  # a peer that fails is a row, not the end of the benchmark
        return row(work, method, count, **fields, status="failed", note=f"{type(error).__name__}: {error}")
    fields |= {"processes": answer.processes, "compile_s": answer.compile_s, "build_s": answer.build_s}
    fields |= judged(*certify(source, target, answer.f, answer.y))
    return row(work, method, count, answer.seconds, **fields)


def section_peers(quick: bool) -> Iterator[dict]:
    """Random pairs of every size, each peer."""
    for n in (3, 5) if quick else SIZES:
        for method in peers.MODULES:
            count = PEER_PAIRS.get(method, PEER_PAIRS["others"]).get(n)
            if count and (method.startswith("highs") or not quick):
                yield peer_pairs(method, n, 8 if quick else count)


# ------------------------------------------------------------------------------------------------------ whole problems


def cold_and_warm(work: str, method: str, pairs: int, call, describe, repeats: int = 3) -> list[dict]:
    """Rows of the first call in this process and, if it is repeated, of the median of the next."""
    start = time.perf_counter()
    result = jax.block_until_ready(call())
    cold = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    fields = describe(result) | ({"compile_s": max(cold - seconds[0], 0.0)} if seconds else {})
    rows = [row(f"{work}, cold", method, pairs, cold, **fields)]
    if seconds:
        rows.append(row(f"{work}, warm", method, pairs, statistics.median(seconds), **fields))
    return rows


def section_racetrack(quick: bool) -> list[dict]:
    """All ordered pairs of states of the racetrack: classes, brackets of their pairs, expansion by label."""
    mdp = jaxhom.racetrack("a").mdp

    def call():
        classes = local_model_classes(mdp)
        number = len(classes.representative)
        similarity = ClassSimilarity(mdp, classes, 1, True, GAP, None)
        pairs = np.stack(np.meshgrid(np.arange(number), np.arange(number), indexing="ij"), -1).reshape(-1, 2)
        found = similarity.solve(pairs)
        table = (bound.reshape(number, number) for bound in (found.lower, found.upper))
        index = np.ix_(classes.label, classes.label)
        return tuple(bounds[index] for bounds in table), number

    def describe(result):
        (lower, upper), number = result
        return judged(lower, upper) | {"actions": mdp.num_actions, "note": f"{number} classes"}

    return cold_and_warm("racetrack, all pairs", "jaxhom auto", mdp.num_states**2, call, describe)


def section_algorithm1(quick: bool) -> list[dict]:
    """Algorithm 1 on the racetrack with ten demonstrations."""
    track = jaxhom.racetrack("a")
    weights = jnp.asarray([5.0, 200.0])
    policy = jaxhom.optimal_policy(track.mdp, track.mdp.features @ weights).policy
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


def section_global(quick: bool) -> list[dict]:
    """LP (8): ours on the 16 x 16 grid and on the grids that HiGHS takes too."""
    rows = []
    for size in (4,) if quick else (6, 8, 10, 16):
        mdp, demonstrations = grid_demonstrations(size, 50)
        rows += our_global(size, mdp, demonstrations, repeats=1)
        if size <= 10 and peers.is_installed("highs_interior_point"):
            rows.append(highs_global(size, mdp, demonstrations))
    return rows


def section_global_large(quick: bool) -> list[dict]:
    """LP (8) on the 48 x 48 grid, demonstrations of 200 steps: a certified bracket after a few hundred iterations."""
    size = 4 if quick else 48
    return our_global(size, *grid_demonstrations(size, 200), repeats=0, max_iterations=500)


def our_global(size: int, mdp, demonstrations, repeats: int, **options) -> list[dict]:
    """One LP (8), cold and, if it is repeated, warm."""

    def describe(result):
        lower, upper = float(result.error_lower), float(result.error_upper)
        certified = {"gap_certified": upper - lower, "settled": float(upper - lower <= GLOBAL_GAP)}
        note = f"{size} x {size} grid, e in [{lower:.5f}, {upper:.5f}]"
        sizes = {"n": mdp.num_states, "m": int(result.visited.sum()), "actions": mdp.num_actions}
        return sizes | certified | {"gap_asked": GLOBAL_GAP, "note": note}

    def call():
        return jaxhom.soft_homomorphism(mdp, demonstrations, tolerance=GLOBAL_GAP, **options)

    return cold_and_warm("LP (8)", "jaxhom", 1, call, describe, repeats=repeats)


def highs_global(size: int, mdp, demonstrations) -> dict:
    """LP (8) by HiGHS's interior point, certified by us."""
    import highspy

    start = time.perf_counter()
    experts = np.unique(np.asarray(demonstrations.states)[np.asarray(demonstrations.mask)])
    problem = GlobalHomomorphismProblem(
        mdp=mdp,
        restricted=jnp.asarray(restricted_model(mdp, experts)),
        pinned=jnp.zeros((mdp.num_states, len(experts)), bool),
    )
    matrix, num_equalities = _global_matrix(mdp, np.asarray(problem.restricted))
    lp = peers.highs_model(matrix.indptr, matrix.indices, matrix.data, num_equalities, np.full(matrix.shape[1], np.inf))
    build = time.perf_counter() - start
    solver = highspy.Highs()
    solver.passOptions(peers.highs_options("highs_interior_point", GLOBAL_GAP, _HIGHS_SECONDS))
    x, multipliers = peers.run_highs(solver, lp, num_equalities)
    seconds = time.perf_counter() - start
    fields = {"n": mdp.num_states, "m": len(experts), "actions": mdp.num_actions, "gap_asked": GLOBAL_GAP}
    fields |= {"build_s": build, "note": f"{size} x {size} grid, one process", "device": "cpu"}
    fields["note"] += f", {solver.modelStatusToString(solver.getModelStatus())}"
    if len(x) != matrix.shape[1] or len(multipliers) != len(matrix.indptr) - 1 - num_equalities:
        return row("LP (8), cold", "highs_interior_point", 1, seconds, **fields, status="failed")
    f = jnp.asarray(feasible_map(x[:-1].reshape(mdp.num_states, -1)))[..., None]
    plus, minus = np.split(multipliers, 2)
    y = jnp.asarray((plus - minus).reshape(mdp.num_states, mdp.num_actions, -1))[..., None]
    lower, upper = problem.bounds(f, y, problem.forward(f), problem.adjoint(y))
    gap = float(upper[0] - lower[0])
    fields |= {"gap_certified": gap, "settled": float(gap <= GLOBAL_GAP)}
    return row("LP (8), cold", "highs_interior_point", 1, seconds, **fields)


def _global_matrix(mdp, restricted: np.ndarray):
    """CSR constraints of LP (8): rows of f sum to 1, then K f - e, then -K f - e."""
    import scipy.sparse as sparse

    num_states, num_experts = mdp.num_states, len(restricted)
    states, actions, _ = np.indices(mdp.next_state.shape)
    entries = (
        np.asarray(mdp.probability).ravel(),
        ((states * mdp.num_actions + actions).ravel(), np.asarray(mdp.next_state).ravel()),
    )
    transition = sparse.csr_array(entries, shape=(num_states * mdp.num_actions, num_states))
    transition.eliminate_zeros()
    mapped = sparse.csr_array(restricted.transpose(1, 2, 0).reshape(-1, num_experts))
    product = sparse.kron(transition, sparse.eye_array(num_experts)) - sparse.kron(sparse.eye_array(num_states), mapped)
    rows = sparse.kron(sparse.eye_array(num_states), np.ones((1, num_experts)))
    error = sparse.csr_array(-np.ones((product.shape[0], 1)))
    blocks = [[rows, sparse.csr_array((num_states, 1))], [product, error], [-product, error]]
    return sparse.csr_array(sparse.block_array(blocks)), num_states


# --------------------------------------------------------------------------------------------- floating-point peak


def section_peak(quick: bool) -> list[dict]:
    """What a large product reaches, and the share of it that a PDHG iteration does."""
    rows = []
    size = 256 if quick else 2048
    for dtype in (np.float64, np.float32):
        matrix = jnp.asarray(np.random.default_rng(0).random((size, size)), dtype)
        product = jax.jit(lambda a: a @ a)
        _, compile_s, seconds = timed(lambda matrix=matrix, product=product: product(matrix))
        peak = 2.0 * size**3 / seconds
        fields = {"dtype": np.dtype(dtype).name, "compile_s": compile_s, "gflops": peak / 1e9, "gap_asked": None}
        rows.append(row("peak", f"matrix product of {size}", 1, seconds, **fields))
        rows += [_iteration(n, dtype, peak) for n in ((5,) if quick else SIZES)]
    return rows


def _iteration(n: int, dtype, peak: float, lanes: int = 64) -> dict:
    """One iteration of a batch of PDHG lanes, from a call of `pdhg.step`."""
    problem = pair_problem(*random_pairs(n, lanes, dtype))
    state = pdhg.init(problem)
    step = jax.jit(pdhg.step)
    _, compile_s, seconds = timed(lambda: [step(problem, state).lower.block_until_ready() for _ in range(20)])
    seconds /= 20 * pdhg.STEPS_PER_CHECK
    flops = 4.0 * n * NUM_ACTIONS * n * (n + n) * lanes
    # Both models for K and for K^T; the iterate read, its anchor read, the next written.
    numbers = lanes * (2 * NUM_ACTIONS * 2 * n * n + 3 * (n * n + n * NUM_ACTIONS * n))
    fields = {"n": n, "m": n, "actions": NUM_ACTIONS, "dtype": np.dtype(dtype).name, "compile_s": compile_s}
    fields |= {"gflops": flops / seconds / 1e9, "peak_fraction": flops / seconds / peak, "gap_asked": None}
    fields |= {"gbytes_per_s": numbers * np.dtype(dtype).itemsize / seconds / 1e9}
    return row("one PDHG iteration", "jaxhom pdhg", lanes, seconds, **fields)


SECTIONS = {
    name.removeprefix("section_"): function for name, function in list(globals().items()) if name.startswith("section_")
}


def main() -> None:
    """Prints the rows of one section as JSON lines, the last lines of the output."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("section", choices=sorted(SECTIONS))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for found in SECTIONS[arguments.section](arguments.quick):
        print_row(found)


if __name__ == "__main__":
    main()
