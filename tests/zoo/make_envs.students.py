# === right: lem.make_vec and the course's chain, a function that wraps, tensors on the device
import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import lemniscate as lem
from lemniscate.envs.vector_view import NormalizeObservation


class TorchEnv(gym.vector.VectorWrapper):
    def __init__(self, env, device="cpu"):
        super().__init__(env)
        self.device = torch.device(device)

    def _t(self, x):
        return torch.as_tensor(np.asarray(x), device=self.device)

    def reset(self, *, seed=None, options=None):
        obs, info = self.env.reset(seed=seed, options=options)
        return self._t(obs), info

    def step(self, actions):
        if isinstance(actions, torch.Tensor):
            actions = actions.detach().cpu().numpy()
        obs, reward, terminated, truncated, info = self.env.step(actions)
        return self._t(obs), self._t(reward), self._t(terminated), self._t(truncated), info


def make_envs(n_envs, n_eval_envs, train_device="cpu", env_name="CartPole-v1"):
    train = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_envs)))
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
    evaluation.update_running_mean = False
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)

# === wrong: the statistics go on being updated in evaluation | update_running_mean|evaluat|statistic|updat
# --- instead of
    evaluation.update_running_mean = False
# --- here

# === wrong: update_running_mean is set on the outermost wrapper, which keeps it for itself | update_running_mean|evaluat|statistic|updat|wrapper
# --- instead of
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
# --- here
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
    train, evaluation = TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- instead of
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- here
    return train, evaluation

# === wrong: the same environments twice | same|two|separate|both|n_eval_envs|number
# --- instead of
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
    evaluation.update_running_mean = False
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- here
    envs = TorchEnv(train, train_device)
    return envs, envs

# === wrong: the numbers of environments are exchanged | number|exchang|swap|n_envs|n_eval_envs|environments
# --- instead of
    train = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_envs)))
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
# --- here
    train = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_envs)))

# === wrong: n_eval_envs is ignored: both have n_envs | number|n_eval_envs|evaluat|environments
# --- instead of
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
# --- here
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_envs)))

# === wrong: the training's statistics are frozen too, and never learned | update_running_mean|train|statistic|frozen|updat|never
# --- instead of
    evaluation.update_running_mean = False
# --- here
    evaluation.update_running_mean = train.update_running_mean = False

# === wrong: only the training envs are returned | two|pair|tuple|return|eval|both|unpack
# --- instead of
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- here
    return TorchEnv(train, train_device)

# === wrong: the pair in the other order: evaluation first | order|exchang|swap|first|number|evaluat
# --- instead of
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- here
    return TorchEnv(evaluation, train_device), TorchEnv(train, train_device)

# === wrong: nothing is returned | None|return|nothing
# --- instead of
    return TorchEnv(train, train_device), TorchEnv(evaluation, train_device)
# --- here
    TorchEnv(train, train_device), TorchEnv(evaluation, train_device)

# === wrong: a misspelt environment | CartPol|environment|known|found|registered|error|name
# --- instead of
    train = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_envs)))
# --- here
    train = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec("CartPol-v1", n_envs)))

# === wrong: both envs hold the same statistics object, and evaluation updates it | statistic|shar|same|update|obs_rms
# --- instead of
    evaluation.update_running_mean = False
# --- here
    evaluation.obs_rms = train.obs_rms

# === wrong: no normalization of the observations in the evaluation envs | normaliz|observation|evaluat
# --- instead of
    evaluation = NormalizeObservation(RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs)))
    evaluation.update_running_mean = False
# --- here
    evaluation = RecordEpisodeStatistics(lem.make_vec(env_name, n_eval_envs))

# === right: SyncVectorEnv with thunks, Gymnasium's own wrappers, its default NEXT_STEP
import gymnasium as gym
import torch
from gymnasium.wrappers.vector import NormalizeObservation, NumpyToTorch


def make_env(env_id, index):
    def thunk():
        env = gym.make(env_id)
        env = gym.wrappers.RecordEpisodeStatistics(env)
        env.action_space.seed(index)
        return env

    return thunk


def make_envs(n_envs, n_eval_envs, train_device=torch.device("cpu"), env_name="Pendulum-v1", seed=0):
    both = []
    for count, learn in ((n_envs, True), (n_eval_envs, False)):
        envs = gym.vector.SyncVectorEnv([make_env(env_name, seed + i) for i in range(count)])
        envs = NormalizeObservation(envs)
        envs.update_running_mean = learn
        both.append(NumpyToTorch(envs, device=train_device))
    return both[0], both[1]

# === wrong: the running mean is learned in evaluation and frozen in training | update_running_mean|evaluat|statistic|updat|exchang|swap
# --- instead of
        envs.update_running_mean = learn
# --- here
        envs.update_running_mean = not learn

# === wrong: one environment too few: range(1, count) | number|n_envs|environments|few|off by one
# --- instead of
        envs = gym.vector.SyncVectorEnv([make_env(env_name, seed + i) for i in range(count)])
# --- here
        envs = gym.vector.SyncVectorEnv([make_env(env_name, seed + i) for i in range(1, count)])

# === wrong: single environments, not vectors | vector|num_envs|number|single
# --- instead of
        envs = gym.vector.SyncVectorEnv([make_env(env_name, seed + i) for i in range(count)])
        envs = NormalizeObservation(envs)
# --- here
        envs = gym.wrappers.NormalizeObservation(make_env(env_name, seed)())
# --- instead of
        both.append(NumpyToTorch(envs, device=train_device))
# --- here
        both.append(envs)

# === right: gym.make_vec, keyword arguments only at the end, NormalizeObservation innermost
from functools import partial

import gymnasium as gym
from gymnasium.wrappers import vector as wrap


def make_envs(n_envs: int, n_eval_envs: int, train_device: str = "cpu", *, env_name: str = "MountainCarContinuous-v0", **kwargs):
    make = partial(gym.make_vec, env_name, vectorization_mode="sync", **kwargs)

    def chain(envs, training):
        envs = wrap.NormalizeObservation(envs)
        envs.update_running_mean = training
        envs = wrap.RecordEpisodeStatistics(envs)
        return wrap.NumpyToTorch(envs, train_device)

    return tuple(chain(make(num_envs=n), training) for n, training in zip((n_envs, n_eval_envs), (True, False)))

# === wrong: the reward is normalized where the observation should be | observation|normaliz
# --- instead of
        envs = wrap.NormalizeObservation(envs)
        envs.update_running_mean = training
# --- here
        envs = wrap.NormalizeReward(envs)

# === right: a class with a static method, the course's names, lem's normalizer, tensors by a transform of its own
import gymnasium as gym
import torch

import lemniscate as lem
from lemniscate.envs.vector_view import NormalizeObservation


class ToDevice(gym.vector.VectorWrapper):
    def __init__(self, env, device):
        super().__init__(env)
        self.move = lambda x: torch.from_numpy(x).to(device)

    def reset(self, **kwargs):
        obs, infos = self.env.reset(**kwargs)
        return self.move(obs), infos

    def step(self, action):
        out = self.env.step(action.cpu().numpy() if torch.is_tensor(action) else action)
        return (*map(self.move, out[:4]), out[4])


class Setup:
    env_name = "Acrobot-v1"

    @staticmethod
    def normalized(n, env_name, update):
        envs = NormalizeObservation(lem.make_vec(env_name, num_envs=n), epsilon=1e-6)
        envs.update_running_mean = update
        return envs

    @staticmethod
    def make_envs(n_envs, n_eval_envs, train_device="cpu", env_name=None):
        env_name = env_name or Setup.env_name
        train_envs = ToDevice(Setup.normalized(n_envs, env_name, True), train_device)
        eval_envs = ToDevice(Setup.normalized(n_eval_envs, env_name, False), train_device)
        return train_envs, eval_envs
