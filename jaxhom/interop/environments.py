"""Gymnasium environments with a transition table `P`, as models.

`env.unwrapped.P[s][a]` lists outcomes (probability p, next state z, reward r, terminated t): FrozenLake, Taxi,
CliffWalking and whatever was written after them. Outcomes with one next state are added up, and

    r(s, a) = sum over outcomes of p r        an expected reward per pair, which is all that values depend on.

A state may lack actions (no outcomes, or no entry): they are not allowed there. One without any outcome ends episodes.

*Termination.* A table goes on after the end of an episode: the goal has rows of its own that lead on. Here a state
that some outcome enters with `terminated` ends every episode: it becomes absorbing, with reward 0. That leaves all
values from the initial states unchanged if such a state is never entered without `terminated` in the course of an
episode. A table where it is (a move that succeeds, or succeeds and ends the episode by chance) is refused: for it
there is `end_state=True`, where every terminated outcome leads to one further, absorbing state, number S, and the
states of the environment stay as they are. That is right for every table.
"""

import contextlib
import dataclasses
import inspect
import warnings
from collections.abc import Mapping

import jax
import numpy as np
import scipy.sparse

from jaxhom import checks
from jaxhom.models.mdp import MDP

_OUTSIDE_THE_TABLE = ("fickle_passenger",)  # options of Gymnasium's environments that act in `step` alone


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class GymnasiumModel:
    """The model of an environment, and the reward that its authors gave it. See `from_gymnasium`.

    Attributes:
      mdp: the model; states and actions are numbered as in the environment.
      reward: float [S, A], expected reward of a step; 0 on absorbing states. For evaluation, or `optimal_policy`.
      terminal: bool [S], the states made absorbing, in which episodes have ended.
    """

    mdp: MDP
    reward: jax.Array
    terminal: jax.Array


def from_gymnasium(env, *, discount, features=None, initial=None, end_state: bool = False) -> GymnasiumModel:
    """Builds the model of a Gymnasium environment from its table `env.unwrapped.P`.

    Args:
      env: an environment, wrapped or not, or the id of one to make (`"FrozenLake-v1"`), which is closed again.
      discount: scalar, strictly between 0 and 1; environments have none.
      features: [S, A, K] or [S, K], by the environment's states; no features (K = 0) if None.
      initial: [S] distribution of the first state; the environment's `initial_state_distrib` if None.
      end_state: False: states that end episodes become absorbing (see the module's text). True: one absorbing state
        is added as the last, with features and reward 0, and every terminated outcome leads there.

    Returns:
      The model, with its reward and its terminal states.

    Raises:
      ValueError: if there is no such environment; if it has no table `P` or no initial distribution, or an option that
        its table does not contain; naming the first entry of the table that is malformed; naming a state in which some
        episodes end and others go on, unless `end_state`; for an id also if its steps are not those of its table
        (`require_steps_of_table`); and as `MDP.from_successors`.
      ImportError: for an id, if Gymnasium is not installed.

    Example:
      >>> lake = from_gymnasium("FrozenLake-v1", discount=0.99)
      >>> lake.mdp.num_states, lake.mdp.num_actions, int(lake.terminal.sum())
      (16, 4, 5)
    """
    if isinstance(env, str):
        env = make_environment(env)
        try:
            require_steps_of_table(env)
            return from_gymnasium(env, discount=discount, features=features, initial=initial, end_state=end_state)
        finally:
            env.close()
    next_state, probability, outcome_reward, terminated, allowed = _table(env)
    _require_same_steps(env)
    initial = _initial(env, initial, len(next_state))
    reward = np.sum(probability * outcome_reward, axis=-1)
    has_rows = allowed.any(axis=1)  # elsewhere nothing goes on, however such a state was entered
    message = "is positive, but P has no outcome there: no episode can start where nothing follows"
    checks.require_all("initial", initial, has_rows | (initial == 0), message)
    terminal = ~has_rows
    if end_state:
        next_state = np.where(terminated, len(next_state), next_state)
        next_state, probability, reward = (_with_row(array) for array in (next_state, probability, reward))
        terminal, allowed = np.append(terminal, True), np.concatenate([allowed, np.ones_like(allowed[:1])])
        initial = np.append(initial, 0.0)
        features = None if features is None else _with_row(_state_features(features, len(initial) - 1))
    else:
        terminal[next_state[terminated]] = True
        _require_ends(next_state, probability, terminated, terminal & has_rows, initial)
    reward[terminal] = 0.0
    next_state[terminal] = np.flatnonzero(terminal)[:, None, None]
    probability[terminal] = np.arange(probability.shape[-1]) == 0
    allowed[terminal] = True
    mdp = MDP.from_successors(
        next_state,
        probability,
        discount=discount,
        initial=initial,
        features=features,
        allowed=None if allowed.all() else allowed,
    )
    reward = checks.to_device(checks.require_floats_in(mdp.dtype, "expected reward", reward))
    return GymnasiumModel(mdp=mdp, reward=reward, terminal=checks.to_device(terminal))


def make_environment(name: str, **options):
    """Makes a Gymnasium environment.

    Args:
      name: its id, `"FrozenLake-v1"`.
      **options: what its constructor takes, `is_slippery=False`.

    Returns:
      The environment.

    Raises:
      ValueError: if there is no such environment, it lacks an option, one that is on or off is given something else
        (a text would count as on, whatever it says), or it refuses the options.
      ImportError: if Gymnasium is not installed.
    """
    try:
        import gymnasium
    except ImportError as error:
        raise ImportError(
            f"making {name!r} needs gymnasium, which is not installed: pip install '.[interop]'"
        ) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the version is the caller's choice
            _require_options(gymnasium, name, options)
            return gymnasium.make(name, **options)
    except gymnasium.error.Error as error:
        reason = str(error).partition("\n")[0]
    except _OptionError as error:
        raise ValueError(f"environment {name!r}: {error}") from None
    except Exception as error:  # constructors raise what they come upon
        reason = f"{type(error).__name__} {' '.join(str(error).split())}"
    given = f" with {', '.join(f'{key}={value!r}' for key, value in options.items())}" if options else ""
    raise ValueError(f"environment {name!r} cannot be made{given}: {reason}")


class _OptionError(ValueError):
    """An option that an environment does not have, or that cannot mean what it says."""


def _require_options(gymnasium, name: str, options: dict) -> None:
    """Raises on an option that a constructor does not name, and on one that is on or off and neither."""
    if not options:
        return
    known = _parameters(gymnasium.envs.registration.load_env_creator, gymnasium.spec(name).entry_point)
    if known is None:
        return
    of_make = inspect.signature(gymnasium.make).parameters
    for option, value in options.items():
        if option not in known and option not in of_make:
            raise _OptionError(f"it has no option {option!r}; it has {', '.join(known) or 'none'}")
        default = known[option].default if option in known else None
        if isinstance(default, bool) and not (isinstance(value, bool | np.bool_) or value in (0, 1)):
            raise _OptionError(f"{option} must be true or false, got {value!r}")


def _parameters(load, entry_point) -> dict | None:
    """The named parameters of what makes an environment; None where they are not known, or any name will do."""
    try:
        parameters = inspect.signature(load(entry_point) if isinstance(entry_point, str) else entry_point).parameters
    except (TypeError, ValueError):
        return None
    kinds = {parameter.kind for parameter in parameters.values()}
    return None if inspect.Parameter.VAR_KEYWORD in kinds else dict(parameters)


def require_steps_of_table(env, num_steps: int = 200) -> None:
    """Takes random steps in an environment and raises if one is not in its table `P`.

    An option or a wrapper may act in `step` alone, and then the table is not the model of what an agent meets. The
    environment is reset and stepped: not for one in which an episode is under way.

    Args:
      env: the environment. Nothing is checked if it has no table, its observations are no states, or it cannot be
        stepped.
      num_steps: how many.

    Raises:
      ValueError: naming the first state, action and next state that the table gives no probability.
    """
    table, found = getattr(env.unwrapped, "P", None), None
    with warnings.catch_warnings(), contextlib.suppress(Exception):  # the environment's own, whatever they are
        warnings.simplefilter("ignore")
        found = _step_outside(env, table, num_steps)
    if found is not None:
        state, action, successor = found
        raise ValueError(
            f"{_name(env)}: action {action} led from state {state} to {successor}, which its table P gives "
            "probability 0: an option or a wrapper acts outside the table; make it without, or record "
            "transitions and estimate a model with jaxhom.interop.from_samples"
        )


def _step_outside(env, table, num_steps: int) -> tuple | None:
    """The first of some random steps that is not in the table: state, action, next state; None if all are."""
    rng = np.random.default_rng(0)
    state = env.reset(seed=0)[0]
    for _ in range(num_steps):
        actions = range(_num_actions(table[int(state)])) if _is_state(state, table) else ()
        actions = [action for action in actions if len(_outcomes(table[int(state)], action))]
        if not actions:
            return None
        action = actions[rng.integers(len(actions))]
        successor, _, terminated, truncated, _ = env.step(action)
        outcomes = _outcomes(table[int(state)], action)
        if _is_state(successor, table) and not any(o[0] > 0 and o[1] == successor for o in outcomes):
            return state, action, successor
        state = env.reset()[0] if terminated or truncated else successor
    return None


def _is_state(observation, table) -> bool:
    return np.ndim(observation) == 0 and np.asarray(observation).dtype.kind in "iu" and 0 <= observation < len(table)


def _table(env) -> tuple[np.ndarray, ...]:
    """Next states, probabilities, rewards and terminations, [S, A, N], padded with 0; and `allowed` [S, A]."""
    table = getattr(getattr(env, "unwrapped", env), "P", None)
    if table is None:
        raise ValueError(
            f"{_name(env)} has no transition table P: record transitions in it, and estimate a model with "
            "jaxhom.interop.from_samples"
        )
    entries, allowed = _entries(_rows(table, _name(env)))
    probability, next_state, reward, terminated = np.moveaxis(entries, -1, 0)
    probability = checks.require_distribution("P: probability", probability, None if allowed.all() else allowed)
    next_state = checks.require_integers("P: next state", next_state, upper=len(entries))
    reward = checks.require_floats("P: reward", reward)
    return next_state, probability.copy(), reward, (terminated != 0) & (probability > 0), allowed


def _entries(rows: list[list]) -> tuple[np.ndarray, np.ndarray]:
    """The table's numbers, [S, A, N, 4], padded with zeros, and which pairs have any, [S, A]."""
    width = max(1, max(len(outcomes) for row in rows for outcomes in row))
    checks.require_slots(len(rows), len(rows[0]), width)
    entries = np.zeros((len(rows), len(rows[0]), width, 4))
    allowed = np.array([[len(outcomes) > 0 for outcomes in row] for row in rows])
    for s, row in enumerate(rows):
        for a, outcomes in enumerate(row):
            for i, outcome in enumerate(outcomes):
                try:
                    probability, next_state, reward, terminated = outcome
                    entries[s, a, i] = probability, next_state, reward, terminated
                except (TypeError, ValueError):
                    expected = "(probability, next state, reward, terminated)"
                    got = checks.in_one_line(outcome)
                    raise ValueError(f"P[{s}][{a}][{i}] must be {expected}, got {got}") from None
    return entries, allowed


def _rows(table, name: str) -> list[list]:
    """The table as nested lists, whatever it is kept in: states 0 ... S-1, each with actions 0 ... A-1.

    Where a state lacks an action (a dictionary without it, or no outcomes), its list is empty.
    """
    try:
        num_states = len(table)
        num_actions = max((_num_actions(table[s]) for s in range(num_states)), default=0)
        rows = [[list(_outcomes(table[s], a)) for a in range(_num_actions(table[s]))] for s in range(num_states)]
    except (TypeError, KeyError, IndexError) as error:
        raise ValueError(
            f"P of {name} must hold a list of outcomes as P[state][action], both numbered from 0: "
            f"{type(error).__name__} {error}"
        ) from None
    if not num_states or not num_actions:
        raise ValueError(f"P of {name} must have at least one state and one action")
    return [row + [[] for _ in range(num_actions - len(row))] for row in rows]


def _num_actions(actions) -> int:
    """The actions of one state: up to the largest number in a dictionary."""
    return max(actions, default=-1) + 1 if isinstance(actions, Mapping) else len(actions)


def _outcomes(actions, action: int):
    return actions.get(action, ()) if isinstance(actions, Mapping) else actions[action]


def _require_same_steps(env) -> None:
    """Raises where an option makes the environment do what its table does not say (Taxi's fickle passenger)."""
    given = getattr(getattr(env, "spec", None), "kwargs", {})
    for option in _OUTSIDE_THE_TABLE:
        if given.get(option) or getattr(getattr(env, "unwrapped", env), option, False):
            raise ValueError(
                f"{_name(env)} was made with {option}=True, which its table P does not contain: make it without, or "
                "record transitions and estimate a model with jaxhom.interop.from_samples"
            )


def _name(env) -> str:
    return f"environment {type(getattr(env, 'unwrapped', env)).__name__}"


def _initial(env, initial, num_states: int) -> np.ndarray:
    """The given distribution of the first state, or the environment's own."""
    if initial is None:
        initial = getattr(getattr(env, "unwrapped", env), "initial_state_distrib", None)
    if initial is None:
        raise ValueError(
            f"{_name(env)} has no initial_state_distrib: pass initial, the distribution of the first state"
        )
    initial = checks.as_host_array("initial", initial)
    checks.require_shape("initial", initial, f"({num_states},)", initial.shape == (num_states,))
    return checks.require_distribution("initial", initial)


def _state_features(features, num_states: int) -> np.ndarray:
    """Features with one row per state of the environment."""
    features = checks.as_host_array("features", features)
    good = features.ndim in (2, 3) and len(features) == num_states
    checks.require_shape("features", features, f"({num_states}, A, K) or ({num_states}, K)", good)
    return features


def _with_row(array: np.ndarray) -> np.ndarray:
    """`array` with a row of zeros appended, for a state that was added."""
    return np.pad(array, [(0, 1)] + [(0, 0)] * (array.ndim - 1))


def _require_ends(next_state, probability, terminated, terminal, initial) -> None:
    """Raises if an episode can start in a terminal state or enter one without ending."""
    num_states = len(next_state)
    source, action, slot = np.nonzero((probability > 0) & ~terminated)
    target = next_state[source, action, slot]
    starts = np.flatnonzero(initial)
    # One more node, with arrows to the initial states, is where the search starts.
    arrows = (np.append(source, np.full(len(starts), num_states)), np.append(target, starts))
    graph = scipy.sparse.csr_array((np.ones(len(arrows[0])), arrows), shape=(num_states + 1, num_states + 1))
    order = scipy.sparse.csgraph.breadth_first_order(graph, num_states, return_predecessors=False)
    alive = np.zeros(num_states + 1, bool)
    alive[order] = True
    mixed = terminal & alive[:-1]
    if not np.any(mixed):
        return
    state = int(np.flatnonzero(mixed)[0])
    how = "episodes start in it"
    if not initial[state] > 0:
        entry = np.flatnonzero((target == state) & alive[source])[0]
        how = f"state {source[entry]} enters it by action {action[entry]} without terminating"
    raise ValueError(
        f"state {state} ends some episodes, but {how}: it cannot be made absorbing; pass end_state=True, "
        "which sends every terminated outcome to one state more"
    )
