"""LPAL by the sparse interior-point method: HiGHS on the same program, features up to one per state."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom
from jaxhom import interop


@pytest.mark.parametrize("num_regions", [16, 64])
def test_monte_carlo_expectations(num_regions):
    world = jaxhom.gridworld(8, num_regions=num_regions)
    mdp = world.mdp
    expert = jaxhom.optimal_policy(mdp, mdp.features[..., -1])
    samples = [jaxhom.sample_demonstrations(jax.random.key(i), mdp, expert.policy, 5, 20) for i in range(2)]
    expectations = jnp.stack([jaxhom.monte_carlo_feature_expectations(mdp, sample) for sample in samples])
    solution = jaxhom.lpal(mdp, expectations, method="interior_point")
    arrays = [np.asarray(mdp.transition), 0.99, np.asarray(mdp.initial), np.asarray(mdp.features)]
    for lane in range(2):
        best = oracles.lpal(*arrays, np.asarray(expectations[lane]))[0]
        assert solution.margin[lane] - 1e-8 <= best <= solution.margin_bound[lane] + 1e-8
        true = oracles.margin(*arrays, np.asarray(expectations[lane]), np.asarray(solution.policy[lane]))
        assert true - 0.1 * 1e-3 <= solution.margin[lane] <= true + 1e-9
    assert (solution.status == jaxhom.Status.SOLVED).all()


def test_one_feature_per_state_and_states_that_hardly_occur():
    """Occupancies of all sizes, and expectations that a policy reaches exactly: rounding must not stop it short."""
    lake = interop.from_gymnasium(gymnasium.make("FrozenLake-v1"), discount=0.99)
    mdp = lake.mdp.replace(features=np.repeat(np.eye(16)[:, None], 4, axis=1))
    expert = jaxhom.optimal_policy(mdp, lake.reward)
    expectations = jaxhom.feature_expectations(mdp, expert.policy)
    solution = jaxhom.lpal(mdp, expectations, method="interior_point")
    assert solution.status == jaxhom.Status.SOLVED
    assert solution.margin <= 0.0 <= solution.margin_bound  # states add up to a constant: v* = 0
