"""Wrong versions of the maths that the suite must kill: each is written into a copy of the package and tested."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

MUTANTS = [
    # what goes wrong, file, the right line, the wrong line, the tests that must notice
    ("a time-out ends the value", "maths/returns.py", "next_value * ~terminated -", "next_value * ~done -", "maths"),
    ("a death does not", "maths/returns.py", "next_value * ~terminated -", "next_value -", "maths"),
    ("the chain runs on", "maths/returns.py", "(~done).to(delta.dtype)", "(~terminated).to(delta.dtype)", "maths"),
    ("the chain is off by one", "maths/returns.py", "decay[t] * trace", "decay[max(t - 1, 0)] * trace", "maths"),
    ("lambda is forgotten", "maths/returns.py", "gamma * lam * (", "gamma * (", "maths"),
    (
        "the target is the advantage",
        "maths/returns.py",
        "return advantage, advantage + value",
        "return advantage, advantage",
        "maths",
    ),
    ("the sign of the surrogate", "maths/losses.py", "return -torch.min(", "return torch.min(", "maths"),
    ("an optimistic bound", "maths/losses.py", "-torch.min(ratio", "-torch.max(ratio", "maths"),
    ("the clip is one-sided", "maths/losses.py", "clamp(1 - clip, 1 + clip)", "clamp(max=1 + clip)", "maths"),
    ("the smaller value error", "maths/losses.py", "error = torch.max(", "error = torch.min(", "maths"),
    ("no half in the value loss", "maths/losses.py", "0.5 * error.mean()", "error.mean()", "maths"),
    ("k3 without its control variate", "maths/stats.py", "log_ratio.exp() - 1 - log_ratio", "-log_ratio", "maths"),
    ("moments forget the distance of means", "maths/stats.py", " + delta.square() *", " + 0 * delta *", "maths"),
    ("log-prob without the std", "maths/distributions.py", "(self.log_std.sum(-1) +", "(", "maths"),
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
        "algos/ppo.py",
        "rollout.valid.flatten().nonzero()[:, 0]",
        "torch.arange(rollout.num_rows)",
        "test_ppo.py",
    ),
    ("the entropy bonus is a penalty", "algos/ppo.py", "- config.entropy_coef", "+ config.entropy_coef", "test_ppo.py"),
    (
        "the normalizer moves before the update",
        "algos/ppo.py",
        "    played = ",
        "    state.policy.observe(rollout.obs[rollout.valid])\n    played = ",
        "test_ppo.py",
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
        "learning_rate / (1 - beta_1**step)",
        "learning_rate",
        "test_descent.py",
    ),
    ("the gradient is not clipped", "nn/descent.py", ".clamp(max=1)", ".clamp(min=1, max=1)", "test_descent.py"),
    ("the gradient is added up", "nn/descent.py", "self._gradient.zero_()", "pass", "test_descent.py"),
    ("ignored rewards are counted", "nn/normalizer.py", ".double() * rollout.valid", ".double()", "test_nn.py"),
    (
        "rewards are clipped unasked",
        "algos/ppo.py",
        "outcome = (rollout.reward,",
        "outcome = (rollout.reward.clamp(-10, 10),",
        "test_ppo.py",
    ),
    ("returns run on over the end", "nn/normalizer.py", "self.running * ~done", "self.running * 1", "test_nn.py"),
    (
        "an episode is counted with its last step missing",
        "envs/books.py",
        "after_end[:1]), after_end[:-1]]",
        "after_end[:0]), after_end]",
        "envs/test_books.py",
    ),
    ("fragments are counted", "envs/books.py", "done & whole]", "done & (whole | done)]", "envs/test_books.py"),
    ("a masked action may be chosen", "nn/policies.py", "== 0, -1e9)", "== 0, 0.0)", "test_ppo.py"),
    (
        "noise 0 chooses what is impossible",
        "maths/distributions.py",
        "cumulative <= noise",
        "cumulative < noise",
        "maths",
    ),
    ("native programs are mixed up", "nn/native.py", "compile(_own(function)", "compile((function)", "test_descent.py"),
    ("noise that grows", "maths/noise.py", "math.sqrt(1 - phi * phi) *", "", "maths/test_noise.py"),
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
    ("a death bootstraps", "maths/returns.py", "gamma * next_value * ~terminated\n", "gamma * next_value\n", "maths"),
    (
        "the target runs away",
        "maths/returns.py",
        "mine.data.lerp_(theirs.data, tau)",
        "theirs.data.lerp_(mine.data, tau)",
        "maths",
    ),
    ("no correction for the squashing", "maths/distributions.py", "(normal - _log_slope(u))", "(normal)", "maths"),
    (
        "a slope that is half as steep",
        "maths/distributions.py",
        "return 2 * (math.log(2)",
        "return (math.log(2)",
        "maths",
    ),
    ("the KL turned round", "algos/trpo.py", "pi(here, batch.obs).kl(", "-pi(here, batch.obs).kl(", "test_road.py"),
    ("curvature turned round", "maths/trust_region.py", "here.kl(there)", "-here.kl(there)", "maths"),
    (
        "the values in the Fisher matrix",
        "algos/trpo.py",
        "FlatPolicy(fresh.policy)",
        "FlatPolicy(fresh)",
        "test_road.py",
    ),
    ("damping forgotten", "algos/trpo.py", " + config.damping * vector", "", "test_road.py"),
    ("a step that is not taken back", "maths/trust_region.py", "return start, 0.0", "return point, 0.0", "maths"),
    ("any KL will do", "maths/trust_region.py", " and kl <= max_kl", "", "maths"),
    ("any loss will do", "maths/trust_region.py", "loss < before and ", "", "maths"),
    ("directions that are not conjugate", "maths/trust_region.py", "(rr / before) * direction", "0", "maths"),
    ("a step up the gradient", "maths/trust_region.py", "product, -gradient", "product, gradient", "maths"),
    ("a step √2 too short", "maths/trust_region.py", "(2 * max_kl / length)", "(max_kl / length)", "maths"),
    ("KL the wrong way round", "maths/distributions.py", "other.log_std - self", "self.log_std - other", "maths"),
    ("down the policy gradient", "maths/losses.py", "-(log_prob * weight)", "(log_prob * weight)", "maths"),
    ("what went before is forgotten", "maths/returns.py", "paid + weight * to_go[t]", "weight * to_go[t]", "maths"),
    ("a reset row is an action", "algos/reinforce.py", "done | ~rollout.valid", "done", "test_road.py"),
    ("the baseline is added", "algos/reinforce.py", "paid - baseline", "paid + baseline", "test_road.py"),
    ("fragments among whole episodes", "data/rollout.py", "(ended >= 1) & ", "", "test_road.py"),
    ("quick copies play more episodes", "data/rollout.py", " & (ended <= episodes)", "", "test_road.py"),
    ("the target critic is the critic", "algos/ddpg.py", "targets.critic(batch", "critic(batch", "test_memory.py"),
    ("the policy climbs down", "algos/ddpg.py", "loss = -critic(", "loss = critic(", "test_memory.py"),
    (
        "a time-out is remembered as a death",
        "data/replay.py",
        "step.next_obs, step.terminated)",
        "step.next_obs, step.terminated | step.truncated)",
        "test_memory.py",
    ),
    (
        "reset rows are remembered",
        "data/replay.py",
        "rows if step.valid.all() else rows[step.valid]",
        "rows",
        "test_memory.py",
    ),
    (
        "the next observation is that after the reset",
        "data/replay.py",
        "step.reward, step.next_obs,",
        "step.reward, step.obs,",
        "test_memory.py",
    ),
    ("the higher of two is believed", "algos/td3.py", "next_action).amin(0)", "next_action).amax(0)", "test_memory.py"),
    (
        "a target without noise",
        "algos/td3.py",
        ".sample((config.target_noise * noise).clamp(-limit, limit))",
        ".mode()",
        "test_memory.py",
    ),
    ("noise on the target that is not clipped", "algos/td3.py", ".clamp(-limit, limit)", "", "test_memory.py"),
    ("entropy costs", "algos/sac.py", "amin(0) - temperature()", "amin(0) + temperature()", "test_memory.py"),
    ("the temperature runs away", "algos/sac.py", "temperature_loss = -(", "temperature_loss = (", "test_memory.py"),
    ("the policy hates entropy", "algos/sac.py", "(alpha.detach() *", "(-alpha.detach() *", "test_memory.py"),
    (
        "noise is not told of ends",
        "algos/sac.py",
        "state.exploration.cut(step.terminated | step.truncated)",
        "",
        "test_memory.py",
    ),
    ("Q learns as fast at the end", "algos/sac.py", "fall * config.critic", "config.critic", "test_memory.py"),
    ("an update at every step", "algos/td3.py", " and t % config.update_every == 0", "", "test_memory.py"),
    ("Q is the higher one", "nn/actor_critic.py", "value.amin(0)", "value.amax(0)", "run/test_critique.py"),
    (
        "a time-out is worth nothing",
        "run/critique.py",
        "realised + self._gamma**age * follows",
        "realised",
        "run/test_critique.py",
    ),
    ("the delay is forgotten", "algos/td3.py", "state.updates % config.policy_delay == 0", "True", "test_memory.py"),
    (
        "the ring tears rows apart",
        "data/replay.py",
        "ring[: count - room] = new[room:]",
        "ring[: count - room] = new[: count - room]",
        "data/test_replay.py",
    ),
    (
        "noise runs on over an end",
        "data/exploration.py",
        "self._position[done.cpu()] = self._length",
        "pass",
        "data/test_exploration.py",
    ),
    (
        "every copy's noise is cut",
        "data/exploration.py",
        "self._position[done.cpu()] = self._length",
        "self._position.fill_(self._length)",
        "data/test_exploration.py",
    ),
    (
        "a tie is lost",
        "report/seeds.py",
        "(1 + np.sign(difference)",
        "(1 + np.sign(difference - 1e-9)",
        "test_seeds.py",
    ),
    ("one seed is ranked", "report/compare.py", "len(one.finals(scores)) > 1", "one.finals(scores)", "test_compare.py"),
    ("the learning rate adapts the wrong way", "maths/schedules.py", "1 / 1.5 if kl > 2", "1 / 1.5 if kl < 2", "maths"),
]


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant[0].replace(" ", "-") for mutant in MUTANTS])
def test_the_suite_kills(tmp_path, mutant):
    _, name, right, wrong, tests = mutant
    shutil.copytree(ROOT / "src" / "lemniscate", tmp_path / "lemniscate")
    file = tmp_path / "lemniscate" / name
    text = file.read_text()
    assert text.count(right) == 1, f"{name} no longer has this line once: {right}"
    file.write_text(text.replace(right, wrong))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not long"]
    done = subprocess.run(
        [*command, str(ROOT / "tests" / tests)], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 1, done.stdout[-2000:]
    assert "1 failed" in done.stdout
