"""Programs for processes of their own: what stands beside ours. The last thing each prints is its number.

Two take turns: REPLAY, which is ours, and PEER_REPLAY. For each line that they read they take 500 steps, and write one;
where nothing more can be read, they end.
"""

PEER = """
import sys, time, torch
peer, env, threads, kind, steps = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4], int(sys.argv[5])
torch.set_num_threads(threads)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
if peer == "sb3":
    from stable_baselines3 import PPO
else:
    from sbx import PPO
if __name__ == "__main__":
    vector = make_vec_env(env, n_envs=16, vec_env_cls=SubprocVecEnv if kind == "subproc" else DummyVecEnv)
    model = PPO("MlpPolicy", vector, n_steps=128, batch_size=64, n_epochs=10, learning_rate=3e-4)
    model.learn(4096)
    started = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    print((model.num_timesteps - 4096) / (time.perf_counter() - started))
"""

BARE = """
import sys, time, warnings, numpy, envpool
warnings.simplefilter("ignore")
env = envpool.make(sys.argv[1], env_type="gymnasium", num_envs=int(sys.argv[3]), num_threads=2, seed=1)
space = env.action_space
num_envs = int(sys.argv[3])
actions = numpy.random.default_rng(0).uniform(space.low, space.high, (64, num_envs, *space.shape))
env.reset()
for t in range(3200 // num_envs): env.step(actions[t % 64])
started = time.perf_counter()
for t in range(int(sys.argv[2]) // num_envs): env.step(actions[t % 64])
print(int(sys.argv[2]) / (time.perf_counter() - started))
"""

REPLAY = """
import json, sys, tempfile
import lemniscate as lem

def take_turns(step, metrics, policy):  # every 500 steps
    print(flush=True)
    sys.stdin.readline() or sys.exit()

sys.stdin.readline()
with tempfile.TemporaryDirectory() as scratch:
    fields = {"preset": "default", "run": scratch + "/run", "progress": False, "callbacks": [take_turns]}
    lem.train("ddpg", "Hopper-v5", **fields, **json.loads(sys.argv[1]))
"""

PEER_REPLAY = """
import os, sys
peer, threads = sys.argv[1], int(sys.argv[2])
if peer == "sbx":  # XLA has a thread for each processor that it may use
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
import numpy, torch
torch.set_num_threads(threads)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
if peer == "sb3":
    from stable_baselines3 import DDPG
else:
    from sbx import DDPG

class Turns(BaseCallback):
    def _on_step(self):
        if self.n_calls % 500 == 0:
            print(flush=True)
            sys.stdin.readline() or sys.exit()
        return True

sys.stdin.readline()
noise = NormalActionNoise(numpy.zeros(3), 0.1 * numpy.ones(3))
fields = dict(batch_size=256, learning_rate=3e-4, learning_starts=500, action_noise=noise, buffer_size=100_000)
DDPG("MlpPolicy", "Hopper-v5", policy_kwargs={"net_arch": [256, 256]}, **fields).learn(1_000_000, Turns())
"""

PEER_LANDER = """
import sys, time, torch
torch.set_num_threads(1)
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
vector, judge = make_vec_env("LunarLander-v3", n_envs=16), make_vec_env("LunarLander-v3", n_envs=16)
fields = dict(n_steps=1024, batch_size=64, gae_lambda=0.98, gamma=0.999, n_epochs=4, ent_coef=0.01)
model = PPO("MlpPolicy", vector, seed=int(sys.argv[1]), **fields)
stop = StopTrainingOnRewardThreshold(250)
model.learn(1_000_000, EvalCallback(judge, stop, n_eval_episodes=100, eval_freq=3125, verbose=0, warn=False))
print(model.num_timesteps)
"""

PEER_MINUTES = """
import importlib, time, torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

SHARED = dict(n_steps=512, policy_kwargs=dict(log_std_init=-2, ortho_init=False, net_arch=[256, 256]))
PPO = {  # rl-baselines3-zoo, ppo.yml; Ant has the defaults there
    "HalfCheetah-v5": dict(batch_size=64, gamma=0.98, learning_rate=2.0633e-5, ent_coef=0.000401762, clip_range=0.1,
        n_epochs=20, gae_lambda=0.92, max_grad_norm=0.8, vf_coef=0.58096, **SHARED),
    "Hopper-v5": dict(batch_size=32, gamma=0.999, learning_rate=9.80828e-5, ent_coef=0.00229519, clip_range=0.2,
        n_epochs=5, gae_lambda=0.99, max_grad_norm=0.7, vf_coef=0.835671, **SHARED),
    "Ant-v5": dict(),
}

class Clock(BaseCallback):
    def __init__(self, started, minutes):
        super().__init__()
        self.started, self.minutes, self.curve, self.returns = started, minutes, [], []

    def _on_step(self):
        self.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        spent = (time.monotonic() - self.started) / 60
        if len(self.returns) >= 5 or self.returns and spent >= self.minutes:
            self.curve.append([spent, self.num_timesteps, float(sum(self.returns) / len(self.returns))])
            self.returns = []
        return spent < self.minutes

def train(library, algorithm, env, seed, minutes):
    torch.set_num_threads(1)
    started = time.monotonic()
    package = importlib.import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[library])
    vector, fields = make_vec_env(env, n_envs=1, seed=seed), dict(learning_starts=10_000)
    if algorithm == "ppo":
        vector, fields = VecNormalize(vector), dict(PPO[env])
        if "policy_kwargs" in fields and library == "sb3":
            fields["policy_kwargs"] = {**fields["policy_kwargs"], "activation_fn": torch.nn.ReLU}
        elif "policy_kwargs" in fields:
            import flax.linen
            fields["policy_kwargs"] = dict(log_std_init=-2, net_arch=[256, 256], activation_fn=flax.linen.relu)
    clock = Clock(started, minutes)
    model = getattr(package, algorithm.upper())("MlpPolicy", vector, seed=seed, **fields)
    model.learn(10**9, clock)
    spent = (time.monotonic() - started) / 60
    judge = make_vec_env(env, n_envs=10, seed=10_000)
    if algorithm == "ppo":
        judge = VecNormalize(judge, training=False, norm_reward=False)
        judge.obs_rms = vector.obs_rms
    mean, _ = evaluate_policy(model, judge, n_eval_episodes=100)
    return {"steps": model.num_timesteps, "minutes": spent, "curve": clock.curve, "mean_return": float(mean)}
"""

PEER_TRPO = """
import sys, time, torch
steps, kind, threads, cg_iterations, critic_epochs, max_kl = int(sys.argv[1]), sys.argv[2], *map(float, sys.argv[3:])
torch.set_num_threads(int(threads))
from sb3_contrib import TRPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
if __name__ == "__main__":
    vector = make_vec_env("HalfCheetah-v5", n_envs=16, vec_env_cls=SubprocVecEnv if kind == "subproc" else DummyVecEnv)
    fields = dict(n_steps=128, batch_size=128, learning_rate=1e-3, cg_damping=0.1, target_kl=max_kl)
    fields |= dict(cg_max_steps=int(cg_iterations), n_critic_updates=int(critic_epochs))
    model = TRPO("MlpPolicy", vector, **fields)
    model.learn(4096)
    started = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    print((model.num_timesteps - 4096) / (time.perf_counter() - started))
"""

EXCHANGE = """
import json, statistics, sys, time, torch
from lemniscate.system.processes import join_world
rounds, sizes, spent = int(sys.argv[1]), map(int, sys.argv[2:]), {}
with join_world() as world:
    for size in sizes:
        mine, times = torch.randn(1, size), []
        for _ in range(20 * rounds):
            started = time.perf_counter()
            world.gather(mine)
            times.append(1e3 * (time.perf_counter() - started))
        spent[size] = statistics.median(times[2:])
print(json.dumps(spent))
"""

RLLIB_CONFIG = """
import json, logging, sys, time, torch
torch.set_num_threads(1)
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

def ppo(env, runners, num_envs, **training):
    ray.init(num_cpus=3, log_to_driver=False, logging_level=logging.ERROR, include_dashboard=False)
    config = PPOConfig().environment(env).framework("torch").debugging(log_level="ERROR")
    config = config.env_runners(num_env_runners=runners, num_envs_per_env_runner=num_envs // max(runners, 1))
    model = DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh", vf_share_layers=False)
    training |= dict(vf_clip_param=float("inf"), kl_coeff=0.0, clip_param=0.2, grad_clip=0.5)
    return config.training(**training).rl_module(model_config=model)
"""

RLLIB = (
    RLLIB_CONFIG
    + """
fields = dict(train_batch_size_per_learner=2048, minibatch_size=64, num_epochs=10, lr=3e-4, gamma=0.99, lambda_=0.95)
algorithm = ppo("HalfCheetah-v5", int(sys.argv[1]), 16, **fields).build_algo()
for _ in range(2): algorithm.train()
started, steps = time.perf_counter(), 0
for _ in range(6): steps += algorithm.train()["env_runners"]["num_env_steps_sampled"]
print(json.dumps(float(steps) / (time.perf_counter() - started)))
"""
)

RLLIB_LANDER = (
    RLLIB_CONFIG
    + """
fields = dict(train_batch_size_per_learner=16_384, minibatch_size=64, num_epochs=4, lr=3e-4, gamma=0.999, lambda_=0.98)
config = ppo("LunarLander-v3", 2, 16, entropy_coeff=0.01, **fields).debugging(seed=int(sys.argv[1]))
judge = dict(evaluation_num_env_runners=0, evaluation_config=dict(explore=False, num_envs_per_env_runner=16))
config = config.evaluation(evaluation_interval=3, evaluation_duration=100, **judge)
algorithm, steps, reached = config.build_algo(), 0, float("-inf")
while steps < 1_000_000 and not reached >= 250:  # RLlib says NaN where no episode of an evaluation has ended
    result = algorithm.train()
    steps += result["env_runners"]["num_env_steps_sampled"]
    if "evaluation" in result:
        reached = float(result["evaluation"]["env_runners"]["episode_return_mean"])
        print(steps, reached, file=sys.stderr, flush=True)
print(json.dumps([int(steps), reached]))
"""
)
