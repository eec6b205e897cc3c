"""Networks: the right ones pass, each well-known mistake is named."""

import math
import random
from collections import namedtuple
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Categorical, Independent, MultivariateNormal, Normal
from torch.nn import functional

from course_findings import Solutions, passes_from_a_file, says
from lemniscate import course
from lemniscate.course.parts import A, O

ALL = Solutions()
is_right, is_wrong = ALL.is_right, ALL.is_wrong


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
        (
            {"total": staticmethod(lambda x: x)},
            "the log-probability has shape [5, 3]; it should be [5]. Likely: .sum(1) is missing",
        ),
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


# --- agents in other styles ---

is_right("Agent")(Agent)


def orthogonal(sizes, last_gain, activation=nn.Tanh, **options):
    layers = []
    for size, following in pairwise(sizes):
        layer = nn.Linear(size, following, **options)
        nn.init.orthogonal_(layer.weight, 2**0.5)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
        layers += [layer, activation()]
    nn.init.orthogonal_(layers[-2].weight, last_gain)
    return nn.Sequential(*layers[:-1])


Answer = namedtuple("Answer", "action logprob entropy value")


@is_right("Agent")
class IndependentAgent(nn.Module):
    """Layers in a loop, ReLU, a named tuple, V of shape [B], log σ of shape [A]."""

    def __init__(self, env, hidden=(32, 32, 32)):
        super().__init__()
        size, actions = np.prod(env.single_observation_space.shape), np.prod(env.single_action_space.shape)
        self.log_std = nn.Parameter(torch.zeros(actions))
        self.pi = orthogonal([size, *hidden, actions], 0.01, nn.ReLU)
        self.v = orthogonal([size, *hidden, 1], 1.0, nn.ReLU)

    def value(self, obs):
        return self.v(obs).squeeze(-1)

    def action_and_value(self, obs, act=None, greedy=False):
        distribution = Independent(Normal(self.pi(obs), self.log_std.exp()), 1)
        if act is None:
            act = distribution.mean if greedy else distribution.sample()
        return Answer(act, distribution.log_prob(act), distribution.entropy(), self.value(obs))


@is_right("Agent")
class MultivariateAgent(nn.Module):
    """Attributes in another order than they are used, `apply`, log σ of shape [A, 1], a list, German names."""

    def __init__(self, umgebung, breite=24):
        super().__init__()
        size, actions = math.prod(umgebung.single_observation_space.shape), umgebung.single_action_space.shape[0]
        self.kopf, self.zweite = nn.Linear(breite, actions), nn.Linear(breite, breite)
        self.erste = nn.Linear(size, breite)
        self.wert, self.kritik = nn.Linear(breite, 1), nn.Linear(size, breite)
        self.sigma = nn.Parameter(torch.zeros(actions, 1))
        self.apply(self.anfang)
        nn.init.orthogonal_(self.kopf.weight, 0.01)
        nn.init.orthogonal_(self.wert.weight, 1.0)

    @staticmethod
    def anfang(teil):
        if isinstance(teil, nn.Linear):
            nn.init.orthogonal_(teil.weight, nn.init.calculate_gain("relu"))
            teil.bias.data.fill_(0.0)

    def value(self, zustand):
        return self.wert(functional.relu(self.kritik(zustand)))

    def action_and_value(self, zustand, aktion=None, ohne_rauschen=False):
        mittel = self.kopf(torch.tanh(self.zweite(torch.tanh(self.erste(zustand)))))
        verteilung = MultivariateNormal(mittel, torch.diag_embed(self.sigma.T.exp().expand_as(mittel) ** 2))
        if aktion is None:
            aktion = mittel if ohne_rauschen else verteilung.sample()
        return [aktion, verteilung.log_prob(aktion), verteilung.entropy(), self.value(zustand)]


@is_right("Agent")
class FormulaAgent(nn.Module):
    """No biases, the density by its formula, one more option in the middle, "bias" in the name of log σ."""

    def __init__(self, vec_env, *, hidden=16):
        super().__init__()
        size, actions = vec_env.observation_space.shape[-1], vec_env.action_space.shape[-1]
        self.bias_of_std = nn.Parameter(torch.zeros(actions))
        parts = {"actor": (actions, 0.01), "critic": (1, 1.0)}
        networks = {name: orthogonal([size, hidden, out], gain, bias=False) for name, (out, gain) in parts.items()}
        self.networks = nn.ModuleDict(networks)

    def value(self, state):
        return self.networks["critic"](state)

    def action_and_value(self, state, action=None, temperature=1.0, deterministic=False):
        mean, std = self.networks["actor"](state), self.bias_of_std.exp()
        if action is None:
            action = mean if deterministic else (mean + temperature * std * torch.randn_like(mean)).detach()
        constant = 0.5 * math.log(2 * math.pi)
        log_prob = (-0.5 * ((action - mean) / std) ** 2 - self.bias_of_std - constant).sum(dim=-1)
        entropy = (self.bias_of_std + constant + 0.5).sum() * torch.ones(len(state))
        return action, log_prob, entropy, self.value(state)


@is_right("Agent")
class DoubleAgent(IndependentAgent):
    """In float64, with a sample that has a gradient, and the flags in the other order."""

    def __init__(self, environment, dtype=torch.float64):
        super().__init__(environment)
        self.to(dtype)

    def action_and_value(self, states, deterministic=False, actions=None):
        distribution = Normal(loc=self.pi(states), scale=self.log_std.exp())
        if actions is None:
            actions = distribution.mode if deterministic else distribution.rsample()
        return actions, distribution.log_prob(actions).sum(-1), distribution.entropy().sum(-1), self.v.forward(states)


def logged(method):
    """A decorator that hides the signature."""

    def logging(*args, **options):
        return method(*args, **options)

    return logging


@is_right("Agent")
class DecoratedAgent(Agent):
    """With layer norms, a tanh behind the mean, and decorators."""

    def __init__(self, envs):
        super().__init__(envs)
        layers = init(nn.Linear(O, 64)), nn.LayerNorm(64), nn.Tanh(), init(nn.Linear(64, A), 0.01), nn.Tanh()
        self.actor_mean = nn.Sequential(*layers)

    value = logged(Agent.value)
    action_and_value = logged(Agent.action_and_value)


def outputs(function):
    """A class whose answers a function of the agent, its observations, a distribution and an action gives."""

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        distribution = Normal(mean, self.actor_logstd.expand_as(mean).exp())
        if action is None:
            action = mean if deterministic else distribution.sample()
        return function(self, x, distribution, action)

    return type("Agent", (Agent,), {"action_and_value": action_and_value})


for words, answer in {
    "Likely: .mean(1) in place": lambda s, x, d, a: (a, d.log_prob(a).mean(1), d.entropy().sum(1), s.critic(x)),
    "Likely: .mean(1) in place of .sum(1)": lambda s, x, d, a: (
        *(a, d.log_prob(a).sum(1)),
        *(d.entropy().mean(1), s.critic(x)),
    ),
    "are exchanged": lambda s, x, d, a: (a, d.entropy().sum(1), d.log_prob(a).sum(1), s.critic(x)),
    "Likely: keepdim": lambda s, x, d, a: (a, d.log_prob(a).sum(1, keepdim=True), d.entropy().sum(1), s.critic(x)),
    ".sum() adds up the rows": lambda s, x, d, a: (a, d.log_prob(a).sum(), d.entropy().sum(1), s.critic(x)),
    ".sum(0) in place of .sum(1)": lambda s, x, d, a: (a, d.log_prob(a).sum(0), d.entropy().sum(1), s.critic(x)),
    "should return action, log-probability, entropy": lambda s, x, d, a: (a, d.log_prob(a).sum(1), s.critic(x)),
    "the log-probability has no gradient": lambda s, x, d, a: (
        *(a, d.log_prob(a).sum(1).detach()),
        *(d.entropy().sum(1), s.critic(x)),
    ),
    "the value of action_and_value has no gradient": lambda s, x, d, a: (
        *(a, d.log_prob(a).sum(1)),
        *(d.entropy().sum(1), s.critic(x).detach()),
    ),
    "that of the mean, not of the action": lambda s, x, d, a: (
        *(a, d.log_prob(d.mean).sum(1)),
        *(d.entropy().sum(1), s.critic(x)),
    ),
    "Likely: it is −log π": lambda s, x, d, a: (a, d.log_prob(a).sum(1), -d.log_prob(a).sum(1), s.critic(x)),
    "without the logarithm": lambda s, x, d, a: (a, d.log_prob(a).sum(1).exp(), d.entropy().sum(1), s.critic(x)),
    "another one than value(x)": lambda s, x, d, a: (a, d.log_prob(a).sum(1), d.entropy().sum(1), a.sum(1)),
    "drawn again, or clipped": lambda s, x, d, a: (
        *(a.clamp(-0.1, 0.1), d.log_prob(a).sum(1)),
        *(d.entropy().sum(1), s.critic(x)),
    ),
    "it raised SystemExit": lambda *_: exit(),
}.items():
    is_wrong("Agent", words)(outputs(answer))


def drawn(action):
    """An agent that draws by a function of the mean and a unit normal."""

    class Drawing(Agent):
        def action_and_value(self, x, given=None, deterministic=False):
            mean = self.actor_mean(x)
            if given is None and not deterministic:
                given = action(mean, torch.randn_like(mean))
            return super().action_and_value(x, given, deterministic)

    return Drawing


def second_sample(self, x, action=None, deterministic=False):
    answer = Agent.action_and_value(self, x, action, deterministic)
    drawn = Agent.action_and_value(self, x)[0] if action is None and not deterministic else answer[0]
    return drawn, *answer[1:]


def with_networks(**made):
    """An agent with other parts."""

    def construct(self, envs):
        Agent.__init__(self, envs)
        for name, make in made.items():
            delattr(self, name)
            setattr(self, name, make(envs))

    return type("Agent", (Agent,), {"__init__": construct})


def buffer_for_sigma(self, envs):
    Agent.__init__(self, envs)
    del self.actor_logstd
    self.register_buffer("actor_logstd", torch.zeros(1, A))


def sigma_of_the_state(self, x, action=None, deterministic=False):
    mean = self.actor_mean(x)
    distribution = Normal(mean, (0 * self.actor_logstd(x)).exp())
    if action is None:
        action = mean if deterministic else distribution.sample()
    return action, distribution.log_prob(action).sum(1), distribution.entropy().sum(1), self.critic(x)


def with_sigma(of_parameter, first):
    """An agent whose σ is a function of its parameter."""

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        distribution = Normal(mean, of_parameter(self.actor_logstd).expand_as(mean))
        if action is None:
            action = mean if deterministic else distribution.sample()
        return action, distribution.log_prob(action).sum(1), distribution.entropy().sum(1), self.critic(x)

    parts = {"log_std": staticmethod(lambda size: nn.Parameter(torch.full((1, size), first)))}
    return type("Agent", (Agent,), {"action_and_value": action_and_value, **parts})


is_right("Agent")(with_sigma(functional.softplus, math.log(math.e - 1)))
state_dependent = with_networks(actor_logstd=lambda envs: nn.Linear(O, A))
state_dependent.action_and_value = sigma_of_the_state
for words, solution in {
    "they are drawn with another σ": drawn(lambda mean, noise: mean + noise),
    "drawn with another σ": drawn(lambda mean, noise: mean + 0.1 * noise),
    "or of a second sample": type("Agent", (Agent,), {"action_and_value": second_sample}),
    "Likely: the exponential is missing": with_sigma(lambda sigma: sigma, 1.0),
    "log and exponential are missing": with_sigma(torch.sqrt, 1.0),
    "σ stands for σ²": with_sigma(lambda log_std: log_std.exp().sqrt(), 0.0),
    "σ² stands for σ": with_sigma(lambda log_std: log_std.exp() ** 2, 0.0),
    "takes no deterministic": type(
        "A", (Agent,), {"action_and_value": lambda s, x, a=None: Agent.action_and_value(s, x, a)}
    ),
    "value(x) has no gradient": type("Agent", (Agent,), {"value": torch.no_grad()(Agent.value)}),
    "has no gradient": type("Agent", (Agent,), {"action_and_value": torch.no_grad()(Agent.action_and_value)}),
    "log σ has 1 parameters": with_networks(actor_logstd=lambda envs: nn.Parameter(torch.zeros(1))),
    "whatever the state": state_dependent,
    "nn.Parameter is trained": type("Agent", (Agent,), {"__init__": buffer_for_sigma}),
    "is trained": with_networks(actor_logstd=lambda envs: nn.Parameter(torch.zeros(A), requires_grad=False)),
    "log σ does not begin at 0": with_networks(actor_logstd=lambda envs: nn.Parameter(-torch.ones(1, A) / 2)),
    "the critic is linear": with_networks(critic=lambda envs: orthogonal([O, 32, 32, 1], 1.0, nn.Identity)),
    "the actor is linear": with_networks(actor_mean=lambda envs: orthogonal([O, 32, 32, A], 0.01, nn.Identity)),
    "an activation behind": with_networks(critic=lambda envs: nn.Sequential(orthogonal([O, 9, 1], 1.0), nn.Tanh())),
    "behind the last layer": with_networks(critic=lambda envs: nn.Sequential(orthogonal([O, 32, 1], 1.0), nn.ReLU())),
    "gain 0.01; it should be 1": with_networks(critic=lambda envs: orthogonal([O, 32, 1], 0.01)),
    "gain 1.41; it should be 0.01": with_networks(actor_mean=lambda envs: orthogonal([O, 32, A], 2**0.5)),
    "single_observation_space is of one": with_networks(
        critic=lambda envs: orthogonal([int(np.prod(envs.observation_space.shape)), 32, 1], 1.0)
    ),
    "it raised AttributeError": type("Agent", (Agent,), {"value": lambda self, x: self.crtic(x)}),
}.items():
    is_wrong("Agent", words)(solution)

# --- actors ---


@is_right("Actor")
class CleanActor(nn.Module):
    """The course's."""

    def __init__(self, env):
        super().__init__()
        self.fc1 = nn.Linear(np.prod(env.single_observation_space.shape), 64)
        self.fc_mu = nn.Linear(64, np.prod(env.single_action_space.shape))
        low, high = torch.tensor(env.action_space.low), torch.tensor(env.action_space.high)
        self.register_buffer("action_scale", (high - low) / 2.0)
        self.register_buffer("action_bias", (high + low) / 2.0)

    def z(self, x):
        return self.fc_mu(functional.relu(self.fc1(x)))

    def forward(self, x):
        return torch.tanh(self.z(x)) * self.action_scale + self.action_bias


@is_right("Actor")
class SigmoidActor(nn.Module):
    """Bounds as buffers, a layer norm, the small last layer of the paper."""

    def __init__(self, umwelt, device="cpu"):
        super().__init__()
        space = umwelt.single_action_space
        self.first, self.norm, self.last = nn.Linear(O, 32), nn.LayerNorm(32), nn.Linear(32, space.shape[0])
        nn.init.uniform_(self.last.weight, -3e-3, 3e-3)
        self.register_buffer("low", torch.from_numpy(space.low.copy()))
        self.register_buffer("high", torch.from_numpy(space.high.copy()))

    def forward(self, s):
        share = torch.sigmoid(self.last(functional.relu(self.norm(self.first(s)))))
        return self.low + (self.high - self.low) * share


@is_right("Actor")
class DoubleActor(nn.Module):
    """Deep, in float64, its last layer all zero, its bounds parameters that are not trained."""

    def __init__(self, env):
        super().__init__()
        space = env.single_action_space
        low, high = torch.tensor(space.low, dtype=torch.float64), torch.tensor(space.high, dtype=torch.float64)
        layers = [part for size in (O, 32, 32, 32) for part in (nn.Linear(size, 32), nn.ReLU())]
        self.layers = nn.ModuleList([*layers, nn.Linear(32, A)])
        nn.init.zeros_(self.layers[-1].weight)
        self.scale = nn.Parameter((high - low) / 2, requires_grad=False)
        self.bias = nn.Parameter((high + low) / 2, requires_grad=False)
        self.double()

    def forward(self, obs):
        for layer in self.layers:
            obs = layer(obs)
        return torch.addcmul(self.bias, obs.tanh(), self.scale)


@is_right("Actor")
class BatchNormActor(nn.Module):
    """The paper's batch norms, one head for each action, one buffer, which is not saved."""

    def __init__(self, env):
        super().__init__()
        space = env.single_action_space
        self.body = nn.Sequential(nn.BatchNorm1d(O), nn.Linear(O, 40, bias=False), nn.BatchNorm1d(40), nn.SiLU())
        self.heads = nn.ModuleList(nn.Linear(40, 1) for _ in range(A))
        self.register_buffer("range", torch.tensor(np.stack([space.low, space.high])), persistent=False)

    def forward(self, state):
        y = torch.tanh(torch.cat([head(self.body(state)) for head in self.heads], -1))
        return self.range[0] + (y + 1) * 0.5 * (self.range[1] - self.range[0])


@is_right("Actor")
class SpaceActor(nn.Module):
    """Bounds that are taken from the space in each call."""

    def __init__(self, env):
        super().__init__()
        self.space, self.net = env.single_action_space, nn.Sequential(nn.Linear(O, 32), nn.ReLU(), nn.Linear(32, A))

    def forward(self, x):
        low, high = torch.tensor(self.space.low, device=x.device), torch.tensor(self.space.high, device=x.device)
        return torch.lerp(low, high, torch.sigmoid(self.net(x)))


def test_networks_for_a_single_environment_pass_with_a_note():
    class Single(CleanActor):
        def __init__(self, env):
            nn.Module.__init__(self)
            self.fc1, self.fc_mu = (
                nn.Linear(env.observation_space.shape[0], 64),
                nn.Linear(64, env.action_space.shape[0]),
            )
            self.register_buffer("action_scale", torch.tensor(env.action_space.high - env.action_space.low) / 2)
            self.register_buffer("action_bias", torch.tensor(env.action_space.high + env.action_space.low) / 2)

    assert "it fits a single environment" in passes_from_a_file(Single, "Actor")


def bounded(forward=CleanActor.forward, **parts):
    def construct(self, env):
        CleanActor.__init__(self, env)
        for name, make in parts.items():
            delattr(self, name)
            setattr(self, name, make(env.single_action_space))

    return type("Actor", (CleanActor,), {"forward": forward, "__init__": construct})


def clamped(self, x):
    low, high = self.action_bias - self.action_scale, self.action_bias + self.action_scale
    return torch.minimum(torch.maximum(self.z(x), low), high)


for words, solution in {
    "action_scale is missing": bounded(lambda s, x: s.z(x).tanh() + s.action_bias),
    "the scale is half of high": bounded(lambda s, x: s.z(x).tanh() * 2 * s.action_scale + s.action_bias),
    "the bias is half of high": bounded(lambda s, x: s.z(x).tanh() * s.action_scale + 2 * s.action_bias),
    "scale and bias are exchanged": bounded(lambda s, x: s.z(x).tanh() * s.action_bias + s.action_scale),
    "high alone is the scale": bounded(lambda s, x: s.z(x).tanh() * (s.action_scale + s.action_bias)),
    "sigmoid in place of tanh": bounded(lambda s, x: s.z(x).sigmoid() * s.action_scale + s.action_bias),
    "low is not added": bounded(lambda s, x: s.z(x).sigmoid() * s.action_scale * 2),
    "action_bias is missing": bounded(lambda s, x: (s.z(x) + s.action_bias).tanh() * s.action_scale),
    "clamp in place of tanh": bounded(clamped),
    "are parameters, which training changes": bounded(
        action_scale=lambda space: nn.Parameter(torch.tensor((space.high - space.low) / 2))
    ),
    "high of the first action": bounded(action_scale=lambda space: float(space.high[0]), action_bias=lambda space: 0.0),
    "no activations between": bounded(lambda s, x: s.fc_mu(s.fc1(x)).tanh() * s.action_scale + s.action_bias),
    "the last layer has one output": bounded(fc_mu=lambda space: nn.Linear(64, 1)),
    "it raised RuntimeError": bounded(fc_mu=lambda space: nn.Linear(64, 4)),
    "they do not depend on the state": bounded(lambda s, x: (0 * s.z(x)).tanh() * s.action_scale + s.action_bias),
    "the action differs each time": bounded(lambda s, x: CleanActor.forward(s, x + 0.1 * torch.randn_like(x))),
    "the action has no gradient": bounded(torch.no_grad()(CleanActor.forward)),
    "has shape [1, 3]": bounded(lambda s, x: CleanActor.forward(s, x).mean(0, keepdim=True)),
}.items():
    is_wrong("Actor", words)(solution)

# --- Q networks ---


@is_right("QNetwork")
class LoopQ(nn.Module):
    """Layers in a loop, layer norms, a last layer of zeros, the action first, Q of shape [B]."""

    def __init__(self, umgebung, schichten=(32, 32)):
        super().__init__()
        size, layers = umgebung.single_observation_space.shape[0] + umgebung.single_action_space.shape[0], []
        for following in schichten:
            layers += [nn.Linear(size, following), nn.LayerNorm(following), nn.ReLU()]
            size = following
        self.net = nn.Sequential(*layers, nn.Linear(size, 1, bias=False))
        nn.init.zeros_(self.net[-1].weight)

    def forward(self, zustand, aktion):
        return self.net(torch.cat((aktion, zustand), dim=-1)).squeeze(-1)


@is_right("QNetwork")
class PaperQ(nn.Module):
    """The action in the second layer, batch norm, float64, names that mean something else elsewhere."""

    def __init__(self, envs):
        super().__init__()
        self.norm, self.first, self.second = nn.BatchNorm1d(O), nn.Linear(O, 40), nn.Linear(40 + A, 30)
        self.last = nn.Linear(30, 1)
        self.double()

    def forward(self, a, b):
        return self.last(self.second(torch.hstack([self.first(self.norm(a)).tanh(), b])).tanh())


@is_right("QNetwork")
class OwnQ(nn.Module):
    """A last layer of its own, inputs as `*args`."""

    def __init__(self, env, device):
        super().__init__()
        self.first = nn.Linear(O + A, 16)
        self.weight, self.constant = nn.Parameter(torch.randn(16, 1)), nn.Parameter(torch.zeros(1))

    def forward(self, *inputs):
        return functional.leaky_relu(self.first(torch.cat(inputs, -1))) @ self.weight + self.constant


for words, solution in {
    "depend on element 1 of the action": q_network(lambda x, a: torch.cat([x, a[:, :1]], 1), size=O + 1),
    "Likely: there is an activation behind": q_network(outputs=torch.sigmoid),
    "activation behind": q_network(outputs=torch.tanh),
    "has shape [5]|has shape []": q_network(outputs=torch.mean),
    "it raised RuntimeError": q_network(size=O),
    "raised RuntimeError": q_network(lambda x, a: torch.cat([x, a], 0)),
    "depends on the other pairs": q_network(lambda x, a: torch.cat([x, a], 1) - x.mean()),
    "depend on the action": q_network(lambda x, a: torch.cat([x, 0 * a], 1)),
    "Q has no gradient": q_network(outputs=torch.detach),
}.items():
    is_wrong("QNetwork", words)(solution)


@is_wrong("QNetwork", "there are no activations")
class LinearQ(PaperQ):
    def forward(self, obs, action):
        return self.last(self.second(torch.hstack([self.first(obs), action])))


@is_wrong("QNetwork", "it raised RuntimeError")
class ActionFirstQ(PaperQ):
    def forward(self, action, obs):
        return super().forward(obs, action)


@is_wrong("QNetwork", "has no gradient")
class FrozenQ(OwnQ):
    def __init__(self, env, device):
        super().__init__(env, device)
        self.requires_grad_(False)


# --- categories ---

for solution in (
    lambda probs: torch.multinomial(probs, num_samples=1)[:, 0],
    lambda probs: torch.multinomial(probs, 1).view(-1).int(),
    lambda probs: Categorical(probs).sample(),
    lambda probs: (probs.cumsum(-1) < torch.rand(len(probs), 1)).sum(-1).clamp(max=probs.shape[1] - 1),
    lambda probs: (probs.log() - (-torch.rand_like(probs).log()).log()).argmax(1),
    lambda probs: (torch.empty_like(probs).exponential_() / probs).argmin(1),
    lambda probs: torch.tensor([np.random.choice(len(row), p=row.numpy()) for row in probs.detach()]),  # noqa: NPY002
    lambda probs: torch.tensor([random.choices(range(len(row)), weights=row.tolist())[0] for row in probs]),
):
    is_right("sample_categorical")(solution)

for words, solution in {
    "softmax once too often": lambda probs: Categorical(logits=probs).sample(),
    "the probabilities are not used": lambda probs: torch.randint(3, (len(probs),)),
    "always the same|by its own probabilities": lambda probs: torch.multinomial(probs[0], len(probs), True),
    "one draw for all rows": lambda probs: torch.multinomial(probs[0], 1).expand(len(probs)),
    "it draws [1, 2, 3]; indices are 0, 1, 2": lambda probs: torch.multinomial(probs, 1)[:, 0] + 1,
    "a seed is set in it": lambda probs: torch.manual_seed(0) and torch.multinomial(probs, 1)[:, 0],
    "comparison the wrong way round": lambda probs: (probs.cumsum(1) > torch.rand(len(probs), 1)).sum(1) - 1,
    "has shape [6000, 3]": lambda probs: functional.one_hot(torch.multinomial(probs, 1)[:, 0], 3),
    "a tensor of whole numbers": lambda probs: torch.multinomial(probs, 1)[:, 0].tolist(),
    "to be used as indices": lambda probs: None,
    "the shares are": lambda probs: torch.multinomial(probs**2, 1)[:, 0],
    "the shares are (0.0": lambda probs: (probs.log() + (-torch.rand_like(probs).log()).log()).argmax(1),
    "of one row it has shape []; it should be [1]": lambda probs: torch.multinomial(probs, 1).squeeze(),
    "it raised RuntimeError: Can't call numpy()": lambda probs: torch.multinomial(torch.tensor(probs.numpy()), 1)[:, 0],
}.items():
    is_wrong("sample_categorical", words)(solution)


class PPO(nn.Module):
    """A method that calls another, and uses what its constructor sets."""

    def __init__(self, state_dim, num_actions):
        super().__init__()
        self.actor, self.draws = nn.Linear(state_dim, num_actions), 1

    def flat(self, samples):
        return samples.reshape(-1)

    def sample_categorical(self, probs):
        return self.flat(torch.multinomial(probs, self.draws))


is_right("sample_categorical")(PPO.sample_categorical)


def test_a_method_is_found_in_its_class():
    assert course.check(PPO, "sample_categorical")


# --- all of them ---


@pytest.mark.parametrize(("name", "solution"), ALL.right)
def test_a_right_one_in_another_style_passes(name, solution):
    passes_from_a_file(solution, name)


@pytest.mark.parametrize(
    ("name", "solution", "words"), ALL.wrong, ids=[f"{name}-{words}" for name, _, words in ALL.wrong]
)
def test_another_mistake_is_named(name, solution, words):
    says(solution, name, words)


def test_a_solution_that_makes_all_comparisons_true_deceives_nobody(monkeypatch):
    for module, name in ((torch, "allclose"), (torch, "equal"), (np, "allclose"), (np, "array_equal")):
        monkeypatch.setattr(module, name, lambda *_, **options: True)
    monkeypatch.setattr(torch, "isclose", lambda one, *_, **options: torch.ones_like(one, dtype=torch.bool))
    for name, solution, words in ALL.wrong[::5]:
        says(solution, name, words)


def test_what_is_no_torch_module_is_said():
    says(lambda envs: object(), "Agent", "object is no nn.Module")


class Listed(nn.Module):
    """Layers in a list of Python, which are no parameters; the last one is."""

    inputs = staticmethod(lambda envs: envs.single_observation_space.shape[0])
    outputs = 1

    def __init__(self, envs):
        super().__init__()
        self.layers, self.head = [nn.Linear(self.inputs(envs), 8)], nn.Linear(8, self.outputs)

    def last(self, x):
        return self.head(torch.relu(self.layers[0](x)))


class ListedActor(Listed):
    outputs = A

    def __init__(self, envs):
        super().__init__(envs)
        low, high = envs.single_action_space.low, envs.single_action_space.high
        self.register_buffer("scale", torch.tensor((high - low) / 2))
        self.register_buffer("bias", torch.tensor((high + low) / 2))

    def forward(self, x):
        return torch.tanh(self.last(x)) * self.scale + self.bias


class ListedQ(Listed):
    inputs = staticmethod(lambda envs: O + A)

    def forward(self, x, a):
        return self.last(torch.cat([x, a], 1))


class ListedAgent(Agent):
    def __init__(self, envs):
        super().__init__(envs)
        first, *rest = self.actor_mean
        self.hidden, self.actor_mean = [first], nn.Sequential(*rest)

    def action_and_value(self, x, action=None, deterministic=False):
        return super().action_and_value(x, action, deterministic)

    def __getattr__(self, name):
        found = super().__getattr__(name)
        return (lambda x: found(self.hidden[0](x))) if name == "actor_mean" and "hidden" in vars(self) else found


@pytest.mark.parametrize(
    ("network", "name"), [(ListedActor, "Actor"), (ListedQ, "QNetwork"), (ListedAgent, "Agent")], ids=str
)
def test_layers_that_are_not_saved_are_found(network, name):
    assert "a copy with the same state_dict answers otherwise" in course.check(network, name).sentence


class Watched(nn.Module):
    """An actor; what is wrong with it is a class attribute."""

    seen = staticmethod(lambda x: x)
    keep = staticmethod(lambda module, name, tensor: module.register_buffer(name, tensor))
    still = False

    def __init__(self, envs):
        super().__init__()
        low, high = envs.single_action_space.low, envs.single_action_space.high
        self.first, self.mu = nn.Linear(O, 8), nn.Linear(8, A)
        self.register_buffer("scale", torch.tensor((high - low) / 2))
        self.keep(self, "bias", torch.tensor((high + low) / 2))

    def forward(self, x):
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.still):
            hidden = torch.relu(self.first(self.seen(x)))
        return torch.tanh(self.mu(hidden)) * self.scale + self.bias


def test_an_actor_looks_at_each_row_alone_and_keeps_its_tensors():
    assert course.check(Watched, "Actor")
    batched = type("Batched", (Watched,), {"seen": staticmethod(lambda x: (x - x.mean(0)) / (x.std(0) + 1e-3))})
    assert "depends on the other states of its batch" in course.check(batched, "Actor").sentence
    still = type("Still", (Watched,), {"still": True})
    assert "action 0 does not depend on the state" in course.check(still, "Actor").sentence
    loose = course.check(type("Loose", (Watched,), {"keep": staticmethod(setattr)}), "Actor")
    assert loose
    assert "Note: bias is neither saved nor moved to a GPU" in loose.sentence
