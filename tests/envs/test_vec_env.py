"""Environments shared by several processes are those of one."""

import pytest
import torch
from gymnasium.vector import AutoresetMode

import toy
from lemniscate.envs import registry
from lemniscate.envs.spaces import random_action
from threads import in_world

ENVS = {"Pendulum-v1": "gymnasium", "CartPole-v1": "envpool", "Countdown-v0": "gymnasium"}


def played(world, env_id, backend, steps=30):
    """Everything that comes of random actions in eight environments, and the episodes that ended."""
    env = registry.make(env_id, 8, backend=backend, stagger=True, world=world)
    try:
        rows, rng = [env.restart(5, steps=0)], torch.Generator().manual_seed(1)
        for _ in range(steps):
            step = env.step(random_action(env.spec, env.obs, rng))
            rows += [step.obs, step.next_obs, step.reward, step.terminated, step.truncated, step.valid]
        return rows, env.take_episodes(), env.steps
    finally:
        env.close()


@pytest.mark.parametrize("env_id", ENVS)
def test_any_number_of_processes_steps_the_same_environments(env_id):
    if ENVS[env_id] == "envpool":
        pytest.importorskip("envpool")
    ((rows, episodes, steps),) = in_world(4, 1, lambda world: played(world, env_id, ENVS[env_id]))
    assert steps == 8 * 30
    for size in (2, 4):
        for theirs, ended, taken in in_world(4, size, lambda world: played(world, env_id, ENVS[env_id])):
            assert all(map(torch.equal, rows, theirs))
            assert (ended, taken) == (episodes, steps)


def test_what_each_environment_does_does_not_depend_on_the_shards():
    alone, shared = (
        in_world(shards, 1, lambda world: played(world, "Pendulum-v1", "gymnasium"))[0] for shards in (1, 4)
    )
    assert all(map(torch.equal, alone[0], shared[0]))


def test_first_episodes_are_cut_alike_in_any_process():
    whole = registry.make("Pendulum-v1", 8, stagger=True)
    whole.restart(3)
    part = registry.make("Pendulum-v1", 2, stagger=True)
    part.backend.restart(3, 4)
    cuts = whole.backend._stagger._steps_left
    assert part.backend._stagger._steps_left.tolist() == cuts[4:6].tolist()
    assert len(set(cuts.tolist())) > 4
    whole.close()
    part.close()


def test_the_vectors_of_several_shards_are_described_as_one_is():
    def described(world):
        env = registry.make(toy.Countdown, 4, kwargs={"mode": "NEXT_STEP"}, world=world)
        names = ("mode", "summaries", "scene", "baseline", "interface", "spec", "device")
        try:
            return type(env.backend).__name__, [getattr(env.backend, name) for name in names]
        finally:
            env.close()

    (one,), (two,) = in_world(1, 1, described), in_world(2, 1, described)
    assert (one[0], two[0]) == ("GymnasiumBackend", "Joined")
    assert one[1] == two[1]
    assert one[1][0] is AutoresetMode.NEXT_STEP
