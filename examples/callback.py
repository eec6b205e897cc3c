"""A callback: it sees the step, the metrics and the policy of every line of metrics, and may stop the run.

cd examples
lemniscate train ppo --env CartPole-v1 --callbacks 'callback:StopWhenSolved(threshold=400)'
python callback.py
"""

from collections.abc import Mapping

import lemniscate as lem


class StopWhenSolved:
    """Stop once the mean return of the last updates reaches a threshold.

    Args:
        threshold: of the mean return.
        updates: number of updates that the mean is taken over.
    """

    def __init__(self, threshold: float, updates: int = 5) -> None:
        self.threshold, self.updates = threshold, updates
        self.returns: list[float] = []

    def __call__(self, step: int, metrics: Mapping[str, float], policy: lem.TrainedPolicy) -> bool:
        """Whether the run is to stop."""
        if "episode/return" in metrics:
            self.returns.append(metrics["episode/return"])
        last = self.returns[-self.updates :]
        return len(last) == self.updates and sum(last) / len(last) >= self.threshold


if __name__ == "__main__":
    trained = lem.train("ppo", env="CartPole-v1", total_steps=100_000, callbacks=[StopWhenSolved(400)])
    print(f"Stopped at step {trained.policy.step}: {lem.evaluate(trained.policy, episodes=20).mean_return:.0f}")
