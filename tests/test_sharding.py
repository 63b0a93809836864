"""Pairs over several devices: eight, forced on the host by a flag that must be set before JAX starts."""

import os
import subprocess
import sys

PROGRAM = """
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


def run(path, devices):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags}
    program = PROGRAM.format(devices=devices, path=str(path))
    subprocess.run([sys.executable, "-c", program], check=True, env=environment, timeout=240)


def test_eight_devices_agree_with_one(tmp_path):
    import numpy as np

    for devices in (1, 8):
        run(tmp_path / f"{devices}.npy", devices)
    one, eight = (np.load(tmp_path / f"{devices}.npy") for devices in (1, 8))
    np.testing.assert_allclose(one, eight, atol=2e-5)
    assert (np.maximum(one[0], eight[0]) <= np.minimum(one[1], eight[1]) + 1e-12).all()
