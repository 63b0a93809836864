"""A short way through the library, for the oldest releases of what it depends on: seconds, and no test framework."""

import jax
import numpy as np

import jaxhom
from jaxhom.interop import from_gymnasium

jax.config.update("jax_enable_x64", True)
lake = from_gymnasium("FrozenLake-v1", discount=0.95, features=np.eye(16))
plan = jaxhom.optimal_policy(lake, lake.reward)
assert plan.status == jaxhom.Status.SOLVED
demonstrations = jaxhom.sample_demonstrations(jax.random.key(0), lake, plan, 2, 20, terminal=lake.terminal)
general = jaxhom.soft_local_homomorphism(lake, demonstrations)
print(general.explain(int(np.argmax(general.radius))))
expectations = jaxhom.feature_expectations(lake, general)
solution = jaxhom.lpal(lake, expectations, initial_policy=general)
assert solution.margin <= solution.margin_bound
bounds = jaxhom.local_similarity(lake, [0, 5], [1, 6])
assert (bounds.lower <= bounds.upper).all()
values = jax.jit(jax.vmap(lambda reward: jaxhom.optimal_policy(lake.mdp, reward).value))(
    np.eye(16)[..., None] * np.ones(4)
)
assert np.isfinite(np.asarray(values)).all()
gradient = jax.grad(lambda reward: jaxhom.optimal_policy(lake.mdp, reward).value.sum())(lake.reward)
assert np.isfinite(np.asarray(gradient)).all()
assert jax.tree.map(np.shape, general).policy == (16, 4)
