"""What `swath` offers from the ground: one module a command, with HELP, add_arguments(parser) and run(arguments).

A command is imported for one line of `swath --help`, so it imports what it needs to work inside `run`.
"""
