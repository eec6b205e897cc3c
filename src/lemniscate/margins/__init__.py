"""The margins of a policy: how much may be other than in training before it fails."""
