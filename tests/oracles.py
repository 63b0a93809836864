"""Independent, slow, plain answers in NumPy and SciPy that the tests hold jaxhom to.

Nothing here imports jax or jaxhom, everything is float64 and dense, and every function is a direct
transcription of an equation of "Apprenticeship Learning via Soft Local Homomorphisms" (Boularias
and Chaib-draa, ICRA 2010; equation numbers are the paper's). Linear programs go to HiGHS.

Notation: S states, A actions, K features; `transition [S, A, S]` is T(s, a, s'), `initial [S]` the
initial distribution alpha, `features [S, A, K]` the phi_i, `policy [S, A]` has rows that sum to 1,
`reward` is `[S, A]`. Trajectories are a list of pairs (states, actions) of integer arrays of equal
length. A "map" is the transfer function f of a soft homomorphism, one row per source state.
"""

import itertools
import math

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

# ------------------------------------------------------------------ occupancy, values, planning


def occupancy(transition, discount, initial, policy):
    """Occupancy measure x [S, A] of `policy`, which sums to 1 / (1 - discount).

    With P(s, s') = sum_a pi(s, a) T(s, a, s'): (I - discount P)^T mu = alpha and x = mu * pi.
    """
    step = np.einsum("sa,sat->st", policy, transition)
    state_occupancy = np.linalg.solve((np.eye(len(step)) - discount * step).T, initial)
    return state_occupancy[:, None] * policy


def feature_expectations(transition, discount, initial, features, policy):
    """V_i(pi) [K] = sum_{s, a} x_pi(s, a) phi_i(s, a)."""
    return np.einsum("sa,sak->k", occupancy(transition, discount, initial, policy), features)


def policy_value(transition, discount, policy, reward):
    """Value [S] of `policy` for `reward` [S, A]: (I - discount P) V = sum_a pi(s, a) R(s, a)."""
    step = np.einsum("sa,sat->st", policy, transition)
    expected_reward = np.sum(policy * reward, axis=1)
    return np.linalg.solve(np.eye(len(step)) - discount * step, expected_reward)


def optimal_value(transition, discount, reward):
    """Optimal value [S] and action value [S, A] for `reward` [S, A], by policy iteration.

    An action is changed only where another is strictly better, and the iteration ends when a policy
    comes back, so that the answer is exact up to the rounding of one linear solve.
    """
    num_states, num_actions, _ = transition.shape
    states = np.arange(num_states)
    actions = np.zeros(num_states, dtype=int)
    seen = set()
    while actions.tobytes() not in seen:
        seen.add(actions.tobytes())
        value = policy_value(transition, discount, np.eye(num_actions)[actions], reward)
        action_value = reward + discount * transition @ value
        best = np.argmax(action_value, axis=1)
        better = action_value[states, best] > action_value[states, actions]
        actions = np.where(better, best, actions)
    return value, action_value


def margin(transition, discount, initial, features, expectations, policy):
    """min_i V_i(policy) - Vhat_i, with Vhat = `expectations` [K]."""
    achieved = feature_expectations(transition, discount, initial, features, policy)
    return np.min(achieved - expectations)


def policy_from_occupancy(x, tolerance=1e-10):
    """Policy [S, A] of an occupancy x [S, A], eq. (5): pi(s, a) = x(s, a) / sum_a' x(s, a').

    Negative entries are clipped, and states with at most `tolerance` occupancy get a uniform row.
    """
    x = np.clip(x, 0.0, None)
    total = x.sum(axis=1, keepdims=True)
    return np.where(total > tolerance, x / np.where(total > 0, total, 1.0), 1.0 / x.shape[1])


# ----------------------------------------------------------------------------- demonstrations


def empirical_policy(num_states, num_actions, trajectories):
    """(visited bool [S], policy [S, A]): the action frequencies on S^E, uniform rows elsewhere."""
    counts = np.zeros((num_states, num_actions))
    for states, actions in trajectories:
        for s, a in zip(states, actions, strict=True):
            counts[s, a] += 1
    visited = counts.sum(axis=1) > 0
    policy = np.full((num_states, num_actions), 1.0 / num_actions)
    policy[visited] = counts[visited] / counts[visited].sum(axis=1, keepdims=True)
    return visited, policy


def monte_carlo_feature_expectations(features, discount, trajectories, ends=None):
    """Eq. (6) [K]: Vhat_i = 1/M sum_m sum_t discount^t phi_i(s_t, a_t), the first t being 0.

    `ends[m]`, if it is not None, is the distribution [S] of the state in which trajectory m is absorbed after its last
    step: from there on every action is as likely as any other.
    """
    total = np.zeros(features.shape[2])
    for m, (states, actions) in enumerate(trajectories):
        for t, (s, a) in enumerate(zip(states, actions, strict=True)):
            total += discount**t * features[s, a]
        if ends is not None and ends[m] is not None:
            total += discount ** len(states) / (1 - discount) * ends[m] @ features.mean(axis=1)
    return total / len(trajectories)


def sample_trajectories(rng, transition, initial, policy, num_trajectories, horizon):
    """List of `num_trajectories` pairs (states [horizon], actions [horizon]) under `policy`."""
    num_states, num_actions, _ = transition.shape
    trajectories = []
    for _ in range(num_trajectories):
        states, actions = [], []
        s = rng.choice(num_states, p=initial)
        for _ in range(horizon):
            a = rng.choice(num_actions, p=policy[s])
            states.append(s)
            actions.append(a)
            s = rng.choice(num_states, p=transition[s, a])
        trajectories.append((np.array(states, dtype=int), np.array(actions, dtype=int)))
    return trajectories


# ------------------------------------------------------------------------------ local models


def successors(transition, s):
    """Set of the states that some action reaches from s with positive probability in one step."""
    return set(np.flatnonzero((transition[s] > 0).any(axis=0)).tolist())


def grow(transition, states):
    """The set s^(t+1) from the set s^t: `states` and all their successors."""
    return set(states).union(*(successors(transition, s) for s in states))


def absorbing(transition):
    """bool [S]: the states that no action leaves; what was done there is no evidence for other states."""
    states = np.arange(len(transition))
    return (transition[states, :, states] > 1 - 1e-12).all(axis=1)


def reach(transition, s, steps):
    """Sorted list of the states s^d that are reachable from s within `steps` steps, s included."""
    states = {int(s)}
    for _ in range(steps):
        states = grow(transition, states)
    return sorted(states)


def restrict(transition, states):
    """The model [n, A, n] on the list `states`, in its order.

    Transitions that leave the list are redirected to a self-loop on the state they leave. They are
    added up by `fsum`, whose result does not depend on the order, so that rounding makes few equal
    models differ (a gridworld has 9 local models at d = 1, and about 17 of them bit by bit).
    """
    num_actions = transition.shape[1]
    inside = set(states)
    restricted = np.zeros((len(states), num_actions, len(states)))
    for i, s in enumerate(states):
        for a in range(num_actions):
            stays = [transition[s, a, s]]
            for s_next in np.flatnonzero(transition[s, a] > 0).tolist():
                if s_next not in inside:
                    stays.append(transition[s, a, s_next])
                elif s_next != s:
                    restricted[i, a, states.index(s_next)] = transition[s, a, s_next]
            restricted[i, a, i] = math.fsum(stays)
    return restricted


def local_model(transition, s, distance):
    """(states, M^{s,d} [n, A, n]): the model restricted to s^d, the centre s first in `states`.

    The other states follow in increasing order.
    """
    states = [int(s)] + [other for other in reach(transition, s, distance) if other != s]
    return states, restrict(transition, states)


# ------------------------------------------------------------------------------ homomorphisms


def homomorphism_residual(source, target, mapping):
    """Largest entry of |sum_j T(i,a,j) f(j,k) - sum_j f(i,j) T'(j,a,k)|, f = `mapping` [n, m]."""
    through_source = np.einsum("iaj,jk->iak", source, mapping)
    through_target = np.einsum("ij,jak->iak", mapping, target)
    return np.max(np.abs(through_source - through_target))


def homomorphism_lp(source, target, anchored=True, labels=None, refused=False, pinned=()):
    """LP (9) between `source` [n, A, n] and `target` [m, A, m]: (error, map [n, m]).

    Minimise e over f >= 0 with sum_k f(i, k) = 1 and, for all i, k, a,
    |sum_j T(i, a, j) f(j, k) - sum_j f(i, j) T'(j, a, k)| <= e.
    `anchored` requires in addition f(0, 0) = 1: state 0 is the centre of both models. `labels`, [n, A, L] and
    [m, A, L], add |l(i, a) - sum_k f(i, k) l'(k, a)| <= e for every label. `refused`: the last state of each model is
    mapped to the other, and nothing else is. `pinned`: pairs (i, k) with f(i, k) = 1.
    The variables are f, row by row, and e.
    """
    n, num_actions, _ = source.shape
    m = target.shape[0]
    identity_n, identity_m = sparse.eye_array(n), sparse.eye_array(m)
    difference = sparse.vstack(
        [
            sparse.kron(source[:, a, :], identity_m) - sparse.kron(identity_n, target[:, a, :].T)
            for a in range(num_actions)
        ]
    )
    constant = np.zeros(n * m * num_actions)
    if labels is not None:
        kept = [(labels[0][:, a, i], labels[1][:, a, i]) for a in range(num_actions) for i in range(labels[0].shape[2])]
        difference = sparse.vstack([difference, *(sparse.kron(identity_n, there[None]) for _, there in kept)])
        constant = np.concatenate([constant, *(here for here, _ in kept)])
    minus_e = -np.ones((len(constant), 1))
    bounds = [(0.0, None)] * (n * m + 1)
    if anchored:
        bounds[0] = (1.0, 1.0)
    for i, k in pinned:
        bounds[i * m + k] = (1.0, 1.0)
    if refused:
        for i in range(n):
            bounds[i * m + m - 1] = (float(i == n - 1),) * 2
    result = _solve_lp(
        cost=np.append(np.zeros(n * m), 1.0),
        A_ub=sparse.block_array([[difference, minus_e], [-difference, minus_e]]),
        b_ub=np.concatenate([constant, -constant]),
        A_eq=sparse.hstack([sparse.kron(identity_n, np.ones((1, m))), np.zeros((n, 1))]),
        b_eq=np.ones(n),
        bounds=bounds,
    )
    return result.fun, result.x[:-1].reshape(n, m)


def lax_homomorphism_lp(source, target, anchored=True, labels=None):
    """(error, permutations): the least error of LP (9) over all permutations of the target's actions, and the best.

    permutation[a] is the action of the target that stands for the source's action a.
    """
    errors = {}
    for order in itertools.permutations(range(source.shape[1])):
        renamed = None if labels is None else (labels[0], labels[1][:, list(order)])
        errors[order] = homomorphism_lp(source, target[:, list(order)], anchored, renamed)[0]
    least = min(errors.values())
    return least, [order for order, error in errors.items() if error <= least + 1e-6]


def are_isomorphic(source, target, anchored=True, labels=None):
    """Whether some renaming of the states, that of the centre being itself, makes the models equal to 1e-9."""
    if source.shape != target.shape:
        return False
    for order in itertools.permutations(range(len(source))):
        if anchored and order[0] != 0:
            continue
        order = list(order)
        same = np.abs(source - target[order][:, :, order]).max() < 1e-9
        if same and (labels is None or np.abs(labels[0] - labels[1][order]).max() < 1e-9):
            return True
    return False


def weisfeiler_lehman_kernel(source, target, rounds, anchored=True, labels=None):
    """Normalised subtree kernel; a colour is written out: a state's own one and those around it, both ways."""

    def histogram(transition, label):
        states = range(len(transition))
        edges = [(i, a, j) for i, a, j in zip(*np.nonzero(transition), strict=True)]
        colour = {i: (anchored and i == 0, () if label is None else tuple(label[i].ravel().round(9))) for i in states}
        counts = {}
        for number in range(rounds + 1):
            for i in states:
                key = (number, colour[i])
                counts[key] = counts.get(key, 0) + 1
            out = {i: [] for i in states}
            into = {i: [] for i in states}
            for i, a, j in edges:
                out[i].append((int(a), round(float(transition[i, a, j]), 9), colour[j]))
                into[j].append((int(a), round(float(transition[i, a, j]), 9), colour[i]))
            colour = {i: (colour[i], tuple(sorted(out[i])), tuple(sorted(into[i]))) for i in states}
        return counts

    one, other = (
        histogram(model, None if labels is None else labels[side]) for side, model in enumerate((source, target))
    )

    def product(x, y):
        return sum(count * y.get(key, 0) for key, count in x.items())

    return product(one, other) / math.sqrt(product(one, one) * product(other, other))


def walk_kernel(source, target, steps, anchored=True, labels=None, continuation=0.5):
    """Random-walk kernel, not normalised, by walking through all pairs of paths of up to `steps` steps."""
    num_actions = source.shape[1]

    def look_alike(i, k):
        return not anchored or (i == 0) == (k == 0)

    def worth(i, k, left):
        total = 1.0
        if left == 0:
            return total
        for a in range(num_actions):
            share = continuation / num_actions
            if labels is not None:
                share *= math.exp(-np.abs(labels[0][i, a] - labels[1][k, a]).sum())
            for j in np.flatnonzero(source[i, a]):
                for m in np.flatnonzero(target[k, a]):
                    if look_alike(j, m) and (i == j) == (k == m):
                        total += share * source[i, a, j] * target[k, a, m] * worth(j, m, left - 1)
        return total

    if anchored:
        return worth(0, 0, steps)
    pairs = [worth(i, k, steps) for i in range(len(source)) for k in range(len(target))]
    return sum(pairs) / len(pairs)


def global_homomorphism_lp(transition, visited, labels=None, anchored=False):
    """LP (8) from the model on all states to M^E on the visited ones: (error, map [S, |S^E|]).

    `visited` is bool [S]; the columns of the map are the visited states in increasing order. `labels` [S, A, L] are
    kept as well, see `homomorphism_lp`; `anchored` maps every visited state to itself.
    """
    experts = np.flatnonzero(visited).tolist()
    pair = None if labels is None else (labels, labels[visited])
    pinned = [(s, k) for k, s in enumerate(experts) if anchored]
    return homomorphism_lp(transition, restrict(transition, experts), anchored=False, labels=pair, pinned=pinned)


# ---------------------------------------------------------------------------- generalization


def algorithm1(
    transition,
    trajectories,
    distance=1,
    threshold=0.0,
    tolerance=1e-6,
    anchored=True,
    mutual=False,
):
    """Algorithm 1 of the paper: (policy [S, A], radius int [S]).

    s and s' are similar if LP (9) from M^{s,d} to M^{s',d} has an optimum of at most `threshold` +
    `tolerance`; `mutual` asks the same from M^{s',d} to M^{s,d}. The radius is the t at which the
    search stopped, 0 on the visited states, -1 where nothing was found (there the row is uniform).
    """
    num_states, num_actions, _ = transition.shape
    visited, empirical = empirical_policy(num_states, num_actions, trajectories)
    local_models = [local_model(transition, s, distance)[1] for s in range(num_states)]
    errors = {}

    def error(s, other):
        source, target = local_models[s], local_models[other]
        key = (source.shape, source.tobytes(), target.shape, target.tobytes())
        if key not in errors:
            errors[key] = homomorphism_lp(source, target, anchored)[0]
        return errors[key]

    def similar(s, other):
        one_way = error(s, other) <= threshold + tolerance
        return one_way and (not mutual or error(other, s) <= threshold + tolerance)

    policy, radius = empirical.copy(), np.zeros(num_states, dtype=int)
    voters = visited & ~absorbing(transition)
    for s in np.flatnonzero(~visited).tolist():
        policy[s], radius[s] = _vote(transition, s, voters, empirical, similar)
    return policy, radius


def hops_nearest_neighbors(transition, trajectories):
    """Manhattan k-NN: (policy [S, A], radius int [S]); the distance is in hops on the MDP's graph.

    t grows until a demonstrated state is in s^t, and all demonstrated states in s^t vote. The
    radius is that t, 0 on the visited states, -1 where nothing was found (a uniform row).
    """
    num_states, num_actions, _ = transition.shape
    visited, empirical = empirical_policy(num_states, num_actions, trajectories)
    policy, radius = empirical.copy(), np.zeros(num_states, dtype=int)
    voters = visited & ~absorbing(transition)
    for s in np.flatnonzero(~visited).tolist():
        policy[s], radius[s] = _vote(transition, s, voters, empirical, lambda s, other: True)
    return policy, radius


def _vote(transition, s, visited, empirical, similar):
    """(row [A], t): the normalised votes of the similar visited states in s^t, at the first such t.

    (uniform row, -1) where s^t stops growing first.
    """
    num_actions = empirical.shape[1]
    previous = {s}
    for t in itertools.count(1):
        current = grow(transition, previous)
        if current == previous:
            return np.full(num_actions, 1.0 / num_actions), -1
        voters = [other for other in sorted(current) if visited[other] and similar(s, other)]
        if voters:
            votes = sum(empirical[other] for other in voters)
            return votes / votes.sum(), t
        previous = current


def euclidean_nearest_neighbors(coordinates, num_actions, trajectories, absorbs=False):
    """Euclidean k-NN on `coordinates` [S, 2]: (policy [S, A], distance float [S]).

    All demonstrated states at the distance of the nearest one vote (ties up to rounding), but for those that absorb,
    bool [S].
    """
    coordinates = np.asarray(coordinates, dtype=float)
    visited, empirical = empirical_policy(len(coordinates), num_actions, trajectories)
    policy, nearest = empirical.copy(), np.zeros(len(coordinates))
    for s in np.flatnonzero(~visited):
        distances = np.sqrt(np.sum((coordinates - coordinates[s]) ** 2, axis=1))
        nearest[s] = distances[visited & ~np.asarray(absorbs)].min()
        voters = visited & ~np.asarray(absorbs) & (distances <= nearest[s] * (1 + 1e-9))
        policy[s] = empirical[voters].mean(axis=0)
    return policy, nearest


def occupancy_regression(transition, discount, initial, coordinates, trajectories):
    """The regression baseline: (occupancy x [S, A], policy [S, A], objective).

    Minimise sum_s |err(s)| over x >= 0, six coefficients b and err, where, for the two coordinates
    (p, q) of s, sum_a x(s, a) = b0 + b1 p + b2 q + b3 p^2 + b4 q^2 + b5 p q + err(s), under the
    Bellman flow (3), with x(s, a) = pihat(s, a) sum_a' x(s, a') on S^E. The coordinates are scaled
    to [0, 1], which changes nothing but the conditioning: quadratics stay quadratics. The policy
    is eq. (5), the empirical one on S^E, uniform where the occupancy is zero. The optimal x need
    not be unique; the objective is.
    """
    num_states, num_actions, _ = transition.shape
    visited, empirical = empirical_policy(num_states, num_actions, trajectories)
    coordinates = np.asarray(coordinates, dtype=float)
    low, high = coordinates.min(axis=0), coordinates.max(axis=0)
    p, q = ((coordinates - low) / np.where(high > low, high - low, 1.0)).T
    basis = np.stack([np.ones(num_states), p, q, p**2, q**2, p * q], axis=1)

    identity = sparse.eye_array(num_states)
    total = sparse.kron(identity, np.ones((1, num_actions)))
    # x(s, a) - pihat(s, a) sum_a' x(s, a') = 0 on S^E
    blocks = [
        np.eye(num_actions) - empirical[s][:, None] if visited[s] else np.zeros((0, num_actions))
        for s in range(num_states)
    ]
    fixed = sparse.block_diag([sparse.csr_array(block) for block in blocks])
    # the variables: x, the coefficients, and the positive and negative parts of the error
    result = _solve_lp(
        cost=np.concatenate([np.zeros(num_states * num_actions + 6), np.ones(2 * num_states)]),
        A_eq=sparse.block_array(
            [
                [_flow(transition, discount), None, None, None],
                [fixed, None, None, None],
                [total, -basis, -identity, identity],
            ]
        ),
        b_eq=np.concatenate([initial, np.zeros(fixed.shape[0] + num_states)]),
        bounds=[(0, None)] * num_states * num_actions + [(None, None)] * 6 + [(0, None)] * 2 * num_states,
    )
    x = result.x[: num_states * num_actions].reshape(num_states, num_actions)
    policy = np.where(visited[:, None], empirical, policy_from_occupancy(x))
    return x, policy, result.fun


# --------------------------------------------------------------------------------------- LPAL


def game_value(payoff):
    """Value of the game of the row player w, who pays: min over w of max_j (M^T w)_j."""
    rows, columns = payoff.shape
    result = linprog(
        np.append(np.zeros(rows), 1.0),
        A_ub=np.hstack([payoff.T, -np.ones((columns, 1))]),
        b_ub=np.zeros(columns),
        A_eq=np.append(np.ones(rows), 0.0)[None],
        b_eq=[1.0],
        bounds=[(0, None)] * rows + [(None, None)],
        method="highs",
    )
    assert result.success
    return result.fun


def lpal(transition, discount, initial, features, expectations):
    """LPAL (2)-(4) for Vhat = `expectations` [K]: (margin v*, occupancy x [S, A], weights w [K]).

    Maximise v over v and x >= 0 with v <= sum_{s, a} x(s, a) phi_i(s, a) - Vhat_i for all i, under
    the Bellman flow. w, the multipliers of these constraints, is the minimiser's strategy: it lies
    in the simplex, and v* = max_pi w . V(pi) - w . Vhat. The variables are v and x, row by row.
    """
    num_states, num_actions, num_features = features.shape
    phi = features.reshape(num_states * num_actions, num_features)
    result = _solve_lp(
        cost=np.append(-1.0, np.zeros(num_states * num_actions)),
        A_ub=sparse.csr_array(np.hstack([np.ones((num_features, 1)), -phi.T])),
        b_ub=-np.asarray(expectations, dtype=float),
        A_eq=sparse.hstack([np.zeros((num_states, 1)), _flow(transition, discount)]),
        b_eq=initial,
        bounds=[(None, None)] + [(0, None)] * (num_states * num_actions),
    )
    x = result.x[1:].reshape(num_states, num_actions)
    return result.x[0], x, -result.ineqlin.marginals


def _flow(transition, discount):
    """Matrix [S, S*A] of the Bellman flow (3), F x = alpha.

    (F x)(s) = sum_a x(s, a) - discount sum_{s', a} x(s', a) T(s', a, s).
    """
    num_states, num_actions, _ = transition.shape
    outflow = sparse.kron(sparse.eye_array(num_states), np.ones((1, num_actions)))
    inflow = sparse.csr_array(transition.reshape(num_states * num_actions, num_states)).T
    return outflow - discount * inflow


def _solve_lp(cost, A_ub=None, b_ub=None, A_eq=None, b_eq=None, bounds=None):
    """Minimise cost . z with HiGHS at tolerance 1e-9; RuntimeError unless it ends at an optimum."""
    result = linprog(
        cost,
        A_ub=None if A_ub is None else sparse.csc_array(A_ub),
        b_ub=b_ub,
        A_eq=None if A_eq is None else sparse.csc_array(A_eq),
        b_eq=b_eq,
        bounds=bounds,
        method="highs",
        options={"primal_feasibility_tolerance": 1e-9, "dual_feasibility_tolerance": 1e-9},
    )
    if not result.success:
        raise RuntimeError(f"linprog: {result.message}")
    return result


# --------------------------------------------------------------------------------- evaluation


def finite_horizon_evaluation(transition, initial, policy, reward, horizon, terminal=None, events=None):
    """Exact expectations over trials of at most `horizon` steps: a dict of floats.

    A trial ends when it enters a state of `terminal` (bool [S]): the step that enters it counts,
    and mass that is there at the beginning of a step takes no more steps. "steps" is the expected
    number of steps taken, "reward_per_step" the expected total of `reward` [S, A] divided by it (a
    ratio of expectations, not an expected ratio; NaN if no step is taken). `events` is a
    dict of arrays [S, A], each reported per step under its own name.
    """
    totals = {"reward_per_step": reward, **(events or {})}
    sums = dict.fromkeys(totals, 0.0)
    steps = 0.0
    running = np.ones(len(initial)) if terminal is None else 1.0 - np.asarray(terminal, dtype=float)
    distribution = np.asarray(initial, dtype=float)
    for _ in range(horizon):
        taken = (distribution * running)[:, None] * policy  # probability of (s, a) at this step
        steps += taken.sum()
        for name, per_pair in totals.items():
            sums[name] += np.sum(taken * per_pair)
        distribution = np.einsum("sa,sat->t", taken, transition)
    per_step = {name: float(total / steps) if steps > 0 else np.nan for name, total in sums.items()}
    return {"steps": float(steps), **per_step}


# --------------------------------------------------------------------------------- guarantees


def agreeing_policies(policy, agreed, allowed=None):
    """All policies [P, S, A] that are as `policy` on the states `agreed` (bool [S]) and deterministic elsewhere."""
    num_states, num_actions = policy.shape
    allowed = np.ones(policy.shape, dtype=bool) if allowed is None else allowed
    options = [[policy[s]] if agreed[s] else list(np.eye(num_actions)[allowed[s]]) for s in range(num_states)]
    return np.array(list(itertools.product(*options)))


def expectations_of_policies(transition, discount, initial, features, policies):
    """Feature expectations [P, K] of policies [P, S, A], by dense solves."""
    step = np.einsum("psa,sat->pst", policies, transition)
    reward = np.einsum("psa,sak->psk", policies, features)
    values = np.linalg.solve(np.eye(len(initial)) - discount * step, reward)
    return np.einsum("s,psk->pk", initial, values)


def best_agreeing(transition, discount, initial, features, policy, agreed, allowed=None):
    """U [K] over the policies of `agreeing_policies`, and for each feature the one that attains it, [K, S, A].

    A stationary policy that is random elsewhere is worth no more than the best of those: it is a decision problem.
    """
    policies = agreeing_policies(policy, agreed, allowed)
    worth = expectations_of_policies(transition, discount, initial, features, policies)
    return worth.max(axis=0), policies[worth.argmax(axis=0)]


def loss_by_states(transition, discount, initial, reward, better, policy):
    """[S]: mu(s) sum_a better(s, a) A(s, a), with mu of `better` and the advantages A = Q - V of `policy`."""
    value = policy_value(transition, discount, policy, reward)
    advantage = reward + discount * transition @ value - value[:, None]
    return (occupancy(transition, discount, initial, better) * advantage).sum(axis=1)


def steps_of_policies(transition, discount, initial, reward, policies):
    """sum_{t < H} discount^t E r of a sequence of H policies [S, A]."""
    total, distribution = 0.0, initial
    for t, policy in enumerate(policies):
        taken = distribution[:, None] * policy
        total += discount**t * np.sum(taken * reward)
        distribution = np.einsum("sa,sat->t", taken, transition)
    return total


def best_agreeing_steps(transition, discount, initial, features, policy, agreed, horizon):
    """U [K] over the first `horizon` steps, by backward induction with every state's choice written out."""
    best = np.zeros(features.shape[2])
    for k in range(len(best)):
        value = np.zeros(len(initial))
        for _ in range(horizon):
            action_value = features[:, :, k] + discount * transition @ value
            value = np.array(
                [row @ q if fixed else q.max() for row, q, fixed in zip(policy, action_value, agreed, strict=True)]
            )
        best[k] = initial @ value
    return best


# ------------------------------------------------------------------------------- small models


def random_mdp(rng, S, A, N=None, K=3, discount=0.9):
    """Random model (transition [S, A, S], discount, initial [S], features [S, A, K]).

    Each pair (s, a) has N distinct successors with flat Dirichlet probabilities (all S states if N
    is None); `initial` is flat Dirichlet, the features are uniform on (0, 1).
    """
    N = S if N is None else N
    transition = np.zeros((S, A, S))
    for s in range(S):
        for a in range(A):
            chosen = rng.choice(S, size=N, replace=False)
            transition[s, a, chosen] = rng.dirichlet(np.ones(N))
    return transition, discount, rng.dirichlet(np.ones(S)), rng.uniform(size=(S, A, K))


def gridworld_transition(n, noise=0.3):
    """Gridworld [S, 4, S] of n x n cells, state = row * n + column.

    Actions: up (row - 1), down (row + 1), left (column - 1), right (column + 1). With probability
    `noise` a uniformly random one of the four moves happens instead (the intended one included);
    moving into the wall stays.
    """
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    transition = np.zeros((n * n, 4, n * n))
    for row in range(n):
        for column in range(n):
            for action in range(4):
                for move, (down, right) in enumerate(moves):
                    new_row = min(max(row + down, 0), n - 1)
                    new_column = min(max(column + right, 0), n - 1)
                    chance = noise / 4 + (1 - noise if move == action else 0.0)
                    transition[row * n + column, action, new_row * n + new_column] += chance
    return transition
