"""Methods as they stand in a course's classes: what they use of `self` is there, and their mistakes are named."""

from functools import partial

import pytest
import torch

from lemniscate import course


class Trainer:
    """The drone's, as a student would write it."""

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        trace = 0
        for t in reversed(range(self.config.n_steps)):
            goes_on = 1 - self.terminated_buffer[t]
            following = next_value if t == self.config.n_steps - 1 else self.values_buffer[t + 1]
            delta = self.rewards_buffer[t] + self.config.gamma * following * goes_on - self.values_buffer[t]
            advantages[t] = trace = delta + self.config.gamma * self.config.gae_lambda * goes_on * trace
        return advantages + self.values_buffer, advantages

    def calculate_pg_loss(self, mb_advantages, ratio):
        clipped = torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        return torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        error = (newvalue - b_returns[mb_inds]) ** 2
        if if_clip:
            eps = self.config.clip_coef
            near = b_values[mb_inds] + torch.clamp(newvalue - b_values[mb_inds], -eps, eps)
            error = torch.max(error, (near - b_returns[mb_inds]) ** 2)
        return 0.5 * error.mean()


class PPO:
    """The lander's."""

    def compute_advantages(self, states, rewards, next_states, terminations):
        values, following = self.compute_values(states), self.compute_values(next_states)
        advantages = []
        for t in reversed(range(len(rewards))):
            if (t + 1) % self.num_steps == 0:
                trace = 0.0
            goes_on = 1 - terminations[t].float()
            delta = rewards[t] + self.gamma * following[t] * goes_on - values[t]
            trace = delta + self.gamma * self.lmbda * goes_on * trace
            advantages.append(trace)
        advantages = torch.stack(advantages[::-1])
        return advantages.detach(), (advantages + values).detach()

    def compute_loss(self, states, actions, advantages, critic_targets, log_probs_old):
        ratio = (self.compute_log_probs(states, actions) - log_probs_old).exp()
        clipped = torch.clamp(ratio, 1 - self.epsilon, 1 + self.epsilon)
        values = self.critic(states).squeeze(-1)
        return -torch.min(ratio * advantages, clipped * advantages).mean(), ((critic_targets - values) ** 2).mean()


METHODS = [
    *(Trainer.calculate_advantages, Trainer.calculate_pg_loss, Trainer.calculate_v_loss),
    *(PPO.compute_advantages, PPO.compute_loss),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__)
def test_a_method_is_judged_as_it_stands_in_its_class(method):
    assert course.check(method)
    assert course.check(getattr(object.__new__(Trainer if method in METHODS[:3] else PPO), method.__name__))


@pytest.mark.parametrize("converted", [torch.Tensor.detach, lambda x: torch.tensor(x.numpy())])
def test_the_gradient_of_a_loss_is_that_in_the_networks(converted):
    class Mine(PPO):
        def compute_loss(self, states, *rows):
            return PPO.compute_loss(self, converted(states), *rows)

    class Theirs(PPO):
        def compute_loss(self, states, actions, *rows):
            self.compute_log_probs = partial(cut, self.compute_log_probs)
            return PPO.compute_loss(self, converted(states), actions, *rows)

    def cut(log_probs, *arguments):
        return log_probs(*arguments).detach()

    assert course.check(Mine.compute_loss)
    assert "no gradient" in course.check(Theirs.compute_loss).sentence


def given_loop(delta):
    """The loop that the drone's course gives, with the `delta` that is to be filled in."""

    def calculate_advantages(self, next_value):
        advantages, trace, last = torch.zeros_like(self.rewards_buffer), 0, len(self.rewards_buffer) - 1
        for t in reversed(range(last + 1)):
            goes_on = 1 - self.terminated_buffer[min(t + 1, last)]
            following = next_value if t == last else self.values_buffer[t + 1]
            missing = delta(self.rewards_buffer[t], self.config.gamma, following, goes_on, self.values_buffer[t])
            advantages[t] = trace = missing + self.config.gamma * self.config.gae_lambda * goes_on * trace
        return advantages + self.values_buffer, advantages

    return calculate_advantages


def test_the_loop_that_the_drone_course_gives_can_be_filled_in_and_its_late_row_is_noted():
    finding = course.check(given_loop(lambda r, gamma, n, goes_on, v: r + gamma * n * goes_on - v))
    assert finding
    assert finding.sentence.startswith("right. Note: the loop that the course gives reads the flags one row too late")


@pytest.mark.parametrize(
    ("delta", "words"),
    [
        (lambda r, gamma, n, goes_on, v: r + gamma * n - v, "1 − terminated is left out of δ"),
        (lambda r, gamma, n, goes_on, v: r + gamma * n * goes_on, "V(s) is not subtracted"),
        (lambda r, gamma, n, goes_on, v: r + n * goes_on - v, "γ is left out of δ"),
    ],
)
def test_a_wrong_delta_in_the_loop_that_the_course_gives_is_named(delta, words):
    finding = course.check(given_loop(delta))
    assert not finding
    assert f"Likely: {words}" in finding.sentence
    assert "also, the flags are read one row too late" in finding.sentence


def test_the_numbers_of_the_drone_course_are_reproduced():
    """Of its losses, that is; its advantages would be 2.38733, 1.37515, 0.3, 0.2."""

    def reference(name, case):
        exercise = course.EXERCISES[name]
        return exercise.answer(exercise.right, exercise.cases[case])["outputs"]

    _, advantages = reference("calculate_advantages", 1)
    assert advantages.flatten().tolist() == pytest.approx([3.25427, 2.29693, 1.2801, 0.2], abs=1e-4)
    losses = [reference("calculate_v_loss", case)[0].item() for case in (0, 1)]
    assert losses == pytest.approx([0.21875, 0.31625])
    assert reference("calculate_pg_loss", 0)[0].item() == pytest.approx(-0.1125)


def test_the_test_of_the_lander_course_cannot_see_a_missing_chain():
    """It has one step for each environment, where the chain is one term; the first case here is like it."""

    def compute_advantages(self, states, rewards, next_states, terminations):
        following = self.compute_values(next_states) * ~terminations
        advantages = rewards + self.gamma * following - self.compute_values(states)
        return advantages.detach(), (advantages + self.compute_values(states)).detach()

    sentence = course.check(compute_advantages).sentence
    assert sentence.startswith("case 2 of 5, four steps of one environment")
    assert "with one step for each environment, as in the course's own test, they are equal" in sentence.lower()


def test_what_a_method_wants_of_self_and_is_not_there_is_said():
    def calculate_pg_loss(self, mb_advantages, ratio):
        return self.clip_range

    assert "it raised AttributeError" in course.check(calculate_pg_loss).sentence
