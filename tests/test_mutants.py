"""Wrong versions of the maths that the suite must kill: each is written into a copy of the package and tested."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

ON, OFF, REINFORCE, PPO, TRPO, DDPG, TD3, SAC = (
    f"algos/test_{name}.py::test_"
    for name in ("on_policy", "off_policy", "reinforce", "ppo", "trpo", "ddpg", "td3", "sac")
)
INTERACT, ROLLOUT = (f"data/test_{name}.py::test_" for name in ("interact", "rollout"))

MUTANTS = [
    # what goes wrong, file, the right line, the wrong line, the tests that must notice
    (
        "a time-out ends the value",
        "maths/returns.py",
        "next_value * ~terminated -",
        "next_value * ~done -",
        "maths/test_returns.py",
    ),
    (
        "a death does not",
        "maths/returns.py",
        "next_value * ~terminated -",
        "next_value -",
        "maths/test_returns.py",
    ),
    (
        "the chain runs on",
        "maths/returns.py",
        "(~done).to(delta.dtype)",
        "(~terminated).to(delta.dtype)",
        "maths/test_returns.py",
    ),
    (
        "the chain is off by one",
        "maths/returns.py",
        "decay[t] * trace",
        "decay[max(t - 1, 0)] * trace",
        "maths/test_returns.py",
    ),
    (
        "lambda is forgotten",
        "maths/returns.py",
        "gamma * lam * (",
        "gamma * (",
        "maths/test_returns.py",
    ),
    (
        "the target is the advantage",
        "maths/returns.py",
        "return advantage, advantage + value",
        "return advantage, advantage",
        "maths/test_returns.py",
    ),
    (
        "the sign of the surrogate",
        "maths/losses.py",
        "return -torch.min(",
        "return torch.min(",
        "maths/test_losses.py",
    ),
    (
        "an optimistic bound",
        "maths/losses.py",
        "-torch.min(ratio",
        "-torch.max(ratio",
        "maths/test_losses.py",
    ),
    (
        "the clip is one-sided",
        "maths/losses.py",
        "clamp(1 - clip, 1 + clip)",
        "clamp(max=1 + clip)",
        "maths/test_losses.py",
    ),
    (
        "the smaller value error",
        "maths/losses.py",
        "error = torch.max(",
        "error = torch.min(",
        "maths/test_losses.py",
    ),
    (
        "no half in the value loss",
        "maths/losses.py",
        "0.5 * error.mean()",
        "error.mean()",
        "maths/test_losses.py",
    ),
    (
        "k3 without its control variate",
        "maths/stats.py",
        "log_ratio.exp() - 1 - log_ratio",
        "-log_ratio",
        "maths/test_stats.py",
    ),
    (
        "moments forget the distance of means",
        "maths/stats.py",
        " + delta.square() *",
        " + 0 * delta *",
        "maths/test_stats.py",
    ),
    (
        "log-prob without the std",
        "maths/distributions.py",
        "(self.log_std.sum(-1) +",
        "(",
        "maths/test_distributions.py",
    ),
    (
        "actions scaled to half their range",
        "envs/spaces.py",
        "middle + half *",
        "middle + 0.5 * half *",
        "envs/test_spaces.py",
    ),
    (
        "reset rows are real",
        "envs/gymnasium.py",
        "~self._resetting, done",
        "valid, done",
        "envs/test_contract.py",
    ),
    (
        "the reset observation is the final one",
        "envs/gymnasium.py",
        "in np.flatnonzero(done):",
        "in np.flatnonzero(done & False):",
        "envs/test_contract.py",
    ),
    (
        "reset rows reach the batch",
        "types.py",
        "self.valid.flatten().nonzero()[:, 0]",
        "torch.arange(self.num_rows)",
        ON + "values_are_bootstrapped_at_time_limits_and_ignore_reset_rows",
    ),
    (
        "the entropy bonus is a penalty",
        "algos/ppo.py",
        "- config.entropy_coef",
        "+ config.entropy_coef",
        PPO + "the_loss_is_equation_9",
    ),
    (
        "the normalizer moves before the update",
        "algos/ppo.py",
        "    valid_rows = rollout.valid_rows\n    metrics: list",
        "    networks.policy.observe(rollout.obs[rollout.valid])\n    valid_rows = rollout.valid_rows\n    metrics: list",
        PPO + "the_first_gradient_step_of_every_update_has_ratios_of_one",
    ),
    (
        "evaluation takes the first that end",
        "run/evaluate.py",
        "(left > 0) & step.valid",
        "step.valid",
        "run/test_evaluate.py",
    ),
    (
        "the environments go on over a checkpoint",
        "run/run.py",
        "if planned and not finished:",
        "if False:",
        "run/test_run.py",
    ),
    (
        "the optimizer's moments are not restored",
        "optim/adam.py",
        'self._square.copy_(state["square"])',
        "pass",
        "optim/test_adam.py::test_a_checkpoint_restores_its_moments_and_count",
    ),
    (
        "Adam without its bias correction",
        "optim/adam.py",
        "new_tensor([-1, -0.5])",
        "new_tensor([0, -0.5])",
        "optim/test_adam.py",
    ),
    (
        "Adam without that of the squares",
        "optim/adam.py",
        "new_tensor([-1, -0.5])",
        "new_tensor([-1, 0])",
        "optim/test_adam.py",
    ),
    (
        "the gradient is not clipped",
        "optim/adam.py",
        ".clamp(max=1)",
        ".clamp(min=1, max=1)",
        "optim/test_adam.py",
    ),
    (
        "the gradient is added up",
        "optim/adam.py",
        "self._gradient.zero_()",
        "self._gradient",
        "optim/test_adam.py",
    ),
    (
        "ignored rewards are counted",
        "nn/normalizer.py",
        ".to(self.var.dtype) * rollout.valid",
        ".to(self.var.dtype)",
        "nn/test_normalizer.py",
    ),
    (
        "rewards are clipped unasked",
        "algos/ppo.py",
        "gae(rollout.reward, value",
        "gae(rollout.reward.clamp(-10, 10), value",
        ON + "rewards_of_any_size_are_scaled_only_on_request",
    ),
    (
        "returns run on over the end",
        "nn/normalizer.py",
        "self.running * ~done",
        "self.running * 1",
        "nn/test_normalizer.py",
    ),
    (
        "an episode is counted with its last step missing",
        "envs/episodes.py",
        "after_end[:1]), after_end[:-1]]",
        "after_end[:0]), after_end]",
        "envs/test_episodes.py",
    ),
    (
        "fragments are counted",
        "envs/episodes.py",
        "done & counts]",
        "done & (counts | done)]",
        "envs/test_episodes.py",
    ),
    (
        "a masked action may be chosen",
        "nn/policies.py",
        "== 0, -1e9)",
        "== 0, 0.0)",
        "nn/test_policies.py::test_masked_actions_have_no_probability",
    ),
    (
        "noise 0 chooses what is impossible",
        "maths/discrete.py",
        "cumulative <= noise",
        "cumulative < noise",
        "maths/test_distributions.py",
    ),
    (
        "compiled programs are mixed up",
        "optim/compiled.py",
        "compile(_with_own_code(method)",
        "compile((method)",
        "optim/test_compiled.py::test_every_compiled_method_has_code_of_its_own",
    ),
    (
        "noise that grows",
        "maths/noise.py",
        " * math.sqrt(1 - phi * phi)",
        "",
        "maths/test_noise.py",
    ),
    (
        "noise that forgets too fast",
        "maths/noise.py",
        "math.exp(-1 / time)",
        "math.exp(-2 / time)",
        "maths/test_noise.py",
    ),
    (
        "power where amplitude was meant",
        "maths/noise.py",
        "(-exponent / 2)",
        "(-exponent)",
        "maths/test_noise.py",
    ),
    (
        "the highest frequency counts twice",
        "maths/noise.py",
        "ends[0] = ends[-1] = 1",
        "ends[0] = 1",
        "maths/test_noise.py",
    ),
    (
        "a death bootstraps",
        "maths/returns.py",
        "gamma * next_value * ~terminated\n",
        "gamma * next_value\n",
        "maths/test_returns.py",
    ),
    (
        "the target runs away",
        "maths/returns.py",
        "mine.lerp_(theirs, tau)",
        "theirs.data.lerp_(mine.data, tau)",
        "maths/test_returns.py",
    ),
    (
        "no correction for the squashing",
        "maths/distributions.py",
        "(normal - _log_slope(u))",
        "(normal)",
        "maths/test_distributions.py",
    ),
    (
        "a slope that is half as steep",
        "maths/distributions.py",
        "return 2 * (math.log(2)",
        "return (math.log(2)",
        "maths/test_distributions.py",
    ),
    (
        "the KL has the wrong sign",
        "algos/trpo.py",
        "pi(here, batch.obs).kl(",
        "-pi(here, batch.obs).kl(",
        TRPO + "the_kl_stays_within_its_bound_at_every_update",
    ),
    (
        "the curvature has the wrong sign",
        "maths/trust_region.py",
        "here.kl(there)",
        "-here.kl(there)",
        "maths/test_trust_region.py",
    ),
    (
        "the value in the Fisher matrix",
        "algos/trpo.py",
        "PolicyVector(self.policy)",
        "PolicyVector(self.networks)",
        TRPO + "the_steps_of_policy_and_value_leave_each_other_alone",
    ),
    (
        "damping forgotten",
        "algos/trpo.py",
        " + config.damping * vector",
        "",
        TRPO + "damping_shortens_the_step",
    ),
    (
        "a step that is not taken back",
        "maths/trust_region.py",
        "return start, 0.0",
        "return point, 0.0",
        "maths/test_trust_region.py",
    ),
    (
        "any KL will do",
        "maths/trust_region.py",
        " and kl <= max_kl",
        "",
        "maths/test_trust_region.py",
    ),
    (
        "any loss will do",
        "maths/trust_region.py",
        "loss < before and ",
        "",
        "maths/test_trust_region.py",
    ),
    (
        "directions that are not conjugate",
        "maths/trust_region.py",
        "(rr / before) * direction",
        "0",
        "maths/test_trust_region.py",
    ),
    (
        "a step up the gradient",
        "maths/trust_region.py",
        "product, -gradient",
        "product, gradient",
        "maths/test_trust_region.py",
    ),
    (
        "a step √2 too short",
        "maths/trust_region.py",
        "(2 * max_kl / length)",
        "(max_kl / length)",
        "maths/test_trust_region.py",
    ),
    (
        "KL the wrong way round",
        "maths/distributions.py",
        "other.log_std - self",
        "self.log_std - other",
        "maths/test_distributions.py",
    ),
    (
        "down the policy gradient",
        "maths/losses.py",
        "-(log_prob * weight)",
        "(log_prob * weight)",
        "maths/test_losses.py",
    ),
    (
        "what went before is forgotten",
        "maths/returns.py",
        "paid + weight * to_go[t]",
        "weight * to_go[t]",
        "maths/test_returns.py",
    ),
    (
        "a reset row is an action",
        "algos/reinforce.py",
        "done | ~rollout.valid",
        "done",
        REINFORCE + "the_weight_is_the_reward_to_go_or_the_return_of_the_episode_less_a_baseline",
    ),
    (
        "the baseline is added",
        "algos/reinforce.py",
        "weight - baseline",
        "weight + baseline",
        REINFORCE + "the_weight_is_the_reward_to_go_or_the_return_of_the_episode_less_a_baseline",
    ),
    (
        "fragments among whole episodes",
        "data/rollout.py",
        "(ended >= 1) & ",
        "",
        ROLLOUT + "whole_episodes_are_whole_and_as_many_from_each_environment",
    ),
    (
        "short episodes give more of them",
        "data/rollout.py",
        " & (ended <= episodes)",
        "",
        ROLLOUT + "whole_episodes_are_whole_and_as_many_from_each_environment",
    ),
    (
        "ten attempts whatever the setting",
        "algos/trpo.py",
        '"attempts": config.attempts',
        '"attempts": 10',
        TRPO + "a_step_that_is_too_long_is_shortened_until_the_kl_is_within_its_bound",
    ),
    (
        "the entropy bonus of REINFORCE is a penalty",
        "algos/reinforce.py",
        "loss - config.entropy_coef",
        "loss + config.entropy_coef",
        REINFORCE + "the_entropy_bonus_rewards_entropy",
    ),
    (
        "weights are never standardized",
        "algos/reinforce.py",
        "standardize(batch.advantage) if config.standardize else",
        "",
        REINFORCE + "weights_are_standardized_only_on_request",
    ),
    (
        "rewards are never scaled",
        "algos/a2c.py",
        "rollout = state.reward_scale.scale(rollout)",
        "state.reward_scale.scale(rollout)",
        ON + "rewards_of_any_size_are_scaled_only_on_request",
    ),
    (
        "the learning rate of the value never falls",
        "algos/trpo.py",
        "state.critic_optimizer.learning_rate = rate",
        "state.critic_optimizer.learning_rate = config.critic_learning_rate",
        ON + "learning_rates_fall_to_zero_where_the_settings_say_so",
    ),
    (
        "the target critic is the critic",
        "algos/ddpg.py",
        "state.targets.critics.first(",
        "critics.first(",
        DDPG + "the_target_is_that_of_the_target_networks_alone",
    ),
    (
        "the policy climbs down",
        "algos/ddpg.py",
        "loss = -state.networks",
        "loss = state.networks",
        DDPG + "the_gradient_of_the_policy_is_that_of_q_through_the_action",
    ),
    (
        "a time-out is stored as a termination",
        "data/replay.py",
        "step.next_obs, step.terminated)",
        "step.next_obs, step.terminated | step.truncated)",
        OFF + "values_are_bootstrapped_at_time_limits_and_ignore_reset_rows",
    ),
    (
        "reset rows are stored",
        "data/replay.py",
        "rows if step.valid.all() else rows[step.valid]",
        "rows",
        OFF + "values_are_bootstrapped_at_time_limits_and_ignore_reset_rows",
    ),
    (
        "the next observation is that after the reset",
        "data/replay.py",
        "step.reward, step.next_obs,",
        "step.reward, step.obs,",
        INTERACT + "transitions_have_their_true_successors_and_terminations",
    ),
    (
        "the larger of two critics is the target",
        "algos/td3.py",
        "next_action).amin(0)",
        "next_action).amax(0)",
        TD3 + "the_target_is_the_smaller_of_two_at_an_action_with_clipped_noise",
    ),
    (
        "a target without noise",
        "algos/td3.py",
        ".sample((config.target_noise * noise).clamp(-limit, limit))",
        ".mode()",
        TD3 + "the_target_is_the_smaller_of_two_at_an_action_with_clipped_noise",
    ),
    (
        "noise on the target that is not clipped",
        "algos/td3.py",
        ".clamp(-limit, limit)",
        "",
        TD3 + "the_target_is_the_smaller_of_two_at_an_action_with_clipped_noise",
    ),
    (
        "entropy is a cost in the target",
        "algos/sac.py",
        "amin(0) - state.networks.temperature()",
        "amin(0) + state.networks.temperature()",
        SAC + "the_target_is_the_smaller_of_two_less_the_price_of_the_action",
    ),
    (
        "the temperature loss has the wrong sign",
        "algos/sac.py",
        "return alpha * (entropy - target_entropy)",
        "return alpha * (target_entropy - entropy)",
        SAC + "the_temperature_falls_where_the_entropy_is_above_its_target",
    ),
    (
        "entropy is a cost in the policy's loss",
        "algos/sac.py",
        "(state.networks.temperature().detach() *",
        "(-state.networks.temperature().detach() *",
        SAC + "the_policy_is_rewarded_for_entropy",
    ),
    (
        "noise runs on into the next episode",
        "data/replay.py",
        "        action_noise.on_episode_end(step.terminated | step.truncated | ~step.valid)\n",
        "",
        INTERACT + "an_episode_has_a_sequence_of_noise_from_its_beginning",
    ),
    (
        "noise for rows that were ignored",
        "data/replay.py",
        " | ~step.valid)",
        ")",
        INTERACT + "an_episode_has_a_sequence_of_noise_from_its_beginning",
    ),
    (
        "statistics of rows that were ignored",
        "data/replay.py",
        "policy.observe(obs[step.valid])",
        "policy.observe(obs)",
        INTERACT + "the_normalizer_learns_from_the_stored_rows_and_no_others",
    ),
    (
        "a time-out ends the entropy",
        "run/q_bias.py",
        " + networks.entropy_bonus(last, self._generator)",
        "",
        "run/test_q_bias.py",
    ),
    (
        "the learning rate of Q never falls",
        "algos/sac.py",
        "linear(config.critic_learning_rate, config.final_learning_rate, progress)",
        "config.critic_learning_rate",
        OFF + "learning_rates_fall_linearly_over_the_run",
    ),
    (
        "an update at every step",
        "run/off_policy.py",
        " and step // self.num_envs % self.update_every == 0",
        "",
        OFF + "as_many_gradient_steps_are_taken_as_the_config_says",
    ),
    (
        "Q is the larger one",
        "nn/actor_critic.py",
        "action).amin(0)",
        "action).amax(0)",
        "nn/test_actor_critic.py::test_q_is_the_smallest_of_the_critics",
    ),
    (
        "a time-out is worth nothing",
        "run/q_bias.py",
        "realised + self._gamma**age * value * ~step.terminated",
        "realised",
        "run/test_q_bias.py",
    ),
    (
        "every call has the flags of the first",
        "optim/learner.py",
        "flag[part]",
        "flag[:size]",
        OFF + "many_steps_are_compiled_in_calls_of_one_size_with_the_flags_of_their_steps",
    ),
    (
        "every step is the first",
        "optim/adam.py",
        "self._count.add_(1)",
        "self._count.fill_(1)",
        "optim/test_adam.py::test_it_is_the_adam_of_torch",
    ),
    (
        "the delay is forgotten",
        "algos/td3.py",
        "(state.updates + k) % config.policy_delay == 0",
        "True",
        OFF + "policy_and_targets_move_at_every_dth_step_of_the_critics",
    ),
    (
        "the ring tears rows apart",
        "data/replay.py",
        "ring[: count - room] = new[room:]",
        "ring[: count - room] = new[: count - room]",
        "data/test_replay.py",
    ),
    (
        "noise runs on over an end",
        "data/action_noise.py",
        "self._position[done.cpu()] = self._length",
        "pass",
        "data/test_action_noise.py",
    ),
    (
        "every copy's noise is cut",
        "data/action_noise.py",
        "self._position[done.cpu()] = self._length",
        "self._position.fill_(self._length)",
        "data/test_action_noise.py",
    ),
    (
        "a tie is lost",
        "report/seeds.py",
        "(1 + np.sign(difference)",
        "(1 + np.sign(difference - 1e-9)",
        "test_seeds.py",
    ),
    (
        "one seed is ranked",
        "report/compare.py",
        "len(one.finals(scores)) > 1",
        "one.finals(scores)",
        "test_compare.py",
    ),
    (
        "the learning rate adapts the wrong way",
        "optim/adam.py",
        "1 / 1.5 if kl > 2",
        "1 / 1.5 if kl < 2",
        "optim/test_learning_rate.py",
    ),
    (
        "the flags of learn are ignored",
        "algos/td3.py",
        "if update_actor[k]:",
        "if True:",
        OFF + "policy_and_targets_move_at_every_dth_step_of_the_critics",
    ),
    (
        "the temperature is learned with every step of the critics",
        "algos/sac.py",
        "            metrics += [actor, state.temperature",
        "        entropy, size = torch.zeros(()), 1\n        if True:\n            metrics += [state.temperature",
        OFF + "policy_and_targets_move_at_every_dth_step_of_the_critics",
    ),
    (
        "one program serves all flags",
        "optim/learner.py",
        "key = tuple(here.values())",
        "key = ()",
        "optim/test_learner.py::test_each_combination_of_flags_is_a_program_of_its_own",
    ),
    (
        "the random generators are one",
        "run/seeding.py",
        "self.minibatch = generator(seed, device, 3)",
        "self.minibatch = self.action",
        "run/test_seeding.py",
    ),
    (
        "the random generators have one stream",
        "run/seeding.py",
        "self.minibatch = generator(seed, device, 3)",
        "self.minibatch = generator(seed, device, 2)",
        "run/test_seeding.py",
    ),
    (
        "recomputed advantages forget the old probabilities",
        "algos/ppo.py",
        "replace(advantages(config, networks, rollout), log_prob=collected.log_prob)",
        "advantages(config, networks, rollout)",
        PPO + "advantages_are_estimated_again_before_each_epoch_on_request",
    ),
    (
        "advantages are never recomputed",
        "algos/ppo.py",
        "if config.recompute_advantages and epoch > 0:",
        "if False:",
        PPO + "advantages_are_estimated_again_before_each_epoch_on_request",
    ),
    (
        "TD3's policy climbs the second Q",
        "algos/td3.py",
        "loss = -state.networks.critics.first(batch.obs, policy(batch.obs).mode()).mean()",
        "loss = -state.networks.critics(batch.obs, policy(batch.obs).mode())[1].mean()",
        TD3 + "the_policy_climbs_the_first_q",
    ),
    (
        "random actions after the warm-up",
        "algos/ddpg.py",
        "random = state.step < config.learning_starts",
        "random = state.step <= config.learning_starts",
        OFF + "actions_are_random_before_learning_starts_and_those_of_the_policy_afterwards",
    ),
    (
        "action noise of unit size",
        "algos/td3.py",
        "noise_std=config.noise_std, ",
        "",
        OFF + "actions_are_random_before_learning_starts_and_those_of_the_policy_afterwards",
    ),
    (
        "the Fisher product is doubled",
        "optim/vector.py",
        "return fisher_product(",
        "return 2 * fisher_product(",
        "optim/test_vector.py",
    ),
    (
        "the targets have a normalizer of their own",
        "nn/actor_critic.py",
        "{id(normalizer): normalizer}",
        "{}",
        "nn/test_actor_critic.py",
    ),
]


SERVER = """
import json, os, sys
import gymnasium, hypothesis.strategies, matplotlib.figure, pytest, torch._dynamo, torch.distributed.tensor, torch.func

for line in sys.stdin:
    package, tests, output = json.loads(line)
    child = os.fork()
    if not child:
        file = os.open(output, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, 1), os.dup2(file, 2)
        sys.path.insert(0, package)
        os.environ["PYTHONPATH"] = package
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-m", "not long", "-o", "addopts=", tests])
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Runs each mutant's tests in a fork of itself: what is slow to import is there, and no lemniscate yet. Without the
checks of shapes, which take longer to build than the tests to run."""


@pytest.fixture(scope="module")
def server():
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", SERVER]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, env=environment, text=True
    ) as process:
        yield process
        process.stdin.close()


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant[0].replace(" ", "-") for mutant in MUTANTS])
def test_the_suite_kills(server, tmp_path, mutant):
    _, name, right, wrong, tests = mutant
    shutil.copytree(ROOT / "src" / "lemniscate", tmp_path / "lemniscate")
    file = tmp_path / "lemniscate" / name
    text = file.read_text()
    assert text.count(right) == 1, f"{name} no longer has this line once: {right}"
    file.write_text(text.replace(right, wrong))
    server.stdin.write(json.dumps([str(tmp_path), str(ROOT / "tests" / tests), str(tmp_path / "output")]) + "\n")
    server.stdin.flush()
    code, said = int(server.stdout.readline()), (tmp_path / "output").read_text()
    assert code == 1, said[-2000:]
    assert "1 failed" in said
    # Hypothesis shows two failures that it found in one test as a group, whose lines begin with a bar.
    assert re.search(r"^E[ |]+(assert|AssertionError|Failed: DID NOT RAISE)", said, re.MULTILINE), said[-2000:]
