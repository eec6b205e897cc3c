"""From steps to rollouts to minibatches."""
