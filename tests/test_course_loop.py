"""Whole training loops: the solution passes; each mistake is seen inside, and in the small world that is made for it."""

import re
from contextlib import closing

import numpy as np
import pytest
import torch
from torch.nn.modules.module import _global_forward_hooks, _global_forward_pre_hooks
from torch.optim.optimizer import _global_optimizer_pre_hooks

from lemniscate import UserError, course
from lemniscate.course import inside, loop
from lemniscate.course.exercise import Note
from lemniscate.envs.vector_view import make_vec

SOLUTION = loop.solution("ppo")

CLIPPED = "ratio.clamp(1 - clip, 1 + clip) * advantage"
COLUMNS = "x, a, adv, goal, old = (column[rows] for column in columns)"
MISTAKES = {
    "no exponential": ([("log_ratio.exp()", "log_ratio")], "the ratio is exp of the difference of log-probabilities, not"),
    "1 + log": ([("log_ratio.exp()", "1 + log_ratio")], "not 1 + the difference"),
    "upside down": ([("log_ratio.exp()", "(-log_ratio).exp()")], "the ratio is upside down"),
    "sign": ([("return -torch.min(ratio", "return torch.min(ratio")], "the sign of the policy's loss is turned"),
    "max": ([("-torch.min(ratio", "-torch.max(ratio")], "the larger of the two objectives is taken"),
    "only clipped": ([(f"torch.min(ratio * advantage, {CLIPPED})", f"({CLIPPED})")], "only the clipped ratio counts"),
    "no clip": ([(CLIPPED, "ratio * advantage")], "is not clipped where it is far below 1 and above 1"),
    "half a clip": ([("clamp(1 - clip, 1 + clip)", "clamp(max=1 + clip)")], "the ratio is not clipped where it is far below 1"),
    "clip around 0": ([("clamp(1 - clip, 1 + clip)", "clamp(-clip, clip)")], "the limits of the clip are not 1 − ε and 1 + ε"),
    "mean added": ([("(adv - adv.mean())", "(adv + adv.mean())")], "the mean of the advantages is added"),
    "softmax twice": ([("Categorical(logits=out)", "Categorical(logits=out.softmax(-1))")], "a softmax of a softmax"),
    "reset": ([("        rollout, obs = collect", "        obs, _ = envs.reset()\n        rollout, obs = collect")], "reset before each rollout"),
    "chain": ([("trace = delta + gamma * lam * trace * ~done[t]", "trace = delta")], "there is no chain"),
    "no λ": ([("gamma * lam * trace", "gamma * trace")], "λ is left out"),
    "death": ([("next_value[t] * ~terminated[t]", "next_value[t]")], "a value follows a death"),
    "uncut": ([("lam * trace * ~done[t]", "lam * trace")], "the chain is cut nowhere"),
    "cut at deaths": ([("trace * ~done[t]", "trace * ~terminated[t]")], "the chain is not cut at time-outs"),
    "time-out": ([("next_value[t] * ~terminated[t]", "next_value[t] * ~done[t]")], "a time-out is taken for a death"),
    "final_obs": ([('next_obs[i] = infos["final_obs"][i]', "pass")], 'infos["final_obs"] is not used'),
    "old, again": (
        [("log_prob(a) - old,", "log_prob(a) - agent.distribution(x).log_prob(a).detach(),")],
        "the ratio is 1 in every gradient step",
    ),
    "old of other rows": (
        [(COLUMNS, "x, a, adv, goal, old = (*(column[rows] for column in columns[:4]), columns[4][: len(rows)])")],
        "the ratio is not 1 in the first gradient step: the old log-probabilities are of other rows",
    ),
    "advantage of other rows": ([(COLUMNS, f"{COLUMNS}; adv = columns[2][: len(rows)]")], "are of other rows than log π"),
    "shuffled apart": ([(COLUMNS, f"{COLUMNS}; adv = adv[torch.randperm(len(adv))]")], "nothing to do with the advantage"),
    "other actions": ([("log_prob(a) - old", "log_prob(distribution.sample()) - old")], "log π is of other actions"),
    "broadcast": ([("log_prob(a) - old, adv,", "log_prob(a) - old, adv[:, None],")], "shapes [M, 1] and [M] give [M, M]"),
    "broadcast V": ([("agent.value(x), goal", "agent.value(x)[:, None], goal")], "the mean of all targets"),
    "V's sign": ([("return 0.5 * (value", "return -0.5 * (value")], "the sign of the critic's loss is turned"),
    "no V": ([("value_loss(agent.value(x)", "value_loss(agent.value(x).detach()")], "the last layer of the critic never"),
    "target": ([("return advantage, advantage + value", "return advantage, advantage")], "V(s) is not added to the target"),
    "target, normalized": ([(COLUMNS, f"{COLUMNS}; goal = goal - columns[2].mean()")], "what moves V is off by a constant"),
    "zero_grad": ([("            optimizer.zero_grad()\n", "")], "zero_grad is missing"),
    "zero_grad of V alone": (
        [("optimizer.zero_grad()", "[p.grad.zero_() for p in agent.actor.parameters() if p.grad is not None]")],
        "zero_grad is missing",
    ),
    "zero_grad, late": ([("optimizer.step()", "optimizer.zero_grad(); optimizer.step()")], "set to zero between backward and"),
    "no step": ([("            optimizer.step()\n", "")], "no optimizer makes a step"),
    "no backward": ([("            loss.backward()\n", "")], "backward() is not called"),
    "half an optimizer": ([("Adam(agent.parameters()", "Adam(agent.actor.parameters()")], "has its parameters"),
    "one minibatch": ([("split(config.minibatch_size):", "split(config.minibatch_size)[:1]:"),
                       ("torch.randperm(len(columns[0]))", "torch.arange(len(columns[0]))")], "the same 64 of the 256 rows of a rollout are trained on"),
    "entropy": ([("loss - config.entropy_coef", "loss + config.entropy_coef"),
                 ("entropy_coef: float = 0.0", "entropy_coef: float = 0.01")], "the entropy is made smaller"),
}  # fmt: skip

STYLES = {
    "unnormalized, clipped value, entropy": [
        ("            adv = (adv - adv.mean()) / (adv.std() + 1e-8)\n", ""),
        ("value_loss(agent.value(x), goal)", "huber(agent.value(x), goal)"),
        ("entropy_coef: float = 0.0", "entropy_coef: float = 0.01"),
        ("def value_loss(", "huber = nn.functional.mse_loss\n\n\ndef value_loss("),
    ],
    "normalized once, full batch, AdamW": [
        ("            adv = (adv - adv.mean()) / (adv.std() + 1e-8)\n", ""),
        (
            "    columns = [column",
            "    advantage = (advantage - advantage.mean()) / advantage.std()\n    columns = [column",
        ),
        ("minibatch_size: int = 64", "minibatch_size: int = 256"),
        ("torch.optim.Adam(", "torch.optim.AdamW("),
    ],
    "two optimizers, float64": [
        (
            "torch.optim.Adam(agent.parameters(), lr=config.learning_rate, eps=1e-5)",
            "torch.optim.Adam(agent.actor.parameters())",
        ),
        (
            "    obs, _ = envs.reset(seed=seed)\n",
            "    update.other = torch.optim.RMSprop(agent.critic.parameters())\n    obs, _ = envs.reset(seed=seed)\n",
        ),
        ("            optimizer.zero_grad()\n", "            optimizer.zero_grad(); update.other.zero_grad()\n"),
        ("            optimizer.step()\n", "            optimizer.step(); update.other.step()\n"),
    ],
    "rewards scaled, rows drawn with replacement": [
        ("step = (obs, action, reward,", "step = (obs, action, reward / 10,"),
        ("torch.randperm(len(columns[0])).split(", "torch.randint(len(columns[0]), (len(columns[0]),)).split("),
    ],
}


def program(changes=()):
    """`train` of the solution with some of its lines changed."""
    text = SOLUTION
    for right, wrong in changes:
        assert text.count(right) == 1
        text = text.replace(right, wrong)
    scope = {"__name__": "mine"}
    exec(compile(text, "mine.py", "exec"), scope)
    return scope["train"]


def inside_of(train, seed=1):
    return inside.judged(inside.watched(lambda envs: train(envs, 60_000, seed), train.__globals__))


QUICK = ("no exponential", "upside down", "half a clip", "death", "clip around 0", "time-out", "final_obs", "old, again", "broadcast",
         "target", "zero_grad", "half an optimizer", "one minibatch", "entropy")  # fmt: skip
"""one of each kind; the long tests take all"""


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in MISTAKES])
@pytest.mark.one_in(2)
def test_a_mistake_is_seen_inside(name):
    changes, words = MISTAKES[name]
    assert words in inside_of(program(changes)).sentence


@pytest.mark.parametrize("style", [None, *STYLES])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_right_loop_is_proved_right_inside_in_any_style(style, seed):
    assert inside_of(program(STYLES.get(style, ())), seed) == inside.Verdict(None, True)


def test_what_is_not_understood_is_no_finding():
    dropout = [
        ("nn.Tanh(), layer(64, outputs, last_gain)", "nn.Tanh(), nn.Dropout(0.1), layer(64, outputs, last_gain)")
    ]
    own_observations = [
        (
            "        self.actor, self.critic =",
            "        self.register_forward_pre_hook(lambda *_: None)\n        self.actor, self.critic =",
        ),
        ("out = self.actor(obs)\n        return Categorical", "out = self.actor(obs / 2)\n        return Categorical"),
        ("self.critic(obs)", "self.critic(obs / 2)"),
    ]
    penalty = [
        (
            "            loss = policy_loss + ",
            "            loss = policy_loss + (old - distribution.log_prob(a)).exp().mean() + ",
        )
    ]
    for changes in (dropout, own_observations, penalty):
        assert inside_of(program(changes)) == inside.Verdict(None, False)


def test_the_hooks_are_gone_afterwards_whatever_happens():
    def train(envs, total_steps, seed):
        envs.reset(seed=seed)
        raise KeyboardInterrupt

    before = [len(hooks) for hooks in (_global_forward_hooks, _global_forward_pre_hooks, _global_optimizer_pre_hooks)]
    with pytest.raises(KeyboardInterrupt):
        inside_of(train)
    assert [
        len(hooks) for hooks in (_global_forward_hooks, _global_forward_pre_hooks, _global_optimizer_pre_hooks)
    ] == before


def better_action(train, number, steps=2_048):
    """Whether a loop takes the better action of a small world."""
    with closing(make_vec(loop.WorldEnv, loop.NUM_ENVS, env_kwargs={"world": number})) as envs:
        return loop._mean_action(train, envs, steps) < 0.5


@pytest.mark.parametrize(("name", "number"), [("sign", 0), ("chain", 1), ("death", 2), ("uncut", 3), ("cut at deaths", 4),
                                              ("time-out", 5), ("final_obs", 6)])  # fmt: skip
@pytest.mark.one_in(3)
def test_a_mistake_shows_in_the_world_that_is_made_for_it(name, number):
    assert not better_action(program(MISTAKES[name][0]), number, 1_024)


@pytest.mark.parametrize("number", [1, 6])
def test_the_solution_finds_the_better_action_of_the_hardest_worlds(number):
    assert better_action(program(), number, 1_024)


@pytest.mark.parametrize(("rollout", "tried"), [(130, [256, 1_024, 8_192]), (32, [256, 1_024])])
def test_a_loop_with_long_rollouts_has_the_steps_that_it_needs(rollout, tried, monkeypatch):
    """130 steps of 8 environments are more than four times the usual steps, so that it makes no update within them."""
    train, steps = program([("num_steps: int = 32", f"num_steps: int = {rollout}")]), []
    monkeypatch.setattr(loop, "STEPS", 256)
    monkeypatch.setattr(loop, "FEW_GRADIENT_STEPS", 10)

    def counted(envs, total_steps, seed):
        steps.append(total_steps)
        return train(envs, total_steps, seed)

    with closing(make_vec(loop.WorldEnv, loop.NUM_ENVS, env_kwargs={"world": 0})) as envs:
        loop._trained(counted, envs, lambda action: False)
    assert steps == tried


def test_what_is_not_understood_inside_is_judged_by_worlds_and_by_returns():
    unclear = {"inside": {"steps": {}, "events": [], "stays": []}}
    worlds = {f"world {number}": 0.0 for number in range(len(loop.WORLDS))}
    assert loop.WORLDS[2]["mistake"] in next(loop.train(unclear | worlds | {"world 2": 1.0}))
    few = unclear | worlds | {"box": [0.5, -0.5], "return": 20.0}
    assert "the mean return after 60,000 steps is 20" in next(loop.train(few))
    assert next(loop.train(few | {"return": 500.0}), None) is None


def of_box(changes, monkeypatch):
    monkeypatch.setattr(loop, "STEPS", 1_024)
    monkeypatch.setattr(inside, "judged", lambda seen: inside.Verdict(None, True))
    monkeypatch.setattr(inside, "watched", lambda start, names: {})
    seen = {}
    loop.observe_train(program(changes), seen)
    return next(loop.train(seen), None)


@pytest.mark.long
def test_a_loop_is_judged_with_box_actions_too(monkeypatch):
    assert of_box((), monkeypatch) is None
    one_each = [("Independent(Normal(out, self.log_std.exp()), 1)", "Normal(out, self.log_std.exp())")]
    assert of_box(one_each, monkeypatch).startswith("in the small world with Box actions it raised RuntimeError: ")
    other = [("action = agent.distribution(torch.as_tensor(obs)).sample().numpy()",
              "action = agent.distribution(torch.as_tensor(obs)).sample().numpy()[..., ::-1].copy()"),
             ("step = (obs, action,", "step = (obs, action[..., ::-1].copy(),")]  # fmt: skip
    assert "it takes" in of_box(other, monkeypatch)


def test_a_loop_for_discrete_actions_alone_is_right_with_a_note(monkeypatch):
    said = of_box([("action.shape[0]", "action.n")], monkeypatch)
    assert isinstance(said, Note)
    assert "has no attribute 'n', in __init__ (line " in said


def test_what_a_loop_returns_may_act_in_several_ways():
    with closing(make_vec("CartPole-v1", 3)) as envs:
        obs, right = torch.zeros(3, 4), [1, 1, 1]
        network = torch.nn.Linear(4, 2)
        network.bias.data.copy_(torch.tensor([-9.0, 9.0]))
        predicts, draws = (
            type("P", (), {"predict": lambda self, obs: (np.ones(len(obs), int), None)})(),
            type("D", (), {"get_action": lambda self, obs: torch.ones(len(obs.float()), dtype=torch.int64)})(),
        )
        for made in (predicts, draws, network, lambda obs: np.ones((len(obs), 1), int)):
            with loop.acting(made, envs) as player:
                assert player(obs).mode().tolist() == right
        with pytest.raises(TypeError, match="train returned None; it should return an agent"):
            loop.acting(None, envs)
        with pytest.raises(UserError, match=r"A policy is a run, a function, .*; not 3"), loop.acting(3, envs):
            pass


def test_a_loop_is_called_by_what_its_parameters_mean():
    def mine(total_timesteps, venv, random_seed=0, num_steps=128):
        return venv, total_timesteps, random_seed, num_steps

    class Trainer:
        def __init__(self, envs, n_steps=16):
            self.envs, self.n_steps = envs, n_steps

        def train(self, steps):
            self.seen = (self.envs, steps, self.n_steps)

    with closing(make_vec("CartPole-v1", 1)) as envs:
        assert loop.started(mine, envs, 50) == (envs, 50, 1, 128)
        assert loop.started(Trainer, envs, 50).seen == (envs, 50, 16)
        with pytest.raises(TypeError, match="its parameter config is not known"):
            loop.started(lambda envs, total_steps, config: None, envs, 50)


@pytest.mark.long
def test_the_solution_passes():
    assert str(course.check(program(), "train")) == "✓ train: right."


def test_the_skeleton_is_the_solution_with_its_gaps(tmp_path):
    file = course.skeleton("ppo", tmp_path / "mine.py")
    text = file.read_text()
    assert "solution" not in text
    assert "    python mine.py" in text
    assert text.count('raise NotImplementedError("to be written")') == SOLUTION.count("# <solution>") == 5
    kept = re.sub(r"# <solution>.*?# </solution>", "", SOLUTION, flags=re.DOTALL)
    assert (
        text.replace("python mine.py", "python ppo.py")
        .replace('raise NotImplementedError("to be written")', "")
        .split()
        == kept.split()
    )
    scope = {"__name__": "mine"}
    exec(compile(text, "mine.py", "exec"), scope)
    finding = course.check(scope["train"])
    assert "it raised NotImplementedError: to be written" in finding.sentence
    with pytest.raises(UserError, match="exists already"):
        course.skeleton("ppo", file)
    with pytest.raises(UserError, match="There is no skeleton 'sac'"):
        course.skeleton("sac", tmp_path / "sac.py")


def test_the_home_folder_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path / "..")
    assert course.skeleton("ppo", "~/mine.py") == tmp_path / "mine.py"
    assert course.start("~/course") == tmp_path / "course" / "README.md"
    assert (tmp_path / "course" / "README.md").exists()


def test_the_environments_of_a_loop_may_be_called_train_envs_and_a_number_of_them_not():
    called = loop._called(lambda train_envs, total_steps: (train_envs, total_steps), "E", 5)
    assert called == ("E", 5)
    with pytest.raises(TypeError, match="its parameter n_envs is not known"):
        loop._called(lambda n_envs, total_steps: None, "E", 5)
