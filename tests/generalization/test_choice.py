"""The choice among generalizations: scores trajectory by trajectory, against fits without each of them."""

import functools

import jax
import numpy as np
import oracles
import pytest
from small_models import dense_transition

from jaxhom import (
    MDP,
    Demonstrations,
    SimilarityTable,
    choose_generalization,
    gridworld,
    nearest_neighbors,
    optimal_policy,
    racetrack,
    sample_demonstrations,
    soft_local_homomorphism,
    uniform_elsewhere,
)
from jaxhom.generalization.choice import default_candidates


@functools.cache
def world(name):
    if name == "track":
        track = racetrack(["S....F", "S....F"])
        plan = optimal_policy(track, track.mdp.features @ track.weights)
        shown = sample_demonstrations(jax.random.key(0), track, plan, 4, 6)
        return track.mdp, shown.replace(mask=shown.mask & ~track.terminal[shown.states])
    if name == "grid":
        mdp = gridworld(6).mdp
        goal = np.zeros((36, 4))
        goal[20] = 1.0
        return mdp, sample_demonstrations(jax.random.key(1), mdp, optimal_policy(mdp, goal), 4, 7)
    rng = np.random.default_rng(3)
    transition = oracles.random_mdp(rng, 14, 3, N=2)[0]
    transition[7:] = transition[:7]
    allowed = rng.random((14, 3)) < 0.7
    allowed[:, 1] = True
    transition[6], allowed[6] = np.eye(14)[6], True  # absorbs
    mdp = MDP.from_dense(transition, discount=0.9, allowed=allowed, initial=np.eye(14)[[0, 3, 6, 9]].mean(axis=0))
    return mdp, sample_demonstrations(
        jax.random.key(2), mdp, uniform_elsewhere(mdp, Demonstrations.from_trajectories([([0], [1])])), 5, 3
    )


def plain_scores(mdp, demonstrations, function, mixing):
    """The mean log-likelihood of steps left out, in one state after the other; 5 % are uniform where others were."""
    transition, allowed = dense_transition(mdp), np.asarray(mdp.allowed)
    absorbs, uniform = oracles.absorbing(transition), allowed / allowed.sum(axis=1, keepdims=True)
    total, steps = 0.0, 0
    for left_out in range(len(demonstrations)):
        others = [walk for number, walk in enumerate(demonstrations) if number != left_out]
        general = function(mdp, Demonstrations.from_trajectories([(s[: len(a)], a) for s, a in others]))
        states, actions = demonstrations[left_out]
        for s, a in zip(states[: len(actions)], actions, strict=True):
            if absorbs[s]:
                continue
            share = 0.05 if general.visited[s] else mixing
            total += np.log((1 - share) * float(general.policy[s, a]) + share * uniform[s, a])
            steps += 1
    return total / steps


def fit_of(mdp, candidate):
    """The candidate as a function, whose fits share a table."""
    if not isinstance(candidate, dict):
        return candidate
    kept = {key: candidate[key] for key in ("relation", "distance", "labels") if key in candidate}
    return functools.partial(soft_local_homomorphism, **candidate, table=SimilarityTable(mdp, **kept))


def once_for_each(function):
    """Remembers what the function says of each set of demonstrations, in whatever arrays they come."""
    known = {}

    def remembered(mdp, demonstrations):
        steps = [(tuple(map(int, s[: len(a)])), tuple(map(int, a))) for s, a in demonstrations]
        key = tuple(walk for walk in steps if walk[1])
        if key not in known:
            known[key] = function(mdp, demonstrations)
        return known[key]

    return remembered


CANDIDATES = {
    "plain": {},
    "lax": {"relation": "lax", "threshold": 0.1},
    "walks, all": {"relation": "random_walk", "voters": "all", "threshold": 0.2},
    "two, weighted": {"voters": 2, "weights": "similarity", "threshold": 0.3, "distance": 2},
    "mutual": {"mutual": True, "labels": "labels"},
    "k-NN": nearest_neighbors,
    "uniform": uniform_elsewhere,
}


@pytest.mark.parametrize("name", ["grid", "track", "random"])
def test_scores_are_those_of_fits_without_each_trajectory(name):
    mdp, demonstrations = world(name)
    labels = np.random.default_rng(0).integers(0, 2, (mdp.num_states, 1)) * 0.2
    candidates = {
        key: {k: labels if k == "labels" else v for k, v in one.items()} if isinstance(one, dict) else one
        for key, one in CANDIDATES.items()
    }
    chosen = choose_generalization(mdp, demonstrations, candidates, mixing=0.1, caution=0)
    fits = {key: once_for_each(fit_of(mdp, one)) for key, one in candidates.items()}
    for key, function in fits.items():
        np.testing.assert_allclose(chosen.scores[key], plain_scores(mdp, demonstrations, function, 0.1), atol=2e-4)
    assert chosen.name == max(chosen.scores, key=chosen.scores.get)
    best = fits[chosen.name](mdp, demonstrations)
    np.testing.assert_allclose(chosen.best.policy, best.policy, atol=1e-4)
    assert chosen.best.explain(0).state == 0
    # Functions that are called once for each trajectory say the same.
    one_by_one = {key: functools.partial(lambda m, d, f: f(m, d), f=function) for key, function in fits.items()}
    again = choose_generalization(mdp, demonstrations, one_by_one, mixing=0.1, caution=0)
    for key in fits:
        np.testing.assert_allclose(again.scores[key], chosen.scores[key], atol=2e-4)
        np.testing.assert_allclose(again.standard_errors[key], chosen.standard_errors[key], atol=1e-3)


@pytest.mark.parametrize("name", ["grid", "random"])
def test_the_share_of_uniform_is_the_likeliest(name):
    mdp, demonstrations = world(name)
    candidates = {"plain": {}, "k-NN": nearest_neighbors, "uniform": uniform_elsewhere}
    free = choose_generalization(mdp, demonstrations, candidates)
    for mixing in (0.01, 0.1, 0.5, 1.0):
        fixed = choose_generalization(mdp, demonstrations, candidates, mixing=mixing)
        for key in candidates:
            assert free.scores[key] >= fixed.scores[key] - 1e-3
    assert free.scores["plain"] >= free.scores["uniform"] - 1e-12  # nothing is below what knows nothing


def test_what_generalizes_wins_over_what_does_not():
    """The expert follows the border to the right: only where models are alike is that of use."""
    grid = gridworld(8)
    walks = [
        ([1, 2, 3], [2, 2, 2]),
        ([3, 4, 5], [2, 2, 2]),
        ([4, 5, 6], [2, 2, 2]),
        ([25, 33], [1, 1]),
        ([35, 43], [1, 1]),
    ]
    chosen = choose_generalization(grid, Demonstrations.from_trajectories(walks))
    assert chosen.scores[chosen.name] > chosen.scores["k-NN"] > chosen.scores["uniform"]
    assert chosen.name not in ("k-NN", "uniform") and "Choice(" in repr(chosen)


@pytest.mark.parametrize("name", ["grid", "track", "random"])
def test_caution_prefers_what_comes_first(name):
    """By the standard error of the difference, trajectory by trajectory."""
    mdp, demonstrations = world(name)
    candidates = {"uniform": uniform_elsewhere, "lax": {"relation": "lax"}, "plain": {}, "k-NN": nearest_neighbors}
    bold = choose_generalization(mdp, demonstrations, candidates, caution=0.0)
    assert bold.scores[bold.name] == max(bold.scores.values())
    assert choose_generalization(mdp, demonstrations, candidates, caution=1e9).name == "uniform"
    names = [choose_generalization(mdp, demonstrations, candidates, caution=c).name for c in (0.0, 0.5, 1.0, 2.0, 4.0)]
    places = [list(candidates).index(found) for found in names]
    assert places == sorted(places, reverse=True)


def test_states_that_are_left_out_do_not_count():
    mdp, demonstrations = world("grid")
    first = np.asarray(demonstrations.states)[:, 0]
    states = np.ones(36, bool)
    states[first[0]] = False
    chosen = choose_generalization(mdp, demonstrations, {"plain": {}}, states=states)
    assert chosen.scores["plain"] != choose_generalization(mdp, demonstrations, {"plain": {}}).scores["plain"]


def test_default_candidates():
    names = list(default_candidates(gridworld(3)))
    assert names[0] == "isomorphic 0" and names[-2:] == ["k-NN", "uniform"] and len(names) == 15
    many = MDP.from_dense(np.ones((2, 7, 2)) / 2, discount=0.9)
    assert not any("lax" in name for name in default_candidates(many))


ONE = Demonstrations.from_trajectories([([0, 1], [2, 2])])

HIDDEN = Demonstrations.from_trajectories([([0, 1], [2, 2]), ([6], [2])])
HIDDEN = HIDDEN.replace(mask=HIDDEN.mask & (np.arange(2) == 0)[:, None])


@pytest.mark.parametrize(
    ("demonstrations", "candidates", "options", "message"),
    [
        (ONE, None, {}, "demonstrations must have at least two trajectories"),
        (HIDDEN, None, {}, "at least two trajectories"),
        (None, {}, {}, "candidates must be a mapping that is not empty"),
        (None, [nearest_neighbors], {}, "candidates must be a mapping"),
        (None, {"odd": {"treshold": 0.1}}, {}, r"candidates\['odd'\] has the option 'treshold'"),
        (None, {"odd": {"voters": "some"}}, {}, r"candidates\['odd'\]: voters must be"),
        (None, {"odd": 3}, {}, r"candidates\['odd'\] must be a mapping of options or a function, got 3"),
        (None, None, {"mixing": 0.0}, r"mixing must lie in \(0, 1\], got 0.0"),
        (None, None, {"caution": -1.0}, "caution must not be negative, got -1.0"),
        (None, None, {"labels": np.zeros(3)}, "labels must have shape"),
        (Demonstrations.from_trajectories([([99], [0]), ([0], [0])]), None, {}, "states"),
    ],
)
def test_what_cannot_be_chosen(demonstrations, candidates, options, message):
    mdp, shown = world("grid")
    with pytest.raises(ValueError, match=message):
        choose_generalization(mdp, demonstrations or shown, candidates, **options)


@pytest.mark.parametrize(
    ("candidate", "message"),
    [
        (lambda mdp, shown: np.full((36, 4), np.nan), r"the policy of candidates\['odd'\]\[0, 0\] must be finite"),
        (lambda mdp, shown: np.full((36, 4), 30.0), r"the policy of candidates\['odd'\]"),
        (lambda mdp, shown: None, r"the policy of candidates\['odd'\]"),
        ({"threshold": -1.0}, r"candidates\['odd'\]: threshold must not be negative"),
        ({"relation": "none"}, r"candidates\['odd'\]: relation must be one of"),
        ({"distance": [1]}, r"candidates\['odd'\]: distance must be a whole number"),
        ({"states": [5, 1]}, r"candidates\['odd'\]: states must have shape"),
        ({"progress": True}, r"candidates\['odd'\] has the option 'progress', which is none of distance"),
    ],
)
def test_candidates_are_named_where_they_are_wrong(candidate, message):
    mdp, shown = world("grid")
    with pytest.raises(ValueError, match=message):
        choose_generalization(mdp, shown, {"plain": {}, "odd": candidate})


@pytest.mark.parametrize("options", [{"mixing": "x"}, {"caution": None}, {"states": np.arange(36)}])
def test_options_of_other_kinds(options):
    mdp, shown = world("grid")
    with pytest.raises(ValueError, match=rf"{next(iter(options))} must be a"):
        choose_generalization(mdp, shown, **options)


def test_a_candidate_may_bring_its_table():
    mdp, shown = world("grid")
    labels, weight = np.random.default_rng(0).integers(0, 2, (36, 1)), np.array(0.5)
    table = SimilarityTable(mdp, relation="lax", labels=labels, label_weight=weight)
    own = {"relation": "lax", "labels": labels}
    found = choose_generalization(mdp, shown, {"table": {"table": table}, "own": own}, label_weight=weight)
    assert found.scores["table"] == pytest.approx(found.scores["own"], abs=1e-12)
    with pytest.raises(ValueError, match=r"candidates\['odd'\]: table was made with relation='lax'"):
        choose_generalization(mdp, shown, {"odd": {"table": table, "relation": "isomorphic"}})


def test_not_inside_programs():
    mdp, demonstrations = world("grid")
    with pytest.raises(ValueError, match="call choose_generalization outside jit"):
        jax.jit(lambda shown: choose_generalization(mdp, shown).best)(demonstrations)
