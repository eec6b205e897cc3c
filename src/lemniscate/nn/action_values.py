"""Q(s, a) of each of n discrete actions, and the policy that acts by it."""

from torch import Tensor, nn

from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import network_of, normalizer_of
from lemniscate.nn.networks import Layers
from lemniscate.nn.policies import EpsilonGreedyPolicy
from lemniscate.spec import Discrete, Spec


class ActionValues(nn.Module):
    """An ε-greedy policy; its network is Q(s, ·).

    Raises:
        UserError: actions of another kind than Discrete.
    """

    def __init__(self, spec: Spec, layers: Layers, normalize_observations: bool) -> None:
        super().__init__()
        if not isinstance(spec.action, Discrete):
            raise UserError(f"{spec.env_id} has actions {spec.action}, and Q has one output for each Discrete action.")
        net = network_of(spec, layers, spec.action.n, last_gain=0.01)
        self.policy = EpsilonGreedyPolicy(normalizer_of(spec, normalize_observations), net, spec.action)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q(s, a) of rows […, O] and […], […]."""
        return self.policy(obs).values.gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Q(s, a) and max_a Q(s', a) of rows […, O], […, O] and […], […] each."""
        return self.q(obs, action), self.policy(next_obs).values.amax(-1)
