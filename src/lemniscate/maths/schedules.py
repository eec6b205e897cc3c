"""How a learning rate changes over a run."""


def linear(start: float, final_fraction: float, progress: float) -> float:
    """From `start` at progress 0 to `final_fraction` of it at progress 1, and no further."""
    return start * (1 - (1 - final_fraction) * min(1.0, progress))


def adapt_to_kl(learning_rate: float, kl: float, desired_kl: float) -> float:
    """A smaller rate after an epoch that went twice too far, a larger one after one that went half as far.

    The rule that Schulman et al. 2017, arXiv:1707.06347, section 4, have for the penalty β, applied to the step size;
    by a factor of 1.5, within [1e-6, 1e-2].
    """
    factor = 1 / 1.5 if kl > 2 * desired_kl else 1.5 if kl < desired_kl / 2 else 1.0
    return min(max(learning_rate * factor, 1e-6), 1e-2)
