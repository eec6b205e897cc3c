# === right: zip, data.copy_, as in CleanRL
def polyak(target, online, tau):
    for target_param, param in zip(target, online):
        target_param.data.copy_(tau * param.data + (1 - tau) * target_param.data)

# === right: lerp_ under no_grad
import torch


def polyak(target, online, tau):
    with torch.no_grad():
        for t, o in zip(target, online):
            t.lerp_(o, tau)

# === right: mul_ and add_, decorated by no_grad
import torch


@torch.no_grad()
def polyak(target, online, tau=0.005):
    for mine, theirs in zip(target, online, strict=True):
        mine.mul_(1.0 - tau)
        mine.add_(theirs, alpha=tau)

# === right: torch._foreach on lists
import torch


@torch.no_grad()
def polyak(target, online, tau):
    target, online = list(target), list(online)
    torch._foreach_mul_(target, 1 - tau)
    torch._foreach_add_(target, online, alpha=tau)

# === right: the step towards the online one, in place on the data
def polyak(target, online, tau):
    for old, new in zip(target, online):
        difference = new.detach() - old.detach()
        old.data += tau * difference

# === right: indexed assignment through a slice
import torch


@torch.inference_mode(False)
@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t[...] = (1 - tau) * t + tau * o

# === right: the online parameters first, with the names of the course
# call: f(online, target, tau)
def polyak(online_params, target_params, tau):
    for param, target_param in zip(online_params, target_params):
        target_param.data.copy_(param.data * tau + target_param.data * (1 - tau))

# === wrong: tau exchanged with 1 - tau | 1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor
def polyak(target, online, tau):
    for target_param, param in zip(target, online):
        target_param.data.copy_((1 - tau) * param.data + tau * target_param.data)

# === wrong: the online network is moved towards the target | direction|online.{0,40}(chang|moved)|exchang|swap|other way|revers|mixed up|confus|in place of|opposite|wrong (one|network)|unchanged|not (been )?(changed|moved|touched)|did not|nothing (moved|changed|happened)|stays|still|in.?place|not move
def polyak(target, online, tau):
    for target_param, param in zip(target, online):
        param.data.copy_(tau * param.data + (1 - tau) * target_param.data)

# === wrong: a new tensor under a name of its own, nothing in place | in.?place|unchanged|not (been )?(changed|moved)|stays|copy|did not
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t = tau * o + (1 - tau) * t

# === wrong: a list of new tensors is returned, the target stays | in.?place|unchanged|not (been )?(changed|moved)|stays|return|did not
def polyak(target, online, tau):
    return [(1 - tau) * t + tau * o for t, o in zip(target, online)]

# === wrong: only the first tensor: the return stands inside the loop | first|only|\brest\b|others|second|loop|unchanged|not (been )?(changed|moved|touched)|did not|nothing (moved|changed|happened)|stays|still|in.?place|not move
import torch


def polyak(target, online, tau):
    with torch.no_grad():
        for t, o in zip(target, online):
            t.mul_(1 - tau).add_(tau * o)
            return

# === wrong: a hard copy: tau is ignored | \bhard|copie|\bcopy|whole|1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.data.copy_(o.data)

# === wrong: tau is 0.005 whatever is asked for | 1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor|ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)
import torch

TAU = 0.005


@torch.no_grad()
def polyak(target, online, tau=TAU):
    for t, o in zip(target, online):
        t.lerp_(o, TAU)

# === wrong: the target's part is not made smaller: target + tau * online | smaller|\bsum\b|grow|shrink|1.{0,3}[-−].{0,3}(tau|τ)|(tau|τ).{0,40}(exchang|swap|ignor|not|never|always|twice|wrong|other|place)|exchang|swap|weight|ignor
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.add_(o, alpha=tau)

# === wrong: the minus of the difference is turned: away from the online one | sign|away|direction|minus|toward|other
import torch


@torch.no_grad()
def polyak(target, online, tau):
    for t, o in zip(target, online):
        t.add_(t - o, alpha=tau)
