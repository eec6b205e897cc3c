"""REPPO that collects while it learns: in a second thread, by the policy of one update before. An experiment.

    cd benchmarks
    lemniscate train reppo --env HalfCheetah-v5 --total-steps 1_000_000 --checkpoint-every 100_000_000 --compile on
    lemniscate train late --env HalfCheetah-v5 --total-steps 1_000_000 --checkpoint-every 100_000_000 --compile on

The first rollout that is learned from is of the first policy, and so is the second: only then is one update behind.
What acts is a copy, with noise of a generator of its own, so that a run has the same bits whichever thread is faster.
docs/speed.md has what it gave. It has no checkpoints on the way: the rollout that is under way would be lost.
"""

from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy

import torch

from lemniscate.algos.reppo import Config, State, init, update
from lemniscate.data.rollout import collect

__all__ = ["Config", "State", "init", "train"]


def train(config, run):
    """Collect with the policy of one update before, while this one's rollout is learned from."""
    state = init(config, run.spec, run.env.device)
    acting = deepcopy(state.policy)  # before its methods are compiled
    state = run.restore(state)
    noise = torch.Generator().manual_seed(config.seed)
    with ThreadPoolExecutor(1) as second:
        rollout = None
        for env in run.until(config.total_steps, state):
            acting.load_state_dict(state.policy.state_dict())
            rollout = rollout or collect(env, acting, config.num_steps, noise)
            episodes = env.take_episodes()
            ahead = second.submit(collect, env, acting, config.num_steps, noise)
            metrics, rollout = update(config, state, rollout), ahead.result()
            run.log(state, metrics, episodes)
    return state
