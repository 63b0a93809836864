"""A short way through the library, for the oldest releases of what it depends on: seconds, and no test framework."""

import os
import tempfile

import distributed
import h5py
import jax
import networkx
import numpy as np
import pyarrow
import pyarrow.parquet

import jaxhom
from jaxhom import interop, plotting, sweeps

jax.config.update("jax_enable_x64", True)

# An environment, planned for, generalized from demonstrations, and LPAL in each of its ways.
lake = interop.from_gymnasium("FrozenLake-v1", discount=0.95, features=np.eye(16))
plan = jaxhom.optimal_policy(lake, lake.reward)
assert plan.status == jaxhom.Status.SOLVED
demonstrations = jaxhom.sample_demonstrations(jax.random.key(0), lake, plan, 2, 20, terminal=lake.terminal)
general = jaxhom.soft_local_homomorphism(lake, demonstrations)
assert jax.tree.map(np.shape, general).policy == (16, 4)
expectations = jaxhom.feature_expectations(lake, general)
for method in ("columns", "interior_point", "pdhg"):
    solution = jaxhom.lpal(lake, expectations, initial_policy=general, method=method, tolerance=1e-2)
    assert solution.margin <= solution.margin_bound

# Maps between local models, with votes that need one.
world = jaxhom.gridworld(4)
walk = jaxhom.Demonstrations.from_trajectories([([0, 1, 2], [3, 3, 3])])
learned = jaxhom.soft_local_homomorphism(world, walk)
print(learned.explain(int(np.argmax(learned.radius))))
bounds = jaxhom.local_similarity(world, [0, 5, 1], [1, 6, 2])
assert (bounds.lower <= bounds.upper).all()

# Transformations and derivatives.
values = jax.jit(jax.vmap(lambda reward: jaxhom.optimal_policy(lake.mdp, reward).value))(
    np.eye(16)[..., None] * np.ones(4)
)
assert np.isfinite(np.asarray(values)).all()
gradient = jax.grad(lambda reward: jaxhom.optimal_policy(lake.mdp, reward).value.sum())(lake.reward)
assert np.isfinite(np.asarray(gradient)).all()

# Files and pictures.
with tempfile.TemporaryDirectory() as folder:
    interop.save_mdp(os.path.join(folder, "model.npz"), lake.mdp)
    assert interop.load_mdp(os.path.join(folder, "model.npz")).num_states == 16
    roads = networkx.path_graph(3).to_directed()
    networkx.write_graphml(roads, os.path.join(folder, "roads.graphml"))
    assert interop.read_model(os.path.join(folder, "roads.graphml")).mdp.num_states == 4
    rows = pyarrow.table({"obs": [[0, 1, 2], [4, 8]], "acts": [[2, 2], [1]]})
    pyarrow.parquet.write_table(rows, os.path.join(folder, "rows.parquet"))
    with h5py.File(os.path.join(folder, "steps.hdf5"), "w") as file:
        file["observations"], file["actions"], file["terminals"] = [0, 1, 4], [2, 2, 1], [False, True, True]
    for name in ("rows.parquet", "steps.hdf5"):
        assert len(interop.demonstrations_from(os.path.join(folder, name), mdp=lake.mdp)[0]) == 2
    plotting.plot_policy(world, learned.policy).figure.savefig(os.path.join(folder, "policy.png"))

# A sweep, by Dask.
options = {"n_workers": 1, "dashboard_address": None}
with (
    tempfile.TemporaryDirectory() as folder,
    distributed.LocalCluster(processes=False, **options) as cluster,
    distributed.Client(cluster) as client,
):
    cases = [{"draw": draw} for draw in range(3)]
    rows = sweeps.run(
        lambda case: {"twice": 2 * case["draw"]}, cases, os.path.join(folder, "rows.jsonl"), executor=client
    )
assert [row["twice"] for row in rows] == [0, 2, 4]
