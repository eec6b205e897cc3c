"""The door to rsl_rl's `VecEnv`, in both directions: rows that join up, and rsl_rl's own runner."""

import sys

import numpy as np
import pytest
import torch

import environments  # noqa: F401  (registers Copy)
import lemniscate as lem
from conftest import tiny_fields
from helpers import CPU
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect
from lemniscate.envs import registry
from lemniscate.envs.rsl_rl import RslRlBackend, RslRlVecEnv
from lemniscate.errors import UserError
from lemniscate.system import named

pytest.importorskip("tensordict")
runners = pytest.importorskip("rsl_rl.runners")
from rsl_rl.env import VecEnv
from tensordict import TensorDict

LIMIT = 10


class Cart(VecEnv):
    """N carts on a line that are to be brought to 0: a simulator of rsl_rl's kind. One beyond 2 has died.

    `gives` says which of `final_obs`, `critic`, `reset` and `seed` it has.
    """

    def __init__(self, num_envs=8, gives=("final_obs", "critic", "reset", "seed"), writes_over=True):
        self.num_envs, self.num_actions, self.max_episode_length = num_envs, 1, LIMIT
        self.device, self.cfg, self.gives = "cpu", {}, gives
        self.rng = torch.Generator().manual_seed(0)
        self.x, self.episode_length_buf = torch.zeros(num_envs, 1), torch.zeros(num_envs, dtype=torch.int64)
        self.buffer = torch.zeros(num_envs, 2) if writes_over else None
        if "reset" in gives:
            self.reset = self._reset
        if "seed" in gives:
            self.seed = lambda seed: self.rng.manual_seed(seed)
        self._begin(torch.ones(num_envs, dtype=torch.bool))

    def _reset(self):
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self.get_observations(), {}

    def _begin(self, which):
        self.x = torch.where(which[:, None], torch.empty_like(self.x).uniform_(-1, 1, generator=self.rng), self.x)
        self.episode_length_buf = self.episode_length_buf * ~which

    def get_observations(self):
        obs = torch.cat([self.x, self.episode_length_buf[:, None] / LIMIT], dim=1)
        obs = obs if self.buffer is None else self.buffer.copy_(obs)
        groups = {"policy": obs} | ({"critic": 2 * obs} if "critic" in self.gives else {})
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions):
        self.x = self.x + 0.5 * actions.clamp(-1, 1)
        self.episode_length_buf = self.episode_length_buf + 1
        died, late = self.x.abs()[:, 0] > 2, self.episode_length_buf >= LIMIT
        reward, dones = 1 - self.x[:, 0].abs(), died | late
        extras = {"time_outs": late & ~died, "log": {"/cart/distance": self.x.abs().mean(), "count": 3}}
        if "final_obs" in self.gives:
            extras["final_obs"] = self.get_observations().clone()
        self._begin(dones)
        return self.get_observations(), reward, dones.long(), extras


def rollout_of(env, steps=40, seed=3):
    env.restart(seed)
    torch.manual_seed(0)
    config = ppo.Config(env="x", hidden=(4,), num_envs=env.num_envs, minibatch_size=8)
    policy = ppo.init(config, env.spec, CPU).policy
    return collect(env, policy, steps, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("final", [True, False])
def test_rows_join_up_and_time_outs_have_what_is_known(final):
    cart = Cart(gives=("critic", "reset", "seed", *["final_obs"] * final))
    env = registry.make(cart, 8)
    rollout = rollout_of(env)
    assert env.spec.privileged == 2
    assert rollout.obs.shape == (40, 8, 4)
    assert torch.equal(rollout.obs[..., 2:], 2 * rollout.obs[..., :2])
    done = rollout.done
    assert rollout.truncated.any()
    assert rollout.terminated.any()
    assert not (rollout.truncated & rollout.terminated).any()
    assert torch.equal(rollout.next_obs[:-1][~done[:-1]], rollout.obs[1:][~done[:-1]])
    assert not torch.equal(rollout.next_obs[:-1][done[:-1]], rollout.obs[1:][done[:-1]])
    late = rollout.next_obs[rollout.truncated]
    assert torch.equal(late[:, 1], torch.full_like(late[:, 1], 1.0 if final else (LIMIT - 1) / LIMIT))
    assert any("hides final observations" in said for said in env.backend.notices) != final
    torch.testing.assert_close(
        rollout.reward, 1 - (rollout.obs[..., 0] + 0.5 * rollout.action[..., 0].clamp(-1, 1)).abs()
    )
    again = rollout_of(env)
    assert torch.equal(again.obs, rollout.obs)


def test_what_has_no_reset_says_so():
    env = registry.make(Cart(gives=("final_obs",)), 8)
    rollout_of(env)
    assert env.spec.privileged == 0
    assert any("has no reset()" in said for said in env.backend.notices)


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "Copy-box-v0"])
def test_ours_as_theirs_as_ours_gives_the_same_rows(env_id):
    """Through both doors: observations, rewards, flags and true successors are those of the environment itself."""
    direct = registry.make(env_id, 4, stagger=True)
    outer = RslRlVecEnv(env_id, 4, seed=7)
    inner = registry.make(outer, 4)
    direct.restart(7)
    rng = torch.Generator().manual_seed(0)
    inner.restart(7)
    assert torch.equal(direct.obs, inner.obs)
    for _ in range(250):
        action = torch.empty(4, direct.spec.action.size).uniform_(-1, 1, generator=rng)
        mine, theirs = direct.step(action), inner.step(action)
        for name in ("obs", "reward", "terminated", "truncated"):
            assert torch.equal(getattr(mine, name), getattr(theirs, name)), name
        assert torch.equal(mine.next_obs, theirs.next_obs)
    assert outer.episode_length_buf.shape == (4,)


def test_ppo_learns_in_a_simulator_that_was_passed(tmp_path):
    fields = tiny_fields("x", num_steps=16, total_steps=16_384, minibatch_size=64, learning_rate=1e-2, epochs=4)
    fields |= {"evaluate_every": 8192, "checkpoint_every": 4096}
    del fields["num_envs"]
    cart = Cart(16)
    run = lem.train("ppo", cart, run=tmp_path / "r", progress=False, **fields)
    assert run.policy.config.num_envs == 16
    assert run.policy.config.backend == "rsl_rl"
    scores = lem.evaluate(run.policy, env=cart, episodes=32, seed=0)
    assert scores.mean_return > 8
    assert "info/cart/distance" in scores.measures
    assert scores.terminated == 0


def test_a_maker_of_ones_own_is_named_on_the_command_line(tmp_path, monkeypatch, capsys):
    from lemniscate.cli import main

    monkeypatch.setitem(sys.modules, "own_simulator", sys.modules[__name__])
    words = ["train", "ppo", "--env", "own_simulator:Cart", "--num-envs", "8", "--num-steps", "8"]
    words += ["--minibatch-size", "16", "--total-steps", "128", "--run", str(tmp_path / "r")]
    assert main(words) == 0
    assert main(["evaluate", str(tmp_path / "r"), "--episodes", "4"]) == 0
    assert "return over 4 episodes" in capsys.readouterr().err
    monkeypatch.setattr(sys.modules[__name__], "make", lambda num_envs: Cart(num_envs), raising=False)
    words = [word.replace("Cart", "make") for word in words[:-1]] + [str(tmp_path / "s")]
    assert main(words) == 2
    assert "what speaks rsl_rl's VecEnv is of the backend rsl_rl" in capsys.readouterr().err
    assert main([*words, "--backend", "rsl_rl"]) == 0
    words[-1] = str(tmp_path / "t")
    assert main([*words, "--backend", "rsl_rl", "--processes", "2"]) == 2
    assert "exists once at a time, and cannot be divided among 2 processes: train in one." in capsys.readouterr().err
    assert not (tmp_path / "t").exists()


def test_rsl_rls_runner_trains_in_ours(tmp_path):
    model = {"class_name": "rsl_rl.models:MLPModel", "hidden_dims": [32], "activation": "elu"}
    gaussian = {"class_name": "rsl_rl.modules.distribution:GaussianDistribution", "init_std": 1.0}
    config = {
        "num_steps_per_env": 16,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": model | {"distribution_cfg": gaussian},
        "critic": dict(model),
        "algorithm": {"class_name": "rsl_rl.algorithms:PPO", "num_learning_epochs": 4, "num_mini_batches": 4},
        "logger": "tensorboard",
    }
    env = RslRlVecEnv("Pendulum-v1", 16, seed=0)
    runner = runners.OnPolicyRunner(env, config, log_dir=None, device="cpu")
    before = [parameter.clone() for parameter in runner.alg.actor.parameters()]
    runner.learn(3)
    after = list(runner.alg.actor.parameters())
    assert any(not torch.equal(one, other) for one, other in zip(before, after, strict=True))
    assert all(parameter.isfinite().all() for parameter in after)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: registry.make(Cart(8), 4), r"has 8 environments, not 4: num_envs=8\."),
        (lambda: registry.make(lambda num_envs: 3, 4, backend="rsl_rl"), "makes a int, which does not speak"),
        (lambda: registry.make(lambda: Cart(), 4, backend="rsl_rl"), "It is called with num_envs and the env_kwargs"),
        (lambda: RslRlVecEnv("CartPole-v1", 2), "CartPole-v1 has no continuous actions, which rsl_rl needs"),
        (lambda: registry.make(lambda: Cart(), 4), "backend rsl_rl"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(made, said):
    with pytest.raises(UserError, match=said):
        made()


def test_groups_without_a_policys_are_refused():
    class Odd(Cart):
        def get_observations(self):
            return TensorDict({"camera": torch.zeros(self.num_envs, 2)}, batch_size=[self.num_envs])

    with pytest.raises(UserError, match="has the groups of observations camera; one must be actor or policy"):
        registry.make(Odd(), 8)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_actions", 0),
        ("num_actions", None),
        ("num_actions", 2.5),
        ("num_actions", float("inf")),
        ("max_episode_length", "20"),
        ("num_envs", None),
    ],
)
def test_attributes_that_count_are_numbers(name, value):
    odd = Cart(8)
    setattr(odd, name, value)
    with pytest.raises(UserError, match=rf"{name} of .*Cart.* is .*; it must be a whole number from 1"):
        registry.make(odd, 8)


def test_a_plain_tensor_of_final_observations_is_that_of_the_one_group():
    class Loose(Cart):
        def step(self, actions):
            *rest, extras = super().step(actions)
            return *rest, extras | {"final_obs": extras["final_obs"]["policy"]}

    plain, loose = (rollout_of(registry.make(kind(8, ("final_obs", "reset", "seed")), 8)) for kind in (Cart, Loose))
    assert torch.equal(plain.next_obs, loose.next_obs)


@pytest.mark.parametrize("seed", [42, lambda: None])
def test_a_seed_that_takes_no_number_is_not_called_which_is_said(seed):
    odd = Cart(8, ("final_obs", "reset"))
    odd.seed = seed
    env = registry.make(odd, 8)
    rollout_of(env)
    assert any(r"has no seed(number): no run can be repeated" in said for said in env.backend.notices)


def test_it_serves_what_speaks_it():
    assert RslRlBackend.serves(registry.name_of(Cart()))
    assert not RslRlBackend.serves("CartPole-v1")


class Columns(Cart):
    """Its rewards, flags and log in other forms, the rewards in one buffer that it writes over."""

    def step(self, actions):
        obs, reward, dones, extras = super().step(actions)
        self.paid = getattr(self, "paid", torch.zeros(self.num_envs, 1)).copy_(reward[:, None])
        extras["log"] |= {"name": "a text", "none": None, "each": torch.ones(self.num_envs)}
        return obs, self.paid, dones[:, None], extras | {"time_outs": extras["time_outs"][:, None]}


def test_columns_and_buffers_that_are_written_over_are_read_as_they_were():
    plain, other = (rollout_of(registry.make(kind(8), 8)) for kind in (Cart, Columns))
    for name in ("obs", "reward", "terminated", "truncated"):
        assert torch.equal(getattr(plain, name), getattr(other, name)), name
    env = registry.make(Columns(8), 8)
    env.restart(0)
    measures = env.step(torch.zeros(8, 1)).measures
    assert set(measures) == {"info/cart/distance", "info/count", "info/each"}


class Bare(Cart):
    def step(self, actions):
        return *super().step(actions)[:3], None


def test_it_is_checked_with_the_environments_that_it_has():
    found = lem.check(Cart(8))
    assert {each.grade for each in found} == {"good"}
    assert "8 parallel environments" in found[-1].sentence


def test_nothing_beside_the_rewards_is_needed():
    rollout = rollout_of(registry.make(Bare(8), 8))
    assert rollout.terminated.any()
    assert not rollout.truncated.any()


def answering(method, change):
    """A cart whose `method` returns what `change` makes of its returns."""
    return type("Answering", (Cart,), {method: lambda self, *args: change(getattr(Cart, method)(self, *args))})(8)


@pytest.mark.parametrize(
    ("method", "change", "said"),
    [
        ("get_observations", lambda obs: (obs, {}), "a tuple from get_observations.*must be groups of observations by"),
        (
            "get_observations",
            lambda obs: TensorDict({"policy": TensorDict({"x": obs["policy"]}, batch_size=[8])}, batch_size=[8]),
            r"as the observations policy; a group must be one Tensor \[8, …\], with its terms concatenated",
        ),
        (
            "get_observations",
            lambda obs: {"policy": obs["policy"][:3]},
            r"an array of shape \(3, 2\) .* as the observations policy; a group",
        ),
        (
            "step",
            lambda step: (*step, {}),
            r"returns 5 values from step\(\); it must be 4, \(obs, rewards, dones, extras\)",
        ),
        ("step", lambda step: (step[0], step[1].numpy(), *step[2:]), r"as rewards; it must be a Tensor \[8\]"),
        ("step", lambda step: (*step[:2], step[2][:3], step[3]), r"as dones; it must be a Tensor \[8\]"),
        ("step", lambda step: (*step[:3], {"time_outs": True}), r"gives True as time_outs; it must be a Tensor \[8\]"),
        ("step", lambda step: (step[0], step[1] + 1j, *step[2:]), r"complex64 as rewards; it must be a Tensor \[8\]\."),
        (
            "step",
            lambda step: (*step[:2], torch.full((8,), torch.nan), step[3]),
            r"as dones; it must be a Tensor \[8\] of True and False",
        ),
        ("step", lambda step: (*step[:3], [1]), r"gives \[1\] as extras; it must be a dictionary"),
        ("step", lambda step: (*step[:3], {"log": [1]}), r"gives \[1\] as extras\['log'\]; it must be a dictionary"),
        (
            "step",
            lambda step: (*step[:3], step[3] | {"final_obs": {"policy": step[0]["policy"][:, :1], "critic": None}}),
            r"\(8, 1\) .* as extras\['final_obs'\], group policy; a group must be one Tensor \[8, 2\]",
        ),
        (
            "step",
            lambda step: ({name: step[0][name][:, :1] for name in ("policy", "critic")}, *step[1:]),
            r"\(8, 1\) .* as the observations policy; a group must be one Tensor \[8, 2\]",
        ),
    ],
)
def test_what_is_returned_wrongly_is_said(method, change, said):
    with pytest.raises(UserError, match=said):
        rollout_of(registry.make(answering(method, change), 8))


def test_what_is_made_already_takes_no_arguments_and_draws_no_film(tmp_path):
    with pytest.raises(UserError, match="is made already, so env_kwargs such as mass do not reach it"):
        registry.make(Cart(8), 8, kwargs={"mass": 1})
    fields = {"num_steps": 8, "minibatch_size": 8, "total_steps": 64, "progress": False, "video_every": 64}
    with pytest.raises(
        UserError, match="a simulator of N environments, which draws itself or nothing: leave the video"
    ):
        lem.train("ppo", Cart(8), run=tmp_path / "r", **fields)


def test_a_run_goes_on_with_the_simulator_passed_again_and_any_policy_plays_in_it(tmp_path, monkeypatch):
    fields = {"num_steps": 8, "minibatch_size": 8, "total_steps": 64, "progress": False}
    lem.train("ppo", Cart(8), run=tmp_path / "r", **fields)
    monkeypatch.setattr(named, "_PASSED", {})  # as in a new process
    with pytest.raises(UserError, match="pass the object again"):
        lem.resume(tmp_path / "r", total_steps=128, progress=False)
    run = lem.resume(tmp_path / "r", env=Cart(8), total_steps=128, progress=False)
    assert run.policy.step == 128
    assert len(lem.evaluate(lambda obs: np.zeros(1), env=Cart(8), episodes=16).returns) == 16
    assert len(lem.evaluate(torch.nn.Linear(2, 1), env=Cart(8), episodes=16).returns) == 16
