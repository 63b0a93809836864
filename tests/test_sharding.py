"""Work over several devices, forced on the host by a flag that must be set before JAX starts."""

import os
import subprocess
import sys

import numpy as np

PAIRS = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from jaxhom.similarity.brackets import Goal, bracket_errors

assert jax.device_count() == {devices}
rng = np.random.default_rng(0)
source, target = (rng.dirichlet(np.ones(3), (700, 3, 2)) for _ in range(2))
found = bracket_errors(source, target, goal=Goal(tolerance=1e-5, method="pdhg"))
assert (found.upper - found.lower).max() <= 1e-5
np.save({path!r}, np.stack([found.lower, found.upper]))
"""

PATHS = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxhom

assert jax.device_count() == {devices}
mdp = jaxhom.gridworld(6, num_regions=9, discount=0.9).mdp
expert = jaxhom.optimal_policy(mdp, mdp.features[..., 8]).policy
table = jaxhom.SimilarityTable(mdp).complete()

def path(key):
    walks = jaxhom.sample_demonstrations(key, mdp, expert, 2, 8)
    general = jaxhom.soft_local_homomorphism(mdp, walks, table=table)
    vhat = jaxhom.feature_expectations(mdp, general.policy)
    learned = jaxhom.lpal(mdp, vhat, initial_policy=general.policy)
    return general.radius, learned.margin, learned.margin_bound

spec, found = jax.sharding.PartitionSpec("draws"), []
for devices in (jax.devices()[:1], jax.devices()):
    mesh = jax.sharding.Mesh(np.array(devices), ("draws",))
    run = jax.jit(jax.shard_map(jax.vmap(path), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    radius, lower, upper = run(jax.random.split(jax.random.key(0), 6))
    assert len(upper.devices()) == len(devices)
    assert (upper - lower).max() <= 1e-3
    found.append(np.concatenate([radius.T, lower[None], upper[None]]))
np.save({path!r}, np.stack(found))
"""


def run(program, path, devices):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags}
    program = program.format(devices=devices, path=str(path))
    subprocess.run([sys.executable, "-c", program], check=True, env=environment, timeout=240)


def test_eight_devices_agree_with_one(tmp_path):
    for devices in (1, 8):
        run(PAIRS, tmp_path / f"{devices}.npy", devices)
    one, eight = (np.load(tmp_path / f"{devices}.npy") for devices in (1, 8))
    np.testing.assert_allclose(one, eight, atol=2e-5)
    assert (np.maximum(one[0], eight[0]) <= np.minimum(one[1], eight[1]) + 1e-12).all()


def test_paths_over_two_devices_are_those_of_one(tmp_path):
    """The same votes draw by draw, and margins within each other's certificates."""
    run(PATHS, tmp_path / "both.npy", 2)
    one, two = np.load(tmp_path / "both.npy")
    np.testing.assert_array_equal(one[:-2], two[:-2])
    assert (np.maximum(one[-2], two[-2]) <= np.minimum(one[-1], two[-1]) + 1e-12).all()
