# === right: the notebook's, with the batch's action space, for one environment
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F


class Actor(nn.Module):
    def __init__(self, env):
        super().__init__()
        hidden_size = 256
        self.fc1 = nn.Linear(np.prod(env.single_observation_space.shape), hidden_size)
        self.fc2 = nn.Linear(hidden_size, hidden_size)
        self.fc_mu = nn.Linear(hidden_size, np.prod(env.single_action_space.shape))
        self.register_buffer(
            "action_scale", torch.tensor((env.action_space.high - env.action_space.low) / 2.0, dtype=torch.float32)
        )
        self.register_buffer(
            "action_bias", torch.tensor((env.action_space.high + env.action_space.low) / 2.0, dtype=torch.float32)
        )

    def forward(self, x):
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = torch.tanh(self.fc_mu(x))
        return x * self.action_scale + self.action_bias

# === right: the notebook's with single_action_space and an own __init__ of the weights
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F


class Actor(nn.Module):
    def __init__(self, env, hidden_size=256):
        super().__init__()
        low, high = env.single_action_space.low, env.single_action_space.high
        self.fc1 = nn.Linear(np.array(env.single_observation_space.shape).prod(), hidden_size)
        self.fc2 = nn.Linear(hidden_size, hidden_size)
        self.fc_mu = nn.Linear(hidden_size, np.prod(env.single_action_space.shape))
        nn.init.uniform_(self.fc_mu.weight, -3e-3, 3e-3)
        nn.init.uniform_(self.fc_mu.bias, -3e-3, 3e-3)
        self.register_buffer("action_scale", torch.tensor((high - low) / 2.0, dtype=torch.float32))
        self.register_buffer("action_bias", torch.tensor((high + low) / 2.0, dtype=torch.float32))

    def forward(self, x):
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = torch.tanh(self.fc_mu(x))
        return x * self.action_scale + self.action_bias

# === wrong: tanh is missing: the action leaves its bounds | tanh|bound|limit|range|outside
# --- instead of
        x = torch.tanh(self.fc_mu(x))
# --- here
        x = self.fc_mu(x)

# === wrong: the bias is missing: bounds that are not symmetric are missed | bias|symmetric|bound|middle|cent(er|re)|range
# --- instead of
        return x * self.action_scale + self.action_bias
# --- here
        return x * self.action_scale

# === wrong: the output is not scaled to the bounds | scal|bound|range
# --- instead of
        return x * self.action_scale + self.action_bias
# --- here
        return x

# === wrong: the scale is the whole width of the range: divided by 2 is missing | scale|half|/ ?2|bound|range|twice|width|outside
# --- instead of
        self.register_buffer("action_scale", torch.tensor((high - low) / 2.0, dtype=torch.float32))
# --- here
        self.register_buffer("action_scale", torch.tensor(high - low, dtype=torch.float32))

# === wrong: the scale of the first dimension is used for all | dimension|each|bound|scale|range|first
# --- instead of
        self.register_buffer("action_scale", torch.tensor((high - low) / 2.0, dtype=torch.float32))
        self.register_buffer("action_bias", torch.tensor((high + low) / 2.0, dtype=torch.float32))
# --- here
        self.register_buffer("action_scale", torch.tensor((high[0] - low[0]) / 2.0, dtype=torch.float32))
        self.register_buffer("action_bias", torch.tensor((high[0] + low[0]) / 2.0, dtype=torch.float32))

# === wrong: ReLU behind the last layer, before the tanh: half of the range is never reached | relu|half|range|reach|lower|bias|never
# --- instead of
        x = torch.tanh(self.fc_mu(x))
# --- here
        x = torch.tanh(F.relu(self.fc_mu(x)))

# === wrong: softmax for tanh, as for discrete actions | tanh|softmax|bound|range|lower|sum
# --- instead of
        x = torch.tanh(self.fc_mu(x))
# --- here
        x = torch.softmax(self.fc_mu(x), dim=-1)

# === wrong: forward returns nothing | None|return|nothing
# --- instead of
        return x * self.action_scale + self.action_bias
# --- here
        x = x * self.action_scale + self.action_bias

# === wrong: one output, whatever the number of actions | shape|output|action|dimension
# --- instead of
        self.fc_mu = nn.Linear(hidden_size, np.prod(env.single_action_space.shape))
# --- here
        self.fc_mu = nn.Linear(hidden_size, 1)

# === wrong: bias and scale are exchanged | bias|scale|exchang|swap|bound|range|reach
# --- instead of
        return x * self.action_scale + self.action_bias
# --- here
        return x * self.action_bias + self.action_scale

# === wrong: scale and bias are learned parameters | parameter|buffer|learn|train
# --- instead of
        self.register_buffer("action_scale", torch.tensor((high - low) / 2.0, dtype=torch.float32))
        self.register_buffer("action_bias", torch.tensor((high + low) / 2.0, dtype=torch.float32))
# --- here
        self.action_scale = nn.Parameter(torch.tensor((high - low) / 2.0, dtype=torch.float32))
        self.action_bias = nn.Parameter(torch.tensor((high + low) / 2.0, dtype=torch.float32))
