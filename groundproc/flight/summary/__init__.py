"""What a flight log holds, in figures: accumulators fed message by message, pure but for their own sums."""
