"""What a training state finds in itself."""

import math

import pytest
import torch

from helpers import small, small_off_policy, spec_of
from lemniscate.algos import a2c, ddpg, trpo
from lemniscate.errors import NonFiniteError
from lemniscate.run.run import require_finite


@pytest.mark.parametrize("algo", [a2c, trpo, ddpg])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_parameter_that_is_not_finite_is_named(algo, value):
    config = small_off_policy(algo) if algo is ddpg else small(algo)
    state = algo.init(config, spec_of(), torch.device("cpu"))
    last = list(state.policy.parameters())[-1]
    with torch.no_grad():
        last.fill_(3e38)
    require_finite(state, {})  # whose sum is infinite
    with torch.no_grad():
        last[..., 0] = value
    with pytest.raises(
        NonFiniteError, match=rf"The parameter policy\.\S+ is {value} after the update that ends at step 0"
    ):
        require_finite(state, {})
