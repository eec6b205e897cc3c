"""The exported C on a Cortex-M4F: its compiler, and QEMU's simulation of one."""

import numpy as np
import pytest
from exported import exported, policy_for

from lemniscate.exporting.compiled import missing_target_tools, simulate, target_sizes
from lemniscate.spec import Box

missing = missing_target_tools()
pytestmark = pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


@pytest.fixture(scope="module")
def drone():
    """Of the size of the figure eight's: 43 numbers, two layers of 64, four actions."""
    policy = policy_for(
        Box((-1.5,) * 3 + (0.05,), (1.5,) * 3 + (0.48,)),
        observations=43,
        hidden=(64, 64),
        normalize_observations=True,
        spread=0.1,
    )
    return exported(policy, rows=10_000)


def test_the_drone_fits(drone):
    sizes = target_sizes(drone.files(tests=72))
    assert sizes["flash_bytes"] <= 32 * 1024
    self_test = sizes["flash_bytes_with_self_test"] - sizes["flash_bytes"]
    assert 72 * 47 * 4 <= self_test <= 72 * 47 * 4 + 500
    assert sizes["ram_bytes"] == sizes["static_bytes"] + sizes["stack_bytes"] <= 1024
    assert sizes["static_bytes"] == 4 * 128


def test_the_simulated_core_acts_as_torch_at_ten_thousand_observations(drone):
    actions, self_test, instructions = simulate(drone.files(), drone.obs, 4)
    assert actions.shape == (10_000, 4)
    assert np.abs(actions - drone.true).max() <= 1e-5
    assert self_test <= 1e-5
    assert 7104 * 4 < instructions < 7104 * 9


def test_instructions_are_counted(drone):
    """Twice the work is twice the instructions."""
    files = drone.files()
    once = simulate(files, drone.obs[:2], 4)[2]
    statement = "policy_linear(weight_"
    lines = [line for line in files["policy.c"].splitlines() if statement in line]
    for line in lines:
        files["policy.c"] = files["policy.c"].replace(line, f"{line}\n{line}")
    twice = simulate(files, drone.obs[:2], 4)[2]
    assert 1.7 < twice / once < 2


@pytest.mark.parametrize("fields", [{"network": "simba"}, {"network": "layer_norm", "activation": "silu"}])
def test_other_networks_too(fields):
    copy = exported(policy_for(**fields))
    actions, _, _ = simulate(copy.files(), copy.obs, copy.true.shape[1])
    assert np.abs(actions - copy.true).max() <= 1e-5
