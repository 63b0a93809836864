"""Other solvers of linear programs: HiGHS, GLOP and PDLP of OR-tools, Clarabel, Moreau, MPAX.

Each is a class of the protocol of `bench.processes`: made from `Settings` and what is given by keyword, it loads
`LinearProgram`s (what is the same array as in the program before is not given again), and its solutions are (z,
multipliers, its own word for how it ended). `Opened` puts one together with what makes programs and reads solutions
(`bench.linear_programs`); whether answers are any good is for a certificate to say. Only MPAX ever imports JAX.
"""

import dataclasses
import functools
import importlib.util

import numpy as np
import scipy.sparse

from bench.linear_programs import Conic, LinearProgram


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a peer is run.

    Attributes:
      tolerance: the first of those that are tried.
      options: of the solver, by its own names.
      form, shares: the program of LPAL that it is given (`linear_programs.Lpal`).
    """

    tolerance: float
    options: dict = dataclasses.field(default_factory=dict)
    form: str = ""
    shares: bool = False

    def __str__(self) -> str:
        if not self.tolerance:
            return ""  # it has none
        unit = f"{self.form} in {'shares' if self.shares else 'sums'}, " if self.form else ""
        options = "".join(f", {name} {value}" for name, value in self.options.items())
        return f"{unit}tolerance {self.tolerance:g}{options}"

    def as_text(self, **more) -> str:
        """Options in the text format of protocol buffers."""
        return " ".join(f"{name}: {value}" for name, value in (more | self.options).items())


class _OneByOne:
    """Solvers of one program at a time: `start` with a matrix, `change` what has changed of the vectors."""

    _lp: LinearProgram | None = None

    def load(self, programs: list[LinearProgram]) -> None:
        (lp,), last = programs, self._lp
        self._lp = lp
        if last is None or lp.matrix is not last.matrix:
            self.start(lp)
        else:
            self.change(lp, last)


class Highs(_OneByOne):
    """HiGHS: simplex, interior point with a crossover only where it gets stuck, or PDLP.

    `hot` simplex starts from the last program's solution.
    """

    def __init__(self, solver: str, settings: Settings, *, threads: int, hot: bool = False, **_):
        import highspy

        self._api, self._solver, self._hot = highspy, highspy.Highs(), hot
        options, tolerance = highspy.HighsOptions(), max(settings.tolerance, 1e-10)  # the least that it takes
        options.output_flag, options.threads, options.solver = False, threads, solver
        options.primal_feasibility_tolerance = options.dual_feasibility_tolerance = tolerance
        options.ipm_optimality_tolerance = options.pdlp_optimality_tolerance = tolerance
        options.run_crossover = "choose"
        for name, value in settings.options.items():
            setattr(options, name, value)
        self._solver.passOptions(options)

    def start(self, lp: LinearProgram) -> None:
        model = self._api.HighsLp()
        model.num_row_, model.num_col_ = lp.matrix.shape
        model.col_cost_, model.col_lower_, model.col_upper_ = lp.cost, lp.lower, lp.upper
        model.row_lower_, model.row_upper_ = lp.right, lp.row_upper
        matrix = model.a_matrix_
        matrix.format_ = self._api.MatrixFormat.kRowwise
        matrix.start_, matrix.index_, matrix.value_ = lp.matrix.indptr, lp.matrix.indices, lp.matrix.data
        self._solver.passModel(model)

    def change(self, lp: LinearProgram, last: LinearProgram) -> None:
        rows, columns = (np.arange(size, dtype=np.int32) for size in lp.matrix.shape)
        if lp.right is not last.right:
            self._solver.changeRowsBounds(len(rows), rows, lp.right, lp.row_upper)
        if lp.cost is not last.cost:
            self._solver.changeColsCost(len(columns), columns, lp.cost)

    def solve(self, limit: float) -> list:
        solver = self._solver
        if not self._hot:
            solver.clearSolver()
        solver.setOptionValue("time_limit", solver.getRunTime() + limit)
        solver.run()
        found, word = solver.getSolution(), solver.modelStatusToString(solver.getModelStatus())
        return [(np.asarray(found.col_value), np.asarray(found.row_dual), word)]


class Glop(_OneByOne):
    """OR-tools' simplex code, on one thread."""

    def __init__(self, settings: Settings, **_):
        from ortools.linear_solver.python import model_builder_helper

        self._api, self._solver = model_builder_helper, model_builder_helper.ModelSolverHelper("glop")
        names = ("primal_feasibility_tolerance", "dual_feasibility_tolerance")
        self._solver.set_solver_specific_parameters(settings.as_text(**dict.fromkeys(names, settings.tolerance)))

    def start(self, lp: LinearProgram) -> None:
        self._model = self._api.ModelBuilderHelper()
        bounds, matrix = (lp.right, lp.row_upper), scipy.sparse.csr_matrix(lp.matrix)
        self._model.fill_model_from_sparse_data(lp.lower, lp.upper, lp.cost, *bounds, matrix)

    def change(self, lp: LinearProgram, last: LinearProgram) -> None:
        for k in np.flatnonzero(lp.right != last.right).tolist():
            self._model.set_constraint_lower_bound(k, float(lp.right[k]))
            self._model.set_constraint_upper_bound(k, float(lp.row_upper[k]))
        for k in np.flatnonzero(lp.cost != last.cost).tolist():
            self._model.set_var_objective_coefficient(k, float(lp.cost[k]))

    def solve(self, limit: float) -> list:
        solver = self._solver
        solver.set_time_limit_in_seconds(limit)
        solver.solve(self._model)
        if not solver.has_solution():
            return [(None, None, str(solver.status()))]
        return [(np.asarray(solver.variable_values()), np.asarray(solver.dual_values()), str(solver.status()))]


class OrtoolsPdlp(_OneByOne):
    """OR-tools' PDLP."""

    def __init__(self, settings: Settings, *, threads: int, **_):
        from google.protobuf import text_format
        from ortools.pdlp import solvers_pb2
        from ortools.pdlp.python import pdlp

        self._api, self._qp = pdlp, pdlp.QuadraticProgram()
        self._parameters = solvers_pb2.PrimalDualHybridGradientParams(num_threads=threads)
        criteria = self._parameters.termination_criteria.simple_optimality_criteria
        criteria.eps_optimal_absolute = criteria.eps_optimal_relative = settings.tolerance
        text_format.Merge(settings.as_text(), self._parameters)

    def start(self, lp: LinearProgram) -> None:
        self._qp.constraint_matrix = scipy.sparse.csc_matrix(lp.matrix)
        self._qp.variable_lower_bounds, self._qp.variable_upper_bounds = lp.lower, lp.upper
        self.change(lp, lp)

    def change(self, lp: LinearProgram, last: LinearProgram) -> None:
        self._qp.objective_vector = lp.cost
        self._qp.constraint_lower_bounds, self._qp.constraint_upper_bounds = lp.right, lp.row_upper

    def solve(self, limit: float) -> list:
        self._parameters.termination_criteria.time_sec_limit = limit
        found = self._api.primal_dual_hybrid_gradient(self._qp, self._parameters)
        word = str(found.solve_log.termination_reason)
        return [(np.asarray(found.primal_solution), np.asarray(found.dual_solution), word)]


class Clarabel(_OneByOne):
    """Clarabel; its analysis of the matrix is kept from one program to the next."""

    def __init__(self, settings: Settings, *, threads: int, limit: float, **_):
        import clarabel

        self._api, self._settings = clarabel, clarabel.DefaultSettings()
        options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), settings.tolerance)
        options |= {"verbose": False, "max_threads": threads, "time_limit": limit} | settings.options
        for name, value in options.items():
            setattr(self._settings, name, value)

    def change(self, lp: LinearProgram, last: LinearProgram) -> None:
        self._solver.update(q=lp.cost, b=self._conic.right(lp))

    def start(self, lp: LinearProgram) -> None:
        self._conic, api = Conic(lp), self._api
        rows, columns = self._conic.matrix.shape
        cones = [api.ZeroConeT(self._conic.num_zero), api.NonnegativeConeT(rows - self._conic.num_zero)]
        quadratic, matrix = scipy.sparse.csc_matrix((columns, columns)), scipy.sparse.csc_matrix(self._conic.matrix)
        self._solver = api.DefaultSolver(quadratic, lp.cost, matrix, self._conic.right(lp), cones, self._settings)

    def solve(self, limit: float) -> list:
        self._settings.time_limit = limit
        self._solver.update(settings=self._settings)
        found = self._solver.solve()
        return [(np.asarray(found.x), self._conic.multipliers(self._lp, np.asarray(found.z)), str(found.status))]


def moreau_arguments(conic: Conic, tolerance: float, **settings) -> dict:
    """What Moreau's solvers are made from: a cone program, and settings for the CPU."""
    import moreau

    (rows, columns), matrix = conic.matrix.shape, conic.matrix
    inner = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)
    return {
        "n": columns,
        "m": rows,
        "P_row_offsets": np.zeros(columns + 1, np.int64),
        "P_col_indices": np.zeros(0, np.int64),
        "A_row_offsets": matrix.indptr.astype(np.int64),
        "A_col_indices": matrix.indices.astype(np.int64),
        "cones": moreau.Cones(num_zero_cones=conic.num_zero, num_nonneg_cones=rows - conic.num_zero),
        "settings": moreau.Settings(device="cpu", solver="ipm", ipm_settings=moreau.IPMSettings(**inner), **settings),
    }


class Moreau:
    """Moreau's compiled solver, for one program or a batch. Its time limit is fixed when it is made."""

    def __init__(self, settings: Settings, *, limit: float, **_):
        self._tolerance, self._limit, self._programs = settings.tolerance, limit, []

    def load(self, programs: list[LinearProgram]) -> None:
        import moreau

        last, self._programs = self._programs, programs
        if len(last) == len(programs) and all(a.matrix is b.matrix for a, b in zip(last, programs, strict=True)):
            return
        self._conic = conic = Conic(programs[0])
        options = moreau_arguments(conic, self._tolerance, batch_size=len(programs), time_limit=self._limit)
        self._solver = moreau.CompiledSolver(**options)
        if all(lp.matrix is programs[0].matrix for lp in programs):
            self._solver.setup(np.zeros(0), conic.matrix.data)
        else:
            self._solver.setup(np.zeros((len(programs), 0)), np.stack([conic.values(lp) for lp in programs]))

    def solve(self, limit: float) -> list:
        del limit
        costs, rights = ([read(lp) for lp in self._programs] for read in (lambda lp: lp.cost, self._conic.right))
        found = self._solver.solve(np.stack(costs), np.stack(rights))
        words = [str(getattr(status, "name", status)) for status in np.atleast_1d(self._solver.info.status)]
        points = zip(self._programs, np.asarray(found.x), np.asarray(found.z), words, strict=True)
        return [(x, self._conic.multipliers(lp, y), word) for lp, x, y, word in points]


class Mpax:
    """MPAX, on all of XLA's threads: restarted reflected PDHG, compiled once; a batch of small programs by `vmap`."""

    def __init__(self, settings: Settings, **_):
        import jax

        jax.config.update("jax_enable_x64", True)
        import mpax

        options = {"algorithm": "r2HPDHG", "sparse": True} | settings.options
        self._sparse, algorithm = options.pop("sparse"), getattr(mpax, options.pop("algorithm"))
        tolerance = settings.tolerance
        self._pdhg, self._solve = algorithm(eps_abs=tolerance, eps_rel=tolerance, verbose=False, **options), None

    def load(self, programs: list[LinearProgram]) -> None:
        self._lp = programs[0]
        if self._solve is None:
            self._solve = self._compiled(self._lp)
        vectors = ((lp.matrix.data, lp.cost, lp.right) for lp in programs)
        self._vectors = tuple(map(np.stack, zip(*vectors, strict=True)))

    def _compiled(self, lp: LinearProgram):
        """(entries, cost, right) of programs -> points, multipliers (equations first) and statuses."""
        import jax
        import jax.numpy as jnp
        import mpax
        from jax.experimental.sparse import BCOO

        entries = lp.matrix.tocoo()
        parts = []
        for chosen in (lp.is_equation, ~lp.is_equation):
            here, rows = chosen[entries.row], np.cumsum(chosen) - 1
            places = np.stack([rows[entries.row[here]], entries.col[here]], axis=1)
            parts.append((np.flatnonzero(here), places, (int(chosen.sum()), len(lp.cost))))

        def matrix(values, here, places, shape):
            if self._sparse:
                return BCOO((values[here], jnp.asarray(places)), shape=shape)
            return jnp.zeros(shape).at[tuple(places.T)].set(values[here])

        def solve(values, cost, right):
            equations, others = (matrix(values, *part) for part in parts)
            rights = right[lp.is_equation], right[~lp.is_equation]
            problem = mpax.create_lp(
                cost, equations, rights[0], others, rights[1], lp.lower, lp.upper, use_sparse_matrix=self._sparse
            )
            found = self._pdhg.optimize(problem)
            return found.primal_solution, found.dual_solution, found.termination_status

        if not self._sparse:
            return jax.jit(jax.vmap(solve))
        one = jax.jit(solve)
        return lambda *stacked: jax.tree.map(lambda leaf: leaf[None], one(*(array[0] for array in stacked)))

    def solve(self, limit: float) -> list:
        del limit
        points, found, words = map(np.asarray, self._solve(*self._vectors))
        multipliers, is_equation = np.empty(found.shape), self._lp.is_equation
        multipliers[:, is_equation] = found[:, : is_equation.sum()]
        multipliers[:, ~is_equation] = found[:, is_equation.sum() :]
        return list(zip(points, multipliers, map(str, words), strict=True))


PEERS = {  # by name: the package, and what opens it
    "moreau": ("moreau", Moreau),
    "clarabel": ("clarabel", Clarabel),
    "highs_simplex": ("highspy", functools.partial(Highs, "simplex")),
    "highs_interior_point": ("highspy", functools.partial(Highs, "ipm")),
    "highs_pdlp": ("highspy", functools.partial(Highs, "pdlp")),
    "glop": ("ortools", Glop),
    "ortools_pdlp": ("ortools", OrtoolsPdlp),
    "mpax": ("mpax", Mpax),
}
USES_BOTH_CORES = ("mpax",)  # alone: batches of the others are shared between two processes


def is_installed(method: str) -> bool:
    """Whether the package behind a peer can be imported."""
    return importlib.util.find_spec(PEERS[method][0]) is not None


class Opened:
    """A peer, with `make()` of what makes programs of lanes and reads answers off their solutions."""

    def __init__(self, method: str, settings: Settings, make, **options):
        self._programs = make()
        self._peer = PEERS[method][1](settings, **options)

    def load(self, lanes: list) -> None:
        self._peer.load([self._programs.given(lane) for lane in lanes])

    def solve(self, limit: float) -> list:
        solved = self._peer.solve(limit)
        return [(None if z is None else self._programs.read(z, y), word, 0) for z, y, word in solved]
