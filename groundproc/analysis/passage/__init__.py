"""Where a vehicle can go: slope and steps of the ground (`relief`), what stands on it, what is `enclosed` unseen, the best `route`."""
