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
        x = F.relu(self.fc3(x))
        return x

# === wrong: concatenation along the batch | axis|dim|concat|cat|shape|size
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
        x = torch.cat([x, a], 0)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: Q does not see the action | action
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
        x = torch.cat([x, torch.zeros_like(a)], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: Q does not see the state: the action twice over | state|observation|obs
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
        x = torch.cat([x * 0, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: tanh at the end: Q is bounded by 1 | tanh|bound|range|limit|last|end
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
        x = torch.tanh(self.fc3(x))
        return x

# === wrong: an output for each dimension of the action, as of a DQN | output|shape|one|\[B, 1\]|scalar
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
        self.fc3 = nn.Linear(hidden_size, int(np.prod(env.single_action_space.shape)))

    def forward(self, x, a):
        x = torch.cat([x, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: no nonlinearity: the layers are one linear map | linear|relu|activation
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
        x = self.fc1(x)
        x = self.fc2(x)
        x = self.fc3(x)
        return x

# === wrong: the input's size lacks the actions | size|shape|mat|input|error|action
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F


class QNetwork(nn.Module):
    def __init__(self, env, hidden_size=256):
        super().__init__()
        self.fc1 = nn.Linear(np.prod(env.single_observation_space.shape), hidden_size)
        self.fc2 = nn.Linear(hidden_size, hidden_size)
        self.fc3 = nn.Linear(hidden_size, 1)

    def forward(self, x, a):
        x = torch.cat([x, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x

# === wrong: the mean over the batch is returned | mean|batch|shape|row|averag|\[B, 1\]
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
        return self.fc3(x).mean()

# === wrong: the size is that of the batch's observations plus one | single_|size|shape|mat|input
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F


class QNetwork(nn.Module):
    def __init__(self, env, hidden_size=256):
        super().__init__()
        self.fc1 = nn.Linear(np.prod(env.observation_space.shape) + 1, hidden_size)
        self.fc2 = nn.Linear(hidden_size, hidden_size)
        self.fc3 = nn.Linear(hidden_size, 1)

    def forward(self, x, a):
        x = torch.cat([x, a], 1)
        x = F.relu(self.fc1(x))
        x = F.relu(self.fc2(x))
        x = self.fc3(x)
        return x
