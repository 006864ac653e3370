"""What people fly for, of clouds of any origin: one file a question."""
