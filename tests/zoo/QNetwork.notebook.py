# === right: the notebook's, with one extra argument
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F


class QNetwork(nn.Module):
    def __init__(self, env, hidden_size=256):
        super().__init__()
        self.fc1 = nn.Linear(
            np.prod(env.single_observation_space.shape) + np.prod(env.single_action_space.shape), hidden_size
        )
        self.fc2 = nn.Linear(hidden_size, hidden_size)
        self.fc3 = nn.Linear(hidden_size, 1)

    def forward(self, x, a):
        x = torch.cat([x, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: ReLU at the end: Q is never negative | relu|negativ|last|end
# --- instead of
        x = self.fc3(x)
# --- here
        x = F.relu(self.fc3(x))

# === wrong: concatenation along the batch | axis|dim|concat|cat|shape|size
# --- instead of
        x = torch.cat([x, a], 1)
# --- here
        x = torch.cat([x, a], 0)

# === wrong: Q does not see the action | action
# --- instead of
        x = torch.cat([x, a], 1)
# --- here
        x = torch.cat([x, torch.zeros_like(a)], 1)

# === wrong: Q does not see the state: the action twice over | state|observation|obs
# --- instead of
        x = torch.cat([x, a], 1)
# --- here
        x = torch.cat([x * 0, a], 1)

# === wrong: tanh at the end: Q is bounded by 1 | tanh|bound|range|limit|last|end
# --- instead of
        x = self.fc3(x)
# --- here
        x = torch.tanh(self.fc3(x))

# === wrong: an output for each dimension of the action, as of a DQN | output|shape|one|\[B, 1\]|scalar
# --- instead of
        self.fc3 = nn.Linear(hidden_size, 1)
# --- here
        self.fc3 = nn.Linear(hidden_size, int(np.prod(env.single_action_space.shape)))

# === wrong: no nonlinearity: the layers are one linear map | linear|relu|activation
# --- instead of
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
# --- here
        x = self.fc1(x)
        x = self.fc2(x)

# === wrong: the input's size lacks the actions | size|shape|mat|input|error|action
# --- instead of
        self.fc1 = nn.Linear(
            np.prod(env.single_observation_space.shape) + np.prod(env.single_action_space.shape), hidden_size
        )
# --- here
        self.fc1 = nn.Linear(np.prod(env.single_observation_space.shape), hidden_size)

# === wrong: the mean over the batch is returned | mean|batch|shape|row|averag|\[B, 1\]
# --- instead of
        x = self.fc3(x)
        return x
# --- here
        return self.fc3(x).mean()

# === wrong: the size is that of the batch's observations plus one | single_|size|shape|mat|input
# --- instead of
        self.fc1 = nn.Linear(
            np.prod(env.single_observation_space.shape) + np.prod(env.single_action_space.shape), hidden_size
        )
# --- here
        self.fc1 = nn.Linear(np.prod(env.observation_space.shape) + 1, hidden_size)
