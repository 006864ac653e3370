"""Many flights, one command: what is to be flown through the steps, where files come from and go to, and who does the work."""
