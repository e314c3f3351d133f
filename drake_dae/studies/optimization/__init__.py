"""Numbers of a loop that are best for a cost, by exact gradients of rollouts."""
