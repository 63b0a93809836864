"""LPAL by the sparse interior-point method: HiGHS on the same program, features up to one per state."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

import jaxhom


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
        assert float(solution.margin[lane]) == pytest.approx(true, abs=1e-7)
    assert (solution.status == jaxhom.Status.SOLVED).all()
