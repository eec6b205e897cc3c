# === right: whole modules are taken, their parameters moved
# call: f(target_module, online_module, tau)
import torch


def polyak(target_network, online_network, tau):
    with torch.no_grad():
        for t, o in zip(target_network.parameters(), online_network.parameters()):
            t.copy_(tau * o + (1 - tau) * t)

# === right: modules, by their state dicts, online first as in the course's loop
# call: f(online_module, target_module, tau)
def polyak(source, target, tau=0.005):
    state = target.state_dict()
    for name, value in source.state_dict().items():
        state[name] = tau * value + (1.0 - tau) * state[name]
    target.load_state_dict(state)

# === right: lists or modules, whichever comes
import torch
from torch import nn


def tensors(thing):
    return thing.parameters() if isinstance(thing, nn.Module) else thing


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(tensors(target), tensors(online)):
        t.sub_(tau * (t - o))

# === right: an assignment to .data
def polyak(target, online, tau):
    for target_param, param in zip(target, online):
        target_param.data = tau * param.data + (1.0 - tau) * target_param.data

# === right: a static method of an agent
# solution: DDPG.polyak
import torch


class DDPG:
    def __init__(self, tau=0.005):
        self.tau = tau

    @staticmethod
    def polyak(target, online, tau):
        for t, o in zip(target, online):
            with torch.no_grad():
                torch.add(t * (1 - tau), o, alpha=tau, out=t)

# === right: one helper for one tensor, mapped over both
import torch


def blend(mine, theirs, tau):
    mine.data.mul_(1 - tau).add_(theirs.data * tau)


def polyak(target, online, tau):
    pairs = zip(list(target), list(online))
    any(blend(t, o, tau) for t, o in pairs)

# === right: tau as a keyword, returns the targets too
# call: f(target, online, tau=tau)
import torch


def polyak(target, online, *, tau=0.005):
    moved = []
    for t, o in zip(target, online):
        t.data.copy_(torch.lerp(t.data, o.data, tau))
        moved.append(t)
    return moved

# === wrong: the target is zipped with itself | unchanged|not (been )?(changed|moved|touched)|did not|nothing (moved|changed|happened)|stays|still|in.?place|not move|itself|ignor|online.{0,30}not
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(list(target), list(target)):
        t.lerp_(o, tau)

# === wrong: in place on leaves that need a gradient, without no_grad | leaf|gradient|no_grad|in.?place|RuntimeError
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t *= 1 - tau
        t += tau * o

# === wrong: the last tensor is left out | \blast|left out|leaves|missing|\ball\b|range|unchanged|not (been )?(changed|moved|touched)|did not|nothing (moved|changed|happened)|stays|still|in.?place|not move
import torch


@torch.no_grad()
def polyak(target, online, tau):
    target, online = list(target), list(online)
    for i in range(len(target) - 1):
        target[i].copy_(tau * online[i] + (1 - tau) * target[i])

# === wrong: the biases are left out, only matrices move | bias|vector|dimension|1-?d\b|only|left out|\bdim|unchanged|not (been )?(changed|moved|touched)|did not|nothing (moved|changed|happened)|stays|still|in.?place|not move
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        if t.dim() > 1:
            t.lerp_(o, tau)

# === wrong: tau twice, applied once more | twice|squar|\btwo\b|once more|1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.lerp_(o, tau)
        t.lerp_(o, tau)

# === wrong: mul_ after add_: the new part is made smaller, too | \border|after add|before mul|1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.add_(o, alpha=tau).mul_(1 - tau)

# === wrong: the target and the online one share memory afterwards | \bshare|same (tensor|memory|object)|alias|online.{0,40}(chang|moved)|\bcopy|memory
import torch


def polyak(target, online, tau):
    for t, o in zip(target, online):
        blended = tau * o.data + (1 - tau) * t.data
        o.data.copy_(blended)
        t.data = o.data

# === wrong: the plain average, a half of each | \bhalf|average|1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor|ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.copy_((t + o) / 2)

# === wrong: an endless loop: the flag is never set | \bin time|seconds|endless|limit|forever|loop|never ends|does not end|too long
import torch


@torch.no_grad()
def polyak(target, online, tau):
    done = False
    while not done:
        for t, o in zip(target, online):
            t.lerp_(o, tau)

# === wrong: it leaves the interpreter | exit|SystemExit|leave|quit
import sys


def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.data.copy_(tau * o.data + (1 - tau) * t.data)
    sys.exit(0)

# === wrong: lerp, not lerp_: the result is thrown away | in.?place|unchanged|not (been )?(changed|moved)|stays|lerp|did not
import torch


def polyak(target, online, tau):
    with torch.no_grad():
        for t, o in zip(target, online):
            torch.lerp(t, o, tau)

# === wrong: the numbers are rounded to half precision on the way | precision|half|round|float16|dtype|close
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.copy_((1 - tau) * t.half() + tau * o.half())
