"""Steps of probability 0 are counted as a plain loop counts them, and the first is named."""

import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import small_models

import jaxhom
from jaxhom import MDP, Demonstrations, ImpossibleStepsWarning
from jaxhom.models.impossible_steps import known_steps

WALK = ([0, 1, 2, 3], [1, 1, 1, 1])  # along the corridor of six cells below


def corridor(**options):
    cells = np.arange(6)
    transition = np.eye(6)[np.stack([np.maximum(cells - 1, 0), np.minimum(cells + 1, 5)], axis=1)]
    return MDP.from_dense(transition, discount=0.9, **options)


@pytest.mark.parametrize("name", ["sparse", "restart", "absorbing"])
def test_counts_and_places_against_a_loop(name, rng):
    case = small_models.case(name)
    num_states, num_actions = case.shape
    states, actions = rng.integers(num_states, size=(5, 7)), rng.integers(num_actions, size=(5, 7))
    for i, t in ((0, 2), (3, 5), (4, 0)):  # some are possible
        states[i, t + 1] = case.transition[states[i, t], actions[i, t]].argmax()
    mask = rng.random((5, 7)) < 0.8
    mask[0, 2:4] = mask[3, 5:] = mask[4, :2] = True
    final = rng.integers(-1, num_states, size=5)
    demonstrations = Demonstrations(
        states=jnp.asarray(states),
        actions=jnp.asarray(actions),
        mask=jnp.asarray(mask),
        final_states=jnp.asarray(final),
    )
    steps = []
    for i in range(5):
        last = max(t for t in range(7) if mask[i, t])
        for t in range(7):
            follows = final[i] if t == last else states[i, t + 1] if mask[i, min(t + 1, 6)] else -1
            if mask[i, t] and follows >= 0:
                steps.append((i, t, states[i, t], actions[i, t], follows))
    assert list(zip(*known_steps(demonstrations), strict=True)) == steps
    bad = [step for step in steps if case.transition[step[2:]] == 0]
    assert 0 < len(bad) < len(steps)
    i, t, s, a, z = bad[0]
    message = (
        f"{len(bad)} of {len(steps)} steps have probability 0 in this model; "
        f"the first is trajectory {i}, step {t}: state {s}, action {a}, then state {z}."
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations.validate(case.mdp)


def test_states_that_are_counted_from_one():
    walk = np.array([0, 0, 1, 2]), [0, 1, 1, 1]  # the first step runs into the wall
    Demonstrations.from_trajectories([walk]).validate(corridor())
    with pytest.raises(ValueError, match="1 of 3 steps .* trajectory 0, step 0: state 1, action 0, then state 1"):
        Demonstrations.from_trajectories([(walk[0] + 1, walk[1])]).validate(corridor())


def test_possible_demonstrations_and_those_that_say_nothing_pass():
    mdp = corridor()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Demonstrations.from_trajectories([WALK]).validate(mdp)
        Demonstrations.from_trajectories([([2], [0]), ([5], [1])]).validate(mdp)
        Demonstrations.from_trajectories([([0, 1, 2, 3, 4], [1] * 4)]).validate(mdp)


def test_a_final_state_is_checked_and_a_step_that_is_hidden_is_not():
    mdp = corridor()
    demonstrations = Demonstrations.from_trajectories([([0, 1, 2, 3, 3], [1] * 4)])
    with pytest.raises(ValueError, match=r"1 of 4 steps .* trajectory 0, step 3: state 3, action 1, then state 3"):
        demonstrations.validate(mdp)
    jump = Demonstrations.from_trajectories([([0, 1, 4, 4, 5], [1, 1, 0, 1, 1])])
    with pytest.raises(ValueError, match="2 of 4 steps"):
        jump.validate(mdp)
    jump.replace(mask=jump.mask.at[0, 2].set(False)).validate(mdp)


def test_what_is_done_about_them_is_an_option():
    mdp, junk = corridor(), Demonstrations.from_trajectories([([0, 3], [1, 1])])
    junk.validate(mdp, "ignore")
    with pytest.warns(ImpossibleStepsWarning, match="1 of 1 steps") as warned:
        junk.validate(mdp, impossible="warn")
    assert [warning.filename for warning in warned] == [__file__]
    with pytest.raises(ValueError, match="1 of 1 steps"):
        junk.validate(mdp)
    with pytest.raises(ValueError, match='impossible must be "refuse", "warn" or "ignore", got None'):
        junk.validate(mdp, None)


@pytest.mark.parametrize(
    "use",
    [
        jaxhom.empirical_policy,
        jaxhom.monte_carlo_feature_expectations,
        jaxhom.nearest_neighbors,
        lambda mdp, junk: jaxhom.occupancy_regression(mdp, junk, np.arange(6)[:, None]),
    ],
)
def test_who_uses_them_is_warned(use):
    mdp, junk = corridor(features=np.eye(6)), Demonstrations.from_trajectories([([0, 3], [1, 1])])
    with pytest.warns(ImpossibleStepsWarning, match="1 of 1 steps") as warned:
        use(mdp, junk)
    assert [warning.filename for warning in warned] == [__file__] * len(warned)


def test_actions_that_are_not_allowed_are_refused_whatever_the_option():
    allowed = np.ones((6, 2), bool)
    allowed[2, 0] = False
    mdp = corridor(allowed=allowed)
    demonstrations = Demonstrations.from_trajectories([([0], [1]), ([1, 2, 1], [1, 0, 1])])
    with pytest.raises(ValueError, match=re.escape("actions[1, 1] is not allowed in its state")):
        demonstrations.validate(mdp, "ignore")
    demonstrations.replace(mask=demonstrations.mask.at[1, 1].set(False)).validate(mdp)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"final_states": [1, 6]}, "final_states[1] must lie in [0, 6), or be -1 where it is not known"),
        ({"final_states": [-2, 0]}, "final_states[0] must lie in [0, 6)"),
        ({"final_states": [0]}, "final_states must have shape (2,), got (1,)"),
        ({"terminated": [[True, False]]}, "terminated must have shape (2,), got (1, 2)"),
    ],
)
def test_ends_that_do_not_fit_are_refused(fields, message):
    demonstrations = Demonstrations.from_trajectories([WALK, WALK])
    with pytest.raises(ValueError, match=re.escape(message)):
        demonstrations.replace(**{name: jnp.asarray(value) for name, value in fields.items()}).validate(corridor())
