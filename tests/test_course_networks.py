"""Networks: the right ones pass, each well-known mistake is named."""

import pytest
import torch
from torch import nn
from torch.distributions import Normal

from course_findings import says
from lemniscate import course


def init(module, gain=2**0.5, bias=0.0):
    nn.init.orthogonal_(module.weight, gain)
    nn.init.constant_(module.bias, bias)
    return module


class Agent(nn.Module):
    """The course's; what is wrong with it is a class attribute."""

    shared = False
    make = staticmethod(init)
    last = 0.01
    log_std = staticmethod(lambda size: nn.Parameter(torch.zeros(1, size)))
    total = staticmethod(lambda x: x.sum(1))
    redraw = False
    pick = staticmethod(lambda mean, sample, deterministic: mean if deterministic else sample)

    def __init__(self, envs):
        super().__init__()
        size, actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
        make = self.make
        self.critic = nn.Sequential(make(nn.Linear(size, 16)), nn.Tanh(), make(nn.Linear(16, 1), 1.0))
        self.actor_mean = nn.Sequential(make(nn.Linear(size, 16)), nn.Tanh(), make(nn.Linear(16, actions), self.last))
        if self.shared:
            self.critic[0] = self.actor_mean[0]
        self.actor_logstd = self.log_std(actions)

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        distribution = Normal(mean, self.actor_logstd.expand_as(mean).exp())
        if action is None or self.redraw:
            action = self.pick(mean, distribution.sample(), deterministic)
        return action, self.total(distribution.log_prob(action)), self.total(distribution.entropy()), self.critic(x)


def small_init(module, gain=2**0.5, bias=0.0):
    return init(module, 1.0 if gain > 1 else gain, bias)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"shared": True}, "the critic and the actor share"),
        ({"make": staticmethod(lambda module, gain=1.0: module)}, "is not orthogonal"),
        ({"make": staticmethod(small_init)}, "has the gain 1; it should be √2"),
        ({"make": staticmethod(lambda module, gain=2**0.5: init(module, gain, 0.1))}, "does not begin at 0"),
        ({"last": 1.0}, "has the gain 1; it should be 0.01 so that the first actions"),
        ({"log_std": staticmethod(lambda size: torch.zeros(1, size))}, "nn.Parameter is trained and saved"),
        ({"log_std": staticmethod(lambda size: nn.Parameter(torch.ones(1, size)))}, "log σ does not begin at 0"),
        ({"total": staticmethod(lambda x: x)}, "the log-probability has shape [5, 3]. Likely: .sum(1) is missing"),
        ({"redraw": True}, "another action is returned than the one that was given"),
        ({"pick": staticmethod(lambda mean, sample, deterministic: sample)}, "the sample is returned, not the mean"),
        ({"pick": staticmethod(lambda mean, sample, deterministic: mean)}, "the mean is returned, not a sample"),
    ],
)
def test_an_agent_is_built_as_the_course_says(wrong, words):
    says(type("Agent", (Agent,), wrong), "Agent", words)


def test_the_agent_passes():
    assert str(course.check(Agent)) == "✓ Agent: right."


class Actor(nn.Module):
    """DDPG's."""

    squash = staticmethod(torch.tanh)
    space = "single_action_space"
    buffers_ = True
    use = staticmethod(lambda x, scale, bias: x * scale + bias)

    def __init__(self, env):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(env.single_observation_space.shape[0], 32), nn.ReLU(), nn.Linear(32, 3))
        space = getattr(env, self.space)
        scale, bias = torch.tensor((space.high - space.low) / 2), torch.tensor((space.high + space.low) / 2)
        if self.buffers_:
            self.register_buffer("action_scale", scale)
            self.register_buffer("action_bias", bias)
        else:
            self.action_scale, self.action_bias = scale, bias

    def forward(self, x):
        return self.use(self.squash(self.net(x)), self.action_scale, self.action_bias)


def test_an_actor_stays_between_its_bounds_and_reaches_them():
    assert str(course.check(Actor)) == "✓ Actor: right."
    batched = course.check(type("Actor", (Actor,), {"space": "action_space"}))
    assert batched
    assert "single_action_space" in batched.sentence
    says(type("A", (Actor,), {"squash": staticmethod(lambda x: x)}), "Actor", "there is no tanh")
    says(
        type("A", (Actor,), {"use": staticmethod(lambda x, scale, bias: x * scale)}), "Actor", "action_bias is missing"
    )
    says(type("A", (Actor,), {"use": staticmethod(lambda x, scale, bias: x)}), "Actor", "tanh is not scaled")
    says(type("A", (Actor,), {"use": staticmethod(lambda x, s, b: x * s / 2 + b)}), "Actor", "the actions reach only")
    says(type("A", (Actor,), {"buffers_": False}), "Actor", "register_buffer")


def q_network(inputs=lambda x, a: torch.cat([x, a], 1), outputs=lambda q: q, size=10):
    class QNetwork(nn.Module):
        def __init__(self, env):
            super().__init__()
            self.net = nn.Sequential(nn.Linear(size, 32), nn.ReLU(), nn.Linear(32, 1))

        def forward(self, x, a):
            return outputs(self.net(inputs(x, a)))

    return QNetwork


def test_a_q_network_looks_at_both_and_has_no_bounds():
    assert course.check(q_network())
    says(q_network(lambda x, a: x, size=7), "QNetwork", "does not depend on the action")
    says(q_network(lambda x, a: a, size=3), "QNetwork", "does not depend on the state")
    says(q_network(outputs=torch.relu), "QNetwork", "an activation behind the last layer")
    says(q_network(outputs=lambda q: q.expand(-1, 2)), "QNetwork", "shape [5, 2]; it should be [5, 1]")


def test_categories_are_drawn_row_by_row():
    def draw(probs):
        return torch.multinomial(probs, 1).squeeze(1)

    assert course.check(draw, "sample_categorical")
    says(lambda probs: torch.multinomial(probs, 1), "sample_categorical", ".squeeze(1) is missing")
    says(lambda probs: probs.argmax(1), "sample_categorical", "always the same")
    says(lambda probs: draw(probs.softmax(1)), "sample_categorical", "softmax once too often")
    says(lambda probs: draw(probs[:1].expand_as(probs)), "sample_categorical", "each by its own probabilities")
    says(lambda probs: draw(probs).float(), "sample_categorical", "whole numbers")
