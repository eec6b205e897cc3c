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

MEMORY, PPO, ROAD = (f"test_{name}.py::test_" for name in ("memory", "ppo", "road"))

MUTANTS = [
    # what goes wrong, file, the right line, the wrong line, the tests that must notice
    (
        "a time-out ends the value",
        "maths/returns.py",
        "next_value * ~terminated -",
        "next_value * ~done -",
        "maths/test_returns.py",
    ),
    ("a death does not", "maths/returns.py", "next_value * ~terminated -", "next_value -", "maths/test_returns.py"),
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
    ("lambda is forgotten", "maths/returns.py", "gamma * lam * (", "gamma * (", "maths/test_returns.py"),
    (
        "the target is the advantage",
        "maths/returns.py",
        "return advantage, advantage + value",
        "return advantage, advantage",
        "maths/test_returns.py",
    ),
    ("the sign of the surrogate", "maths/losses.py", "return -torch.min(", "return torch.min(", "maths/test_losses.py"),
    ("an optimistic bound", "maths/losses.py", "-torch.min(ratio", "-torch.max(ratio", "maths/test_losses.py"),
    (
        "the clip is one-sided",
        "maths/losses.py",
        "clamp(1 - clip, 1 + clip)",
        "clamp(max=1 + clip)",
        "maths/test_losses.py",
    ),
    ("the smaller value error", "maths/losses.py", "error = torch.max(", "error = torch.min(", "maths/test_losses.py"),
    ("no half in the value loss", "maths/losses.py", "0.5 * error.mean()", "error.mean()", "maths/test_losses.py"),
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
    ("reset rows are real", "envs/gymnasium.py", "~self._resetting, done", "valid, done", "envs/test_contract.py"),
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
        PPO + "time_outs_bootstrap_and_reset_rows_teach_nothing",
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
        "    played = ",
        "    state.policy.observe(rollout.obs[rollout.valid])\n    played = ",
        PPO + "the_first_gradient_step_sees_ratios_of_one_whatever_the_normalizer_learns_from_the_rollout",
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
        "nn/descent.py",
        'self._square.copy_(state["square"])',
        "pass",
        "run/test_checkpoint.py",
    ),
    (
        "Adam without its bias correction",
        "nn/descent.py",
        "new_tensor([-1, -0.5])",
        "new_tensor([0, -0.5])",
        "test_descent.py",
    ),
    (
        "Adam without that of the squares",
        "nn/descent.py",
        "new_tensor([-1, -0.5])",
        "new_tensor([-1, 0])",
        "test_descent.py",
    ),
    ("the gradient is not clipped", "nn/descent.py", ".clamp(max=1)", ".clamp(min=1, max=1)", "test_descent.py"),
    ("the gradient is added up", "nn/descent.py", "self._gradient.zero_()", "self._gradient", "test_descent.py"),
    ("ignored rewards are counted", "nn/normalizer.py", ".double() * rollout.valid", ".double()", "test_nn.py"),
    (
        "rewards are clipped unasked",
        "algos/ppo.py",
        "outcome = (rollout.reward,",
        "outcome = (rollout.reward.clamp(-10, 10),",
        PPO + "rewards_of_any_size_are_learned_from_as_they_are_unless_scaling_is_asked_for",
    ),
    ("returns run on over the end", "nn/normalizer.py", "self.running * ~done", "self.running * 1", "test_nn.py"),
    (
        "an episode is counted with its last step missing",
        "envs/books.py",
        "after_end[:1]), after_end[:-1]]",
        "after_end[:0]), after_end]",
        "envs/test_episodes.py",
    ),
    ("fragments are counted", "envs/books.py", "done & whole]", "done & (whole | done)]", "envs/test_episodes.py"),
    (
        "a masked action may be chosen",
        "nn/policies.py",
        "== 0, -1e9)",
        "== 0, 0.0)",
        PPO + "it_learns_in_spaces_of_every_kind",
    ),
    (
        "noise 0 chooses what is impossible",
        "maths/discrete.py",
        "cumulative <= noise",
        "cumulative < noise",
        "maths/test_distributions.py",
    ),
    (
        "native programs are mixed up",
        "nn/native.py",
        "compile(_own(function)",
        "compile((function)",
        "test_descent.py::test_the_two_engines_agree[programs_are_not_mixed_up()]",
    ),
    ("noise that grows", "maths/noise.py", " * math.sqrt(1 - phi * phi)", "", "maths/test_noise.py"),
    (
        "noise that forgets too fast",
        "maths/noise.py",
        "math.exp(-1 / time)",
        "math.exp(-2 / time)",
        "maths/test_noise.py",
    ),
    ("power where amplitude was meant", "maths/noise.py", "(-exponent / 2)", "(-exponent)", "maths/test_noise.py"),
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
        "the KL turned round",
        "algos/trpo.py",
        "pi(here, batch.obs).kl(",
        "-pi(here, batch.obs).kl(",
        ROAD + "trpo_keeps_its_promises_after_every_step",
    ),
    (
        "curvature turned round",
        "maths/trust_region.py",
        "here.kl(there)",
        "-here.kl(there)",
        "maths/test_trust_region.py",
    ),
    (
        "the values in the Fisher matrix",
        "algos/trpo.py",
        "FlatPolicy(self.policy)",
        "FlatPolicy(self.networks)",
        ROAD + "trpos_policy_step_leaves_the_critic_alone_and_the_critics_the_policy",
    ),
    ("damping forgotten", "algos/trpo.py", " + config.damping * vector", "", ROAD + "damping_shortens_the_step"),
    (
        "a step that is not taken back",
        "maths/trust_region.py",
        "return start, 0.0",
        "return point, 0.0",
        "maths/test_trust_region.py",
    ),
    ("any KL will do", "maths/trust_region.py", " and kl <= max_kl", "", "maths/test_trust_region.py"),
    ("any loss will do", "maths/trust_region.py", "loss < before and ", "", "maths/test_trust_region.py"),
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
        ROAD + "an_action_is_paid_with_what_followed_it_or_with_the_whole_episode",
    ),
    (
        "the baseline is added",
        "algos/reinforce.py",
        "paid - baseline",
        "paid + baseline",
        ROAD + "an_action_is_paid_with_what_followed_it_or_with_the_whole_episode",
    ),
    (
        "fragments among whole episodes",
        "data/rollout.py",
        "(ended >= 1) & ",
        "",
        ROAD + "whole_episodes_are_whole_and_as_many_from_each_copy",
    ),
    (
        "quick copies play more episodes",
        "data/rollout.py",
        " & (ended <= episodes)",
        "",
        ROAD + "whole_episodes_are_whole_and_as_many_from_each_copy",
    ),
    (
        "every attempt is a tenth",
        "algos/trpo.py",
        '"attempts": config.attempts',
        '"attempts": 10',
        ROAD + "trpo_shortens_a_step_that_is_too_long",
    ),
    (
        "the entropy of a policy costs",
        "algos/reinforce.py",
        "loss - config.entropy_coef",
        "loss + config.entropy_coef",
        ROAD + "the_entropy_bonus_pays_for_entropy",
    ),
    (
        "weights are never standardized",
        "algos/reinforce.py",
        "standardize(batch.advantage) if config.standardize else",
        "",
        ROAD + "weights_are_standardized_only_where_that_is_asked_for",
    ),
    (
        "rewards are never scaled",
        "algos/a2c.py",
        "rollout = state.reward_scale.follow(rollout)",
        "state.reward_scale.follow(rollout)",
        ROAD + "rewards_of_any_size_are_learned_from_as_they_are_unless_scaling_is_asked_for",
    ),
    (
        "the critic learns as fast at the end",
        "algos/trpo.py",
        "state.critic(batch, parts, rate)",
        "state.critic(batch, parts, config.critic_learning_rate)",
        ROAD + "steps_shrink_to_nothing_where_they_are_told_to",
    ),
    (
        "the target critic is the critic",
        "algos/ddpg.py",
        "targets.critic(batch",
        "critic(batch",
        MEMORY + "ddpgs_target_is_of_the_target_networks_alone",
    ),
    (
        "the policy climbs down",
        "algos/ddpg.py",
        "loss = -critic(",
        "loss = critic(",
        MEMORY + "the_actors_gradient_is_that_of_q_through_the_action",
    ),
    (
        "a time-out is remembered as a death",
        "data/replay.py",
        "step.next_obs, step.terminated)",
        "step.next_obs, step.terminated | step.truncated)",
        MEMORY + "time_outs_bootstrap_and_reset_rows_teach_nothing",
    ),
    (
        "reset rows are remembered",
        "data/replay.py",
        "rows if step.valid.all() else rows[step.valid]",
        "rows",
        MEMORY + "time_outs_bootstrap_and_reset_rows_teach_nothing",
    ),
    (
        "the next observation is that after the reset",
        "data/replay.py",
        "step.reward, step.next_obs,",
        "step.reward, step.obs,",
        MEMORY + "what_is_remembered_is_what_happened",
    ),
    (
        "the higher of two is believed",
        "algos/td3.py",
        "next_action).amin(0)",
        "next_action).amax(0)",
        MEMORY + "td3s_target_is_the_lower_of_two_at_a_noisy_action",
    ),
    (
        "a target without noise",
        "algos/td3.py",
        ".sample((config.target_noise * noise).clamp(-limit, limit))",
        ".mode()",
        MEMORY + "td3s_target_is_the_lower_of_two_at_a_noisy_action",
    ),
    (
        "noise on the target that is not clipped",
        "algos/td3.py",
        ".clamp(-limit, limit)",
        "",
        MEMORY + "td3s_target_is_the_lower_of_two_at_a_noisy_action",
    ),
    (
        "entropy costs",
        "algos/sac.py",
        "amin(0) - temperature()",
        "amin(0) + temperature()",
        MEMORY + "sacs_target_is_the_lower_of_two_less_the_price_of_the_action",
    ),
    (
        "the temperature runs away",
        "algos/sac.py",
        "temperature_loss = -(",
        "temperature_loss = (",
        MEMORY + "sacs_policy_is_paid_for_entropy_and_its_temperature_steers_it",
    ),
    (
        "the policy hates entropy",
        "algos/sac.py",
        "(alpha.detach() *",
        "(-alpha.detach() *",
        MEMORY + "sacs_policy_is_paid_for_entropy_and_its_temperature_steers_it",
    ),
    (
        "noise is not told of ends",
        "algos/sac.py",
        "state.action_noise.cut(step.terminated | step.truncated | ~step.valid)",
        "",
        MEMORY + "an_episode_hears_a_sequence_from_its_beginning",
    ),
    (
        "noise for rows that were ignored",
        "algos/td3.py",
        " | ~step.valid",
        "",
        MEMORY + "an_episode_hears_a_sequence_from_its_beginning",
    ),
    (
        "statistics of rows that were ignored",
        "algos/ddpg.py",
        "state.policy.observe(obs[step.valid])",
        "state.policy.observe(obs)",
        MEMORY + "the_normalizer_learns_from_what_is_remembered_and_nothing_else",
    ),
    (
        "a time-out ends the entropy",
        "run/q_bias.py",
        " + networks.entropy_bonus(last, self._generator)",
        "",
        "run/test_q_bias.py",
    ),
    (
        "Q learns as fast at the end",
        "algos/sac.py",
        "fall * config.critic",
        "config.critic",
        MEMORY + "learning_rates_fall_linearly_over_the_run",
    ),
    (
        "an update at every step",
        "algos/td3.py",
        " and state.step // env.num_envs % config.update_every == 0",
        "",
        MEMORY + "as_many_gradient_steps_are_taken_as_announced",
    ),
    ("Q is the higher one", "nn/actor_critic.py", "value.amin(0)", "value.amax(0)", "run/test_q_bias.py"),
    (
        "a time-out is worth nothing",
        "run/q_bias.py",
        "realised + self._gamma**age * value * ~step.terminated",
        "realised",
        "run/test_q_bias.py",
    ),
    (
        "the first turns are everyone's",
        "nn/joint.py",
        "turns[done : done + len(chunk[0])]",
        "turns[: len(chunk[0])]",
        MEMORY + "many_steps_are_several_calls_of_the_same_size",
    ),
    (
        "every step is the first",
        "nn/descent.py",
        "self._count.add_(1)",
        "self._count.fill_(1)",
        "test_descent.py::test_it_is_torchs_adam",
    ),
    (
        "the delay is forgotten",
        "algos/td3.py",
        "(state.updates + k) % config.policy_delay == 0",
        "True",
        MEMORY + "each_step_moves_what_it_should",
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
    ("one seed is ranked", "report/compare.py", "len(one.finals(scores)) > 1", "one.finals(scores)", "test_compare.py"),
    (
        "the learning rate adapts the wrong way",
        "maths/schedules.py",
        "1 / 1.5 if kl > 2",
        "1 / 1.5 if kl < 2",
        "maths/test_schedules.py",
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
    assert re.search(r"^E +(assert|AssertionError|Failed: DID NOT RAISE)", said, re.MULTILINE), said[-2000:]
