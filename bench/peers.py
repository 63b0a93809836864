"""Other solvers on the same linear programs: HiGHS, Moreau and MPAX.

Each gets LP (9) in its standard form, x = (f, e): minimise e subject to E f = 1, K f <= e, -K f <= e, f >= 0, the row
of the centre fixed by bounds. The multipliers of the two blocks of inequalities give y = y+ - y-, the dual point of
`jaxhom.similarity.homomorphism_lp`, so that one certificate judges every solver. Solvers that run on one core share the
pairs between two spawned processes; `seconds` is what the slower of them spent on building and solving, without the
transfer.
"""

import dataclasses
import functools
import importlib.util
import multiprocessing
import os
import time

import numpy as np

MODULES = {
    "highs_simplex": "highspy",
    "highs_interior_point": "highspy",
    "moreau": "moreau",
    "mpax": "mpax",
}
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "RAYON_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclasses.dataclass(frozen=True)
class PeerAnswer:
    """Answers for P pairs: f [P, n, m], y [P, n, A, m], and what they cost in seconds."""

    f: np.ndarray
    y: np.ndarray
    compile_s: float
    build_s: float
    seconds: float
    processes: int


def is_installed(method: str) -> bool:
    """Whether the module behind a method can be imported."""
    return importlib.util.find_spec(MODULES[method]) is not None


@dataclasses.dataclass(frozen=True)
class PairTemplate:
    """The sparsity of the constraints of all pairs of one shape, as CSR: n equalities, then K f - e, then -K f - e."""

    n: int
    m: int
    num_actions: int
    indptr: np.ndarray
    indices: np.ndarray
    slot: np.ndarray  # where each entry of K goes in its block; entries that meet are added

    @classmethod
    def make(cls, n: int, m: int, num_actions: int) -> "PairTemplate":
        """Row (i, a, k) of K has T(i, a, j) at (j, k) and -T'(l, a, k) at (i, l)."""
        i, a, k, j = np.ix_(*map(np.arange, (n, num_actions, m, n)))
        row_1, column_1 = np.broadcast_arrays((i * num_actions + a) * m + k, j * m + k)
        i, a, k, j = np.ix_(*map(np.arange, (n, num_actions, m, m)))
        row_2, column_2 = np.broadcast_arrays((i * num_actions + a) * m + k, i * m + j)
        rows = np.concatenate([row_1.ravel(), row_2.ravel()])
        columns = np.concatenate([column_1.ravel(), column_2.ravel()])
        width = n * m + 1
        num_rows = n * num_actions * m
        error = np.arange(num_rows) * width + n * m  # the column of e
        places, slot = np.unique(np.concatenate([rows * width + columns, error]), return_inverse=True)
        counts = np.bincount(places // width, minlength=num_rows)
        block = places % width
        indptr = np.concatenate([[0], np.cumsum(np.concatenate([np.full(n, m), counts, counts]))])
        indices = np.concatenate([np.arange(n * m), block, block])
        return cls(n, m, num_actions, indptr.astype(np.int32), indices.astype(np.int32), slot)

    def values(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The CSR values of one pair, [n, A, n] and [m, A, m]."""
        shape = (self.n, self.num_actions, self.m)
        moved = np.broadcast_to(source[:, :, None, :], (*shape, self.n))
        mapped = np.broadcast_to(-target.transpose(1, 2, 0), (*shape, self.m))
        product = np.concatenate([moved.ravel(), mapped.ravel()])
        ones = -np.ones(self.n * self.num_actions * self.m)
        zeros = np.zeros(len(product))
        plus = np.bincount(self.slot, np.concatenate([product, ones]))
        error = np.bincount(self.slot, np.concatenate([zeros, ones]))
        return np.concatenate([np.ones(self.n * self.m), plus, 2.0 * error - plus])

    def upper_bounds(self, anchored: bool = True) -> np.ndarray:
        """Of x: infinite, and 0 where the centre must not go."""
        upper = np.full(self.n * self.m + 1, np.inf)
        if anchored:
            upper[1 : self.m] = 0.0
        return upper

    def split(self, x: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f and y from x and the non-negative multipliers of the inequalities; leading axes stay."""
        plus, minus = np.split(multipliers, 2, axis=-1)
        f = x[..., :-1].reshape(*x.shape[:-1], self.n, self.m)
        return f, (plus - minus).reshape(*x.shape[:-1], self.n, self.num_actions, self.m)


# ------------------------------------------------------------------------------------------------------------- HiGHS


def highs_options(method: str, gap: float, time_limit: float = np.inf):
    """HiGHS's best settings here: dual simplex without presolve; interior point without crossover."""
    import highspy

    options = highspy.HighsOptions()
    options.output_flag = False
    options.threads = 1
    options.time_limit = time_limit
    if method == "highs_simplex":
        options.solver, options.presolve = "simplex", "off"
    else:
        options.solver, options.run_crossover = "ipm", "off"
        options.ipm_optimality_tolerance = 0.1 * gap
    return options


def highs_model(indptr, indices, values, num_equalities: int, upper: np.ndarray):
    """Minimise the last variable: the first rows equal 1, the others are at most 0."""
    import highspy

    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = len(upper), len(indptr) - 1
    cost, row_lower, row_upper = np.zeros(len(upper)), np.full(len(indptr) - 1, -np.inf), np.zeros(len(indptr) - 1)
    cost[-1] = row_lower[:num_equalities] = row_upper[:num_equalities] = 1.0
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = cost, np.zeros(len(upper)), upper
    lp.row_lower_, lp.row_upper_ = row_lower, row_upper
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = indptr, indices, values
    return lp


def run_highs(solver, lp, num_equalities: int) -> tuple[np.ndarray, np.ndarray]:
    """x and the multipliers of the inequalities (HiGHS's row duals with their sign turned)."""
    solver.passModel(lp)
    solver.run()
    solution = solver.getSolution()
    return np.asarray(solution.col_value), -np.asarray(solution.row_dual)[num_equalities:]


def _highs_pairs(method, sources, targets, gap):
    import highspy

    template = PairTemplate.make(sources.shape[1], targets.shape[1], sources.shape[2])
    solver = highspy.Highs()
    solver.passOptions(highs_options(method, gap))
    build, total, answers = 0.0, time.perf_counter(), []
    for source, target in zip(sources, targets, strict=True):
        start = time.perf_counter()
        values = template.values(source, target)
        lp = highs_model(template.indptr, template.indices, values, template.n, template.upper_bounds())
        build += time.perf_counter() - start
        answers.append(run_highs(solver, lp, template.n))
    total = time.perf_counter() - total
    x, multipliers = map(np.stack, zip(*answers, strict=True))
    return (*template.split(x, multipliers), build, total)


# ------------------------------------------------------------------------------------------------------------ Moreau


class MoreauForm:
    """Moreau's form A x + s = b, with f >= 0 and the fixed entries of the centre's row among its rows."""

    def __init__(self, template: PairTemplate):
        size = template.n * template.m + 1
        self.template, self.size = template, size
        fixed = np.arange(1, template.m)  # entries of f that must be zero
        self.num_zero = len(fixed) + template.n
        single = np.concatenate([np.ones(len(fixed), np.int32), np.diff(template.indptr), np.ones(size - 1, np.int32)])
        self.indptr = np.concatenate([[0], np.cumsum(single)]).astype(np.int64)
        self.indices = np.concatenate([fixed, template.indices, np.arange(size - 1)]).astype(np.int64)
        self.fixed, self.num_rows = len(fixed), len(single)
        self.b = np.zeros(self.num_rows)
        self.b[self.fixed : self.num_zero] = 1.0
        self.q = np.zeros(size)
        self.q[-1] = 1.0

    def values(self, source, target) -> np.ndarray:
        """CSR values of A."""
        return np.concatenate([np.ones(self.fixed), self.template.values(source, target), -np.ones(self.size - 1)])

    def multipliers(self, z: np.ndarray) -> np.ndarray:
        """Those of K f <= e and -K f <= e."""
        return z[..., self.num_zero : self.num_rows - self.size + 1]

    def arguments(self, settings) -> dict:
        """Constructor arguments that Moreau's solvers share."""
        import moreau

        cones = moreau.Cones(num_zero_cones=self.num_zero, num_nonneg_cones=self.num_rows - self.num_zero)
        return {
            "n": self.size,
            "m": self.num_rows,
            "P_row_offsets": np.zeros(self.size + 1, np.int64),
            "P_col_indices": np.zeros(0, np.int64),
            "A_row_offsets": self.indptr,
            "A_col_indices": self.indices,
            "cones": cones,
            "settings": settings,
        }


def moreau_settings(gap: float, **options):
    """CPU, tolerances a tenth of the gap."""
    import moreau

    tolerance = 0.1 * gap
    inner = moreau.IPMSettings(tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance)
    return moreau.Settings(device="cpu", solver="ipm", ipm_settings=inner, **options)


def _moreau_pairs(method, sources, targets, gap):
    import moreau

    form = MoreauForm(PairTemplate.make(sources.shape[1], targets.shape[1], sources.shape[2]))
    count, start = len(sources), time.perf_counter()
    solver = moreau.CompiledSolver(**form.arguments(moreau_settings(gap, batch_size=count)))
    values = np.stack([form.values(*pair) for pair in zip(sources, targets, strict=True)])
    solver.setup(np.zeros((count, 0)), values)
    build = time.perf_counter() - start
    found = solver.solve(np.tile(form.q, (count, 1)), np.tile(form.b, (count, 1)))
    total = time.perf_counter() - start
    return (*form.template.split(np.asarray(found.x), form.multipliers(np.asarray(found.z))), build, total)


def moreau_value_and_gradient(n: int, m: int, num_actions: int, gap: float):
    """A function of batches of pairs: values and gradients, by `jax.vmap(jax.value_and_grad(...))`."""
    import jax
    import jax.numpy as jnp
    from moreau.jax import Solver

    template = PairTemplate.make(n, m, num_actions)
    form = MoreauForm(template)
    solver = Solver(**form.arguments(moreau_settings(gap, enable_grad=True)))
    constant = form.values(np.zeros((n, num_actions, n)), np.zeros((m, num_actions, m)))
    first = form.fixed + n * m
    block = (len(constant) - first - n * m) // 2

    def value(source, target):
        moved = jnp.broadcast_to(source[:, :, None, :], (n, num_actions, m, n))
        mapped = jnp.broadcast_to(-target.transpose(1, 2, 0), (n, num_actions, m, m))
        product = jnp.concatenate([moved.ravel(), mapped.ravel()])
        slot = template.slot[: product.size]
        values = jnp.asarray(constant).at[first + slot].add(product).at[first + block + slot].add(-product)
        return solver.solve(jnp.zeros(0), values, jnp.asarray(form.q), jnp.asarray(form.b)).x[-1]

    return jax.jit(jax.vmap(jax.value_and_grad(value, argnums=(0, 1))))


# -------------------------------------------------------------------------------------------------------------- MPAX


@functools.cache
def _mpax_solver(n: int, m: int, num_actions: int, gap: float):
    import jax
    import jax.numpy as jnp
    from mpax import create_lp, r2HPDHG

    template = PairTemplate.make(n, m, num_actions)
    size, num_rows = n * m + 1, n * num_actions * m
    rows = np.repeat(np.arange(len(template.indptr) - 1), np.diff(template.indptr))
    upper = jnp.asarray(template.upper_bounds())
    cost = jnp.zeros(size).at[-1].set(1.0)
    solver = r2HPDHG(eps_abs=gap, eps_rel=gap, verbose=False)

    def solve(values):
        matrix = jnp.zeros((n + 2 * num_rows, size)).at[rows, template.indices].set(values)
        # MPAX has G x >= h.
        lp = create_lp(
            cost, matrix[:n], jnp.ones(n), -matrix[n:], jnp.zeros(2 * num_rows), jnp.zeros(size), upper, False
        )
        found = solver.optimize(lp)
        return found.primal_solution, found.dual_solution[n:]

    return template, jax.jit(jax.vmap(solve))


def _mpax_pairs(method, sources, targets, gap):
    start = time.perf_counter()
    template, solve = _mpax_solver(sources.shape[1], targets.shape[1], sources.shape[2], 0.1 * gap)
    values = np.stack([template.values(*pair) for pair in zip(sources, targets, strict=True)])
    build = time.perf_counter() - start
    x, multipliers = map(np.asarray, solve(values))
    return (*template.split(x, multipliers), build, time.perf_counter() - start)


# --------------------------------------------------------------------------------------------------------- processes

_SOLVERS = {
    "highs_simplex": _highs_pairs,
    "highs_interior_point": _highs_pairs,
    "moreau": _moreau_pairs,
    "mpax": _mpax_pairs,
}


def _worker(task):
    method, *arguments = task
    return _SOLVERS[method](method, *arguments)


def solve_pairs(method: str, sources, targets, gap: float, *, processes: int = 2, repeats: int = 3) -> PeerAnswer:
    """Solves P pairs, [P, n, A, n] and [P, m, A, m], in `processes` workers (MPAX: in this one, on all cores).

    The median of `repeats` runs after one that warms up; `compile_s` is what the first took beyond the next.
    """
    if method == "mpax":
        runs = [[_worker((method, sources, targets, gap))] for _ in range(repeats + 1)]
        processes = 1
    else:
        shares = np.array_split(np.arange(len(sources)), min(processes, len(sources)))
        tasks = [(method, sources[share], targets[share], gap) for share in shares]
        processes = len(tasks)
        with _single_threaded_pool(processes) as pool:
            runs = [pool.map(_worker, tasks, chunksize=1) for _ in range(repeats + 1)]
    seconds = [max(part[3] for part in run) for run in runs]
    middle = 1 + int(np.argsort(seconds[1:])[(len(runs) - 2) // 2])
    f, y = (np.concatenate([part[k] for part in runs[middle]]) for k in (0, 1))
    build = max(part[2] for part in runs[middle])
    return PeerAnswer(f, y, max(seconds[0] - seconds[1], 0.0), build, seconds[middle], processes)


def _single_threaded_pool(processes: int):
    """Spawned workers whose numerical libraries use one thread each."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        return multiprocessing.get_context("spawn").Pool(processes)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
