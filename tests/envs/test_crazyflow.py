"""The drone behind the contract, held against crazyflow's own step."""

import os
import subprocess
import sys
import warnings

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
import pytest
import torch

pytest.importorskip("crazyflow")

import gymnasium as gym

from lemniscate.envs import registry
from lemniscate.envs.conversion import scale_action
from lemniscate.envs.factory import model_warnings_off

FIGURE_EIGHT = "DroneFigureEightTrajectory-v0"
N = 8


@pytest.fixture(scope="module")
def env():
    return registry.make(FIGURE_EIGHT, N)


@pytest.fixture(scope="module")
def staggered():
    return registry.make(FIGURE_EIGHT, N, stagger=True)


def test_the_layout_is_the_documented_one(env):
    layout = [(part.name, part.size) for part in env.spec.observation_parts]
    assert layout == [("pos", 3), ("quat", 4), ("vel", 3), ("ang_vel", 3), ("local_samples", 30)]
    assert env.spec.observation_size == 43
    assert env.scene.error == slice(13, 16)
    assert env.scene.time_step == 0.02
    assert env.spec.max_episode_steps == 500


def test_every_number_has_a_unit_and_a_frame(env):
    interface = env.backend.interface
    assert all(len(interface.parts[part.name]) == part.size for part in env.spec.observation_parts)
    assert len(interface.action) == env.spec.action.size
    assert (interface.period, interface.dynamics, interface.vehicle) == (0.02, ("so_rpy",), "crazyflie")
    assert interface.reference.points.shape == (500, 3)
    obs = env.restart(3)
    seen = interface.reference.points[(499 + interface.reference.offsets) % 500].ravel()
    assert np.allclose(obs[0, 13:] + obs[0, :3].repeat(10), seen, atol=1e-5)


def test_the_first_observation_is_a_start_of_the_task(env):
    obs = env.restart(3)
    assert (obs[:, 0:2].abs() <= 0.1).all()
    assert ((obs[:, 2] >= 1.1) & (obs[:, 2] <= 1.3)).all()
    assert torch.equal(obs[:, 3:7], torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(N, 4))
    curve_start = torch.tensor([0.0, 0.0, 1.0])  # right after a reset crazyflow looks at the curve's last point
    torch.testing.assert_close(obs[:, 0:3] + obs[:, 13:16], curve_start.expand(N, 3), atol=1e-4, rtol=0)


def test_every_step_is_crazyflows_own_step(env):
    """Same state, same physical actions: same observations and rewards, until an episode ends."""
    import jax

    env.restart(5)
    backend = env.backend
    with warnings.catch_warnings(action="ignore"), model_warnings_off():
        native = gym.make_vec(FIGURE_EIGHT, num_envs=N, freq=50, device="cpu").unwrapped
        native.reset(seed=0)
    native.sim.data = jax.tree.map(lambda x: x, backend._state[0])
    g = torch.Generator().manual_seed(0)
    for _ in range(20):
        action = 0.3 * torch.randn(N, 4, generator=g)
        step = env.step(action)
        obs, reward, terminated, truncated, _ = native.step(scale_action(action.numpy(), env.spec.action))
        assert not (terminated | truncated).any()
        flat = np.concatenate([np.asarray(obs[part.name]) for part in env.spec.observation_parts], axis=-1)
        np.testing.assert_allclose(step.next_obs.numpy(), flat, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(step.reward.numpy(), np.asarray(reward), rtol=1e-4, atol=1e-5)


def test_a_crash_ends_with_the_true_final_observation_and_a_real_reward(env):
    env.restart(1)
    down = torch.tensor([0.0, 0.0, 0.0, -1.0]).expand(N, 4)
    for _ in range(100):
        step = env.step(down)
        done = step.terminated | step.truncated
        if done.any():
            break
    assert step.terminated[done].all()
    assert (step.next_obs[done][:, 2] < 0).all()  # under the floor: the end itself
    assert ((step.obs[done][:, 2] >= 1.1) & (step.obs[done][:, 2] <= 1.3)).all()  # and a new start
    assert (step.reward[done] == -1).all()
    assert torch.equal(step.obs[~done], step.next_obs[~done])
    following = env.step(torch.zeros(N, 4))
    assert not (following.terminated | following.truncated)[done].any()
    assert following.valid.all()


def test_a_time_out_is_a_truncation_after_500_steps(env):
    env.restart(2)
    for t in range(1, 501):
        pos, vel = env.obs[:, 0:3], env.obs[:, 7:10]
        tilt = torch.stack([-pos[:, 1] - vel[:, 1], pos[:, 0] + vel[:, 0]], -1).clamp(-0.5, 0.5) * -0.2
        lift = (0.236 + 0.4 * (1 - pos[:, 2]) - 0.3 * vel[:, 2]).unsqueeze(-1)
        step = env.step(torch.cat([tilt, torch.zeros(N, 1), lift], -1))  # a crude hover
        assert not step.terminated.any()
        assert step.truncated.all() == step.truncated.any() == (t == 500)
    assert ((step.obs[:, 0:3] - step.next_obs[:, 0:3]).norm(dim=-1) > 0).all()  # the end, and a new start


def test_staggered_drones_are_spread_over_the_curve_and_stay_beside_it(staggered):
    env = registry.make(FIGURE_EIGHT, 256, stagger=True)
    obs = env.restart(0)
    offset = obs[:, 13:16]
    assert (offset[:, :2].abs() <= 0.1 + 1e-4).all()
    assert ((offset[:, 2] <= -0.1 + 1e-4) & (offset[:, 2] >= -0.3 - 1e-4)).all()
    goal = obs[:, 0:3] + offset
    assert goal[:, 0].min() < -0.9
    assert goal[:, 0].max() > 0.9
    whole = env.backend.counts
    assert 0.1 < whole.float().mean() < 0.4  # a quarter begins at the beginning
    assert ((goal[whole] - torch.tensor([0.0, 0.0, 1.0])).norm(dim=-1) < 1e-3).all()


def test_only_whole_episodes_are_counted(staggered):
    staggered.restart(0)
    down = torch.tensor([0.0, 0.0, 0.0, -1.0]).expand(N, 4)
    ends = 0
    for _ in range(200):
        step = staggered.step(down)
        ends += int((step.terminated | step.truncated).sum())
    assert 0 < len(staggered.take_episodes().returns) < ends


def test_no_copy_is_made_on_the_way_to_torch(env, monkeypatch):
    made = []
    convert = torch.from_dlpack
    monkeypatch.setattr(torch, "from_dlpack", lambda array: made.append((array, convert(array))) or made[-1][1])
    env.restart(0)
    step = env.step(torch.zeros(N, 4))
    assert any(tensor is step.next_obs for _, tensor in made)
    assert all(array.unsafe_buffer_pointer() == tensor.data_ptr() for array, tensor in made)


@pytest.mark.parametrize("env_id", ["DroneReachPos-v0", "DroneReachVel-v0"])
@pytest.mark.one_in(2)
@pytest.mark.long
def test_goals_come_from_the_seed_too(env_id):
    env = registry.make(env_id, 4)
    first, second, again = env.restart(1), env.restart(2), env.restart(1)
    assert not torch.equal(first, second)
    assert torch.equal(first, again)
    assert first[:, -3:].std(0).min() > 0.01


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_nothing_leaves_it():
    env = registry.make(FIGURE_EIGHT, N, device="cuda")
    env.restart(0)
    step = env.step(torch.zeros(N, 4, device="cuda"))
    assert step.obs.is_cuda
    assert step.reward.is_cuda


KEEP = """
import jax, lemniscate.drones.crazyflow as c
c._keep_programs()
print(jax.config.jax_compilation_cache_dir)
if jax.config.jax_compilation_cache_dir:
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.jit(lambda x: x + 1)(1.0)
"""


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("variables", "kept"),
    [
        ({"XDG_CACHE_HOME": "{}"}, "{}/lemniscate/jax"),
        ({"HOME": "{}"}, "{}/.cache/lemniscate/jax"),
        ({"XDG_CACHE_HOME": "/dev/null/x"}, None),
        ({"XDG_CACHE_HOME": "{}", "JAX_COMPILATION_CACHE_DIR": "{}/own"}, "{}/own"),
    ],
)
def test_compiled_programs_are_kept_in_the_users_cache_or_where_jax_was_told(tmp_path, variables, kept):
    own = {name: value.format(tmp_path) for name, value in variables.items()}
    others = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XDG_"))}
    done = subprocess.run(
        [sys.executable, "-c", KEEP], env={**others, "JAX_PLATFORMS": "cpu", **own}, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.strip()) == (0, str(kept and kept.format(tmp_path))), done.stderr
    assert not kept or list((tmp_path / done.stdout.strip()).iterdir())


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        pytest.param(
            {"dynamics": ["so_rpy", "first_principles"], "history": 2, "mass": [0.9, 1.1], "action_delay": [0.0, 0.02]},
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_derivatives_of_a_flight_are_its_differences(kwargs):
    env = registry.make(FIGURE_EIGHT, N, stagger=True, kwargs=kwargs)
    generator = torch.Generator().manual_seed(0)
    gain = 0.02 * torch.randn(env.spec.observation_size, 4, generator=generator)
    actions = 0.1 * torch.randn(10, N, 4, generator=generator)
    directions = torch.randn(3, 10, N, 4, generator=generator)

    def flown(actions):
        """A number that all rewards and observations take part in, the actions being a feedback."""
        env.restart(3)
        env.detach()
        total = torch.zeros(())
        for given in actions:
            step = env.step((given + env.obs @ gain).clamp(-0.9, 0.9))
            total = total + step.reward.sum() + 0.1 * step.next_obs[:, :7].sum()
        return total

    asked = actions.clone().requires_grad_()
    env.backend.prepare_gradient()
    flown(asked).backward()
    assert asked.grad is not None
    size = asked.grad.norm().item()  # a direction's slope has about this size
    assert size > 0.1
    for direction in directions:
        with torch.no_grad():
            slope = (flown(actions + 3e-3 * direction) - flown(actions - 3e-3 * direction)) / 6e-3
        assert slope.item() == pytest.approx((asked.grad * direction).sum().item(), abs=0.02 * size)


def test_a_gradient_goes_back_to_the_last_detach_and_not_through_a_reset(env):
    env.restart(1)
    env.detach()
    down = torch.tensor([0.0, 0.0, 0.0, -1.0]).expand(N, 4).clone().requires_grad_()
    steps = [env.step(down * 1.0)]
    while not steps[-1].terminated.any():
        steps.append(env.step(down * 1.0))
    ended = steps[-1].terminated
    (slope,) = torch.autograd.grad(steps[-1].obs[ended].sum(), down, allow_unused=True)
    assert slope is None or not slope.any()
    env.detach()
    with torch.enable_grad():
        step = env.step(torch.zeros(N, 4))
    assert not step.reward.requires_grad
