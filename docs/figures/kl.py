"""The normal distribution that is nearest to two peaks, by KL(p ‖ q) and by KL(q ‖ p).

.venv/bin/python docs/figures/kl.py [FILE]
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

PEAKS, WIDTH, SHARES = (-2.0, 2.0), 0.5, (0.6, 0.4)
X = torch.linspace(-7, 7, 2_801, dtype=torch.float64)


def log_normal(mean, std):
    """Log N(x; mean, std²) on the grid."""
    return torch.distributions.Normal(mean, std).log_prob(X)


def log_peaks():
    """Log p(x) on the grid: a mixture of two normals."""
    parts = [log_normal(peak, WIDTH) + torch.tensor(share).log() for peak, share in zip(PEAKS, SHARES, strict=True)]
    return torch.stack(parts).logsumexp(0)


def kl(log_p, log_q):
    """KL(p ‖ q) = ∫ p (log p − log q) dx, by the trapezoidal rule."""
    return torch.trapezoid(log_p.exp() * (log_p - log_q), X)


def nearest(divergence, mean):
    """(mean, std) at which a divergence of log q is smallest, from that mean on."""
    theta = torch.tensor([mean, 0.0], dtype=torch.float64, requires_grad=True)  # mean, log std
    optimizer = torch.optim.LBFGS([theta], max_iter=200, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        value = divergence(log_normal(theta[0], theta[1].exp()))
        value.backward()
        return value

    optimizer.step(loss)
    return theta[0].item(), theta[1].exp().item()


def fits():
    """{direction: (mean, std, the other direction's KL)}; of the reverse one's two minima the lower."""
    log_p = log_peaks()
    return {
        "forward, KL(p ‖ q)": nearest(lambda log_q: kl(log_p, log_q), 0.5),
        "reverse, KL(q ‖ p)": nearest(lambda log_q: kl(log_q, log_p), -1.0),
    }


def draw():
    """Both, over the two peaks."""
    log_p = log_peaks()
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, (name, (mean, std)) in zip(figure.subplots(1, 2, sharey=True), fits().items(), strict=True):
        log_q = log_normal(mean, std)
        axes.fill_between(X, log_p.exp(), color="#d3d7cf", lw=0, label="p")
        both = f"KL(p ‖ q) = {kl(log_p, log_q):.2f}\n      KL(q ‖ p) = {kl(log_q, log_p):.2f}"
        axes.plot(X, log_q.exp(), color="#3465a4", linewidth=1.8, label=f"q:  {both}")
        axes.set_title(f"the nearest by the {name}", loc="left", fontsize=11)
        axes.set(xlim=(-5, 5), ylim=(0, 0.85), xlabel="x")
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "kl.png", dpi=130)
