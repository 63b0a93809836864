"""LPAL by other solvers: Moreau, Clarabel, HiGHS, GLOP and PDLP of OR-tools, MPAX. Each with the best of its
`CANDIDATES`.

A solver is opened once per model and asked for one expectation vector after another; Moreau also takes a batch of them.
It runs in a process of its own (`bench.limits`), in which every solver but MPAX never imports JAX. Answers are (x, w):
occupancies, and weights of the features (see `bench.lpal_program`); whether they are any good is for the certificate in
`bench.lpal_certificate` to say.
"""

import dataclasses
import importlib.util
import time

import numpy as np
import scipy.sparse

from bench.lpal_program import ConicProgram, Model, Program


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a peer is run.

    Attributes:
      form: "primal" or "dual", the program that it is given.
      shares: x sums to 1 instead of to 1 / (1 - discount).
      tolerance: the first of those that are tried, each a tenth of the one before.
      options: of the solver, by its own names.
    """

    form: str
    shares: bool
    tolerance: float
    options: dict = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        unit = "shares" if self.shares else "sums"
        options = "".join(f", {name} {value}" for name, value in self.options.items())
        return f"{self.form} in {unit}, tolerance {self.tolerance:g}{options}"


MODULES = {
    "moreau": "moreau",
    "clarabel": "clarabel",
    "highs_simplex": "highspy",
    "highs_interior_point": "highspy",
    "highs_pdlp": "highspy",
    "glop": "ortools",
    "ortools_pdlp": "ortools",
    "mpax": "mpax",
}
_PRIMAL_SIMPLEX = {"simplex_strategy": 4, "presolve": "off"}
_DUAL_SIMPLEX = {"use_dual_simplex": "true"}
CANDIDATES = {  # the fastest on one instance or another; the best of them is taken on each
    "moreau": (Settings("dual", False, 1e-6), Settings("primal", False, 1e-5)),
    "clarabel": (Settings("dual", False, 1e-6), Settings("primal", False, 1e-5)),
    "highs_simplex": (
        Settings("dual", True, 1e-7, _PRIMAL_SIMPLEX | {"simplex_scale_strategy": 0}),
        Settings("dual", True, 1e-7, _PRIMAL_SIMPLEX),
        Settings("primal", True, 1e-7),
    ),
    "highs_interior_point": (
        Settings("dual", True, 1e-5, {"presolve": "off"}),
        Settings("dual", False, 1e-6, {"presolve": "off"}),
    ),
    "highs_pdlp": (Settings("dual", False, 1e-5),),
    "glop": (
        Settings("dual", True, 1e-7, _DUAL_SIMPLEX),
        Settings("dual", True, 1e-7, _DUAL_SIMPLEX | {"use_preprocessing": "false"}),
        Settings("primal", False, 1e-7),
    ),
    "ortools_pdlp": (Settings("dual", True, 1e-5),),
    "mpax": (Settings("primal", True, 1e-5),),
}
USES_BOTH_CORES = ("mpax",)  # alone: other peers' batches are shared between two processes
LEAST_TOLERANCE = 1e-10
_MIN_HIGHS_TOLERANCE = 1e-10
_SHARE_OF_WARM_UP = 0.1  # of the time limit, that a first solve may take to count as a warm-up


def is_installed(method: str) -> bool:
    """Whether the module behind a method can be imported."""
    return importlib.util.find_spec(MODULES[method]) is not None


# ------------------------------------------------------------------------------------------------------------ solvers


class Highs:
    """HiGHS: simplex, interior point with a crossover only where it gets stuck, or PDLP."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int):
        import highspy

        self._program, self._solver, self.is_hot = program, highspy.Highs(), False
        options = highspy.HighsOptions()
        options.output_flag, options.threads = False, threads
        tolerance = max(settings.tolerance, _MIN_HIGHS_TOLERANCE)
        options.primal_feasibility_tolerance = options.dual_feasibility_tolerance = tolerance
        if method == "highs_simplex":
            options.solver = "simplex"
        elif method == "highs_interior_point":
            options.solver, options.run_crossover, options.ipm_optimality_tolerance = "ipm", "choose", tolerance
        else:
            options.solver, options.pdlp_optimality_tolerance = "pdlp", tolerance
        for name, value in settings.options.items():
            setattr(options, name, value)
        self._solver.passOptions(options)
        self._solver.passModel(self._model(program.base))

    @staticmethod
    def _model(base):
        import highspy

        lp = highspy.HighsLp()
        lp.num_row_, lp.num_col_ = base.matrix.shape
        lp.col_cost_, lp.col_lower_, lp.col_upper_ = base.cost, base.lower, np.full(len(base.cost), np.inf)
        lp.row_lower_, lp.row_upper_ = base.row_lower, base.row_upper
        lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        lp.a_matrix_.start_, lp.a_matrix_.index_ = base.matrix.indptr, base.matrix.indices
        lp.a_matrix_.value_ = base.matrix.data
        return lp

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and HiGHS's own word for how it ended."""
        lp, solver = self._program.given(expectations), self._solver
        rows, columns = (np.arange(n, dtype=np.int32) for n in lp.matrix.shape)
        if self._program.form == "primal":
            solver.changeRowsBounds(len(rows), rows, lp.row_lower, lp.row_upper)
        else:
            solver.changeColsCost(len(columns), columns, lp.cost)
        if not self.is_hot:
            solver.clearSolver()
        solver.setOptionValue("time_limit", solver.getRunTime() + limit)
        solver.run()
        found = solver.getSolution()
        status = solver.modelStatusToString(solver.getModelStatus())
        return *self._program.read(np.asarray(found.col_value), np.asarray(found.row_dual)), status


class Glop:
    """OR-tools' simplex code, on one thread."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int):
        from ortools.linear_solver.python import model_builder_helper

        del method, threads
        base = program.base
        self._program, self._helper = program, model_builder_helper.ModelBuilderHelper()
        upper = np.full(len(base.cost), np.inf)
        bounds = (base.row_lower, base.row_upper)
        self._helper.fill_model_from_sparse_data(
            base.lower, upper, base.cost, *bounds, scipy.sparse.csr_matrix(base.matrix)
        )
        self._solver = model_builder_helper.ModelSolverHelper("glop")
        tolerance = settings.tolerance
        options = {"primal_feasibility_tolerance": tolerance, "dual_feasibility_tolerance": tolerance}
        text = " ".join(f"{name}: {value}" for name, value in (options | settings.options).items())
        self._solver.set_solver_specific_parameters(text)

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and a status."""
        program, solver, num_features = self._program, self._solver, len(expectations)
        lp = program.given(expectations)
        rows, columns = lp.matrix.shape
        for k in range(1, num_features + 1):
            if program.form == "primal":
                self._helper.set_constraint_lower_bound(rows - k, float(lp.row_lower[-k]))
            else:
                self._helper.set_var_objective_coefficient(columns - k, float(lp.cost[-k]))
        solver.set_time_limit_in_seconds(limit)
        solver.solve(self._helper)
        if not solver.has_solution():
            return None, None, str(solver.status())
        point = (np.asarray(solver.variable_values()), np.asarray(solver.dual_values()))
        return *program.read(*point), str(solver.status())


class OrtoolsPdlp:
    """OR-tools' PDLP."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int):
        from google.protobuf import text_format
        from ortools.pdlp import solvers_pb2
        from ortools.pdlp.python import pdlp

        del method
        self._pdlp, self._program, self._qp = pdlp, program, pdlp.QuadraticProgram()
        base = program.base
        self._qp.objective_vector, self._qp.constraint_matrix = base.cost, scipy.sparse.csc_matrix(base.matrix)
        self._qp.variable_lower_bounds, self._qp.variable_upper_bounds = base.lower, np.full(len(base.cost), np.inf)
        self._qp.constraint_lower_bounds, self._qp.constraint_upper_bounds = base.row_lower, base.row_upper
        self._parameters = solvers_pb2.PrimalDualHybridGradientParams(num_threads=threads)
        criteria = self._parameters.termination_criteria.simple_optimality_criteria
        criteria.eps_optimal_absolute = criteria.eps_optimal_relative = settings.tolerance
        text_format.Merge(" ".join(f"{name}: {value}" for name, value in settings.options.items()), self._parameters)

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and a status."""
        lp = self._program.given(expectations)
        self._qp.objective_vector, self._qp.constraint_lower_bounds = lp.cost, lp.row_lower
        self._parameters.termination_criteria.time_sec_limit = limit
        found = self._pdlp.primal_dual_hybrid_gradient(self._qp, self._parameters)
        status = str(found.solve_log.termination_reason)
        return *self._program.read(np.asarray(found.primal_solution), np.asarray(found.dual_solution)), status


class Clarabel:
    """Clarabel."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int):
        import clarabel

        del method
        self._conic, self._settings = ConicProgram.of(program), clarabel.DefaultSettings()
        self._settings.verbose, self._settings.max_threads = False, threads
        for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
            setattr(self._settings, name, settings.tolerance)
        for name, value in settings.options.items():
            setattr(self._settings, name, value)
        num_rows, num_columns = self._conic.matrix.shape
        self._matrix = scipy.sparse.csc_matrix(self._conic.matrix)
        self._quadratic = scipy.sparse.csc_matrix((num_columns, num_columns))
        self._cones = [
            clarabel.ZeroConeT(self._conic.num_zero),
            clarabel.NonnegativeConeT(num_rows - self._conic.num_zero),
        ]
        self._solver = None

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and a status; the analysis of the matrix is kept from one call to the next."""
        import clarabel

        q, b = self._conic.given(expectations)
        self._settings.time_limit = limit
        if self._solver is None:
            data = (self._quadratic, q, self._matrix, b, self._cones)
            self._solver = clarabel.DefaultSolver(*data, self._settings)
        else:
            self._solver.update(q=q, b=b, settings=self._settings)
        found = self._solver.solve()
        return *self._conic.read(np.asarray(found.x), np.asarray(found.z)), str(found.status)


class Moreau:
    """Moreau's compiled solver, for one expectation vector or a batch."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int, lanes: int = 1):
        import moreau

        del method, threads
        self._conic = ConicProgram.of(program)
        matrix, tolerance = self._conic.matrix, settings.tolerance
        options = dict(settings.options)
        inner = {"tol_gap_abs": tolerance, "tol_gap_rel": tolerance, "tol_feas": tolerance} | options
        self._make = lambda limit: moreau.CompiledSolver(
            n=matrix.shape[1],
            m=matrix.shape[0],
            P_row_offsets=np.zeros(matrix.shape[1] + 1, np.int64),
            P_col_indices=np.zeros(0, np.int64),
            A_row_offsets=matrix.indptr.astype(np.int64),
            A_col_indices=matrix.indices.astype(np.int64),
            cones=moreau.Cones(
                num_zero_cones=self._conic.num_zero,
                num_nonneg_cones=matrix.shape[0] - self._conic.num_zero,
            ),
            settings=moreau.Settings(
                device="cpu",
                solver="ipm",
                batch_size=lanes,
                time_limit=limit,
                ipm_settings=moreau.IPMSettings(**inner),
            ),
        )
        self._solver = None

    def prepare(self, limit: float) -> None:
        """The compiled solver, its time limit fixed."""
        self._solver = self._make(limit)
        self._solver.setup(np.zeros(0), self._conic.matrix.data)

    def solve_batch(self, expectations: np.ndarray, limit: float):
        """x, w and statuses of a batch [B, K]."""
        if self._solver is None:
            self.prepare(limit)
        q, b = map(np.stack, zip(*map(self._conic.given, expectations), strict=True))
        found = self._solver.solve(q, b)
        status = [str(getattr(s, "name", s)) for s in np.atleast_1d(self._solver.info.status)]
        pairs = zip(np.asarray(found.x), np.asarray(found.z), status, strict=True)
        return [(*self._conic.read(x, z), word) for x, z, word in pairs]

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and a status."""
        return self.solve_batch(expectations[None], limit)[0]


class Mpax:
    """MPAX, on all of XLA's threads: its restarted, average-free or averaged PDHG, compiled once."""

    def __init__(self, method: str, program: Program, settings: Settings, threads: int):
        import jax

        jax.config.update("jax_enable_x64", True)
        import mpax
        from jax.experimental import sparse as jax_sparse

        del method, threads
        options = {"algorithm": "r2HPDHG", "sparse": True} | settings.options
        is_sparse, algorithm = options.pop("sparse"), getattr(mpax, options.pop("algorithm"))
        base = program.base
        is_equation = base.row_lower == base.row_upper
        self._order = np.concatenate([np.flatnonzero(is_equation), np.flatnonzero(~is_equation)])
        num_equations, self._program = int(is_equation.sum()), program
        parts = [base.matrix[is_equation], base.matrix[~is_equation]]
        parts = [
            jax_sparse.BCOO.from_scipy_sparse(scipy.sparse.csr_matrix(p)) if is_sparse else p.toarray() for p in parts
        ]
        tolerance = settings.tolerance
        solver = algorithm(eps_abs=tolerance, eps_rel=tolerance, verbose=False, **options)
        infinite = np.full(len(base.cost), np.inf)

        def solve(cost, right):
            equations, inequalities = right[:num_equations], right[num_equations:]
            lp = mpax.create_lp(
                cost, parts[0], equations, parts[1], inequalities, base.lower, infinite, use_sparse_matrix=is_sparse
            )
            found = solver.optimize(lp)
            return found.primal_solution, found.dual_solution, found.termination_status

        self._solve = jax.jit(solve)

    def solve(self, expectations: np.ndarray, limit: float):
        """x, w and a status. It knows no time limit."""
        del limit
        lp = self._program.given(expectations)
        z, y, status = map(np.asarray, self._solve(lp.cost, lp.row_lower[self._order]))
        multipliers = np.empty(len(y))
        multipliers[self._order] = y
        return *self._program.read(z, multipliers), str(status)


_SOLVERS = {
    "moreau": Moreau,
    "clarabel": Clarabel,
    "highs_simplex": Highs,
    "highs_interior_point": Highs,
    "highs_pdlp": Highs,
    "glop": Glop,
    "ortools_pdlp": OrtoolsPdlp,
    "mpax": Mpax,
}


# ------------------------------------------------------------------------------------------------------------ answers


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a process found for its lanes.

    Attributes:
      x: list of [S, A], w: list of [K]; None where the solver has nothing.
      seconds: per lane; for a batch solved together, the whole divided by its lanes.
      statuses: the solver's words.
      build_s: what opening the solver took. compile_s: what a first solve took beyond the second.
    """

    x: list
    w: list
    seconds: list[float]
    statuses: list[str]
    build_s: float
    compile_s: float


def solve(method: str, settings: Settings, model: Model, expectations, limit: float, threads: int, batch: bool):
    """Solves all lanes [B, K], or as many as end before the limit.

    In a batch Moreau solves all lanes at once, and HiGHS's simplex starts from the lane before.
    """
    start = time.perf_counter()
    program = Program(model, settings.form, settings.shares)
    if method == "moreau" and batch:
        solver = Moreau(method, program, settings, threads, lanes=len(expectations))
        solver.prepare(limit)
        build, start = time.perf_counter() - start, time.perf_counter()
        found = solver.solve_batch(expectations, limit)
        first = seconds = time.perf_counter() - start
        if first < _SHARE_OF_WARM_UP * limit:
            start = time.perf_counter()
            found = solver.solve_batch(expectations, limit)
            seconds = time.perf_counter() - start
        return _answer(found, [seconds / len(found)] * len(found), build, max(first - seconds, 0.0))
    solver = _SOLVERS[method](method, program, settings, threads)
    if method == "moreau":
        solver.prepare(limit)
    elif method == "highs_simplex":
        solver.is_hot = batch
    return _one_by_one(solver, expectations, limit, time.perf_counter() - start)


def _one_by_one(solver, expectations, limit: float, build: float) -> Answer:
    """A first lane that leaves time for it is solved again, and the first time counts as compilation."""
    is_hot = getattr(solver, "is_hot", False)  # it would start from its own solution
    begin, found, seconds, compile_s = time.perf_counter(), [], [], 0.0
    for lane, vector in enumerate(expectations):
        start = time.perf_counter()
        answer = solver.solve(vector, limit - (start - begin))
        seconds.append(time.perf_counter() - start)
        if lane == 0 and not is_hot and seconds[0] < _SHARE_OF_WARM_UP * limit:
            start = time.perf_counter()
            answer = solver.solve(vector, limit)
            first, seconds = seconds[0], [time.perf_counter() - start]
            compile_s = max(first - seconds[0], 0.0)
        found.append(answer)
        if time.perf_counter() - begin + max(seconds) > limit:
            break
    return _answer(found, seconds, build, compile_s)


def _answer(found, seconds, build: float, compile_s: float) -> Answer:
    x, w, statuses = map(list, zip(*found, strict=True))
    return Answer(x, w, seconds, statuses, build, compile_s)
