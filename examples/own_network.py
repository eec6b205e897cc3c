"""A network of one's own, for the policy and for every critic.

    cd examples
    lemniscate train ppo --env CartPole-v1 --total-steps 30_000 --network own_network:Fourier
    python own_network.py

A network is called with the number of its inputs and outputs, and takes [B, inputs] to [B, outputs].
"""

import torch
from torch import Tensor, nn

import lemniscate as lem


class Fourier(nn.Module):
    """Random Fourier features of the inputs, then one hidden layer (Tancik et al. 2020, arXiv:2006.10739)."""

    frequencies: Tensor

    def __init__(self, inputs: int, outputs: int, features: int = 32) -> None:
        super().__init__()
        self.register_buffer("frequencies", torch.randn(inputs, features))
        self.layers = nn.Sequential(nn.Linear(2 * features, 64), nn.Tanh(), nn.Linear(64, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """[…, inputs] to […, outputs]."""
        phases = x @ self.frequencies
        return self.layers(torch.cat([phases.sin(), phases.cos()], dim=-1))


if __name__ == "__main__":
    trained = lem.train("ppo", env="CartPole-v1", network=Fourier, total_steps=30_000)
    print(lem.evaluate(trained.policy, episodes=20).mean_return)
