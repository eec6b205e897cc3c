"""From steps to rollouts, replay and minibatches."""
