"""The training state that every algorithm shares."""

from typing import Any

from lemniscate.nn.policies import Policy


class TrainState:
    """Training state; saved whole in every checkpoint. An algorithm adds its networks, optimizers and counters."""

    networks: Any
    step: int

    @property
    def policy(self) -> Policy:
        """The policy that acts and is evaluated."""
        return self.networks.policy

    def on_restart(self) -> None:
        """What follows episodes forgets them: the environments have been restarted."""
        for part in vars(self).values():
            if hasattr(part, "restart"):
                part.restart()

    def on_warm_start(self) -> None:
        """Called when networks of another run have been loaded into `networks`: target networks become copies again."""

    def compile(self) -> None:
        """Compile what is called at every step, from the next call on."""
        for part in (self.policy, *vars(self).values()):
            if hasattr(part, "make_native"):
                part.make_native()
