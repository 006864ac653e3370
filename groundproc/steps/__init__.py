"""The flight from logs to products."""
