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

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from jaxhom import checks
from jaxhom.interop.environment_makers import make_environment
from jaxhom.interop.environment_tables import (
    TransitionTable,
    name_of,
    read_table,
    require_known_options,
    require_steps_of_table,
)
from jaxhom.models.mdp import MDP
from jaxhom.status import Record

if TYPE_CHECKING:
    import gymnasium
    from jaxtyping import Array, ArrayLike, Bool, Float


class GymnasiumModel(Record):
    """The model of an environment, and the reward that its authors gave it. See `from_gymnasium`.

    Attributes:
      mdp: the model; states and actions are numbered as in the environment.
      reward: float [S, A], expected reward of a step; 0 on absorbing states. For evaluation, or `optimal_policy`.
      terminal: bool [S], the states made absorbing, in which episodes have ended.
    """

    mdp: MDP
    reward: Float[Array, "S A"]
    terminal: Bool[Array, "S"]


def from_gymnasium(
    env: gymnasium.Env | str,
    *,
    discount: Float[ArrayLike, ""],
    features: Float[ArrayLike, "S *A K"] | None = None,
    initial: Float[ArrayLike, "S"] | None = None,
    end_state: bool = False,
) -> GymnasiumModel:
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

    Outside jit, vmap and grad only: the table is read on the host.

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
    table = read_table(env)
    require_known_options(env)
    start = _initial(env, initial, len(table.allowed))
    goes_on = table.allowed.any(axis=1)  # elsewhere nothing follows, however such a state was entered
    message = "is positive, but P has no outcome there: no episode can start where nothing follows"
    checks.require_all("initial", start, goes_on | (start == 0), message)
    if end_state:
        features = None if features is None else _with_row(_state_features(features, len(start)))
        table, start, terminal = _with_end_state(table), np.append(start, 0.0), np.append(~goes_on, True)
    else:
        terminal = np.array(~goes_on)
        terminal[table.next_state[table.terminated]] = True
        _require_ends(table.next_state, table.probability, table.terminated, terminal & goes_on, start)
    return _model(_with_absorbing(table, terminal), terminal, discount=discount, initial=start, features=features)


def _with_end_state(table: TransitionTable) -> TransitionTable:
    """The table with one state more, where every terminated outcome leads."""
    next_state = np.where(table.terminated, len(table.allowed), table.next_state)
    allowed = np.concatenate([table.allowed, np.ones_like(table.allowed[:1])])
    return TransitionTable(
        next_state=_with_row(next_state),
        probability=_with_row(table.probability),
        reward=_with_row(table.reward),
        terminated=_with_row(table.terminated),
        allowed=allowed,
    )


def _with_absorbing(table: TransitionTable, terminal: np.ndarray) -> TransitionTable:
    """The table with terminal states, bool [S], that every action leaves where they are, at no reward."""
    here = np.arange(len(terminal))[:, None, None]
    alone = np.arange(table.probability.shape[-1]) == 0  # one outcome of probability 1
    is_end = terminal[:, None, None]
    return TransitionTable(
        next_state=np.where(is_end, here, table.next_state),
        probability=np.where(is_end, alone, table.probability),
        reward=np.where(is_end, 0.0, table.reward),
        terminated=table.terminated,
        allowed=table.allowed | terminal[:, None],
    )


def _model(table: TransitionTable, terminal: np.ndarray, **options: Any) -> GymnasiumModel:
    """The model of a table, whose reward is the expected one of a step."""
    allowed = None if table.allowed.all() else table.allowed
    mdp = MDP.from_successors(table.next_state, table.probability, allowed=allowed, **options)
    reward = np.sum(table.probability * table.reward, axis=-1)
    reward = checks.to_device(checks.require_floats_in(mdp.dtype, "expected reward", reward))
    return GymnasiumModel(mdp=mdp, reward=reward, terminal=checks.to_device(terminal))


def _initial(env, initial, num_states: int) -> np.ndarray:
    """The given distribution of the first state, or the environment's own."""
    if initial is None:
        initial = getattr(getattr(env, "unwrapped", env), "initial_state_distrib", None)
    if initial is None:
        raise ValueError(
            f"{name_of(env)} has no initial_state_distrib: pass initial, the distribution of the first state"
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
