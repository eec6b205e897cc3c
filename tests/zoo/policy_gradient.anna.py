# === right: one line
def policy_gradient(log_prob, weight):
    return -(log_prob * weight).mean()

# === right: own names, the weights detached, a sum divided by numel
import torch


def policy_gradient(logp: torch.Tensor, psi: torch.Tensor) -> torch.Tensor:
    """REINFORCE: minus E[log pi * Psi]."""
    psi = psi.detach()
    total = torch.sum(logp * psi)
    return -total / logp.numel()

# === right: a loop over the batch
def policy_gradient(log_prob, weight):
    loss = 0.0
    for lp, w in zip(log_prob, weight):
        loss = loss - lp * w
    return loss / len(log_prob)

# === right: a dot product
import torch


def policy_gradient(log_prob, weight):
    n = log_prob.shape[0]
    return torch.dot(log_prob, -weight) / n

# === wrong: the sign: it is the objective, not the loss | sign|negat|minus|ascen|descen|maximi|opposite
def policy_gradient(log_prob, weight):
    return (log_prob * weight).mean()

# === wrong: a sum in place of a mean | \bsum|mean|averag|batch|times too|divid
def policy_gradient(log_prob, weight):
    return -(log_prob * weight).sum()

# === wrong: the log-probabilities are detached, so nothing learns | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
def policy_gradient(log_prob, weight):
    log_prob = log_prob.detach()
    return -(log_prob * weight).mean()

# === wrong: the probability in place of its logarithm | \bexp|probabilit(y|ies) in|its logarithm|logarithm|already|\blog π
import torch


def policy_gradient(log_prob, weight):
    prob = torch.exp(log_prob)
    return -(prob * weight).mean()

# === wrong: the logarithm of a logarithm | \bnan|logarithm|finite|already|twice|\blog of
import torch


def policy_gradient(log_prob, weight):
    return -(torch.log(log_prob) * weight).mean()

# === wrong: one value for each row, the mean is missing | mean|scalar|shape|averag
def policy_gradient(log_prob, weight):
    loss = -log_prob * weight
    return loss

# === wrong: the product of the means, not the mean of the products | product|each|element|row|mean|before
def policy_gradient(log_prob, weight):
    return -log_prob.mean() * weight.mean()
