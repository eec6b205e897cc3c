"""The exported C on a Cortex-M4F: its compiler, and QEMU's simulation of one."""

import numpy as np
import pytest
from exported import exported, policy_for

from lemniscate.exporting import target
from lemniscate.spec import Box

missing = target.missing_tools()
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
    sizes = target.sizes(drone.files(tests=72))
    assert sizes.flash <= 32 * 1024
    assert 72 * 47 * 4 <= sizes.self_test <= 72 * 47 * 4 + 500
    assert sizes.static + sizes.stack <= 1024
    assert sizes.static == 4 * 128


def test_the_simulated_core_acts_as_torch_at_ten_thousand_observations(drone):
    done = target.simulate(drone.files(), drone.obs, 4)
    assert done.actions.shape == (10_000, 4)
    assert np.abs(done.actions - drone.true).max() <= 1e-5
    assert done.self_test <= 1e-5
    assert 7104 * 4 < done.instructions < 7104 * 9


def test_instructions_are_counted(drone):
    """Twice the work is twice the instructions."""
    files = drone.files()
    once = target.simulate(files, drone.obs[:2], 4).instructions
    statement = "policy_linear(weight_"
    lines = [line for line in files["policy.c"].splitlines() if statement in line]
    for line in lines:
        files["policy.c"] = files["policy.c"].replace(line, f"{line}\n{line}")
    twice = target.simulate(files, drone.obs[:2], 4).instructions
    assert 1.7 < twice / once < 2


@pytest.mark.parametrize("fields", [{"network": "simba"}, {"network": "layer_norm", "activation": "silu"}])
def test_other_networks_too(fields):
    copy = exported(policy_for(**fields))
    done = target.simulate(copy.files(), copy.obs, copy.true.shape[1])
    assert np.abs(done.actions - copy.true).max() <= 1e-5
