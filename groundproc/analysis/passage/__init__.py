"""Where a vehicle can go: slope and steps of the ground (`relief`), what stands on it, and the best route (`route`)."""
